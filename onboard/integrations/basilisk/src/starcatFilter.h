// Attitude and gyro bias from a gyro and the frames of starcatTracker: a multiplicative extended Kalman
// filter of six states (Lefferts, Markley and Shuster 1982). It takes every frame that was identified,
// with the covariance that the library states of it, and refuses none.
//
// SPDX-License-Identifier: MIT
#ifndef STARCAT_FILTER_H
#define STARCAT_FILTER_H

#include <Eigen/Dense>
#include <cstdint>

#include "StarcatFrameMsgPayload.h"
#include "architecture/_GeneralModuleFiles/sys_model.h"
#include "architecture/messaging/messaging.h"
#include "architecture/msgPayloadDefC/IMUSensorMsgPayload.h"
#include "architecture/msgPayloadDefC/NavAttMsgPayload.h"
#include "architecture/utilities/bskLogging.h"

/*! @brief gyro and star tracker to an attitude */
class StarcatFilter : public SysModel {
 public:
  StarcatFilter() = default;
  void Reset(uint64_t CurrentSimNanos) override;
  void UpdateState(uint64_t CurrentSimNanos) override;

  ReadFunctor<StarcatFrameMsgPayload> frameInMsg;  //!< frames of the star tracker
  ReadFunctor<IMUSensorMsgPayload> imuInMsg;       //!< gyro, in the axes of the body
  Message<NavAttMsgPayload> navAttOutMsg;          //!< written from the first attitude on

  double gyroNoise = 1e-5;   //!< [rad/sqrt(s)] angle random walk
  double biasNoise = 1e-8;   //!< [rad/s/sqrt(s)] of the bias
  double biasError = 5e-5;   //!< [rad/s] of the bias at the start
  double floorError = 3e-6;  //!< [rad] error of a frame beside its covariance
  BSKLogger bskLogger;       //!< -- BSK Logging

 private:
  using Matrix6 = Eigen::Matrix<double, 6, 6>;
  void propagate(const Eigen::Vector3d &turn, double seconds);
  void update(const Eigen::Matrix3d &measured, const Eigen::Matrix3d &covariance);

  Eigen::Matrix3d dcm_BN = Eigen::Matrix3d::Identity();
  Eigen::Vector3d bias = Eigen::Vector3d::Zero();
  Matrix6 covariance = Matrix6::Zero();
  uint64_t previous = 0;
  bool isStarted = false;
};

#endif
