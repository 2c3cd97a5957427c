/* SPDX-License-Identifier: MIT */
#include "starcat_app_stubs.h"

STUB_OF_HANDLER(STARCAT_APP_Wakeup, STARCAT_APP_WakeupCmd_t)

void STARCAT_APP_StartImages(void) { UT_GenStub_Execute(STARCAT_APP_StartImages, Basic, NULL); }

CFE_Status_t STARCAT_APP_BeginLoad(const char *Path, uint32 Crc, bool IsPatch) {
  UT_GenStub_SetupReturnBuffer(STARCAT_APP_BeginLoad, CFE_Status_t);
  UT_GenStub_AddParam(STARCAT_APP_BeginLoad, const char *, Path);
  UT_GenStub_AddParam(STARCAT_APP_BeginLoad, uint32, Crc);
  UT_GenStub_AddParam(STARCAT_APP_BeginLoad, bool, IsPatch);
  UT_GenStub_Execute(STARCAT_APP_BeginLoad, Basic, NULL);
  return UT_GenStub_GetReturnValue(STARCAT_APP_BeginLoad, CFE_Status_t);
}
