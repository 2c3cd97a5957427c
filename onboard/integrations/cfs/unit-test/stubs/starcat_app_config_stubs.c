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

void STARCAT_APP_SetTracking(uint8 Tracking) {
  STARCAT_APP_Data.HkTlm.Payload.Tracking = Tracking;
  (void)UT_DEFAULT_IMPL(STARCAT_APP_SetTracking);
}

void STARCAT_APP_TakeCamera(const STARCAT_APP_Camera_t *From, starcat_camera *Camera) {
  Camera->focal_length_px = (starcat_real)From->FocalLength_px;
  (void)UT_DEFAULT_IMPL(STARCAT_APP_TakeCamera);
}
