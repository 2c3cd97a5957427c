/* The table STARCAT_APP.Config. Nothing lies between its members.
 *
 * SPDX-License-Identifier: MIT
 */
#ifndef STARCAT_APP_TBLDEFS_H
#define STARCAT_APP_TBLDEFS_H

#include "common_types.h"
#include "starcat_app_msgdefs.h"

typedef struct {
  STARCAT_APP_Camera_t Camera; /* used if CameraOfImage is 0 */
  double Tolerance_px;         /* starcat_options; see starcat.h */
  double Noise_px;
  double Noise_mag;
  double LogChance;
  double FovError;
  double Prior_rad;     /* largest error of the last attitude as prior, up to 0.35 */
  uint32 MaxSteps;      /* total of a frame, tracked and identified */
  uint32 PriorAge_ms;   /* attitudes of this age or older are not used as prior */
  uint16 ScrubBlocks;   /* blocks of 4096 bytes to check per tick, 1 or more */
  uint16 LoadPieces;    /* pieces of 4096 bytes to read from a file per tick, 1 or more */
  uint8 CameraOfImage;  /* 1: the camera that the image was built for */
  uint8 Tracking;       /* 1: begin with the last attitude */
  uint8 Spare[2];
} STARCAT_APP_Config_t;

#endif
