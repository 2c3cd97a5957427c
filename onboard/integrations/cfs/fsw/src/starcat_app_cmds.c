/* Commands and housekeeping.
 *
 * SPDX-License-Identifier: MIT
 */
#include "starcat_app.h"

#include <string.h>

#define HK (STARCAT_APP_Data.HkTlm.Payload)
#define SESSION (STARCAT_APP_Data.Session)
#define SETTINGS (STARCAT_APP_Data.Settings)

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
  STARCAT_APP_Data.FramesOfWrongLength = 0;
  memset(&SESSION.counts, 0, sizeof SESSION.counts);
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
  const starcat_status Status = starcat_change_image(&SESSION);
  if (Status != STARCAT_OK) {
    HK.CommandErrorCounter++;
    CFE_EVS_SendEvent(STARCAT_APP_SWITCH_ERR_EID, CFE_EVS_EventType_ERROR,
                      "STARCAT: no switch: the other image cannot be used, or not yet, status %d",
                      (int)Status);
    return;
  }
  HK.CommandCounter++;
}

void STARCAT_APP_SetCameraCmd(const STARCAT_APP_SetCameraCmd_t *Msg) {
  starcat_settings Settings = SETTINGS;
  const starcat_camera *Camera = &Settings.camera;
  STARCAT_APP_TakeCamera(&Msg->Payload.Camera, &Settings.camera);
  Settings.has_own_camera = 1;
  const starcat_status Status = starcat_check_settings(&Settings);
  if (Status != STARCAT_OK) {
    HK.CommandErrorCounter++;
    CFE_EVS_SendEvent(STARCAT_APP_CAMERA_ERR_EID, CFE_EVS_EventType_ERROR,
                      "STARCAT: the camera is refused with status %d; the old one stays",
                      (int)Status);
    return;
  }
  HK.CommandCounter++;
  HK.CameraSource = STARCAT_APP_CAMERA_OF_COMMAND;
  SETTINGS = Settings;
  CFE_EVS_SendEvent(STARCAT_APP_CAMERA_INF_EID, CFE_EVS_EventType_INFORMATION,
                    "STARCAT: camera of %.1f by %.1f px, focal length %.3f px",
                    (double)Camera->width_px, (double)Camera->height_px,
                    (double)Camera->focal_length_px);
}

static void SetTracking(uint8 Tracking) {
  HK.CommandCounter++;
  STARCAT_APP_SetTracking(Tracking);
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
  starcat_settings Settings = SETTINGS;
  Settings.max_steps_track = Msg->Payload.MaxSteps;
  Settings.max_steps_identify = Msg->Payload.MaxSteps;
  const starcat_status Status = starcat_check_settings(&Settings);
  if (Status != STARCAT_OK) {
    HK.CommandErrorCounter++;
    CFE_EVS_SendEvent(STARCAT_APP_BUDGET_ERR_EID, CFE_EVS_EventType_ERROR,
                      "STARCAT: a budget of %lu steps is refused with status %d",
                      (unsigned long)Msg->Payload.MaxSteps, (int)Status);
    return;
  }
  HK.CommandCounter++;
  SETTINGS = Settings;
  CFE_EVS_SendEvent(STARCAT_APP_BUDGET_INF_EID, CFE_EVS_EventType_INFORMATION,
                    "STARCAT: a frame may take %lu steps in each mode",
                    (unsigned long)Settings.max_steps_identify);
}

/* Fill housekeeping from the session. */
void STARCAT_APP_FillHk(void) {
  const starcat_counts *Counts = &SESSION.counts;
  const starcat_status ImageStatus = starcat_check_session(&SESSION);
  const bool HasImage = ImageStatus == STARCAT_OK;
  HK.FramesIdentified = Counts->frames_identified;
  HK.FramesTracked = Counts->frames_tracked;
  memcpy(HK.FramesNotIdentified, Counts->frames_not_identified, sizeof HK.FramesNotIdentified);
  HK.FramesWithoutImage = Counts->frames_without_image;
  HK.FrameErrors = Counts->frames_refused + STARCAT_APP_Data.FramesOfWrongLength;
  HK.ImageStatus = (int16)ImageStatus;
  HK.ActiveSlot = (uint8)SESSION.slots.active;
  HK.LoadState = (uint8)(SESSION.load == STARCAT_LOAD_ACCEPTED ? STARCAT_LOAD_READY : SESSION.load);
  HK.LoadBytes = (uint32)SESSION.load_bytes;
  HK.LoadSize = (uint32)SESSION.load_size;
  HK.MaxSteps = SETTINGS.max_steps_identify;
  HK.ScrubBlock = SESSION.scrub_next;
  HK.ScrubPasses = Counts->scrub_passes;
  HK.DamageFound = Counts->damage_found;
  HK.BlocksMended = Counts->blocks_mended;
  HK.FallBacks = Counts->fall_backs;
  HK.ImageBytes = 0;
  memset(HK.ImageName, 0, sizeof HK.ImageName);
  memset(HK.ImageDigest, 0, sizeof HK.ImageDigest);
  if (HasImage) {
    HK.ImageBytes = (uint32)SESSION.slots.size[SESSION.slots.active];
    memcpy(HK.ImageName, SESSION.image.name, sizeof HK.ImageName);
    memcpy(HK.ImageDigest, SESSION.image.manifest_sha256, sizeof HK.ImageDigest);
  }
}

void STARCAT_APP_SendHkCmd(const STARCAT_APP_SendHkCmd_t *Msg) {
  (void)Msg;
  STARCAT_APP_FillHk();
  CFE_SB_TimeStampMsg(CFE_MSG_PTR(STARCAT_APP_Data.HkTlm.TelemetryHeader));
  CFE_SB_TransmitMsg(CFE_MSG_PTR(STARCAT_APP_Data.HkTlm.TelemetryHeader), true);
  (void)STARCAT_APP_ManageConfig();
}
