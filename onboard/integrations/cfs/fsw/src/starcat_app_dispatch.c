/* Messages to those who handle them, once their length is right.
 *
 * SPDX-License-Identifier: MIT
 */
#include "starcat_app.h"

static bool HasLength(const CFE_SB_Buffer_t *Buffer, size_t Expected) {
  CFE_MSG_Size_t Length = 0;
  CFE_SB_MsgId_t MsgId = CFE_SB_INVALID_MSG_ID;
  CFE_MSG_GetSize(&Buffer->Msg, &Length);
  if (Length == Expected) {
    return true;
  }
  CFE_MSG_GetMsgId(&Buffer->Msg, &MsgId);
  CFE_EVS_SendEvent(STARCAT_APP_LEN_ERR_EID, CFE_EVS_EventType_ERROR,
                    "STARCAT: message 0x%X has %u bytes, not %u",
                    (unsigned int)CFE_SB_MsgIdToValue(MsgId), (unsigned int)Length,
                    (unsigned int)Expected);
  return false;
}

/* Call a handler if the length is right; count the command as wrong if not. */
#define OBEY(handler, type)                                 \
  do {                                                      \
    if (HasLength(Buffer, sizeof(type))) {                  \
      handler((const type *)Buffer);                        \
    } else {                                                \
      STARCAT_APP_Data.HkTlm.Payload.CommandErrorCounter++; \
    }                                                       \
  } while (0)

static void GroundCommand(const CFE_SB_Buffer_t *Buffer) {
  CFE_MSG_FcnCode_t Code = 0;
  CFE_MSG_GetFcnCode(&Buffer->Msg, &Code);
  switch (Code) {
    case STARCAT_APP_NOOP_CC:
      OBEY(STARCAT_APP_NoopCmd, STARCAT_APP_NoopCmd_t);
      break;
    case STARCAT_APP_RESET_COUNTERS_CC:
      OBEY(STARCAT_APP_ResetCountersCmd, STARCAT_APP_ResetCountersCmd_t);
      break;
    case STARCAT_APP_LOAD_IMAGE_CC:
      OBEY(STARCAT_APP_LoadImageCmd, STARCAT_APP_LoadImageCmd_t);
      break;
    case STARCAT_APP_SWITCH_IMAGE_CC:
      OBEY(STARCAT_APP_SwitchImageCmd, STARCAT_APP_SwitchImageCmd_t);
      break;
    case STARCAT_APP_SET_CAMERA_CC:
      OBEY(STARCAT_APP_SetCameraCmd, STARCAT_APP_SetCameraCmd_t);
      break;
    case STARCAT_APP_ENABLE_TRACKING_CC:
      OBEY(STARCAT_APP_EnableTrackingCmd, STARCAT_APP_EnableTrackingCmd_t);
      break;
    case STARCAT_APP_DISABLE_TRACKING_CC:
      OBEY(STARCAT_APP_DisableTrackingCmd, STARCAT_APP_DisableTrackingCmd_t);
      break;
    case STARCAT_APP_SET_BUDGET_CC:
      OBEY(STARCAT_APP_SetBudgetCmd, STARCAT_APP_SetBudgetCmd_t);
      break;
    case STARCAT_APP_LOAD_PATCH_CC:
      OBEY(STARCAT_APP_LoadPatchCmd, STARCAT_APP_LoadPatchCmd_t);
      break;
    default:
      STARCAT_APP_Data.HkTlm.Payload.CommandErrorCounter++;
      CFE_EVS_SendEvent(STARCAT_APP_CC_ERR_EID, CFE_EVS_EventType_ERROR,
                        "STARCAT: no command has code %u", (unsigned int)Code);
      break;
  }
}

void STARCAT_APP_TaskPipe(const CFE_SB_Buffer_t *Buffer) {
  CFE_SB_MsgId_t MsgId = CFE_SB_INVALID_MSG_ID;
  CFE_MSG_GetMsgId(&Buffer->Msg, &MsgId);
  switch (CFE_SB_MsgIdToValue(MsgId)) {
    case STARCAT_APP_FRAME_TLM_MID:
      if (HasLength(Buffer, sizeof(STARCAT_APP_FrameTlm_t))) {
        STARCAT_APP_Frame((const STARCAT_APP_FrameTlm_t *)Buffer);
      } else {
        STARCAT_APP_Data.HkTlm.Payload.FramesIn++;
        STARCAT_APP_Data.FramesOfWrongLength++;
      }
      break;
    case STARCAT_APP_WAKEUP_MID:
      OBEY(STARCAT_APP_Wakeup, STARCAT_APP_WakeupCmd_t);
      break;
    case STARCAT_APP_SEND_HK_MID:
      OBEY(STARCAT_APP_SendHkCmd, STARCAT_APP_SendHkCmd_t);
      break;
    case STARCAT_APP_CMD_MID:
      GroundCommand(Buffer);
      break;
    default:
      CFE_EVS_SendEvent(STARCAT_APP_MID_ERR_EID, CFE_EVS_EventType_ERROR,
                        "STARCAT: message 0x%X is none of the app's",
                        (unsigned int)CFE_SB_MsgIdToValue(MsgId));
      break;
  }
}
