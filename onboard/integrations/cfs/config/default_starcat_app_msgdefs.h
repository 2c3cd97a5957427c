/* What the messages carry. Nothing lies between the members; numbers are in the processor's byte
 * order. test/icd.py writes starcat.xml, the ICD, of this file: a member a line, what it is behind it.
 *
 * SPDX-License-Identifier: MIT
 */
#ifndef STARCAT_APP_MSGDEFS_H
#define STARCAT_APP_MSGDEFS_H

#include "common_types.h"
#include "starcat_app_fcncodes.h"
#include "starcat_app_interface_cfg.h"

/* Flags of a frame. */
#define STARCAT_APP_HAS_MAGNITUDES 1
#define STARCAT_APP_HAS_SIGMAS     2

/* How a frame was identified: the numbers of starcat_mode. */
#define STARCAT_APP_MODE_NONE     0 /* no image can be used */
#define STARCAT_APP_MODE_IDENTIFY 1 /* lost in space */
#define STARCAT_APP_MODE_TRACK    2 /* near the last attitude */
#define STARCAT_APP_MODE_CONFIRM  3 /* by the frames before it */

/* Source of the camera in use. */
#define STARCAT_APP_CAMERA_OF_IMAGE   0
#define STARCAT_APP_CAMERA_OF_TABLE   1
#define STARCAT_APP_CAMERA_OF_COMMAND 2

/* How far a new image has come: the numbers of starcat_load. */
#define STARCAT_APP_LOAD_NONE     0
#define STARCAT_APP_LOAD_READING  1 /* reading its file, a few pieces per tick */
#define STARCAT_APP_LOAD_CHECKING 2 /* checking its blocks, a few per tick */
#define STARCAT_APP_LOAD_READY    3 /* ready to be switched to */
#define STARCAT_APP_LOAD_FAILED   4 /* not read, damaged, or not the stated image */

typedef struct {
  double Width_px;       /* width of the detector */
  double Height_px;      /* height of the detector */
  double FocalLength_px; /* focal length */
  double X0_px;          /* principal point */
  double Y0_px;          /* principal point */
  double K1;             /* radial distortion */
  double K2;             /* radial distortion */
  double K3;             /* radial distortion */
  double P1;             /* tangential distortion */
  double P2;             /* tangential distortion */
  double FoldRadius;     /* largest x/z that the distortion holds for; 0: any */
} STARCAT_APP_Camera_t;

typedef struct {
  char Path[STARCAT_APP_PATH_LEN]; /* file of the image */
  uint32 Crc;                      /* its number 8 bytes before its end; 0: not stated */
} STARCAT_APP_LoadImage_Payload_t;

typedef struct {
  char Path[STARCAT_APP_PATH_LEN]; /* file of the patch */
} STARCAT_APP_LoadPatch_Payload_t;

typedef struct {
  STARCAT_APP_Camera_t Camera; /* camera to be used from now on */
} STARCAT_APP_SetCamera_Payload_t;

typedef struct {
  uint32 MaxSteps; /* steps that a frame may take, 1 or more */
} STARCAT_APP_SetBudget_Payload_t;

typedef struct {
  uint32 Sequence;                            /* number of the frame */
  uint32 Seconds;                             /* middle of the exposure, spacecraft time */
  uint32 Subseconds;                          /* the same, in 2^-32 s */
  uint16 Count;                               /* centroids of the frame */
  uint16 Flags;                               /* 1: magnitudes are given, 2: noises are given */
  float X_px[STARCAT_APP_MAX_CENTROIDS];      /* from the left edge of the detector */
  float Y_px[STARCAT_APP_MAX_CENTROIDS];      /* from the upper edge of the detector */
  float Magnitude[STARCAT_APP_MAX_CENTROIDS]; /* magnitudes; not finite: unknown */
  float Sigma_px[STARCAT_APP_MAX_CENTROIDS];  /* noise of a centroid on each axis */
} STARCAT_APP_FrameTlm_Payload_t;

typedef struct {
  uint32 Sequence;           /* number of the frame */
  uint32 Seconds;            /* time of the frame */
  uint32 Subseconds;         /* the same, in 2^-32 s */
  int16 Status;              /* starcat_status, 0: identified */
  uint8 Reason;              /* starcat_reason, why there is no answer */
  uint8 Mode;                /* 0: no image, 1: identified, 2: tracked, 3: confirmed */
  uint16 Matched;            /* centroids that are stars of the image */
  uint16 Usable;             /* centroids that could be used */
  uint32 Steps;              /* steps that were taken */
  double Quaternion[4];      /* x, y, z, w: camera = A icrs, A and an example in starcat.h */
  double Covariance_rad2[6]; /* of turns about the camera's axes: xx, xy, xz, yy, yz, zz */
  double LogChance;          /* natural logarithm of the bound on chance */
  double Residual_rad;       /* root mean square of the matched centroids */
  double ReducedChiSquare;   /* squared residuals in the stated noise; 0: not stated */
} STARCAT_APP_AttitudeTlm_Payload_t;

typedef struct {
  uint8 CommandCounter;            /* commands that were obeyed */
  uint8 CommandErrorCounter;       /* commands that were not */
  uint8 Tracking;                  /* 1: begins with the last attitude */
  uint8 CameraSource;              /* 0: image, 1: table, 2: command */
  uint32 FramesIn;                 /* frames that came; the sum of the other counts of frames */
  uint32 FramesIdentified;         /* frames identified lost in space */
  uint32 FramesTracked;            /* frames identified from the last attitude */
  uint32 FramesNotIdentified[6];   /* frames without an answer, by starcat_reason from 1 on */
  uint32 FramesWithoutImage;       /* frames that came while no image could be used */
  uint32 FrameErrors;              /* frames of a wrong length, or that were refused */
  int16 LastStatus;                /* starcat_status of the last frame */
  int16 ImageStatus;               /* starcat_status of the image in use, 0: it can be used */
  uint8 ActiveSlot;               /* slot of the image in use */
  uint8 LoadState;                 /* 0: none, 1: reading, 2: checking, 3: ready, 4: failed */
  uint8 Spare[2];                  /* zeros */
  uint32 ImageBytes;               /* size of the image in use */
  uint32 LoadBytes;                /* bytes of the new image, or patch, that were read */
  uint32 LoadSize;                 /* size of the new image, or patch */
  uint32 MaxSteps;                 /* steps that a frame may take */
  uint32 ScrubBlock;               /* block that is checked next */
  uint32 ScrubPasses;              /* how often the whole image was checked */
  uint32 DamageFound;              /* how often a block of the image in use was damaged */
  uint32 BlocksMended;             /* blocks that were made anew from parity */
  uint32 FallBacks;                /* how often the other image had to take over */
  uint8 ImageDigest[32];           /* SHA-256 of the manifest of the image in use */
  char ImageName[STARCAT_APP_NAME_LEN]; /* name of the image in use */
} STARCAT_APP_HkTlm_Payload_t;

#endif
