// SPDX-License-Identifier: MIT
#include "starcatFilter.h"

#include <algorithm>

#include "architecture/utilities/rigidBodyKinematics.h"

using Eigen::Matrix3d;
using Eigen::Vector3d;
using RowMajor = Eigen::Matrix<double, 3, 3, Eigen::RowMajor>;

namespace {

// The matrix that turns components when the axes turn by a vector.
Matrix3d turned_by(const Vector3d &turn) {
  const double angle = turn.norm();
  const Vector3d axis = angle > 0.0 ? Vector3d(turn / angle) : Vector3d(Vector3d::UnitX());
  return Eigen::AngleAxisd(-angle, axis).toRotationMatrix();
}

}  // namespace

void StarcatFilter::Reset(uint64_t now) {
  if (!frameInMsg.isLinked() || !imuInMsg.isLinked()) {
    bskLogger.bskError("starcatFilter: link frameInMsg and imuInMsg");
  }
  isStarted = false;
  previous = now;
}

void StarcatFilter::UpdateState(uint64_t now) {
  const double seconds = static_cast<double>(now - previous) * 1e-9;
  previous = now;
  const IMUSensorMsgPayload gyro = imuInMsg();
  const StarcatFrameMsgPayload frame = frameInMsg();
  if (isStarted && seconds > 0.0) {
    propagate(Vector3d(gyro.DRFramePlatform) - bias * seconds, seconds);
  }
  if (frame.valid != 0 && frame.timeTag == now) {
    double sigma[3], rows[3][3];
    std::copy(frame.sigma_BN, frame.sigma_BN + 3, sigma);
    MRP2C(sigma, rows);
    update(Eigen::Map<const RowMajor>(&rows[0][0]), Eigen::Map<const RowMajor>(frame.covariance_B));
  }
  if (!isStarted) {
    return;
  }
  NavAttMsgPayload known = {};
  known.timeTag = static_cast<double>(now) * 1e-9;
  RowMajor body = dcm_BN;
  double rows[3][3];
  std::copy(body.data(), body.data() + 9, &rows[0][0]);
  C2MRP(rows, known.sigma_BN);
  Eigen::Map<Vector3d>(known.omega_BN_B) = Vector3d(gyro.AngVelPlatform) - bias;
  navAttOutMsg.write(&known, moduleID, now);
}

void StarcatFilter::propagate(const Vector3d &turn, double seconds) {
  dcm_BN = turned_by(turn) * dcm_BN;
  Matrix6 step = Matrix6::Identity(), noise = Matrix6::Zero();
  step.topLeftCorner<3, 3>() = turned_by(turn);
  step.topRightCorner<3, 3>() = -seconds * Matrix3d::Identity();
  noise.topLeftCorner<3, 3>().diagonal().setConstant(gyroNoise * gyroNoise * seconds);
  noise.bottomRightCorner<3, 3>().diagonal().setConstant(biasNoise * biasNoise * seconds);
  covariance = step * covariance * step.transpose() + noise;
}

void StarcatFilter::update(const Matrix3d &measured, const Matrix3d &given) {
  const Matrix3d spread = given + floorError * floorError * Matrix3d::Identity();
  if (!isStarted) {
    dcm_BN = measured;
    bias.setZero();
    covariance.setZero();
    covariance.topLeftCorner<3, 3>() = spread;
    covariance.bottomRightCorner<3, 3>().diagonal().setConstant(biasError * biasError);
    isStarted = true;
    return;
  }
  const Eigen::AngleAxisd left(Matrix3d((measured * dcm_BN.transpose()).transpose()));
  const Vector3d turn = left.angle() * left.axis();
  const Matrix3d whole = covariance.topLeftCorner<3, 3>() + spread;
  const Eigen::Matrix<double, 6, 3> gain = covariance.leftCols<3>() * whole.inverse();
  const Eigen::Matrix<double, 6, 1> change = gain * turn;
  dcm_BN = turned_by(change.head<3>()) * dcm_BN;
  bias += change.tail<3>();
  // Joseph's form keeps it symmetric and positive.
  Matrix6 rest = Matrix6::Identity();
  rest.leftCols<3>() -= gain;
  covariance = rest * covariance * rest.transpose() + gain * spread * gain.transpose();
}
