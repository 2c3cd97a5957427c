/* The app: one task that takes frames, commands and ticks of idle time from its pipe.
 *
 * SPDX-License-Identifier: MIT
 */
#ifndef STARCAT_APP_H
#define STARCAT_APP_H

#include "cfe.h"

#include "starcat_session.h"

#include "starcat_app_eventids.h"
#include "starcat_app_msg.h"
#include "starcat_app_msgids.h"
#include "starcat_app_perfids.h"
#include "starcat_app_platform_cfg.h"
#include "starcat_app_tbl.h"

#if STARCAT_APP_MAX_CENTROIDS != STARCAT_MAX_CENTROIDS
#error "The library has to be compiled with STARCAT_MAX_CENTROIDS of STARCAT_APP_MAX_CENTROIDS"
#endif

typedef struct {
  uint32 RunStatus;
  CFE_SB_PipeId_t Pipe;
  CFE_TBL_Handle_t Table;
  STARCAT_APP_HkTlm_t HkTlm;
  STARCAT_APP_AttitudeTlm_t AttitudeTlm;

  starcat_settings Settings;
  starcat_session Session;     /* its clock counts 2^-32 s */
  starcat_answer Answer;       /* of the last frame */
  STARCAT_APP_Config_t Config; /* the table as it was taken over */
  uint32 FramesOfWrongLength;
  osal_id_t LoadFile;
} STARCAT_APP_Data_t;

extern STARCAT_APP_Data_t STARCAT_APP_Data;

/* starcat_app.c */
void STARCAT_APP_Main(void);
CFE_Status_t STARCAT_APP_Init(void);

/* starcat_app_dispatch.c */
void STARCAT_APP_TaskPipe(const CFE_SB_Buffer_t *Buffer);

/* starcat_app_cmds.c: commands, housekeeping */
void STARCAT_APP_FillHk(void);
void STARCAT_APP_NoopCmd(const STARCAT_APP_NoopCmd_t *Msg);
void STARCAT_APP_ResetCountersCmd(const STARCAT_APP_ResetCountersCmd_t *Msg);
void STARCAT_APP_LoadImageCmd(const STARCAT_APP_LoadImageCmd_t *Msg);
void STARCAT_APP_LoadPatchCmd(const STARCAT_APP_LoadPatchCmd_t *Msg);
void STARCAT_APP_SwitchImageCmd(const STARCAT_APP_SwitchImageCmd_t *Msg);
void STARCAT_APP_SetCameraCmd(const STARCAT_APP_SetCameraCmd_t *Msg);
void STARCAT_APP_EnableTrackingCmd(const STARCAT_APP_EnableTrackingCmd_t *Msg);
void STARCAT_APP_DisableTrackingCmd(const STARCAT_APP_DisableTrackingCmd_t *Msg);
void STARCAT_APP_SetBudgetCmd(const STARCAT_APP_SetBudgetCmd_t *Msg);
void STARCAT_APP_SendHkCmd(const STARCAT_APP_SendHkCmd_t *Msg);

/* starcat_app_config.c: table, camera */
CFE_Status_t STARCAT_APP_ValidateConfig(void *Table);
CFE_Status_t STARCAT_APP_ManageConfig(void);
void STARCAT_APP_SetTracking(uint8 Tracking);
void STARCAT_APP_TakeCamera(const STARCAT_APP_Camera_t *From, starcat_camera *Camera);

/* starcat_app_frame.c: frames to attitudes */
void STARCAT_APP_Frame(const STARCAT_APP_FrameTlm_t *Msg);

/* starcat_app_image.c: images in their slots */
void STARCAT_APP_StartImages(void);
CFE_Status_t STARCAT_APP_BeginLoad(const char *Path, uint32 Crc, bool IsPatch);
void STARCAT_APP_Wakeup(const STARCAT_APP_WakeupCmd_t *Msg);

#endif
