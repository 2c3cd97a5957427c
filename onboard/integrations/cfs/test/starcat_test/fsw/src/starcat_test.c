/* Test app: plays a flight of 1,000 frames to starcat_app over the software bus, checks what comes
 * back, records every packet in order in /cf/run.ccsds, and restarts the processor at the end, which
 * ends the program of a native build. check_run.c then compares the recording with the truth and
 * with the library.
 *
 * SPDX-License-Identifier: MIT
 */
#include "cfe.h"
#include "cfe_es_msg.h"
#include "cfe_evs_msg.h"
#include "cfe_msgids.h"
#include "cfe_tbl_msg.h"
#include "starcat_app.h"
#include "starcat_test_values.h"

#include <math.h>
#include <string.h>

#define TIMEOUT_MS 5000
#define SETTLE_MS 150 /* for tasks of table services */
#define QUIET_MS 2000 /* event services hold back who sends more than 15 events a second */
#define N_EVENT_IDS 32
#define MOST_TICKS 2000
#define BLOCK_BYTES 4096u
#define BURST 4 /* default number of messages of one identifier in a pipe */

typedef STARCAT_APP_HkTlm_Payload_t hk;

static CFE_SB_PipeId_t Pipe;
static osal_id_t Recording, Sources[3];
static STARCAT_APP_FrameTlm_t Frame;
static STARCAT_APP_AttitudeTlm_Payload_t Attitude;
static hk Hk;
static uint32 Checks, Failures, FrameClock;
static uint32 Events[N_EVENT_IDS]; /* events of starcat_app, by identifier */
static uint8 Obeyed, Refused;      /* commands, as they have to be counted */
static uint32 Seen, Identified, Tracked, Errors, Longest_us, LongestSwitch_us, LongestMend_us;

