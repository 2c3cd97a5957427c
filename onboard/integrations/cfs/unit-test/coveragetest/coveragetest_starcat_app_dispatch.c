/* SPDX-License-Identifier: MIT */
#include "coveragetest_starcat.h"

/* Dispatch a message of an identifier, a code and a length. */
static void Dispatch(CFE_SB_MsgId_Atom_t Mid, CFE_MSG_FcnCode_t Code, size_t Length) {
  static STARCAT_APP_FrameTlm_t Largest;
  CFE_SB_MsgId_t MsgIds[2] = {CFE_SB_ValueToMsgId(Mid), CFE_SB_ValueToMsgId(Mid)};
  CFE_MSG_Size_t Size = Length;
  UT_ResetState(UT_KEY(CFE_MSG_GetMsgId));
  UT_ResetState(UT_KEY(CFE_MSG_GetFcnCode));
  UT_ResetState(UT_KEY(CFE_MSG_GetSize));
  UT_SetDataBuffer(UT_KEY(CFE_MSG_GetMsgId), MsgIds, sizeof MsgIds, true);
  UT_SetDataBuffer(UT_KEY(CFE_MSG_GetFcnCode), &Code, sizeof Code, true);
  UT_SetDataBuffer(UT_KEY(CFE_MSG_GetSize), &Size, sizeof Size, true);
  STARCAT_APP_TaskPipe((const CFE_SB_Buffer_t *)(const void *)&Largest);
}

/* Once with the right length, once with a wrong length, which is an error. */
#define CHECK_COMMAND(mid, code, function, type) \
  do {                                           \
    const uint8 Before = HK.CommandErrorCounter; \
    Dispatch((mid), (code), sizeof(type));       \
    CALLED(function, 1);                         \
    IS(HK.CommandErrorCounter, Before);          \
    Dispatch((mid), (code), sizeof(type) + 1);   \
    CALLED(function, 1);                         \
    IS(HK.CommandErrorCounter, Before + 1);      \
    IS(LastEvent(), STARCAT_APP_LEN_ERR_EID);    \
  } while (0)

static void TestCommands(void) {
  CHECK_COMMAND(STARCAT_APP_CMD_MID, STARCAT_APP_NOOP_CC, STARCAT_APP_NoopCmd,
                STARCAT_APP_NoopCmd_t);
  CHECK_COMMAND(STARCAT_APP_CMD_MID, STARCAT_APP_RESET_COUNTERS_CC, STARCAT_APP_ResetCountersCmd,
                STARCAT_APP_ResetCountersCmd_t);
  CHECK_COMMAND(STARCAT_APP_CMD_MID, STARCAT_APP_LOAD_IMAGE_CC, STARCAT_APP_LoadImageCmd,
                STARCAT_APP_LoadImageCmd_t);
  CHECK_COMMAND(STARCAT_APP_CMD_MID, STARCAT_APP_LOAD_PATCH_CC, STARCAT_APP_LoadPatchCmd,
                STARCAT_APP_LoadPatchCmd_t);
  CHECK_COMMAND(STARCAT_APP_CMD_MID, STARCAT_APP_SWITCH_IMAGE_CC, STARCAT_APP_SwitchImageCmd,
                STARCAT_APP_SwitchImageCmd_t);
  CHECK_COMMAND(STARCAT_APP_CMD_MID, STARCAT_APP_SET_CAMERA_CC, STARCAT_APP_SetCameraCmd,
                STARCAT_APP_SetCameraCmd_t);
  CHECK_COMMAND(STARCAT_APP_CMD_MID, STARCAT_APP_ENABLE_TRACKING_CC, STARCAT_APP_EnableTrackingCmd,
                STARCAT_APP_EnableTrackingCmd_t);
  CHECK_COMMAND(STARCAT_APP_CMD_MID, STARCAT_APP_DISABLE_TRACKING_CC,
                STARCAT_APP_DisableTrackingCmd, STARCAT_APP_DisableTrackingCmd_t);
  CHECK_COMMAND(STARCAT_APP_CMD_MID, STARCAT_APP_SET_BUDGET_CC, STARCAT_APP_SetBudgetCmd,
                STARCAT_APP_SetBudgetCmd_t);
}

static void TestOtherMessages(void) {
  CHECK_COMMAND(STARCAT_APP_SEND_HK_MID, 0, STARCAT_APP_SendHkCmd, STARCAT_APP_SendHkCmd_t);
  CHECK_COMMAND(STARCAT_APP_WAKEUP_MID, 0, STARCAT_APP_Wakeup, STARCAT_APP_WakeupCmd_t);
}

static void TestFrames(void) {
  Dispatch(STARCAT_APP_FRAME_TLM_MID, 0, sizeof(STARCAT_APP_FrameTlm_t));
  CALLED(STARCAT_APP_Frame, 1);
  IS(HK.FramesIn, 0); /* the handler counts it */
  Dispatch(STARCAT_APP_FRAME_TLM_MID, 0, sizeof(STARCAT_APP_FrameTlm_t) - 4);
  CALLED(STARCAT_APP_Frame, 1);
  IS(LastEvent(), STARCAT_APP_LEN_ERR_EID);
  IS(HK.FramesIn, 1);
  IS(STARCAT_APP_Data.FramesOfWrongLength, 1);
  IS(HK.CommandErrorCounter, 0);
}

static void TestUnknown(void) {
  Dispatch(STARCAT_APP_CMD_MID, 100, sizeof(STARCAT_APP_NoopCmd_t));
  IS(LastEvent(), STARCAT_APP_CC_ERR_EID);
  IS(HK.CommandErrorCounter, 1);
  Dispatch(STARCAT_APP_HK_TLM_MID, 0, sizeof(STARCAT_APP_NoopCmd_t));
  IS(LastEvent(), STARCAT_APP_MID_ERR_EID);
  IS(HK.CommandErrorCounter, 1);
}

void UtTest_Setup(void) {
  ADD(TestCommands);
  ADD(TestOtherMessages);
  ADD(TestFrames);
  ADD(TestUnknown);
}
