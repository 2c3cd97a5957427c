// Flies the component: 1,000 frames, tracking, images that are loaded, damaged, mended and switched.
// The handlers are called directly; what the component says comes to the members of the base class
// that fpp-to-cpp declares, which are defined here and keep it.
//
//   test_star_tracker FOLDER
//
// SPDX-License-Identifier: MIT
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <map>
#include <string>
#include <vector>

#include "StarTracker.hpp"

extern "C" {
#include "random_sky.h"
}

static unsigned checks, failures;

#define CHECK(condition)                                                   \
  do {                                                                     \
    checks++;                                                              \
    if (!(condition)) {                                                    \
      failures++;                                                          \
      std::fprintf(stderr, "%s:%d: not so: %s\n", __FILE__, __LINE__, #condition); \
    }                                                                      \
  } while (0)

// What the component said last, and what its parameters are.
static std::map<std::string, unsigned> events;
static std::map<std::string, U32> channels;
static std::string image_name;
static Starcat::Counts not_identified;
static Starcat::Status last_status;
static Starcat::Attitude attitude;
static Fw::CmdResponse::T response;
static bool camera_of_image = true, tracking = false;
static Starcat::Camera camera;
static Starcat::Options options;
static U16 scrub_blocks = 4, load_pieces = 4;

namespace Starcat {

using Base = StarTrackerComponentBase;

Base::StarTrackerComponentBase(const char* name) : Fw::ActiveComponentBase(name) {}
Base::~StarTrackerComponentBase() {}
Fw::ActiveComponentBase::MsgDispatchStatus Base::doDispatch() { return MSG_DISPATCH_OK; }
void Base::framesIn_preMsgHook(FwIndexType, Centroids&) {}
void Base::schedIn_preMsgHook(FwIndexType, U32) {}
void Base::LOAD_IMAGE_preMsgHook(FwOpcodeType, U32) {}
void Base::LOAD_PATCH_preMsgHook(FwOpcodeType, U32) {}
void Base::SWITCH_IMAGE_preMsgHook(FwOpcodeType, U32) {}
void Base::CLEAR_COUNTERS_preMsgHook(FwOpcodeType, U32) {}
void Base::parameterUpdated(FwPrmIdType) {}
void Base::parametersLoaded() {}
void Base::parameterLoaded(FwPrmIdType, Fw::ParamValid) {}

bool Base::isConnected_attitudesOut_OutputPort(FwIndexType) const { return true; }
void Base::attitudesOut_out(FwIndexType, Attitude& sent) const { attitude = sent; }
void Base::cmdResponse_out(FwOpcodeType, U32, Fw::CmdResponse given) { response = given.e; }

bool Base::paramGet_CAMERA_OF_IMAGE(Fw::ParamValid&) { return camera_of_image; }
Camera Base::paramGet_CAMERA(Fw::ParamValid&) { return camera; }
Options Base::paramGet_OPTIONS(Fw::ParamValid&) { return options; }
bool Base::paramGet_TRACKING(Fw::ParamValid&) { return tracking; }
F64 Base::paramGet_PRIOR_RAD(Fw::ParamValid&) { return 0.009; }
U32 Base::paramGet_PRIOR_AGE_MS(Fw::ParamValid&) { return 2000; }
U16 Base::paramGet_SCRUB_BLOCKS(Fw::ParamValid&) { return scrub_blocks; }
U16 Base::paramGet_LOAD_PIECES(Fw::ParamValid&) { return load_pieces; }

void Base::log_ACTIVITY_HI_Started(const Status&, const Fw::StringBase&) const {
  events["Started"]++;
}
void Base::log_WARNING_HI_SettingsRefused(const Status&) const { events["SettingsRefused"]++; }
void Base::log_ACTIVITY_HI_LoadBegun(U32, const Fw::StringBase&) const { events["LoadBegun"]++; }
void Base::log_WARNING_HI_LoadFailed(const Status&, U32) const { events["LoadFailed"]++; }
void Base::log_ACTIVITY_HI_LoadReady() const { events["LoadReady"]++; }
void Base::log_WARNING_HI_LoadRefused(const Status&, U32) const { events["LoadRefused"]++; }
void Base::log_ACTIVITY_HI_Switched(U32, const Fw::StringBase&) const { events["Switched"]++; }
void Base::log_WARNING_HI_SwitchRefused(const Status&) const { events["SwitchRefused"]++; }
void Base::log_WARNING_LO_Mended(U32, U32) const { events["Mended"]++; }
void Base::log_WARNING_HI_FellBack(U32, U32) const { events["FellBack"]++; }
void Base::log_FATAL_NoImage(const Status&) const { events["NoImage"]++; }
void Base::log_WARNING_LO_FrameRefused(U32, const Status&) { events["FrameRefused"]++; }
void Base::log_WARNING_LO_FrameRefused_ThrottleClear() {}

#define CHANNEL(name) \
  void Base::tlmWrite_##name(U32 value, Fw::Time) const { channels[#name] = value; }
CHANNEL(FramesIn)
CHANNEL(FramesIdentified)
CHANNEL(FramesTracked)
CHANNEL(FramesWithoutImage)
CHANNEL(FrameErrors)
CHANNEL(ActivePlace)
CHANNEL(LoadBytes)
CHANNEL(ScrubBlock)
CHANNEL(ScrubPasses)
CHANNEL(DamageFound)
CHANNEL(BlocksMended)
CHANNEL(FallBacks)
void Base::tlmWrite_FramesNotIdentified(const Counts& value, Fw::Time) const {
  not_identified = value;
}
void Base::tlmWrite_LastStatus(const Status& value, Fw::Time) const { last_status = value; }
void Base::tlmWrite_ImageStatus(const Status&, Fw::Time) const {}
void Base::tlmWrite_ImageName(const Fw::StringBase& value, Fw::Time) const {
  image_name = value.toChar();
}
void Base::tlmWrite_Load(const LoadState& value, Fw::Time) const {
  channels["Load"] = static_cast<U32>(value.e);
}

}  // namespace Starcat

// The images, opened beside the component's to compare with.
static uint64_t words[2][SKY_MOST_BYTES / 8u];
static size_t sizes[2];
static starcat_image images[2];
static U64 places[2][SKY_MOST_BYTES / 8u];
static U32 patch_memory[4096];
static starcat_workspace work;
static starcat_result direct;
static std::string folder;
static unsigned right, wrong, unanswered, differences;

static void write_image(const char* name, uint32_t sky, size_t damaged, size_t count) {
  std::vector<uint8_t> bytes(reinterpret_cast<uint8_t*>(words[sky]),
                             reinterpret_cast<uint8_t*>(words[sky]) + sizes[sky]);
  if (damaged > 0) {
    bytes[damaged] ^= 8u;
  }
  std::FILE* file = std::fopen((folder + "/" + name).c_str(), "wb");
  std::fwrite(bytes.data(), 1, count < bytes.size() ? count : bytes.size(), file);
  std::fclose(file);
}

static void put_number(std::vector<uint8_t>& patch, uint32_t number) {
  for (; number >= 0x80u; number >>= 7) {
    patch.push_back(static_cast<uint8_t>(number | 0x80u));
  }
  patch.push_back(static_cast<uint8_t>(number));
}

// The patch that gives the first image another name, by docs/onboard-format.md: its first block and
// the last one, that of checks, are given, the others copied.
static void write_patch() {
  const size_t size = sizes[0], check = size - 4096u;
  std::vector<uint64_t> renamed(words[0], words[0] + size / 8u);
  uint8_t* bytes = reinterpret_cast<uint8_t*>(renamed.data());
  std::memcpy(bytes + 160, "sky-a-1.0.1", 12);
  sky_seal(bytes);
  uint32_t header[10] = {0, 0, 0x01020304u, 1u, static_cast<uint32_t>(size), 0u,
                         static_cast<uint32_t>(size), 0u, 0u, 0u};
  std::memcpy(header, "STARPAT", 8);
  std::memcpy(header + 5, reinterpret_cast<uint8_t*>(words[0]) + size - 8u, 4);
  std::memcpy(header + 7, bytes + size - 8u, 4);
  std::vector<uint8_t> patch(sizeof header);
  put_number(patch, 4096u * 8u);
  patch.insert(patch.end(), bytes, bytes + 4096u);
  put_number(patch, static_cast<uint32_t>(check - 4096u) * 8u + 1u);
  put_number(patch, 2u * 4096u);
  put_number(patch, 4096u * 8u);
  patch.insert(patch.end(), bytes + check, bytes + size);
  header[9] = static_cast<uint32_t>(patch.size());
  std::memcpy(patch.data(), header, sizeof header);
  std::FILE* file = std::fopen((folder + "/a.patch").c_str(), "wb");
  std::fwrite(patch.data(), 1, patch.size(), file);
  std::fclose(file);
}

static void make_images() {
  for (uint32_t n = 0; n < 2u; n++) {
    const sky_recipe recipe = {1, 2, SKY_STARS, 0.42, 8u + n};
    uint8_t* bytes = reinterpret_cast<uint8_t*>(words[n]);
    sizes[n] = sky_image(&recipe, bytes);
    std::memcpy(bytes + 160, n == 0u ? "sky-a-1.0.0" : "sky-b-1.0.0", 12);
    sky_seal(bytes);
    CHECK(starcat_open(&images[n], bytes, sizes[n], 0) == STARCAT_IDENTIFIED);
  }
  write_image("a.img", 0, 0, SIZE_MAX);
  write_image("b.img", 1, 0, SIZE_MAX);
  write_image("damaged.img", 1, 20000, SIZE_MAX);
  write_image("odd.img", 1, 0, 5000);
  write_patch();
}

namespace Starcat {

// The friend that may call handlers.
class StarTrackerTester {
 public:
  explicit StarTrackerTester(StarTracker& tracker) : m_base(tracker) {}
  void frame(Centroids& centroids) { m_base.framesIn_handler(0, centroids); }
  void ticks(unsigned count) {
    for (unsigned n = 0; n < count; n++) {
      m_base.schedIn_handler(0, 0);
    }
  }
  void load(const char* name) {
    m_base.LOAD_IMAGE_cmdHandler(0, 0, Fw::CmdStringArg((folder + "/" + name).c_str()), 0);
  }
  void patch(const char* name) {
    m_base.LOAD_PATCH_cmdHandler(3, 0, Fw::CmdStringArg((folder + "/" + name).c_str()));
  }
  bool takeOver() {
    m_base.SWITCH_IMAGE_cmdHandler(1, 0);
    return response == Fw::CmdResponse::OK;
  }
  void clear() { m_base.CLEAR_COUNTERS_cmdHandler(2, 0); }
  void update() { m_base.parameterUpdated(0); }

 private:
  StarTrackerComponentBase& m_base;
};

}  // namespace Starcat

static Starcat::Centroids centroids_of(const sky_frame& frame, U32 sequence) {
  Starcat::Centroids given;
  given.set_sequence(sequence);
  given.set_seconds(sequence);
  given.set_count(static_cast<U16>(frame.count));
  given.set_hasMagnitudes(true);
  for (uint32_t n = 0; n < frame.count; n++) {
    given.get_x_px()[n] = static_cast<F32>(frame.x[n]);
    given.get_y_px()[n] = static_cast<F32>(frame.y[n]);
    given.get_magnitude()[n] = static_cast<F32>(frame.magnitudes[n]);
  }
  return given;
}

// Compare what came out with the truth, and with the library called directly.
static void compare(const Starcat::Centroids& given, const sky_frame& frame, uint32_t sky) {
  static starcat_real numbers[3][STARCAT_MAX_CENTROIDS];
  starcat_camera its_camera;
  starcat_options its_options;
  const starcat_frame its_frame = {frame.count, numbers[0], numbers[1], numbers[2], nullptr};
  double dot = 0.0;
  for (uint32_t n = 0; n < frame.count; n++) {
    numbers[0][n] = static_cast<starcat_real>(given.get_x_px()[n]);
    numbers[1][n] = static_cast<starcat_real>(given.get_y_px()[n]);
    numbers[2][n] = static_cast<starcat_real>(given.get_magnitude()[n]);
  }
  starcat_camera_of(&images[sky], &its_camera);
  starcat_default_options(&its_options);
  its_options.log_chance = static_cast<starcat_real>(options.get_logChance());
  const starcat_status status = starcat_identify(&images[sky], &its_camera, &its_options,
                                                 &its_frame, &work, &direct);
  bool is_same = static_cast<int>(attitude.get_status()) == static_cast<int>(status);
  // A frame that was tracked in vain took those steps too.
  is_same = is_same && (tracking || (attitude.get_steps() == direct.steps)) &&
            (attitude.get_matched() == direct.n_matched) &&
            (attitude.get_sequence() == given.get_sequence());
  for (U32 n = 0; (n < 4) && (status == STARCAT_IDENTIFIED); n++) {
    is_same = is_same &&
              (attitude.get_quaternion()[n] == static_cast<F64>(direct.q_body_from_icrs[n]));
    dot += attitude.get_quaternion()[n] * static_cast<double>(frame.q_body_from_icrs[n]);
  }
  differences += !is_same;
  if (status != STARCAT_IDENTIFIED) {
    unanswered++;
  } else if (2.0 * std::acos(std::fmin(std::fabs(dot), 1.0)) < 0.01) {
    right++;
  } else {
    wrong++;
  }
}

static U32 sequence;

static void fly(Starcat::StarTrackerTester& tester, uint32_t sky, unsigned count) {
  static uint64_t state = 1;
  starcat_camera its_camera;
  starcat_camera_of(&images[sky], &its_camera);
  for (unsigned n = 0; n < count; n++) {
    sky_frame frame;
    do { // not where hardly a star is
      sky_look(&images[sky], &its_camera, &state, 0.3, SKY_SPOTS, n % 3u, &frame);
    } while (frame.count < 8u + n % 3u);
    Starcat::Centroids given = centroids_of(frame, sequence++);
    tester.frame(given);
    compare(given, frame, sky);
    if (tracking) { // the same once more, from the attitude that was found
      given.set_microseconds(100000);
      tester.frame(given);
      CHECK(attitude.get_mode() == Starcat::Mode::TRACK);
      CHECK(attitude.get_status() == Starcat::Status::IDENTIFIED);
    }
    tester.ticks(1);
  }
}

static void test_images(Starcat::StarTrackerTester& tester) {
  tester.load("nothing.img");
  CHECK((response == Fw::CmdResponse::EXECUTION_ERROR) && (events["LoadFailed"] == 1));
  tester.load("odd.img");
  CHECK((response == Fw::CmdResponse::EXECUTION_ERROR) && (events["LoadFailed"] == 2));
  CHECK(!tester.takeOver() && (events["SwitchRefused"] == 1));
  tester.load("damaged.img");
  CHECK(!tester.takeOver()); /* while it is read */
  fly(tester, 0, 30);
  CHECK((events["LoadRefused"] == 1) && !tester.takeOver() && (image_name == "sky-a-1.0.0"));
  tester.load("b.img");
  fly(tester, 0, 30);
  CHECK((events["LoadReady"] == 1) && tester.takeOver() && (image_name == "sky-b-1.0.0"));
  fly(tester, 1, 200);
  CHECK(tester.takeOver() && (image_name == "sky-a-1.0.0")); /* falls back */
  fly(tester, 0, 40);
}

static void test_patches(Starcat::StarTrackerTester& tester) {
  tester.patch("a.img");  // too large
  CHECK(response == Fw::CmdResponse::EXECUTION_ERROR);
  tester.patch("a.patch");
  CHECK(response == Fw::CmdResponse::OK);
  tester.ticks(4);
  CHECK((events["LoadReady"] == 2) && tester.takeOver() && (image_name == "sky-a-1.0.1"));
  fly(tester, 0, 20);
  tester.patch("a.patch");  // for the other image
  tester.ticks(4);
  CHECK((events["LoadRefused"] == 2) && tester.takeOver() && (image_name == "sky-a-1.0.0"));
  tester.load("b.img");  // to fall back on
  tester.ticks(60);
  CHECK(events["LoadReady"] == 3);
}

static void test_upsets(Starcat::StarTrackerTester& tester) {
  uint8_t* bytes = reinterpret_cast<uint8_t*>(places[channels["ActivePlace"]]);
  bytes[2u * 4096u + 77u] ^= 1u;
  tester.ticks(40);
  CHECK((events["Mended"] == 1) && (channels["BlocksMended"] == 1));
  CHECK(std::memcmp(bytes, words[0], sizes[0]) == 0);
  for (size_t block = 1; block < 6; block++) {
    bytes[block * 4096u + 5u] ^= 1u;
  }
  tester.ticks(40);
  CHECK((events["FellBack"] == 1) && (channels["FallBacks"] == 1));
  CHECK((image_name == "sky-b-1.0.0") && (channels["DamageFound"] == 2));
  fly(tester, 1, 100);
}

static void test_settings(Starcat::StarTrackerTester& tester) {
  const Starcat::Options before = options;
  options.set_maxSteps(0);
  tester.update();
  tester.ticks(1);
  CHECK(events["SettingsRefused"] == 1);
  fly(tester, 1, 10); /* with the settings before */
  options.set_maxSteps(20);
  tester.update();
  sky_frame frame;
  starcat_camera its_camera;
  uint64_t state = 5;
  starcat_camera_of(&images[1], &its_camera);
  sky_look(&images[1], &its_camera, &state, 0.3, SKY_SPOTS, 0, &frame);
  Starcat::Centroids given = centroids_of(frame, 999999);
  tester.frame(given);
  CHECK(last_status == Starcat::Status::E_BUDGET);
  CHECK(not_identified[STARCAT_REASON_STEPS - 1] == 1);
  options = before;
  tester.update();
  given.set_count(65);
  tester.frame(given);
  CHECK((last_status == Starcat::Status::E_TOO_MANY_CENTROIDS) && (events["FrameRefused"] == 1));
  CHECK(channels["FrameErrors"] == 1);
  camera_of_image = false;
  camera.set_width_px(-1.0);
  tester.update();
  fly(tester, 1, 10); /* refused; that of the image goes on */
  CHECK(events["SettingsRefused"] == 2);
  camera_of_image = true;
}

int main(int argc, char** argv) {
  if (argc != 2) {
    std::fprintf(stderr, "test_star_tracker FOLDER\n");
    return 2;
  }
  folder = argv[1];
  options.set_tolerance_px(2.0);
  options.set_logChance(-20.723265836946411);
  options.set_maxSteps(4000000);
  make_images();
  static Starcat::StarTracker tracker("starTracker");
  Starcat::StarTrackerTester tester(tracker);
  tracker.configure(reinterpret_cast<U8*>(places[0]), reinterpret_cast<U8*>(places[1]),
                    sizeof places[0], reinterpret_cast<U8*>(patch_memory), sizeof patch_memory);
  tracker.openImages((folder + "/a.img").c_str(), nullptr);
  CHECK((events["Started"] == 1) && (image_name == "sky-a-1.0.0"));
  fly(tester, 0, 460);
  test_images(tester);
  test_patches(tester);
  test_upsets(tester);
  test_settings(tester);
  tracking = true;
  fly(tester, 1, 100);
  const U32 counted = channels["FramesIdentified"] + channels["FramesTracked"] +
                      channels["FrameErrors"] + not_identified[STARCAT_REASON_STEPS - 1];
  CHECK(channels["FramesIn"] == 1102);
  CHECK(channels["FramesTracked"] == 100);
  CHECK(counted + unanswered == channels["FramesIn"]);
  CHECK(channels["ScrubPasses"] > 0);
  tester.clear();
  CHECK((channels["FramesIn"] == 0) && (channels["ScrubPasses"] == 0));
  std::printf("fprime: %u frames, %u right, %u wrong, %u without an answer, %u differ from the "
              "library; %u checks, %u failed\n",
              static_cast<unsigned>(sequence), right, wrong, unanswered, differences, checks,
              failures);
  return (sequence != 1000) || (right != 1000) || (wrong > 0) || (differences > 0) ||
         (failures > 0);
}
