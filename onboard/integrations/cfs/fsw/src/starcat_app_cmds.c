/* Commands and housekeeping.
 *
 * SPDX-License-Identifier: MIT
 */
#include "starcat_app.h"

#include <string.h>

#define HK (STARCAT_APP_Data.HkTlm.Payload)

void STARCAT_APP_NoopCmd(const STARCAT_APP_NoopCmd_t *Msg) {
  (void)Msg;
  HK.CommandCounter++;
  CFE_EVS_SendEvent(STARCAT_APP_NOOP_INF_EID, CFE_EVS_EventType_INFORMATION, "STARCAT: starcat %s",
                    starcat_version());
}

void STARCAT_APP_ResetCountersCmd(const STARCAT_APP_ResetCountersCmd_t *Msg) {
  (void)Msg;
  HK.CommandCounter = 0;
  HK.CommandErrorCounter = 0;
  HK.FramesIn = 0;
  HK.FramesIdentified = 0;
  HK.FramesTracked = 0;
  memset(HK.FramesNotIdentified, 0, sizeof HK.FramesNotIdentified);
  HK.FramesWithoutImage = 0;
  HK.FrameErrors = 0;
  HK.ScrubPasses = 0;
  HK.DamageFound = 0;
  HK.BlocksMended = 0;
  HK.FallBacks = 0;
  CFE_EVS_SendEvent(STARCAT_APP_RESET_INF_EID, CFE_EVS_EventType_INFORMATION,
                    "STARCAT: counters are 0");
}

static void Load(const char Given[STARCAT_APP_PATH_LEN], uint32 Crc, bool IsPatch) {
  char Path[STARCAT_APP_PATH_LEN + 1];
  memcpy(Path, Given, STARCAT_APP_PATH_LEN);
  Path[STARCAT_APP_PATH_LEN] = 0;
  if (STARCAT_APP_BeginLoad(Path, Crc, IsPatch) == CFE_SUCCESS) {
    HK.CommandCounter++;
  } else {
    HK.CommandErrorCounter++;
  }
}

void STARCAT_APP_LoadImageCmd(const STARCAT_APP_LoadImageCmd_t *Msg) {
  Load(Msg->Payload.Path, Msg->Payload.Crc, false);
}

void STARCAT_APP_LoadPatchCmd(const STARCAT_APP_LoadPatchCmd_t *Msg) {
  Load(Msg->Payload.Path, 0, true);
}

void STARCAT_APP_SwitchImageCmd(const STARCAT_APP_SwitchImageCmd_t *Msg) {
  (void)Msg;
  /* What is half read might be the old image still; what is not checked, or failed, may not be. */
  const bool IsBusy = (HK.LoadState == STARCAT_APP_LOAD_READING) ||
                      (HK.LoadState == STARCAT_APP_LOAD_CHECKING);
  starcat_image Image; /* a switch that fails writes it too */
  starcat_status Status = STARCAT_NO_MATCH;
  if (!IsBusy) {
    Status = starcat_switch_image(&STARCAT_APP_Data.Slots, &Image);
  }
  if (Status != STARCAT_OK) {
    HK.CommandErrorCounter++;
    CFE_EVS_SendEvent(STARCAT_APP_SWITCH_ERR_EID, CFE_EVS_EventType_ERROR,
                      "STARCAT: no switch: %s, status %d",
                      IsBusy ? "an image is being loaded" : "the other image cannot be used",
                      (int)Status);
    return;
  }
  HK.CommandCounter++;
  HK.LoadState = STARCAT_APP_LOAD_NONE;
  STARCAT_APP_Data.Image = Image;
  STARCAT_APP_ImageInUse(Status);
  CFE_EVS_SendEvent(STARCAT_APP_SWITCH_INF_EID, CFE_EVS_EventType_INFORMATION,
                    "STARCAT: image %.*s of slot %u is in use", STARCAT_APP_NAME_LEN, HK.ImageName,
                    (unsigned int)HK.ActiveSlot);
}

void STARCAT_APP_SetCameraCmd(const STARCAT_APP_SetCameraCmd_t *Msg) {
  starcat_camera Camera;
  STARCAT_APP_TakeCamera(&Msg->Payload.Camera, &Camera);
  const starcat_status Status = STARCAT_APP_CheckSettings(&Camera, &STARCAT_APP_Data.Options);
  if (Status != STARCAT_OK) {
    HK.CommandErrorCounter++;
    CFE_EVS_SendEvent(STARCAT_APP_CAMERA_ERR_EID, CFE_EVS_EventType_ERROR,
                      "STARCAT: the camera is refused with status %d; the old one stays",
                      (int)Status);
    return;
  }
  HK.CommandCounter++;
  HK.CameraSource = STARCAT_APP_CAMERA_OF_COMMAND;
  STARCAT_APP_Data.Camera = Camera;
  CFE_EVS_SendEvent(STARCAT_APP_CAMERA_INF_EID, CFE_EVS_EventType_INFORMATION,
                    "STARCAT: camera of %.1f by %.1f px, focal length %.3f px",
                    (double)Camera.width_px, (double)Camera.height_px,
                    (double)Camera.focal_length_px);
}

static void SetTracking(uint8 Tracking) {
  HK.CommandCounter++;
  HK.Tracking = Tracking;
  STARCAT_APP_Data.HasPrior = false;
  CFE_EVS_SendEvent(STARCAT_APP_TRACKING_INF_EID, CFE_EVS_EventType_INFORMATION,
                    "STARCAT: tracking is %s", Tracking != 0 ? "on" : "off");
}

void STARCAT_APP_EnableTrackingCmd(const STARCAT_APP_EnableTrackingCmd_t *Msg) {
  (void)Msg;
  SetTracking(1);
}

void STARCAT_APP_DisableTrackingCmd(const STARCAT_APP_DisableTrackingCmd_t *Msg) {
  (void)Msg;
  SetTracking(0);
}

void STARCAT_APP_SetBudgetCmd(const STARCAT_APP_SetBudgetCmd_t *Msg) {
  starcat_options Options = STARCAT_APP_Data.Options;
  Options.max_steps = Msg->Payload.MaxSteps;
  const starcat_status Status = STARCAT_APP_CheckSettings(NULL, &Options);
  if (Status != STARCAT_OK) {
    HK.CommandErrorCounter++;
    CFE_EVS_SendEvent(STARCAT_APP_BUDGET_ERR_EID, CFE_EVS_EventType_ERROR,
                      "STARCAT: a budget of %lu steps is refused with status %d",
                      (unsigned long)Msg->Payload.MaxSteps, (int)Status);
    return;
  }
  HK.CommandCounter++;
  HK.MaxSteps = Options.max_steps;
  STARCAT_APP_Data.Options = Options;
  CFE_EVS_SendEvent(STARCAT_APP_BUDGET_INF_EID, CFE_EVS_EventType_INFORMATION,
                    "STARCAT: a frame may take %lu steps", (unsigned long)HK.MaxSteps);
}

void STARCAT_APP_SendHkCmd(const STARCAT_APP_SendHkCmd_t *Msg) {
  (void)Msg;
  CFE_SB_TimeStampMsg(CFE_MSG_PTR(STARCAT_APP_Data.HkTlm.TelemetryHeader));
  CFE_SB_TransmitMsg(CFE_MSG_PTR(STARCAT_APP_Data.HkTlm.TelemetryHeader), true);
  (void)STARCAT_APP_ManageConfig();
}
