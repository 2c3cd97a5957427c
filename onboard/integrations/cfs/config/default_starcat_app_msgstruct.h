/* The messages, with their headers.
 *
 * SPDX-License-Identifier: MIT
 */
#ifndef STARCAT_APP_MSGSTRUCT_H
#define STARCAT_APP_MSGSTRUCT_H

#include "cfe_msg_hdr.h"
#include "starcat_app_mission_cfg.h"
#include "starcat_app_msgdefs.h"

/* Commands without arguments. */
typedef struct {
  CFE_MSG_CommandHeader_t CommandHeader;
} STARCAT_APP_NoArgs_t;

typedef STARCAT_APP_NoArgs_t STARCAT_APP_NoopCmd_t;
typedef STARCAT_APP_NoArgs_t STARCAT_APP_ResetCountersCmd_t;
typedef STARCAT_APP_NoArgs_t STARCAT_APP_SwitchImageCmd_t;
typedef STARCAT_APP_NoArgs_t STARCAT_APP_EnableTrackingCmd_t;
typedef STARCAT_APP_NoArgs_t STARCAT_APP_DisableTrackingCmd_t;
typedef STARCAT_APP_NoArgs_t STARCAT_APP_SendHkCmd_t;
typedef STARCAT_APP_NoArgs_t STARCAT_APP_WakeupCmd_t;

typedef struct {
  CFE_MSG_CommandHeader_t CommandHeader;
  STARCAT_APP_LoadImage_Payload_t Payload;
} STARCAT_APP_LoadImageCmd_t;

typedef struct {
  CFE_MSG_CommandHeader_t CommandHeader;
  STARCAT_APP_LoadPatch_Payload_t Payload;
} STARCAT_APP_LoadPatchCmd_t;

typedef struct {
  CFE_MSG_CommandHeader_t CommandHeader;
  STARCAT_APP_SetCamera_Payload_t Payload;
} STARCAT_APP_SetCameraCmd_t;

typedef struct {
  CFE_MSG_CommandHeader_t CommandHeader;
  STARCAT_APP_SetBudget_Payload_t Payload;
} STARCAT_APP_SetBudgetCmd_t;

typedef struct {
  CFE_MSG_TelemetryHeader_t TelemetryHeader;
  STARCAT_APP_FrameTlm_Payload_t Payload;
} STARCAT_APP_FrameTlm_t;

typedef struct {
  CFE_MSG_TelemetryHeader_t TelemetryHeader;
  STARCAT_APP_AttitudeTlm_Payload_t Payload;
} STARCAT_APP_AttitudeTlm_t;

typedef struct {
  CFE_MSG_TelemetryHeader_t TelemetryHeader;
  STARCAT_APP_HkTlm_Payload_t Payload;
} STARCAT_APP_HkTlm_t;

#endif