#define CHECK(condition)                                                  \
  do {                                                                    \
    Checks++;                                                             \
    if (!(condition)) {                                                   \
      Failures++;                                                         \
      OS_printf("starcat_test.c:%d: not so: %s\n", __LINE__, #condition); \
    }                                                                     \
  } while (0)

static void Record(const CFE_MSG_Message_t *Msg) {
  CFE_MSG_Size_t Size = 0;
  CFE_MSG_GetSize(Msg, &Size);
  (void)OS_write(Recording, Msg, Size);
}

/* Send a message whose payload is filled in; the header, which clears it, is written here. */
static void Send(CFE_MSG_Message_t *Msg, CFE_SB_MsgId_Atom_t MsgId, CFE_MSG_FcnCode_t Code,
                 size_t Size) {
  static uint8 Kept[sizeof Frame];
  const size_t Header = MsgId == STARCAT_APP_FRAME_TLM_MID ? sizeof(CFE_MSG_TelemetryHeader_t)
                                                           : sizeof(CFE_MSG_CommandHeader_t);
  memcpy(Kept, Msg, Size);
  CFE_MSG_Init(Msg, CFE_SB_ValueToMsgId(MsgId), Size);
  (void)CFE_MSG_SetFcnCode(Msg, Code); /* a frame has none */
  memcpy((uint8 *)Msg + Header, Kept + Header, Size - Header);
  Record(Msg);
  CHECK(CFE_SB_TransmitMsg(Msg, true) == CFE_SUCCESS);
}

/* Wait for a message; keep count of the app's events, and of attitudes and housekeeping on the
 * way. */
static bool Await(CFE_SB_MsgId_Atom_t Wanted) {
  for (;;) {
    CFE_SB_Buffer_t *Buffer = NULL;
    CFE_SB_MsgId_t MsgId = CFE_SB_INVALID_MSG_ID;
    if (CFE_SB_ReceiveBuffer(&Buffer, Pipe, Wanted == 0 ? CFE_SB_POLL : TIMEOUT_MS) !=
        CFE_SUCCESS) {
      return Wanted == 0;
    }
    CFE_MSG_GetMsgId(&Buffer->Msg, &MsgId);
    const CFE_SB_MsgId_Atom_t Value = CFE_SB_MsgIdToValue(MsgId);
    if (Value == CFE_EVS_LONG_EVENT_MSG_MID) {
      const CFE_EVS_LongEventTlm_t *Event = (const CFE_EVS_LongEventTlm_t *)Buffer;
      if ((strcmp(Event->Payload.PacketID.AppName, "STARCAT_APP") == 0) &&
          (Event->Payload.PacketID.EventID < N_EVENT_IDS)) {
        Events[Event->Payload.PacketID.EventID]++;
      }
    } else {
      Record(&Buffer->Msg);
      if (Value == STARCAT_APP_ATTITUDE_TLM_MID) {
        Attitude = ((const STARCAT_APP_AttitudeTlm_t *)Buffer)->Payload;
      } else {
        Hk = ((const STARCAT_APP_HkTlm_t *)Buffer)->Payload;
      }
    }
    if (Value == Wanted) {
      return true;
    }
  }
}

static void AskHk(void) {
  STARCAT_APP_SendHkCmd_t Msg;
  Send(CFE_MSG_PTR(Msg.CommandHeader), STARCAT_APP_SEND_HK_MID, 0, sizeof Msg);
  CHECK(Await(STARCAT_APP_HK_TLM_MID));
  CHECK(Hk.CommandCounter == Obeyed);
  CHECK(Hk.CommandErrorCounter == Refused);
  CHECK(Hk.FramesIn == Seen);
  CHECK(Hk.FramesIdentified == Identified);
  CHECK(Hk.FramesTracked == Tracked);
  CHECK(Hk.FrameErrors == Errors);
  uint32 Sum = Hk.FramesIdentified + Hk.FramesTracked + Hk.FrameErrors + Hk.FramesWithoutImage;
  for (uint32 n = 0; n < 6u; n++) {
    Sum += Hk.FramesNotIdentified[n];
  }
  CHECK(Sum == Hk.FramesIn);
}

static void Wakeup(void) {
  STARCAT_APP_WakeupCmd_t Msg;
  Send(CFE_MSG_PTR(Msg.CommandHeader), STARCAT_APP_WAKEUP_MID, 0, sizeof Msg);
}

/* A command of any payload, and what it has to come to. */
static void Command(CFE_MSG_FcnCode_t Code, const void *Payload, size_t Size, bool IsRight) {
  union {
    CFE_SB_Buffer_t Aligned;
    uint8 Bytes[sizeof(STARCAT_APP_SetCameraCmd_t) + 8];
  } Msg;
  memset(&Msg, 0, sizeof Msg);
  if (Size > 0) {
    memcpy(Msg.Bytes + sizeof(CFE_MSG_CommandHeader_t), Payload, Size);
  }
  Send(&Msg.Aligned.Msg, STARCAT_APP_CMD_MID, Code, sizeof(CFE_MSG_CommandHeader_t) + Size);
  Obeyed = (uint8)(Obeyed + IsRight);
  Refused = (uint8)(Refused + !IsRight);
  AskHk();
}

static void LoadImage(const char *Path, uint32 Crc, bool IsRight) {
  STARCAT_APP_LoadImage_Payload_t Payload;
  memset(&Payload, 0, sizeof Payload);
  strncpy(Payload.Path, Path, sizeof Payload.Path - 1);
  Payload.Crc = Crc;
  Command(STARCAT_APP_LOAD_IMAGE_CC, &Payload, sizeof Payload, IsRight);
}

static void LoadPatch(const char *Path, bool IsRight) {
  STARCAT_APP_LoadPatch_Payload_t Payload;
  memset(&Payload, 0, sizeof Payload);
  strncpy(Payload.Path, Path, sizeof Payload.Path - 1);
  Command(STARCAT_APP_LOAD_PATCH_CC, &Payload, sizeof Payload, IsRight);
}

static void SetCamera(double FocalLength_px, bool IsRight) {
  STARCAT_APP_SetCamera_Payload_t Payload;
  memset(&Payload, 0, sizeof Payload);
  Payload.Camera.Width_px = Payload.Camera.Height_px = 512.0;
  Payload.Camera.X0_px = Payload.Camera.Y0_px = 256.0;
  Payload.Camera.FocalLength_px = FocalLength_px;
  Command(STARCAT_APP_SET_CAMERA_CC, &Payload, sizeof Payload, IsRight);
}

static void SetBudget(uint32 MaxSteps, bool IsRight) {
  const STARCAT_APP_SetBudget_Payload_t Payload = {MaxSteps};
  Command(STARCAT_APP_SET_BUDGET_CC, &Payload, sizeof Payload, IsRight);
  CHECK(!IsRight || (Hk.MaxSteps == MaxSteps));
}

static uint32 Since_us(OS_time_t Before) {
  OS_time_t After;
  OS_GetLocalTime(&After);
  return (uint32)OS_TimeGetTotalMicroseconds(OS_TimeSubtract(After, Before));
}

/* Send the frame that lies ready, at its time. */
static void PostFrame(void) {
  Frame.Payload.Seconds = FrameClock / 10;
  Frame.Payload.Subseconds = (uint32)(((uint64)(FrameClock % 10) << 32) / 10);
  FrameClock++;
  Send(CFE_MSG_PTR(Frame.TelemetryHeader), STARCAT_APP_FRAME_TLM_MID, 0, sizeof Frame);
}

/* Take the attitude of a frame. */
static void TakeAttitude(uint32 Sequence) {
  CHECK(Await(STARCAT_APP_ATTITUDE_TLM_MID));
  CHECK(Attitude.Sequence == Sequence);
  Seen++;
  Identified += (Attitude.Status == STARCAT_IDENTIFIED) && (Attitude.Mode == 1);
  Tracked += (Attitude.Status == STARCAT_IDENTIFIED) && (Attitude.Mode == 2);
  Errors += (Attitude.Status < 0) && (Attitude.Status != STARCAT_E_BUDGET) && (Attitude.Mode != 0);
}

static bool NextFrame(uint32 Source) {
  return OS_read(Sources[Source], &Frame.Payload, sizeof Frame.Payload) ==
         (int32)sizeof Frame.Payload;
}

static void SendFrame(void) {
  OS_time_t Before;
  OS_GetLocalTime(&Before);
  PostFrame();
  TakeAttitude(Frame.Payload.Sequence);
  const uint32 Took_us = Since_us(Before);
  Longest_us = Took_us > Longest_us ? Took_us : Longest_us;
  CHECK(Attitude.Seconds == Frame.Payload.Seconds);
  CHECK(Attitude.Subseconds == Frame.Payload.Subseconds);
}

/* The next frames of a file: 0 sky A, 1 its slew, 2 sky B. Each is followed by a tick. */
static void Fly(uint32 Source, uint32 Count) {
  for (uint32 n = 0; n < Count; n++) {
    CHECK(NextFrame(Source));
    SendFrame();
    CHECK(Attitude.Status == STARCAT_IDENTIFIED);
    Wakeup();
  }
  AskHk();
}

/* The last frame again, as one that no answer is to be found for. */
static void FlyExtra(int16 Status) {
  static uint32 Extras;
  Frame.Payload.Sequence = TEST_FIRST_EXTRA + Extras;
  Extras++;
  SendFrame();
  CHECK(Attitude.Status == Status);
  CHECK(Attitude.Quaternion[3] == 0.0);
  AskHk();
}

/* Frames go on until a load has come to an end. */
static void FlyUntilLoaded(uint32 Source, uint8 State) {
  uint32 Ticks = 0;
  Longest_us = 0;
  while (
      ((Hk.LoadState == STARCAT_APP_LOAD_READING) || (Hk.LoadState == STARCAT_APP_LOAD_CHECKING)) &&
      (Ticks < MOST_TICKS)) {
    Fly(Source, Ticks % 4 == 0);
    Wakeup();
    AskHk();
    Ticks++;
  }
  OS_printf("starcat_test: loaded in %lu ticks, to state %u\n", (unsigned long)Ticks, Hk.LoadState);
  CHECK(Hk.LoadState == State);
}

static void Switch(const char *Name, bool IsRight) {
  OS_time_t Before;
  OS_GetLocalTime(&Before);
  const uint32 Switches = Events[STARCAT_APP_SWITCH_INF_EID];
  Command(STARCAT_APP_SWITCH_IMAGE_CC, NULL, 0, IsRight);
  for (uint32 n = 0;
       IsRight && (n < MOST_TICKS) && (Events[STARCAT_APP_SWITCH_INF_EID] == Switches); n++) {
    Wakeup();
    AskHk();
  }
  const uint32 Took_us = Since_us(Before);
  LongestSwitch_us = Took_us > LongestSwitch_us ? Took_us : LongestSwitch_us;
  CHECK(Hk.ImageStatus == STARCAT_OK);
  CHECK(strcmp(Hk.ImageName, Name) == 0);
}

static void TestRefusals(void) {
  STARCAT_APP_FrameTlm_t Short;
  const STARCAT_APP_NoopCmd_t Unused = {{{{{{0}}}}}};
  Command(STARCAT_APP_NOOP_CC, NULL, 0, true);
  CHECK(Events[STARCAT_APP_NOOP_INF_EID] == 1);
  Command(STARCAT_APP_NOOP_CC, &Unused, 1, false);
  Command(STARCAT_APP_LOAD_IMAGE_CC, &Unused, 3, false);
  CHECK(Events[STARCAT_APP_LEN_ERR_EID] == 2);
  Command(99, NULL, 0, false);
  CHECK(Events[STARCAT_APP_CC_ERR_EID] == 1);
  LoadImage("/cf/nothing.img", 0, false);
  CHECK(Events[STARCAT_APP_LOAD_ERR_EID] == 1);
  Switch(TEST_IMAGE_A, false);
  CHECK(Events[STARCAT_APP_SWITCH_ERR_EID] == 1);
  SetCamera((double)NAN, false);
  SetCamera(-1.0, false);
  CHECK(Events[STARCAT_APP_CAMERA_ERR_EID] == 2);
  CHECK(Hk.CameraSource == STARCAT_APP_CAMERA_OF_IMAGE);
  SetBudget(0, false);
  CHECK(Events[STARCAT_APP_BUDGET_ERR_EID] == 1);
  memset(&Short, 0, sizeof Short);
  Send(CFE_MSG_PTR(Short.TelemetryHeader), STARCAT_APP_FRAME_TLM_MID, 0, sizeof Short - 4);
  Seen++;
  Errors++;
  AskHk();
  CHECK(Events[STARCAT_APP_LEN_ERR_EID] == 3);
  memset(&Frame.Payload, 0, sizeof Frame.Payload);
  Frame.Payload.Count = STARCAT_APP_MAX_CENTROIDS + 1;
  FlyExtra(STARCAT_E_TOO_MANY_CENTROIDS);
  Frame.Payload.Count = 0;
  FlyExtra(STARCAT_TOO_FEW_STARS);
  CHECK(Hk.FramesNotIdentified[STARCAT_REASON_TOO_FEW_STARS - 1] == 1);
  CHECK(Events[STARCAT_APP_FRAME_ERR_EID] == 1);
  Refused = 0;
  Obeyed = (uint8)-1; /* the next command makes it 0 */
  Seen = Identified = Tracked = Errors = 0;
  Command(STARCAT_APP_RESET_COUNTERS_CC, NULL, 0, true);
}

static void TestTracking(void) {
  Command(STARCAT_APP_ENABLE_TRACKING_CC, NULL, 0, true);
  CHECK(Hk.Tracking == 1);
  Fly(1, TEST_FRAMES_SLEW / 2);
  FrameClock += TEST_MISS_PERIODS; /* the last attitude is too old now */
  Fly(1, TEST_FRAMES_SLEW / 2);
  CHECK(Tracked == TEST_FRAMES_SLEW - 2);
  Command(STARCAT_APP_DISABLE_TRACKING_CC, NULL, 0, true);
  Fly(0, 5);
  CHECK(Tracked == TEST_FRAMES_SLEW - 2);
}

static void TestReload(void) {
  LoadImage("/cf/b.img", 0, true);
  Switch(TEST_IMAGE_A, false);
  FlyUntilLoaded(0, STARCAT_APP_LOAD_READY);
  OS_printf("starcat_test: longest answer meanwhile %lu us\n", (unsigned long)Longest_us);
  Switch(TEST_IMAGE_B, true);
  Fly(2, 100);
  Switch(TEST_IMAGE_A, true); /* falls back */
  FlyExtra(STARCAT_NO_MATCH); /* a frame of sky B */
  Fly(0, 30);
  Switch(TEST_IMAGE_B, true);
}

static void TestSettings(void) {
  SetCamera(703.35 * 1.2, true);
  CHECK(Hk.CameraSource == STARCAT_APP_CAMERA_OF_COMMAND);
  Fly(2, 0);
  FlyExtra(STARCAT_NO_MATCH);
  SetCamera(703.35, true);
  Fly(2, 20);
  SetBudget(TEST_BUDGET, true);
  FlyExtra(STARCAT_E_BUDGET);
  CHECK(Hk.FramesNotIdentified[STARCAT_REASON_STEPS - 1] == 1);
  SetBudget(4000000, true);
  Fly(2, 20);
}

static void TableLoad(const char *Path) {
  CFE_TBL_LoadCmd_t Load;
  CFE_TBL_ValidateCmd_t Validate;
  CFE_TBL_ActivateCmd_t Activate;
  memset(&Load, 0, sizeof Load);
  memset(&Validate, 0, sizeof Validate);
  memset(&Activate, 0, sizeof Activate);
  strncpy(Load.Payload.LoadFilename, Path, sizeof Load.Payload.LoadFilename - 1);
  strcpy(Validate.Payload.TableName, "STARCAT_APP.Config");
  strcpy(Activate.Payload.TableName, "STARCAT_APP.Config");
  Validate.Payload.ActiveTableFlag = CFE_TBL_BufferSelect_INACTIVE;
  Send(CFE_MSG_PTR(Load.CommandHeader), CFE_TBL_CMD_MID, CFE_TBL_LOAD_CC, sizeof Load);
  OS_TaskDelay(SETTLE_MS);
  Send(CFE_MSG_PTR(Validate.CommandHeader), CFE_TBL_CMD_MID, CFE_TBL_VALIDATE_CC, sizeof Validate);
  OS_TaskDelay(SETTLE_MS);
  AskHk(); /* the app validates in this call */
  AskHk();
  Send(CFE_MSG_PTR(Activate.CommandHeader), CFE_TBL_CMD_MID, CFE_TBL_ACTIVATE_CC, sizeof Activate);
  OS_TaskDelay(SETTLE_MS);
  AskHk(); /* after which the app takes it over */
  AskHk();
}

static void TestTable(void) {
  CFE_TBL_AbortLoadCmd_t Abort;
  TableLoad("/cf/starcat_bad.tbl");
  CHECK(Events[STARCAT_APP_TABLE_ERR_EID] == 1);
  CHECK(Hk.CameraSource == STARCAT_APP_CAMERA_OF_IMAGE);
  memset(&Abort, 0, sizeof Abort);
  strcpy(Abort.Payload.TableName, "STARCAT_APP.Config");
  Send(CFE_MSG_PTR(Abort.CommandHeader), CFE_TBL_CMD_MID, CFE_TBL_ABORT_LOAD_CC, sizeof Abort);
  Fly(0, 10);
  const uint32 Taken = Events[STARCAT_APP_TABLE_INF_EID];
  TableLoad("/cf/starcat_good.tbl");
  CHECK(Events[STARCAT_APP_TABLE_ERR_EID] == 1);
  CHECK(Events[STARCAT_APP_TABLE_INF_EID] == Taken + 1);
  CHECK(Hk.CameraSource == STARCAT_APP_CAMERA_OF_TABLE);
  CHECK(Hk.Tracking == 1);
  Fly(0, 50);
}

static void TestDamagedFiles(void) {
  static const char *const Damaged[3] = {"/cf/damaged.img", "/cf/headless.img", "/cf/cut.img"};
  Switch(TEST_IMAGE_A, true);
  for (uint32 n = 0; n < 3; n++) {
    LoadImage(Damaged[n], 0,
              true); /* a damaged block, one in the header, blocks that are not there */
    FlyUntilLoaded(0, STARCAT_APP_LOAD_FAILED);
    CHECK(Events[STARCAT_APP_REFUSED_ERR_EID] == n + 1);
    Switch(TEST_IMAGE_A, false);
  }
  LoadImage("/cf/b.img", 0x12345678, true); /* another image than was stated */
  FlyUntilLoaded(0, STARCAT_APP_LOAD_FAILED);
  CHECK(Events[STARCAT_APP_REFUSED_ERR_EID] == 4);
  LoadImage("/cf/odd.img", 0, false); /* not a size of an image */
  LoadImage("/cf/big.img", 0, false);
  LoadImage("/cf/b.img", 0, true);
  LoadImage("/cf/b.img", 0, true); /* begins again */
  FlyUntilLoaded(0, STARCAT_APP_LOAD_READY);
}

/* Bits of the image in use are turned over, as by radiation, in the app's memory. */
static void Upset(STARCAT_APP_Data_t *App, size_t Offset) {
  App->Session.slots.bytes[App->Session.slots.active][Offset] ^= 0x10u;
}

static void ScrubUntil(const uint32 *Counter, uint32 Wanted) {
  for (uint32 Ticks = 0; (*Counter < Wanted) && (Ticks < MOST_TICKS); Ticks++) {
    OS_time_t Before;
    OS_GetLocalTime(&Before);
    Wakeup();
    AskHk();
    const uint32 Took_us = Since_us(Before);
    LongestMend_us = Took_us > LongestMend_us ? Took_us : LongestMend_us;
  }
  CHECK(*Counter == Wanted);
}

/* Neither image can be used: frames are answered with that, until one is loaded. */
static void TestNoImage(STARCAT_APP_Data_t *App, size_t Blocks) {
  for (size_t n = 0; n < Blocks; n++) {
    Upset(App, n * BLOCK_BYTES + 600);
  }
  ScrubUntil(&Events[STARCAT_APP_NO_IMAGE_ERR_EID], 1);
  CHECK(Hk.ImageStatus == STARCAT_E_CRC);
  CHECK(Hk.ImageName[0] == 0);
  FlyExtra(STARCAT_E_CRC);
  CHECK(Attitude.Mode == STARCAT_APP_MODE_NONE);
  CHECK(Hk.FramesWithoutImage == 1);
  LoadImage("/cf/b.img", 0, true);
  for (uint32 n = 0; (n < MOST_TICKS) && (Hk.LoadState != STARCAT_APP_LOAD_READY); n++) {
    Wakeup();
    AskHk();
  }
  Switch(TEST_IMAGE_B, true);
  Fly(2, 5);
}

static void TestUpsets(void) {
  osal_id_t Module;
  cpuaddr Address = 0;
  CHECK(OS_ModuleLoad(&Module, "starcat_probe", "/cf/starcat_app.so",
                      OS_MODULE_FLAG_LOCAL_SYMBOLS) == OS_SUCCESS);
  CHECK(OS_ModuleSymbolLookup(Module, &Address, "STARCAT_APP_Data") == OS_SUCCESS);
  STARCAT_APP_Data_t *App = (STARCAT_APP_Data_t *)Address;
  if ((App == NULL) || (App->Session.has_image == 0)) {
    return;
  }
  const size_t Blocks = App->Session.image.data_bytes / BLOCK_BYTES;
  Upset(App, 3 * BLOCK_BYTES + 100);
  ScrubUntil(&Hk.DamageFound, 1);
  CHECK(Hk.BlocksMended == 1);
  CHECK(Events[STARCAT_APP_MENDED_INF_EID] == 1);
  Fly(0, 10);
  for (size_t n = 0; n < Blocks; n++) { /* several blocks of each group of parity */
    Upset(App, n * BLOCK_BYTES + 600);
  }
  ScrubUntil(&Hk.FallBacks, 1);
  CHECK(Hk.DamageFound >= 2);
  CHECK(Events[STARCAT_APP_FALLBACK_ERR_EID] == 1);
  CHECK(strcmp(Hk.ImageName, TEST_IMAGE_B) == 0);
  Fly(2, 10);
  TestNoImage(App, Blocks);
  LoadPatch("/cf/big.img", false);
  LoadPatch("/cf/a.patch", true); /* for the other image */
  FlyUntilLoaded(2, STARCAT_APP_LOAD_FAILED);
  CHECK(Events[STARCAT_APP_REFUSED_ERR_EID] == 5);
  LoadImage("/cf/starcat.img", 0, true);
  FlyUntilLoaded(2, STARCAT_APP_LOAD_READY);
}

/* All frames that are left, of the sky whose image is in use, several at once. */
static void FlyTheRest(void) {
  for (uint32 Source = 2; Source <= 2; Source -= 2) {
    uint32 Sequences[BURST], Posted = BURST;
    while (Posted == BURST) {
      for (Posted = 0; (Posted < BURST) && NextFrame(Source); Posted++) {
        Sequences[Posted] = Frame.Payload.Sequence;
        PostFrame();
      }
      Wakeup();
      for (uint32 n = 0; n < Posted; n++) {
        TakeAttitude(Sequences[n]);
        CHECK(Attitude.Status == STARCAT_IDENTIFIED);
      }
    }
    AskHk();
    if (Source == 2) {
      Switch(TEST_IMAGE_A, true);
      LoadPatch("/cf/a.patch", true);
      FlyUntilLoaded(0, STARCAT_APP_LOAD_READY);
      Switch(TEST_PATCHED, true);
    }
  }
}

static void Subscribe(void) {
  CHECK(CFE_SB_CreatePipe(&Pipe, 32, "STARCAT_TEST_PIPE") == CFE_SUCCESS);
  CHECK(CFE_SB_Subscribe(CFE_SB_ValueToMsgId(STARCAT_APP_ATTITUDE_TLM_MID), Pipe) == CFE_SUCCESS);
  CHECK(CFE_SB_Subscribe(CFE_SB_ValueToMsgId(STARCAT_APP_HK_TLM_MID), Pipe) == CFE_SUCCESS);
  CHECK(CFE_SB_Subscribe(CFE_SB_ValueToMsgId(CFE_EVS_LONG_EVENT_MSG_MID), Pipe) == CFE_SUCCESS);
}

static void Fly1000(void) {
  AskHk();
  CHECK(strcmp(Hk.ImageName, TEST_IMAGE_A) == 0);
  CHECK(Hk.ImageStatus == STARCAT_OK);
  TestRefusals();
  Longest_us = 0;
  Fly(0, 200);
  OS_printf("starcat_test: longest answer of 200 frames %lu us\n", (unsigned long)Longest_us);
  TestTracking();
  TestTable();
  TestReload();
  TestSettings();
  OS_TaskDelay(QUIET_MS);
  TestDamagedFiles();
  OS_TaskDelay(QUIET_MS);
  TestUpsets();
  OS_TaskDelay(QUIET_MS);
  FlyTheRest();
  CHECK(Hk.FramesIdentified + Hk.FramesTracked == TEST_FRAMES);
  CHECK(Hk.ScrubPasses > 0);
  CHECK(Events[STARCAT_APP_SWITCH_INF_EID] == 7);
  OS_printf("starcat_test: longest switch %lu us, longest tick with damage %lu us\n",
            (unsigned long)LongestSwitch_us, (unsigned long)LongestMend_us);
}

void STARCAT_TEST_Main(void);
void STARCAT_TEST_Main(void) {
  static const char *const Paths[3] = {"/cf/frames-a.bin", "/cf/frames-slew.bin",
                                       "/cf/frames-b.bin"};
  CFE_ES_RestartCmd_t Restart;
  (void)CFE_EVS_Register(NULL, 0, CFE_EVS_EventFilter_BINARY);
  (void)CFE_ES_WaitForSystemState(CFE_ES_SystemState_OPERATIONAL, 60000);
  Subscribe();
  CHECK(OS_OpenCreate(&Recording, "/cf/run.ccsds", OS_FILE_FLAG_CREATE | OS_FILE_FLAG_TRUNCATE,
                      OS_WRITE_ONLY) == OS_SUCCESS);
  for (uint32 n = 0; n < 3; n++) {
    CHECK(OS_OpenCreate(&Sources[n], Paths[n], OS_FILE_FLAG_NONE, OS_READ_ONLY) == OS_SUCCESS);
  }
  if (Failures == 0) {
    Fly1000();
  }
  (void)OS_close(Recording);
  OS_printf("starcat_test: %lu checks, %lu failed\n", (unsigned long)Checks,
            (unsigned long)Failures);
  memset(&Restart, 0, sizeof Restart);
  CFE_MSG_Init(CFE_MSG_PTR(Restart.CommandHeader), CFE_SB_ValueToMsgId(CFE_ES_CMD_MID),
               sizeof Restart);
  (void)CFE_MSG_SetFcnCode(CFE_MSG_PTR(Restart.CommandHeader), CFE_ES_RESTART_CC);
  Restart.Payload.RestartType = CFE_PSP_RST_TYPE_POWERON;
  (void)CFE_SB_TransmitMsg(CFE_MSG_PTR(Restart.CommandHeader), true);
  OS_TaskDelay(10000);
  CFE_ES_ExitApp(CFE_ES_RunStatus_APP_EXIT);
}
