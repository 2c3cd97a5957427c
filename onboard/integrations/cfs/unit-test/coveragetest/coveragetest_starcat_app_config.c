/* SPDX-License-Identifier: MIT */
#include "coveragetest_starcat.h"

static STARCAT_APP_Config_t Sound(void) {
  STARCAT_APP_Config_t Config;
  memset(&Config, 0, sizeof Config);
  Config.Prior_rad = 0.01;
  Config.ScrubBlocks = 1;
  Config.LoadPieces = 1;
  Config.MaxSteps = 100;
  return Config;
}

static int32 Validated(STARCAT_APP_Config_t Config) { return STARCAT_APP_ValidateConfig(&Config); }

static void TestValidate(void) {
  STARCAT_APP_Config_t Config = Sound();
  IS(Validated(Config), CFE_SUCCESS);
  Config.CameraOfImage = 1;
  IS(Validated(Config), CFE_SUCCESS);
  CALLED(CFE_EVS_SendEvent, 0);
  ONCE(starcat_check_settings, STARCAT_E_OPTIONS);
  IS(STARCAT_APP_ValidateConfig(&Config), -1);
  IS(LastEvent(), STARCAT_APP_TABLE_ERR_EID);
}

static void TestValidateRanges(void) {
  STARCAT_APP_Config_t Bad[7];
  for (uint32 n = 0; n < 7; n++) {
    Bad[n] = Sound();
  }
  Bad[0].Prior_rad = 0.0;
  Bad[1].Prior_rad = 0.36;
  Bad[2].Prior_rad = (double)__builtin_nan("");
  Bad[3].ScrubBlocks = 0;
  Bad[4].LoadPieces = 0;
  Bad[5].CameraOfImage = 2;
  Bad[6].Tracking = 2;
  for (uint32 n = 0; n < 7; n++) {
    IS(Validated(Bad[n]), -1);
  }
  CALLED(CFE_EVS_SendEvent, 7);
}

static void Manage(STARCAT_APP_Config_t *Config) {
  void *Address = Config;
  UT_SetDataBuffer(UT_KEY(CFE_TBL_GetAddress), &Address, sizeof Address, true);
  ONCE(CFE_TBL_GetAddress, CFE_TBL_INFO_UPDATED);
  IS(STARCAT_APP_ManageConfig(), CFE_SUCCESS);
}

static void TestManage(void) {
  STARCAT_APP_Config_t Config = Sound();
  Config.Camera.FocalLength_px = 500.0;
  Config.Tolerance_px = 3.0;
  Config.Tracking = 1;
  Config.PriorAge_ms = 2000;
  SESSION.has_prior = 1;
  Manage(&Config);
  IS(HK.CameraSource, STARCAT_APP_CAMERA_OF_TABLE);
  IS(SETTINGS.camera.focal_length_px, 500);
  IS(SETTINGS.options.tolerance_px, 3);
  IS(SETTINGS.max_steps_identify, 100);
  IS(SETTINGS.has_own_camera, 1);
  IS(HK.Tracking, 1);
  UtAssert_True(SETTINGS.prior_age == (uint64)2 << 32, "age");
  IS(SESSION.has_prior, 0);
  IS(LastEvent(), STARCAT_APP_TABLE_INF_EID);
  Config.CameraOfImage = 1;
  Config.Tracking = 0;
  Manage(&Config);
  IS(SETTINGS.prior_age, 0);
  IS(HK.CameraSource, STARCAT_APP_CAMERA_OF_IMAGE);
  IS(SETTINGS.has_own_camera, 0);
  CALLED(CFE_TBL_Manage, 2);
  CALLED(CFE_TBL_ReleaseAddress, 2);
}

static void TestManageNothingNew(void) {
  IS(STARCAT_APP_ManageConfig(), CFE_SUCCESS);
  CALLED(CFE_TBL_ReleaseAddress, 1);
  CALLED(CFE_EVS_SendEvent, 0);
  ONCE(CFE_TBL_GetAddress, CFE_TBL_ERR_NEVER_LOADED);
  IS(STARCAT_APP_ManageConfig(), CFE_TBL_ERR_NEVER_LOADED);
  CALLED(CFE_TBL_ReleaseAddress, 1);
}

void UtTest_Setup(void) {
  ADD(TestValidate);
  ADD(TestValidateRanges);
  ADD(TestManage);
  ADD(TestManageNothingNew);
}
