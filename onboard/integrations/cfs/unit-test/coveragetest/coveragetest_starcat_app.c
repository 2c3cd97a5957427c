/* SPDX-License-Identifier: MIT */
#include "coveragetest_starcat.h"

static void TestInit(void) {
  IS(STARCAT_APP_Init(), CFE_SUCCESS);
  IS(LastEvent(), STARCAT_APP_INIT_INF_EID);
  IS(STARCAT_APP_Data.RunStatus, CFE_ES_RunStatus_APP_RUN);
  CALLED(CFE_SB_Subscribe, 4);
  CALLED(CFE_MSG_Init, 2);
  CALLED(STARCAT_APP_StartImages, 1);
}

static void TestInitWithoutEvents(void) {
  ONCE(CFE_EVS_Register, CFE_EVS_INVALID_PARAMETER);
  IS(STARCAT_APP_Init(), CFE_EVS_INVALID_PARAMETER);
  CALLED(CFE_ES_WriteToSysLog, 1);
  CALLED(CFE_EVS_SendEvent, 0);
}

static void TestInitWithoutTable(void) {
  ONCE(CFE_TBL_Register, CFE_TBL_ERR_INVALID_OPTIONS);
  IS(STARCAT_APP_Init(), CFE_TBL_ERR_INVALID_OPTIONS);
  IS(LastEvent(), STARCAT_APP_TABLE_ERR_EID);
  ONCE(CFE_TBL_Load, CFE_TBL_ERR_FILE_TOO_LARGE);
  IS(STARCAT_APP_Init(), CFE_TBL_ERR_FILE_TOO_LARGE);
  ONCE(STARCAT_APP_ManageConfig, CFE_TBL_ERR_NEVER_LOADED);
  IS(STARCAT_APP_Init(), CFE_TBL_ERR_NEVER_LOADED);
  CALLED(CFE_EVS_SendEvent, 3);
  CALLED(CFE_SB_CreatePipe, 0);
}

static void TestInitWithoutPipe(void) {
  ONCE(CFE_SB_CreatePipe, CFE_SB_BAD_ARGUMENT);
  IS(STARCAT_APP_Init(), CFE_SB_BAD_ARGUMENT);
  IS(LastEvent(), STARCAT_APP_PIPE_ERR_EID);
  CALLED(CFE_SB_Subscribe, 0);
  LATER(CFE_SB_Subscribe, 3, CFE_SB_MAX_MSGS_MET);
  IS(STARCAT_APP_Init(), CFE_SB_MAX_MSGS_MET);
  IS(LastEvent(), STARCAT_APP_PIPE_ERR_EID);
  CALLED(CFE_SB_Subscribe, 3);
}

static void TestMain(void) {
  ONCE(CFE_ES_RunLoop, true);
  STARCAT_APP_Main();
  CALLED(STARCAT_APP_TaskPipe, 1);
  CALLED(CFE_ES_ExitApp, 1);
  IS(STARCAT_APP_Data.RunStatus, CFE_ES_RunStatus_APP_RUN);
}

static void TestMainOfAFailedStart(void) {
  ONCE(CFE_EVS_Register, CFE_EVS_INVALID_PARAMETER);
  STARCAT_APP_Main();
  IS(STARCAT_APP_Data.RunStatus, CFE_ES_RunStatus_APP_ERROR);
  CALLED(CFE_SB_ReceiveBuffer, 0);
  CALLED(CFE_ES_ExitApp, 1);
}

static void TestMainOfABrokenPipe(void) {
  ONCE(CFE_ES_RunLoop, true);
  ONCE(CFE_SB_ReceiveBuffer, CFE_SB_PIPE_RD_ERR);
  STARCAT_APP_Main();
  IS(LastEvent(), STARCAT_APP_PIPE_ERR_EID);
  IS(STARCAT_APP_Data.RunStatus, CFE_ES_RunStatus_APP_ERROR);
  CALLED(STARCAT_APP_TaskPipe, 0);
}

void UtTest_Setup(void) {
  ADD(TestInit);
  ADD(TestInitWithoutEvents);
  ADD(TestInitWithoutTable);
  ADD(TestInitWithoutPipe);
  ADD(TestMain);
  ADD(TestMainOfAFailedStart);
  ADD(TestMainOfABrokenPipe);
}
