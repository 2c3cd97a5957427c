// What became of one frame of the star tracker: for the attitude filter, and for who counts.
//
// SPDX-License-Identifier: MIT
#ifndef STARCAT_FRAME_MESSAGE_H
#define STARCAT_FRAME_MESSAGE_H

#include <stdint.h>

typedef struct {
  uint64_t timeTag;         //!< [ns] Middle of the exposure
  int valid;                //!< [-] 1: the attitude below is to be used
  int outcome;              //!< [-] One of the StarcatOutcome of starcatTracker.h
  int tracked;              //!< [-] 1: found near the expected attitude, 0: lost in space
  int nStars;               //!< [-] Centroids that are stars
  int nFalse;               //!< [-] Centroids that are none
  int nNamed;               //!< [-] Centroids that were given a star
  int nMisnamed;            //!< [-] Of these, the ones that are another star or none
  int moonSeen;             //!< [-] 1: the disc of the Moon is at least partly in the field
  int earthSeen;            //!< [-] 1: that of the Earth
  int steps;                //!< [-] Steps that the library took
  double streak_px;         //!< [px] Length of a spot by the camera's turning, in the middle
  double sigma_BN[3];       //!< [-] Attitude of the body
  double covariance_B[9];   //!< [rad^2] Of small turns about the axes of the body
} StarcatFrameMsgPayload;

#endif
