// SPDX-License-Identifier: MIT
#include "starcatTracker.h"

#include <algorithm>
#include <cmath>
#include <fstream>
#include <iterator>

#include "architecture/utilities/rigidBodyKinematics.h"
#include "frame.h"
#include "starcat_session.h"

using Eigen::Matrix3d;
using Eigen::Vector3d;
using star_camera::Centroid;
using RowMajor = Eigen::Matrix<double, 3, 3, Eigen::RowMajor>;

namespace {

constexpr double kLight_m_s = 299792458.0;
constexpr double kNano = 1e-9;
constexpr double kLeastNoise_px = 0.4, kNoise_mag = 0.3;  // as they are stated to the library

Vector3d vector_of(const double (&from)[3]) { return Vector3d(from[0], from[1], from[2]); }

Matrix3d matrix_of(const double (&mrp)[3]) {
  double copy[3] = {mrp[0], mrp[1], mrp[2]}, rows[3][3];
  MRP2C(copy, rows);
  return Eigen::Map<const RowMajor>(&rows[0][0]);
}

// Return the quaternion of starcat.h for the matrix of body from ICRS. Eigen has Hamilton's
// convention, in which the transposed matrix has these components.
void quaternion_of(const Matrix3d &matrix, double (&q)[4]) {
  const Eigen::Quaterniond turn(Matrix3d(matrix.transpose()));
  const double sign = turn.w() < 0.0 ? -1.0 : 1.0;
  q[0] = sign * turn.x();
  q[1] = sign * turn.y();
  q[2] = sign * turn.z();
  q[3] = sign * turn.w();
}

// Return the matrix of such a quaternion.
Matrix3d matrix_of_quaternion(const double q[4]) {
  return Eigen::Quaterniond(q[3], q[0], q[1], q[2]).toRotationMatrix().transpose();
}

}  // namespace

// What the library and the frames are made of, kept out of the header that SWIG reads.
struct StarcatTracker::Parts {
  std::vector<std::uint64_t> words;
  starcat_settings settings{};
  starcat_session session{};
  starcat_answer answer{};
  Vector3d beta;  // what is known on board of the velocity, in that of light
  star_camera::Lens lens{};
  std::vector<star_camera::Star> sky;
  star_camera::Random random{0}, drops{0};  // the same frames are dropped whatever is in them
  std::vector<Centroid> last;

  starcat_status identify(std::uint64_t now, const std::vector<Centroid> &seen);
  static void removeAberration(void *context, const double q[4], std::uint32_t count, double *x_px,
                               double *y_px);
};

StarcatTracker::StarcatTracker() : dcm_CB(Matrix3d::Identity()), parts(new Parts) {}

StarcatTracker::~StarcatTracker() = default;

void StarcatTracker::loadImage(const std::string &path) {
  std::ifstream file(path, std::ios::binary);
  const std::vector<char> bytes((std::istreambuf_iterator<char>(file)), {});
  parts->words.assign((bytes.size() + 7u) / 8u, 0u);
  std::copy(bytes.begin(), bytes.end(), reinterpret_cast<char *>(parts->words.data()));
  starcat_session &session = parts->session;
  starcat_settings &settings = parts->settings;
  starcat_set_default_settings(&settings);
  settings.options.noise_mag = kNoise_mag;
  settings.prior_age = 1;  // the filter turns its attitude on to the time of the frame
  settings.correct = &Parts::removeAberration;
  settings.context = parts.get();
  starcat_prepare_session(&session, &settings);
  const starcat_status status =
      starcat_use_image(&session, parts->words.data(), 8u * parts->words.size());
  if (status != STARCAT_OK) {
    bskLogger.bskError(
        "starcatTracker: %s is no image that opens (code %d); write one with "
        "starcat export DATABASE --to onboard -o FILE",
        path.c_str(), static_cast<int>(status));
  }
  const starcat_camera &camera = session.camera;
  parts->lens = {camera.width_px, camera.height_px, camera.focal_length_px};
}

void StarcatTracker::setSky(const std::vector<double> &directions,
                            const std::vector<double> &magnitudes,
                            const std::vector<long long> &ids) {
  if (directions.size() != 3 * magnitudes.size() || ids.size() != magnitudes.size()) {
    bskLogger.bskError(
        "starcatTracker: %zu numbers of directions, %zu magnitudes and %zu ids; "
        "expected three, one and one a star",
        directions.size(), magnitudes.size(), ids.size());
  }
  parts->sky.clear();
  for (std::size_t n = 0; n < magnitudes.size(); n++) {
    parts->sky.push_back({Vector3d(&directions[3 * n]), magnitudes[n], ids[n]});
  }
}

