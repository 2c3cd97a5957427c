/* SPDX-License-Identifier: MIT */
#include "starcat_app_stubs.h"

CFE_Status_t STARCAT_APP_ValidateConfig(void *Table) {
  UT_GenStub_SetupReturnBuffer(STARCAT_APP_ValidateConfig, CFE_Status_t);
  UT_GenStub_AddParam(STARCAT_APP_ValidateConfig, void *, Table);
  UT_GenStub_Execute(STARCAT_APP_ValidateConfig, Basic, NULL);
  return UT_GenStub_GetReturnValue(STARCAT_APP_ValidateConfig, CFE_Status_t);
}

CFE_Status_t STARCAT_APP_ManageConfig(void) {
  UT_GenStub_SetupReturnBuffer(STARCAT_APP_ManageConfig, CFE_Status_t);
  UT_GenStub_Execute(STARCAT_APP_ManageConfig, Basic, NULL);
  return UT_GenStub_GetReturnValue(STARCAT_APP_ManageConfig, CFE_Status_t);
}

starcat_status STARCAT_APP_CheckSettings(const starcat_camera *Camera,
                                         const starcat_options *Options) {
  (void)Camera;
  (void)Options;
  return (starcat_status)UT_DEFAULT_IMPL(STARCAT_APP_CheckSettings);
}

void STARCAT_APP_TakeCamera(const STARCAT_APP_Camera_t *From, starcat_camera *Camera) {
  Camera->focal_length_px = (starcat_real)From->FocalLength_px;
  (void)UT_DEFAULT_IMPL(STARCAT_APP_TakeCamera);
}
