/* SPDX-License-Identifier: MIT */
#include "coveragetest_starcat.h"

static void TestNoop(void) {
  STARCAT_APP_NoopCmd(NULL);
  IS(HK.CommandCounter, 1);
  IS(LastEvent(), STARCAT_APP_NOOP_INF_EID);
}

static void TestResetCounters(void) {
  STARCAT_APP_HkTlm_Payload_t Zeros;
  memset(&Zeros, 0, sizeof Zeros);
  memset(&HK, 0x55, sizeof HK);
  STARCAT_APP_ResetCountersCmd(NULL);
  IS(HK.CommandCounter + HK.CommandErrorCounter, 0);
  IS(HK.FramesIn + HK.FramesIdentified + HK.FramesTracked, 0);
  IS(memcmp(HK.FramesNotIdentified, Zeros.FramesNotIdentified, sizeof HK.FramesNotIdentified), 0);
  IS(HK.FramesWithoutImage + HK.FrameErrors, 0);
  IS(HK.ScrubPasses + HK.DamageFound + HK.BlocksMended + HK.FallBacks, 0);
  IS(HK.ScrubBlock, 0x55555555); /* no counter */
  IS(HK.ImageName[0], 0x55);
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
  HK.LoadState = STARCAT_APP_LOAD_READY;
  STARCAT_APP_SwitchImageCmd(NULL);
  IS(HK.CommandCounter, 1);
  IS(HK.LoadState, STARCAT_APP_LOAD_NONE);
  IS(STARCAT_APP_Data.Image.n_stars, 4321);
  CALLED(STARCAT_APP_ImageInUse, 1);
  IS(LastEvent(), STARCAT_APP_SWITCH_INF_EID);
}

static void TestSwitchImageThatCannotBe(void) {
  ONCE(starcat_switch_image, STARCAT_E_CRC);
  STARCAT_APP_SwitchImageCmd(NULL);
  IS(HK.CommandErrorCounter, 1);
  IS(LastEvent(), STARCAT_APP_SWITCH_ERR_EID);
  IS(STARCAT_APP_Data.Image.n_stars, 0); /* nothing changes */
  HK.LoadState = STARCAT_APP_LOAD_READING;
  STARCAT_APP_SwitchImageCmd(NULL);
  HK.LoadState = STARCAT_APP_LOAD_CHECKING;
  STARCAT_APP_SwitchImageCmd(NULL);
  IS(HK.CommandErrorCounter, 3);
  CALLED(starcat_switch_image, 1);
  CALLED(STARCAT_APP_ImageInUse, 0);
}

static void TestSetCamera(void) {
  STARCAT_APP_SetCameraCmd_t Msg;
  memset(&Msg, 0, sizeof Msg);
  Msg.Payload.Camera.FocalLength_px = 99.0;
  STARCAT_APP_SetCameraCmd(&Msg);
  IS(HK.CommandCounter, 1);
  IS(HK.CameraSource, STARCAT_APP_CAMERA_OF_COMMAND);
  IS(STARCAT_APP_Data.Camera.focal_length_px, 99);
  IS(LastEvent(), STARCAT_APP_CAMERA_INF_EID);
  Msg.Payload.Camera.FocalLength_px = 77.0;
  ONCE(STARCAT_APP_CheckSettings, STARCAT_E_CAMERA);
  STARCAT_APP_SetCameraCmd(&Msg);
  IS(HK.CommandErrorCounter, 1);
  IS(STARCAT_APP_Data.Camera.focal_length_px, 99);
  IS(LastEvent(), STARCAT_APP_CAMERA_ERR_EID);
}

static void TestTracking(void) {
  STARCAT_APP_Data.HasPrior = true;
  STARCAT_APP_EnableTrackingCmd(NULL);
  IS(HK.Tracking, 1);
  IS(STARCAT_APP_Data.HasPrior, false);
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
  IS(HK.MaxSteps, 500);
  IS(STARCAT_APP_Data.Options.max_steps, 500);
  IS(LastEvent(), STARCAT_APP_BUDGET_INF_EID);
  Msg.Payload.MaxSteps = 0;
  ONCE(STARCAT_APP_CheckSettings, STARCAT_E_OPTIONS);
  STARCAT_APP_SetBudgetCmd(&Msg);
  IS(HK.CommandErrorCounter, 1);
  IS(STARCAT_APP_Data.Options.max_steps, 500);
  IS(LastEvent(), STARCAT_APP_BUDGET_ERR_EID);
}

static void TestSendHk(void) {
  STARCAT_APP_SendHkCmd(NULL);
  CALLED(CFE_SB_TimeStampMsg, 1);
  CALLED(CFE_SB_TransmitMsg, 1);
  CALLED(STARCAT_APP_ManageConfig, 1);
  IS(HK.CommandCounter, 0);
}

void UtTest_Setup(void) {
  ADD(TestNoop);
  ADD(TestResetCounters);
  ADD(TestLoadImage);
  ADD(TestLoadPatch);
  ADD(TestSwitchImage);
  ADD(TestSwitchImageThatCannotBe);
  ADD(TestSetCamera);
  ADD(TestTracking);
  ADD(TestSetBudget);
  ADD(TestSendHk);
}