void StarcatTracker::setOutages(const std::vector<double> &times) { outages = times; }

std::vector<double> StarcatTracker::lastCentroids() const {
  std::vector<double> numbers;
  for (const Centroid &one : parts->last) {
    numbers.insert(numbers.end(), {one.x_px, one.y_px, one.mag});
  }
  return numbers;
}

std::vector<long long> StarcatTracker::lastIds() const {
  std::vector<long long> ids;
  for (const Centroid &one : parts->last) {
    ids.push_back(one.id);
  }
  return ids;
}

double StarcatTracker::focalLength() const { return parts->lens.focal_length_px; }

double StarcatTracker::cornerAngle() const { return parts->lens.corner_rad(); }

void StarcatTracker::Reset(uint64_t) {
  if (!scStateInMsg.isLinked() || !sunInMsg.isLinked() || !moonInMsg.isLinked() ||
      !navTransInMsg.isLinked()) {
    bskLogger.bskError("starcatTracker: link scStateInMsg, sunInMsg, moonInMsg and navTransInMsg");
  }
  if (starcat_check_session(&parts->session) != STARCAT_OK || parts->words.empty() ||
      parts->sky.empty()) {
    bskLogger.bskError("starcatTracker: call loadImage and setSky before the simulation starts");
  }
  parts->random = star_camera::Random(RNGSeed);
  parts->drops = star_camera::Random(~static_cast<std::uint64_t>(RNGSeed));
}

void StarcatTracker::UpdateState(uint64_t now) {
  StarcatFrameMsgPayload frame = {};
  frame.timeTag = now;
  parts->last.clear();
  if (isDropped(static_cast<double>(now) * kNano)) {
    frame.outcome = STARCAT_OUTCOME_DROPPED;
  } else {
    see(now, frame);
  }
  frameOutMsg.write(&frame, moduleID, now);
}

bool StarcatTracker::isDropped(double time_s) {
  bool dropped = parts->drops.uniform() < droppedShare;
  for (std::size_t n = 0; n + 1 < outages.size(); n += 2) {
    dropped = dropped || (time_s >= outages[n] && time_s < outages[n + 1]);
  }
  return dropped;
}

// Expose a frame at the true state, and identify it with what is known on board.
void StarcatTracker::see(uint64_t now, StarcatFrameMsgPayload &frame) {
  const SCStatesMsgPayload truth = scStateInMsg();
  const SpicePlanetStateMsgPayload sun = sunInMsg(), moon = moonInMsg();
  const Vector3d place = vector_of(truth.r_BN_N), sun_velocity = vector_of(sun.VelocityVector);
  const Vector3d earth =
      earthInMsg.isLinked() ? vector_of(earthInMsg().PositionVector) : Vector3d(Vector3d::Zero());
  star_camera::Scene scene;
  scene.camera_from_icrs = dcm_CB * matrix_of(truth.sigma_BN);
  scene.rate_rad_s = dcm_CB * vector_of(truth.omega_BN_B);
  scene.beta = (vector_of(truth.v_BN_N) - sun_velocity) / kLight_m_s;
  scene.sun_m = vector_of(sun.PositionVector) - place;
  scene.moon_m = vector_of(moon.PositionVector) - place;
  scene.earth_m = earth - place;
  const Vector3d axis = scene.camera_from_icrs.row(2);
  if (axis.dot(scene.sun_m.normalized()) > std::cos(sunExclusion)) {
    frame.outcome = STARCAT_OUTCOME_BLINDED;
    return;
  }
  star_camera::Optics optics;
  optics.exposure_s = exposure;
  optics.limit_mag = limitMag;
  optics.missed_share = missedShare;
  optics.false_mean = falseMean;
  const auto seen = star_camera::expose(parts->sky, parts->lens, optics, scene, parts->random);
  parts->last = seen.centroids;
  frame.streak_px = seen.streak_px;
  frame.moonSeen = seen.moon_seen;
  frame.earthSeen = seen.earth_seen;
  for (const Centroid &one : seen.centroids) {
    (one.id != 0 ? frame.nStars : frame.nFalse)++;
  }

  // From here on as on board.
  starcat_session &session = parts->session;
  parts->beta = (vector_of(navTransInMsg().v_BN_N) - sun_velocity) / kLight_m_s;
  parts->settings.prior_error_rad = priorError;
  session.prior_time = now;
  session.has_prior = expected(now, session.q_prior) ? 1u : 0u;
  const starcat_status status = parts->identify(now, seen.centroids);
  frame.tracked = status == STARCAT_IDENTIFIED && parts->answer.mode == STARCAT_MODE_TRACK;
  if (status == STARCAT_IDENTIFIED) {
    answer(now, frame);
  } else {
    frame.outcome = STARCAT_OUTCOME_WITHHELD + static_cast<int>(parts->answer.result.reason);
  }
  frame.steps = static_cast<int>(parts->answer.steps);
}

