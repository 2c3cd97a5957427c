/* SPDX-License-Identifier: MIT */
#include "coveragetest_starcat.h"

static void TestNoop(void) {
  STARCAT_APP_NoopCmd(NULL);
  IS(HK.CommandCounter, 1);
  IS(LastEvent(), STARCAT_APP_NOOP_INF_EID);
}

static void TestResetCounters(void) {
  starcat_counts Zeros;
  memset(&Zeros, 0, sizeof Zeros);
  memset(&HK, 0x55, sizeof HK);
  memset(&SESSION.counts, 0x55, sizeof SESSION.counts);
  SESSION.scrub_next = 5;
  STARCAT_APP_Data.FramesOfWrongLength = 5;
  STARCAT_APP_ResetCountersCmd(NULL);
  IS(HK.CommandCounter + HK.CommandErrorCounter, 0);
  IS(HK.FramesIn + STARCAT_APP_Data.FramesOfWrongLength, 0);
  IS(memcmp(&SESSION.counts, &Zeros, sizeof Zeros), 0);
  IS(SESSION.scrub_next, 5); /* no counter */
  IS(LastEvent(), STARCAT_APP_RESET_INF_EID);
}

static void TestLoadImage(void) {
  STARCAT_APP_LoadImageCmd_t Msg;
  memset(&Msg, 'x', sizeof Msg); /* a path without an end */
  STARCAT_APP_LoadImageCmd(&Msg);
  IS(HK.CommandCounter, 1);
  ONCE(STARCAT_APP_BeginLoad, CFE_STATUS_EXTERNAL_RESOURCE_FAIL);
  STARCAT_APP_LoadImageCmd(&Msg);
  IS(HK.CommandCounter, 1);
  IS(HK.CommandErrorCounter, 1);
}

static void TestLoadPatch(void) {
  STARCAT_APP_LoadPatchCmd_t Msg;
  memset(&Msg, 0, sizeof Msg);
  STARCAT_APP_LoadPatchCmd(&Msg);
  IS(HK.CommandCounter, 1);
  CALLED(STARCAT_APP_BeginLoad, 1);
}

static void TestSwitchImage(void) {
  STARCAT_APP_SwitchImageCmd(NULL);
  IS(HK.CommandCounter, 1);
  CALLED(CFE_EVS_SendEvent, 0); /* a tick tells when it is done */
  ONCE(starcat_change_image, STARCAT_INCOMPLETE);
  STARCAT_APP_SwitchImageCmd(NULL);
  IS(HK.CommandErrorCounter, 1);
  IS(LastEvent(), STARCAT_APP_SWITCH_ERR_EID);
}

static void TestSetCamera(void) {
  STARCAT_APP_SetCameraCmd_t Msg;
  memset(&Msg, 0, sizeof Msg);
  Msg.Payload.Camera.FocalLength_px = 99.0;
  STARCAT_APP_SetCameraCmd(&Msg);
  IS(HK.CommandCounter, 1);
  IS(HK.CameraSource, STARCAT_APP_CAMERA_OF_COMMAND);
  IS(SETTINGS.camera.focal_length_px, 99);
  IS(SETTINGS.has_own_camera, 1);
  IS(LastEvent(), STARCAT_APP_CAMERA_INF_EID);
  Msg.Payload.Camera.FocalLength_px = 77.0;
  ONCE(starcat_check_settings, STARCAT_E_CAMERA);
  STARCAT_APP_SetCameraCmd(&Msg);
  IS(HK.CommandErrorCounter, 1);
  IS(SETTINGS.camera.focal_length_px, 99);
  IS(LastEvent(), STARCAT_APP_CAMERA_ERR_EID);
}

static void TestTracking(void) {
  STARCAT_APP_EnableTrackingCmd(NULL);
  IS(HK.Tracking, 1);
  STARCAT_APP_DisableTrackingCmd(NULL);
  IS(HK.Tracking, 0);
  IS(HK.CommandCounter, 2);
  IS(LastEvent(), STARCAT_APP_TRACKING_INF_EID);
}

static void TestSetBudget(void) {
  STARCAT_APP_SetBudgetCmd_t Msg;
  memset(&Msg, 0, sizeof Msg);
  Msg.Payload.MaxSteps = 500;
  STARCAT_APP_SetBudgetCmd(&Msg);
  IS(HK.CommandCounter, 1);
  IS(SETTINGS.max_steps_identify, 500);
  IS(LastEvent(), STARCAT_APP_BUDGET_INF_EID);
  Msg.Payload.MaxSteps = 0;
  ONCE(starcat_check_settings, STARCAT_E_OPTIONS);
  STARCAT_APP_SetBudgetCmd(&Msg);
  IS(HK.CommandErrorCounter, 1);
  IS(SETTINGS.max_steps_identify, 500);
  IS(LastEvent(), STARCAT_APP_BUDGET_ERR_EID);
}

static void TestSendHk(void) {
  static char Name[STARCAT_APP_NAME_LEN] = "name";
  static uint8 Digest[32] = {1, 2, 3};
  SESSION.image.name = Name;
  SESSION.image.manifest_sha256 = Digest;
  SESSION.slots.active = 1;
  SESSION.slots.size[1] = 4096;
  SESSION.counts.frames_not_identified[STARCAT_REASON_SHARE - 1] = 8;
  SESSION.counts.frames_refused = 2;
  STARCAT_APP_Data.FramesOfWrongLength = 3;
  STARCAT_APP_SendHkCmd(NULL);
  IS(HK.FramesNotIdentified[STARCAT_REASON_SHARE - 1], 8);
  IS(HK.FrameErrors, 5);
  IS(HK.ActiveSlot, 1);
  IS(HK.ImageBytes, 4096);
  IS(HK.ImageName[0], 'n');
  IS(HK.ImageDigest[2], 3);
  CALLED(CFE_SB_TimeStampMsg, 1);
  CALLED(CFE_SB_TransmitMsg, 1);
  CALLED(STARCAT_APP_ManageConfig, 1);
  IS(HK.CommandCounter, 0);
  ONCE(starcat_check_session, STARCAT_E_CRC);
  STARCAT_APP_SendHkCmd(NULL);
  IS(HK.ImageStatus, STARCAT_E_CRC);
  IS(HK.ImageBytes, 0);
  IS(HK.ImageName[0], 0);
}

void UtTest_Setup(void) {
  ADD(TestNoop);
  ADD(TestResetCounters);
  ADD(TestLoadImage);
  ADD(TestLoadPatch);
  ADD(TestSwitchImage);
  ADD(TestSetCamera);
  ADD(TestTracking);
  ADD(TestSetBudget);
  ADD(TestSendHk);
}
