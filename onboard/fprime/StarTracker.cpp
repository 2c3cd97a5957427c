// SPDX-License-Identifier: MIT
#include "StarTracker.hpp"

#include <cstring>

namespace Starcat {

static_assert(Numbers::SIZE == STARCAT_MAX_CENTROIDS,
              "MAX_CENTROIDS of StarTracker.fpp has to be STARCAT_MAX_CENTROIDS");

namespace {

constexpr U32 BLOCK_BYTES = 4096;  // the unit in which an image is checked

Status::T statusOf(starcat_status status) { return static_cast<Status::T>(status); }

starcat_camera cameraOf(const Camera& given) {
  starcat_camera camera;
  camera.width_px = static_cast<starcat_real>(given.get_width_px());
  camera.height_px = static_cast<starcat_real>(given.get_height_px());
  camera.focal_length_px = static_cast<starcat_real>(given.get_focalLength_px());
  camera.x0_px = static_cast<starcat_real>(given.get_x0_px());
  camera.y0_px = static_cast<starcat_real>(given.get_y0_px());
  camera.k1 = static_cast<starcat_real>(given.get_k1());
  camera.k2 = static_cast<starcat_real>(given.get_k2());
  camera.k3 = static_cast<starcat_real>(given.get_k3());
  camera.p1 = static_cast<starcat_real>(given.get_p1());
  camera.p2 = static_cast<starcat_real>(given.get_p2());
  camera.fold_radius = static_cast<starcat_real>(given.get_foldRadius());
  return camera;
}

starcat_options optionsOf(const Options& given) {
  starcat_options options;
  options.tolerance_px = static_cast<starcat_real>(given.get_tolerance_px());
  options.noise_px = static_cast<starcat_real>(given.get_noise_px());
  options.noise_mag = static_cast<starcat_real>(given.get_noise_mag());
  options.log_chance = static_cast<starcat_real>(given.get_logChance());
  options.fov_error = static_cast<starcat_real>(given.get_fovError());
  options.max_steps = given.get_maxSteps();
  return options;
}

U64 timeOf(const Centroids& given) {
  return static_cast<U64>(given.get_seconds()) * 1000000 + given.get_microseconds();
}

}  // namespace

StarTracker::StarTracker(const char* const compName) : StarTrackerComponentBase(compName) {
  std::memset(&m_places, 0, sizeof m_places);
  std::memset(&m_image, 0, sizeof m_image);
  std::memset(&m_camera, 0, sizeof m_camera);
  std::memset(m_prior, 0, sizeof m_prior);
  starcat_default_options(&m_options);
}

// ---------------------------------------------------------------------------------------------
// Settings
// ---------------------------------------------------------------------------------------------

// What the library says to a camera and to options: with them it looks at a frame of no centroids,
// for which it needs no image.
starcat_status StarTracker::check(const starcat_camera& camera, const starcat_options& options) {
  static const starcat_image noImage = {};
  static const starcat_frame noFrame = {};
  const starcat_status status =
      starcat_identify(&noImage, &camera, &options, &noFrame, &m_work, &m_result);
  return status == STARCAT_TOO_FEW_STARS ? STARCAT_IDENTIFIED : status;
}

void StarTracker::takeSettings() {
  m_isNew = false;
  m_hasPrior = false;
  Fw::ParamValid valid;
  starcat_camera camera = m_camera;
  if (!this->paramGet_CAMERA_OF_IMAGE(valid)) {
    camera = cameraOf(this->paramGet_CAMERA(valid));
  } else if (m_hasImage) {
    starcat_camera_of(&m_image, &camera);
  } else {
    return;  // taken when there is an image
  }
  const starcat_options options = optionsOf(this->paramGet_OPTIONS(valid));
  const starcat_status status = this->check(camera, options);
  if (status != STARCAT_IDENTIFIED) {
    this->log_WARNING_HI_SettingsRefused(statusOf(status));
    return;
  }
  m_camera = camera;
  m_options = options;
}

// Called by the thread that dispatches commands: the component's own takes the settings over, with
// the next frame or tick.
void StarTracker::parameterUpdated(FwPrmIdType id) {
  static_cast<void>(id);
  m_isNew = true;
}

void StarTracker::parametersLoaded() { m_isNew = true; }

// ---------------------------------------------------------------------------------------------
// Frames
// ---------------------------------------------------------------------------------------------

// Whether the last attitude is fresh enough to begin with; frames may come in any order.
bool StarTracker::isFresh(U64 time_us) {
  Fw::ParamValid valid;
  const U64 apart = time_us > m_priorTime_us ? time_us - m_priorTime_us : m_priorTime_us - time_us;
  return m_hasPrior && (apart < static_cast<U64>(this->paramGet_PRIOR_AGE_MS(valid)) * 1000);
}

// From the last attitude where there is one; lost in space with the steps that are left if not, or
// if that fails.
starcat_status StarTracker::identify(const starcat_frame& frame, bool hasPrior, Mode& mode,
                                     U32& steps) {
  Fw::ParamValid valid;
  starcat_options options = m_options;
  mode = Mode::TRACK;
  steps = 0;
  if (hasPrior) {
    const starcat_status status =
        starcat_track(&m_image, &m_camera, &options, &frame, m_prior,
                      static_cast<starcat_real>(this->paramGet_PRIOR_RAD(valid)), &m_work,
                      &m_result);
    steps = m_result.steps;
    if ((status == STARCAT_IDENTIFIED) || (steps >= options.max_steps)) {
      return status;
    }
    options.max_steps -= steps;
  }
  mode = Mode::IDENTIFY;
  const starcat_status status =
      starcat_identify(&m_image, &m_camera, &options, &frame, &m_work, &m_result);
  steps += m_result.steps;
  return status;
}

starcat_status StarTracker::answer(const Centroids& given, Mode& mode, U32& steps) {
  Fw::ParamValid valid;
  const starcat_frame frame = {given.get_count(), m_numbers[0], m_numbers[1],
                               given.get_hasMagnitudes() ? m_numbers[2] : nullptr,
                               given.get_hasSigmas() ? m_numbers[3] : nullptr};
  for (U32 n = 0; (n < given.get_count()) && (n < Numbers::SIZE); n++) {
    m_numbers[0][n] = static_cast<starcat_real>(given.get_x_px()[n]);
    m_numbers[1][n] = static_cast<starcat_real>(given.get_y_px()[n]);
    m_numbers[2][n] = static_cast<starcat_real>(given.get_magnitude()[n]);
    m_numbers[3][n] = static_cast<starcat_real>(given.get_sigma_px()[n]);
  }
  const bool isTracking = this->paramGet_TRACKING(valid);
  return this->identify(frame, isTracking && this->isFresh(timeOf(given)), mode, steps);
}

void StarTracker::count(U32 sequence, Mode mode, starcat_status status) {
  const U32 reason = m_result.reason;
  m_framesIn++;
  if (mode == Mode::NONE) {
    m_withoutImage++;
  } else if (status == STARCAT_IDENTIFIED) {
    U32& counter = mode == Mode::TRACK ? m_tracked : m_identified;
    counter++;
  } else if (((status > 0) || (status == STARCAT_E_BUDGET)) && (reason > 0) &&
             (reason <= Counts::SIZE)) {
    m_notIdentified[reason - 1]++;
  } else {
    m_errors++;
    this->log_WARNING_LO_FrameRefused(sequence, statusOf(status));
  }
  this->tlmWrite_LastStatus(statusOf(status));
}

// What the frame came to; the numbers of an attitude are zeros where there is none.
Attitude StarTracker::attitudeOf(const Centroids& given, Mode mode, starcat_status status,
                                 U32 steps) const {
  static const U32 kept[6] = {0, 1, 2, 4, 5, 8};  // the others are the same by symmetry
  Attitude attitude;
  attitude.set_sequence(given.get_sequence());
  attitude.set_seconds(given.get_seconds());
  attitude.set_microseconds(given.get_microseconds());
  attitude.set_status(statusOf(status));
  attitude.set_reason(static_cast<Reason::T>(m_result.reason));
  attitude.set_mode(mode);
  attitude.set_matched(static_cast<U16>(m_result.n_matched));
  attitude.set_usable(static_cast<U16>(m_result.n_usable));
  attitude.set_steps(steps);
  if (status == STARCAT_IDENTIFIED) {
    for (U32 n = 0; n < Quaternion::SIZE; n++) {
      attitude.get_quaternion()[n] = static_cast<F64>(m_result.q_body_from_icrs[n]);
    }
    for (U32 n = 0; n < Covariance::SIZE; n++) {
      attitude.get_covariance_rad2()[n] = static_cast<F64>(m_result.covariance_rad2[kept[n]]);
    }
    attitude.set_logChance(static_cast<F64>(m_result.log_chance));
    attitude.set_residual_rad(static_cast<F64>(m_result.residual_rad));
    attitude.set_reducedChiSquare(static_cast<F64>(m_result.reduced_chi_square));
  }
  return attitude;
}

void StarTracker::framesIn_handler(FwIndexType portNum, Starcat::Centroids& centroids) {
  static_cast<void>(portNum);
  if (m_isNew) {
    this->takeSettings();
  }
  starcat_status status = m_imageStatus;
  Mode mode = Mode::NONE;
  U32 steps = 0;
  m_result.n_matched = 0;
  m_result.n_usable = 0;
  m_result.reason = STARCAT_REASON_NONE;
  if (m_hasImage) {
    status = this->answer(centroids, mode, steps);
  }
  this->count(centroids.get_sequence(), mode, status);
  m_hasPrior = m_hasImage && (status == STARCAT_IDENTIFIED);
  if (m_hasPrior) {
    std::memcpy(m_prior, m_result.q_body_from_icrs, sizeof m_prior);
    m_priorTime_us = timeOf(centroids);
  }
  Attitude attitude = this->attitudeOf(centroids, mode, status, steps);
  if (this->isConnected_attitudesOut_OutputPort(0)) {
    this->attitudesOut_out(0, attitude);
  }
  this->report();
}

void StarTracker::report() const {
  this->tlmWrite_FramesIn(m_framesIn);
  this->tlmWrite_FramesIdentified(m_identified);
  this->tlmWrite_FramesTracked(m_tracked);
  this->tlmWrite_FramesNotIdentified(m_notIdentified);
  this->tlmWrite_FramesWithoutImage(m_withoutImage);
  this->tlmWrite_FrameErrors(m_errors);
  this->tlmWrite_ActivePlace(m_places.active);
  this->tlmWrite_Load(m_load);
  this->tlmWrite_LoadBytes(m_loadBytes);
  this->tlmWrite_ScrubBlock(m_scrubBlock);
  this->tlmWrite_ScrubPasses(m_scrubPasses);
  this->tlmWrite_DamageFound(m_damageFound);
  this->tlmWrite_BlocksMended(m_blocksMended);
  this->tlmWrite_FallBacks(m_fallBacks);
}

// ---------------------------------------------------------------------------------------------
// Images
// ---------------------------------------------------------------------------------------------

// After a start, a switch or damage: what is known of the image in use.
void StarTracker::imageInUse(starcat_status status) {
  char name[97] = {};
  m_imageStatus = status;
  m_hasImage = status == STARCAT_IDENTIFIED;
  m_scrubBlock = 0;
  if (m_hasImage) {
    std::memcpy(name, m_image.name, 96);
  }
  this->tlmWrite_ImageStatus(statusOf(status));
  this->tlmWrite_ImageName(Fw::String(name));
  this->takeSettings();
}

void StarTracker::endLoad(LoadState state) {
  m_file.close();
  m_load = state;
}

// Open the file of an image, and prepare the other place for it, or the file of a patch.
bool StarTracker::beginLoad(const char* path, U32 crc, bool isPatch) {
  FwSizeType size = 0;
  if (m_load == LoadState::READING) {
    this->endLoad(LoadState::FAILED);
  }
  starcat_status status = STARCAT_E_SHORT;
  if ((m_file.open(path, Os::File::OPEN_READ) == Os::File::OP_OK) &&
      (m_file.size(size) == Os::File::OP_OK)) {
    if (!isPatch) {
      status = starcat_receive(&m_places, static_cast<size_t>(size), crc);
    } else if (size <= m_patchCapacity) {
      status = STARCAT_IDENTIFIED;
    }
  }
  if (status != STARCAT_IDENTIFIED) {
    this->endLoad(LoadState::FAILED);
    this->log_WARNING_HI_LoadFailed(statusOf(status), 0);
    return false;
  }
  m_load = LoadState::READING;
  m_isPatch = isPatch;
  m_loadBytes = 0;
  m_loadSize = static_cast<U32>(size);
  m_checkBlock = 0;
  this->log_ACTIVITY_HI_LoadBegun(m_loadSize, Fw::String(path));
  return true;
}

void StarTracker::readPiece() {
  FwSizeType count = sizeof m_piece;
  starcat_status status = STARCAT_E_SHORT;
  if ((m_file.read(m_piece, count) != Os::File::OP_OK) || (count == 0)) {
    status = STARCAT_E_SHORT;
  } else if (m_isPatch) {
    if (count <= m_patchCapacity - m_loadBytes) {
      std::memcpy(m_patch + m_loadBytes, m_piece, static_cast<size_t>(count));
      status = STARCAT_IDENTIFIED;
    }
  } else {
    status = starcat_put(&m_places, m_loadBytes, m_piece, static_cast<size_t>(count));
  }
  if (status != STARCAT_IDENTIFIED) {
    this->endLoad(LoadState::FAILED);
    this->log_WARNING_HI_LoadFailed(statusOf(status), m_loadBytes);
    return;
  }
  m_loadBytes += static_cast<U32>(count);
  if (m_loadBytes >= m_loadSize) {
    this->endLoad(LoadState::CHECKING);
  }
}

// Check some blocks of the new image: those of checks first, as they tell of the others. A patch is
// applied instead, which makes and checks the new image in one go.
void StarTracker::checkLoaded() {
  Fw::ParamValid valid;
  const U32 blocks = m_isPatch ? 0 : m_loadSize / BLOCK_BYTES;
  const U32 some = this->paramGet_SCRUB_BLOCKS(valid) + (this->paramGet_SCRUB_BLOCKS(valid) == 0);
  U32 bad = 0;
  starcat_status status = m_isPatch ? starcat_patch(&m_places, m_patch, m_loadSize)
                                    : starcat_missing(&m_places, blocks, &bad);
  if ((status == STARCAT_IDENTIFIED) && !m_isPatch) {
    status = starcat_scrub(m_places.bytes[1 - m_places.active], m_loadSize, m_checkBlock, some,
                           &bad);
  }
  m_checkBlock += some;
  if (status != STARCAT_IDENTIFIED) {
    m_load = LoadState::FAILED;
    this->log_WARNING_HI_LoadRefused(statusOf(status), bad);
  } else if (m_checkBlock >= blocks) {
    m_load = LoadState::READY;
    this->log_ACTIVITY_HI_LoadReady();
  }
}

// Mend damage of the image in use from parity; where that cannot be, use the other image.
void StarTracker::repair(U32 block) {
  U32 mended = 0;
  m_damageFound++;
  starcat_status status =
      starcat_mend(m_places.bytes[m_places.active], m_places.size[m_places.active], &mended);
  m_blocksMended += mended;
  if (status == STARCAT_IDENTIFIED) {
    this->log_WARNING_LO_Mended(block, mended);
    return;
  }
  status = starcat_start(&m_places, &m_image);
  this->imageInUse(status);
  if (status == STARCAT_IDENTIFIED) {
    m_fallBacks++;
    this->log_WARNING_HI_FellBack(block, m_places.active);
  } else {
    this->log_FATAL_NoImage(statusOf(status));
  }
}

void StarTracker::scrub() {
  Fw::ParamValid valid;
  const U32 some = this->paramGet_SCRUB_BLOCKS(valid) + (this->paramGet_SCRUB_BLOCKS(valid) == 0);
  U32 bad = 0;
  const starcat_status status =
      starcat_scrub(m_places.bytes[m_places.active], m_places.size[m_places.active], m_scrubBlock,
                    some, &bad);
  if (status != STARCAT_IDENTIFIED) {
    this->repair(bad);  // the same blocks are checked again in the next tick
    return;
  }
  m_scrubBlock += some;
  if (m_scrubBlock >= m_image.total_bytes / BLOCK_BYTES) {
    m_scrubBlock = 0;
    m_scrubPasses++;
  }
}

void StarTracker::schedIn_handler(FwIndexType portNum, U32 context) {
  static_cast<void>(portNum);
  static_cast<void>(context);
  Fw::ParamValid valid;
  if (m_isNew) {
    this->takeSettings();
  }
  if (m_load == LoadState::CHECKING) {
    this->checkLoaded();
  } else if (m_load == LoadState::READING) {
    U32 n = 0;
    do {
      this->readPiece();
      n++;
    } while ((n < this->paramGet_LOAD_PIECES(valid)) && (m_load == LoadState::READING));
  } else if (m_hasImage) {
    this->scrub();
  }
  this->report();
}

// Read a file whole into the place that is not `active` then.
void StarTracker::readWhole(const char* path, U32 active) {
  m_places.active = active;
  if (this->beginLoad(path, 0, false)) {
    while (m_load == LoadState::READING) {
      this->readPiece();
    }
  }
}

void StarTracker::configure(U8* first, U8* second, FwSizeType capacity, U8* patch,
                            FwSizeType patchCapacity) {
  m_places.bytes[0] = first;
  m_places.bytes[1] = second;
  m_places.capacity = static_cast<size_t>(capacity);
  m_patch = patch;
  m_patchCapacity = patchCapacity;
}

void StarTracker::openImages(const char* path, const char* otherPath) {
  this->readWhole(path, 1);
  if (otherPath != nullptr) {
    this->readWhole(otherPath, 0);
  }
  m_places.active = 0;
  m_load = LoadState::NONE;
  const starcat_status status = starcat_start(&m_places, &m_image);
  this->imageInUse(status);
  if (status == STARCAT_IDENTIFIED) {
    char name[97] = {};
    std::memcpy(name, m_image.name, 96);
    this->log_ACTIVITY_HI_Started(statusOf(status), Fw::String(name));
  } else {
    this->log_FATAL_NoImage(statusOf(status));
  }
}

// ---------------------------------------------------------------------------------------------
// Commands
// ---------------------------------------------------------------------------------------------

void StarTracker::LOAD_IMAGE_cmdHandler(FwOpcodeType opCode, U32 cmdSeq,
                                        const Fw::CmdStringArg& path, U32 crc) {
  const bool isBegun = this->beginLoad(path.toChar(), crc, false);
  this->cmdResponse_out(opCode, cmdSeq,
                        isBegun ? Fw::CmdResponse::OK : Fw::CmdResponse::EXECUTION_ERROR);
}

void StarTracker::LOAD_PATCH_cmdHandler(FwOpcodeType opCode, U32 cmdSeq,
                                        const Fw::CmdStringArg& path) {
  const bool isBegun = this->beginLoad(path.toChar(), 0, true);
  this->cmdResponse_out(opCode, cmdSeq,
                        isBegun ? Fw::CmdResponse::OK : Fw::CmdResponse::EXECUTION_ERROR);
}

void StarTracker::SWITCH_IMAGE_cmdHandler(FwOpcodeType opCode, U32 cmdSeq) {
  const bool isBusy = (m_load == LoadState::READING) || (m_load == LoadState::CHECKING);
  starcat_image image;  // a switch that fails writes it too
  const starcat_status status = isBusy ? STARCAT_NO_MATCH : starcat_switch(&m_places, &image);
  if (status != STARCAT_IDENTIFIED) {
    this->log_WARNING_HI_SwitchRefused(statusOf(status));
    this->cmdResponse_out(opCode, cmdSeq, Fw::CmdResponse::EXECUTION_ERROR);
    return;
  }
  char name[97] = {};
  m_image = image;
  m_load = LoadState::NONE;
  this->imageInUse(status);
  std::memcpy(name, m_image.name, 96);
  this->log_ACTIVITY_HI_Switched(m_places.active, Fw::String(name));
  this->cmdResponse_out(opCode, cmdSeq, Fw::CmdResponse::OK);
}

void StarTracker::CLEAR_COUNTERS_cmdHandler(FwOpcodeType opCode, U32 cmdSeq) {
  m_framesIn = 0;
  m_identified = 0;
  m_tracked = 0;
  m_notIdentified = 0;
  m_withoutImage = 0;
  m_errors = 0;
  m_scrubPasses = 0;
  m_damageFound = 0;
  m_blocksMended = 0;
  m_fallBacks = 0;
  this->log_WARNING_LO_FrameRefused_ThrottleClear();
  this->report();
  this->cmdResponse_out(opCode, cmdSeq, Fw::CmdResponse::OK);
}

}  // namespace Starcat