// The attitude that the filter expects, turned on from the time of its message to now.
bool StarcatTracker::expected(uint64_t now, double (&q)[4]) {
  if (!navAttInMsg.isLinked() || !navAttInMsg.isWritten()) {
    return false;
  }
  const NavAttMsgPayload known = navAttInMsg();
  const Vector3d turn =
      vector_of(known.omega_BN_B) * (static_cast<double>(now) * kNano - known.timeTag);
  const double angle = turn.norm();
  const Vector3d axis = angle > 0.0 ? Vector3d(turn / angle) : Vector3d(Vector3d::UnitX());
  const Matrix3d moved =
      Eigen::AngleAxisd(-angle, axis).toRotationMatrix() * matrix_of(known.sigma_BN);
  quaternion_of(dcm_CB * moved, q);
  return true;
}

// Move centroids to where they were without aberration, as an attitude tells it.
void StarcatTracker::Parts::removeAberration(void *context, const double q[4], std::uint32_t count,
                                             double *x_px, double *y_px) {
  const Parts &known = *static_cast<const Parts *>(context);
  const Matrix3d near = matrix_of_quaternion(q);
  for (std::uint32_t n = 0; n < count; n++) {
    const Vector3d seen = near.transpose() * known.lens.direction(x_px[n], y_px[n]);
    known.lens.project(near * star_camera::aberrated(seen, -known.beta), x_px[n], y_px[n]);
  }
}

// Give a frame to the session, with the mean of its noises and without what only the simulation knows.
starcat_status StarcatTracker::Parts::identify(std::uint64_t now,
                                               const std::vector<Centroid> &seen) {
  std::vector<double> x, y, mag, sigma;
  double squares = 0.0;
  for (const Centroid &one : seen) {
    x.push_back(one.x_px);
    y.push_back(one.y_px);
    mag.push_back(one.mag);
    sigma.push_back(one.sigma_px);
    squares += one.sigma_px * one.sigma_px;
  }
  const double mean = squares / std::max<double>(static_cast<double>(seen.size()), 1.0);
  settings.options.noise_px = std::max(kLeastNoise_px, std::sqrt(mean));
  const starcat_frame frame = {static_cast<std::uint32_t>(seen.size()), x.data(), y.data(),
                               mag.data(), sigma.data()};
  return starcat_answer_frame(&session, &frame, now, &answer);
}

void StarcatTracker::answer(uint64_t now, StarcatFrameMsgPayload &frame) {
  const starcat_session &session = parts->session;
  const starcat_result &result = parts->answer.result;
  const Matrix3d camera = Eigen::Map<const RowMajor>(result.matrix);
  const RowMajor body = dcm_CB.transpose() * camera, rows = camera;
  const RowMajor spread =
      dcm_CB.transpose() * Matrix3d(Eigen::Map<const RowMajor>(result.covariance_rad2)) * dcm_CB;
  double copy[3][3];
  std::copy(body.data(), body.data() + 9, &copy[0][0]);
  C2MRP(copy, frame.sigma_BN);
  std::copy(spread.data(), spread.data() + 9, frame.covariance_B);
  frame.valid = 1;
  frame.outcome = STARCAT_OUTCOME_IDENTIFIED;
  for (std::size_t n = 0; n < parts->last.size(); n++) {
    const std::int32_t row = result.star[n];
    if (row >= 0) {
      const std::int64_t named = session.image.star_ids[row];
      const Centroid &true_one = parts->last[n];
      frame.nNamed++;
      frame.nMisnamed += named != true_one.id && named != true_one.blended_id;
    }
  }
  STAttMsgPayload attitude = {};
  attitude.timeTag = now;
  std::copy(frame.sigma_BN, frame.sigma_BN + 3, attitude.MRP_BdyInrtl);
  attOutMsg.write(&attitude, moduleID, now);
  STSensorMsgPayload sensor = {};
  sensor.timeTag = now;
  std::copy(rows.data(), rows.data() + 9, &copy[0][0]);
  C2EP(copy, sensor.qInrtl2Case);
  sensorOutMsg.write(&sensor, moduleID, now);
}
