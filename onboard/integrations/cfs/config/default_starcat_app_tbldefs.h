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
  double Prior_rad;     /* how far the last attitude may be from the next one, up to 0.35 */
  uint32 MaxSteps;      /* of a frame, tracked and identified together */
  uint32 PriorAge_ms;   /* an attitude as old or older is no prior */
  uint16 ScrubBlocks;   /* blocks of 4096 bytes that are checked a tick, 1 or more */
  uint16 LoadPieces;    /* pieces of 4096 bytes that are read from a file a tick, 1 or more */
  uint8 CameraOfImage;  /* 1: the camera that the image was built for */
  uint8 Tracking;       /* 1: begin with the last attitude */
  uint8 Spare[2];
} STARCAT_APP_Config_t;

#endif
