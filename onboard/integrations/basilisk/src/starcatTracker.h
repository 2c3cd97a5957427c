// A star tracker for Basilisk that identifies: it exposes a frame of the sky at the true attitude,
// and finds its own attitude from the centroids with starcat's C library. Nothing of the truth goes
// past the centroids but the counts of its frame message, which are for who judges it.
//
// SPDX-License-Identifier: MIT
#ifndef STARCAT_TRACKER_H
#define STARCAT_TRACKER_H

#include <Eigen/Dense>
#include <cstdint>
#include <memory>
#include <string>
#include <vector>

#include "StarcatFrameMsgPayload.h"
#include "architecture/_GeneralModuleFiles/sys_model.h"
#include "architecture/messaging/messaging.h"
#include "architecture/msgPayloadDefC/NavAttMsgPayload.h"
#include "architecture/msgPayloadDefC/NavTransMsgPayload.h"
#include "architecture/msgPayloadDefC/SCStatesMsgPayload.h"
#include "architecture/msgPayloadDefC/STAttMsgPayload.h"
#include "architecture/msgPayloadDefC/STSensorMsgPayload.h"
#include "architecture/msgPayloadDefC/SpicePlanetStateMsgPayload.h"
#include "architecture/utilities/bskLogging.h"

/* ! Outcome of a frame. From STARCAT_WITHHELD on, the library's reason is added to it. */
enum StarcatOutcome {
  STARCAT_OUTCOME_IDENTIFIED = 0,
  STARCAT_OUTCOME_DROPPED = 1,  //!< there is no frame
  STARCAT_OUTCOME_BLINDED = 2,  //!< the Sun is too close
  STARCAT_OUTCOME_WITHHELD = 10
};

/*! @brief star tracker that identifies the stars of its frames */
class StarcatTracker : public SysModel {
 public:
  StarcatTracker();
  ~StarcatTracker();
  void Reset(uint64_t CurrentSimNanos) override;
  void UpdateState(uint64_t CurrentSimNanos) override;

  void loadImage(const std::string &path);  //!< file of `starcat export --to onboard`
  //! stars that there are: unit vectors one after the other (ICRS), magnitudes, numbers of the catalog
  void setSky(const std::vector<double> &directions, const std::vector<double> &magnitudes,
              const std::vector<long long> &ids);
  //! times without frames: begin and end one after the other [s]
  void setOutages(const std::vector<double> &times);
  //! the last frame: x and y [px] and magnitude of each centroid, one after the other
  std::vector<double> lastCentroids() const;
  std::vector<long long> lastIds() const;  //!< and its star's number in the catalog; 0: none
  double focalLength() const;  //!< [px] of the camera that the image was built for
  double cornerAngle() const;  //!< [rad] from its boresight to a corner of the field

  ReadFunctor<SCStatesMsgPayload> scStateInMsg;         //!< true state
  ReadFunctor<SpicePlanetStateMsgPayload> sunInMsg;     //!< Sun from the origin of N, with its velocity
  ReadFunctor<SpicePlanetStateMsgPayload> moonInMsg;    //!< Moon from the origin of N
  ReadFunctor<SpicePlanetStateMsgPayload> earthInMsg;   //!< Earth; not linked: it is the origin of N
  ReadFunctor<NavTransMsgPayload> navTransInMsg;        //!< what is known on board of the velocity
  ReadFunctor<NavAttMsgPayload> navAttInMsg;            //!< (optional) expected attitude, to track
  Message<StarcatFrameMsgPayload> frameOutMsg;          //!< what became of each frame
  Message<STAttMsgPayload> attOutMsg;                   //!< attitude of the body, when there is a new one
  Message<STSensorMsgPayload> sensorOutMsg;             //!< the same of the camera, as of starTracker

  Eigen::Matrix3d dcm_CB;        //!< [-] mounting; camera axes are x right, y down, z boresight
  double exposure = 0.1;         //!< [s]
  double limitMag = 6.5;         //!< [mag] of a camera at rest
  double missedShare = 0.03;     //!< [-] of the stars
  double falseMean = 1.5;        //!< [-] false centroids of a frame
  double droppedShare = 0.01;    //!< [-] of the frames
  double sunExclusion = 0.52;    //!< [rad] closest to the Sun
  double priorError = 0.009;     //!< [rad] largest error of the expected attitude
  BSKLogger bskLogger;           //!< -- BSK Logging

 private:
  struct Parts;
  bool isDropped(double time_s);
  void see(uint64_t now, StarcatFrameMsgPayload &frame);
  bool expected(uint64_t now, double (&q_camera_from_icrs)[4]);
  void answer(uint64_t now, StarcatFrameMsgPayload &frame);

  std::unique_ptr<Parts> parts;
  std::vector<double> outages;
};

#endif
