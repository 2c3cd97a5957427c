/* Start of the app, and its loop.
 *
 * SPDX-License-Identifier: MIT
 */
#include "starcat_app.h"

#include <string.h>

STARCAT_APP_Data_t STARCAT_APP_Data;

static CFE_Status_t MakePipe(void) {
  static const CFE_SB_MsgId_Atom_t Subscribed[] = {STARCAT_APP_CMD_MID, STARCAT_APP_SEND_HK_MID,
                                                   STARCAT_APP_WAKEUP_MID,
                                                   STARCAT_APP_FRAME_TLM_MID};
  CFE_Status_t Status =
      CFE_SB_CreatePipe(&STARCAT_APP_Data.Pipe, STARCAT_APP_PIPE_DEPTH, STARCAT_APP_PIPE_NAME);
  for (size_t n = 0; (n < sizeof Subscribed / sizeof Subscribed[0]) && (Status == CFE_SUCCESS);
       n++) {
    Status = CFE_SB_Subscribe(CFE_SB_ValueToMsgId(Subscribed[n]), STARCAT_APP_Data.Pipe);
  }
  if (Status != CFE_SUCCESS) {
    CFE_EVS_SendEvent(STARCAT_APP_PIPE_ERR_EID, CFE_EVS_EventType_ERROR,
                      "STARCAT: the pipe cannot be made, RC = 0x%08lX", (unsigned long)Status);
  }
  return Status;
}

static CFE_Status_t LoadTable(void) {
  CFE_Status_t Status = CFE_TBL_Register(&STARCAT_APP_Data.Table, STARCAT_APP_TABLE_NAME,
                                         sizeof(STARCAT_APP_Config_t), CFE_TBL_OPT_DEFAULT,
                                         STARCAT_APP_ValidateConfig);
  if (Status == CFE_SUCCESS) {
    Status = CFE_TBL_Load(STARCAT_APP_Data.Table, CFE_TBL_SRC_FILE, STARCAT_APP_TABLE_FILE);
  }
  if (Status == CFE_SUCCESS) {
    Status = STARCAT_APP_ManageConfig();
  }
  if (Status != CFE_SUCCESS) {
    CFE_EVS_SendEvent(STARCAT_APP_TABLE_ERR_EID, CFE_EVS_EventType_ERROR,
                      "STARCAT: no table of %s, RC = 0x%08lX", STARCAT_APP_TABLE_FILE,
                      (unsigned long)Status);
  }
  return Status;
}

CFE_Status_t STARCAT_APP_Init(void) {
  /* A camera that sends what is refused would flood the events. */
  static const CFE_EVS_BinFilter_t Filters[] = {{STARCAT_APP_FRAME_ERR_EID, CFE_EVS_FIRST_16_STOP}};
  memset(&STARCAT_APP_Data, 0, sizeof STARCAT_APP_Data);
  STARCAT_APP_Data.RunStatus = CFE_ES_RunStatus_APP_RUN;
  CFE_Status_t Status = CFE_EVS_Register(Filters, 1, CFE_EVS_EventFilter_BINARY);
  if (Status != CFE_SUCCESS) {
    CFE_ES_WriteToSysLog("STARCAT: events cannot be registered, RC = 0x%08lX\n",
                         (unsigned long)Status);
    return Status;
  }
  CFE_MSG_Init(CFE_MSG_PTR(STARCAT_APP_Data.HkTlm.TelemetryHeader),
               CFE_SB_ValueToMsgId(STARCAT_APP_HK_TLM_MID), sizeof STARCAT_APP_Data.HkTlm);
  CFE_MSG_Init(CFE_MSG_PTR(STARCAT_APP_Data.AttitudeTlm.TelemetryHeader),
               CFE_SB_ValueToMsgId(STARCAT_APP_ATTITUDE_TLM_MID),
               sizeof STARCAT_APP_Data.AttitudeTlm);
  STARCAT_APP_StartImages();
  Status = LoadTable();
  if (Status == CFE_SUCCESS) {
    Status = MakePipe();
  }
  if (Status == CFE_SUCCESS) {
    STARCAT_APP_FillHk();
    CFE_EVS_SendEvent(STARCAT_APP_INIT_INF_EID, CFE_EVS_EventType_INFORMATION,
                      "STARCAT: starcat %s started, image %.*s, status %d", starcat_version(),
                      STARCAT_APP_NAME_LEN, STARCAT_APP_Data.HkTlm.Payload.ImageName,
                      STARCAT_APP_Data.HkTlm.Payload.ImageStatus);
  }
  return Status;
}

void STARCAT_APP_Main(void) {
  CFE_SB_Buffer_t *Buffer;
  CFE_ES_PerfLogEntry(STARCAT_APP_PERF_ID);
  if (STARCAT_APP_Init() != CFE_SUCCESS) {
    STARCAT_APP_Data.RunStatus = CFE_ES_RunStatus_APP_ERROR;
  }
  while (CFE_ES_RunLoop(&STARCAT_APP_Data.RunStatus)) {
    CFE_ES_PerfLogExit(STARCAT_APP_PERF_ID);
    const CFE_Status_t Status =
        CFE_SB_ReceiveBuffer(&Buffer, STARCAT_APP_Data.Pipe, CFE_SB_PEND_FOREVER);
    CFE_ES_PerfLogEntry(STARCAT_APP_PERF_ID);
    if (Status == CFE_SUCCESS) {
      STARCAT_APP_TaskPipe(Buffer);
    } else {
      CFE_EVS_SendEvent(STARCAT_APP_PIPE_ERR_EID, CFE_EVS_EventType_ERROR,
                        "STARCAT: the pipe cannot be read, RC = 0x%08lX; the app ends",
                        (unsigned long)Status);
      STARCAT_APP_Data.RunStatus = CFE_ES_RunStatus_APP_ERROR;
    }
  }
  CFE_ES_PerfLogExit(STARCAT_APP_PERF_ID);
  CFE_ES_ExitApp(STARCAT_APP_Data.RunStatus);
}
