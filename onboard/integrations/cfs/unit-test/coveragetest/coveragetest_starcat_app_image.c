/* SPDX-License-Identifier: MIT */
#include "coveragetest_starcat.h"

#define PIECE 4096

/* A file of `Pieces` pieces, read by the next load. */
static void GiveFile(uint32 Pieces) {
  os_fstat_t Found[3];
  memset(Found, 0, sizeof Found);
  Found[0].FileSize = Found[1].FileSize = Found[2].FileSize = Pieces * PIECE;
  UT_ResetState(UT_KEY(OS_stat));
  UT_SetDataBuffer(UT_KEY(OS_stat), Found, sizeof Found, true);
  UT_SetDefaultReturnValue(UT_KEY(OS_read), PIECE);
  UT_SetDefaultReturnValue(UT_KEY(starcat_load_piece), STARCAT_INCOMPLETE);
  STARCAT_APP_Data.Config.LoadPieces = 2;
}

static void TestLoad(void) {
  GiveFile(3);
  IS(STARCAT_APP_BeginLoad("/cf/x.img", 0, false), CFE_SUCCESS);
  IS(LastEvent(), STARCAT_APP_LOAD_INF_EID);
  IS(SESSION.load_size, 3 * PIECE);
  STARCAT_APP_Wakeup(NULL);
  CALLED(starcat_load_piece, 2);
  CALLED(OS_close, 0);
  ONCE(starcat_load_piece, STARCAT_OK);
  STARCAT_APP_Wakeup(NULL);
  CALLED(starcat_load_piece, 3);
  CALLED(OS_close, 1);
  CALLED(starcat_do_idle_work, 0);
  CALLED(CFE_ES_PerfLogAdd, 4);
  IS(STARCAT_APP_BeginLoad("/cf/x.patch", 0, true), CFE_SUCCESS);
  CALLED(starcat_begin_load, 1);
  CALLED(starcat_begin_patch_load, 1);
}

static void TestLoadThatCannotBegin(void) {
  ONCE(OS_stat, OS_ERROR);
  IS(STARCAT_APP_BeginLoad("/cf/x.img", 0, false), CFE_STATUS_EXTERNAL_RESOURCE_FAIL);
  ONCE(OS_OpenCreate, OS_ERROR);
  IS(STARCAT_APP_BeginLoad("/cf/x.img", 0, false), CFE_STATUS_EXTERNAL_RESOURCE_FAIL);
  IS(LastEvent(), STARCAT_APP_LOAD_ERR_EID);
  CALLED(OS_close, 0);
  ONCE(starcat_begin_load, STARCAT_E_SHORT);
  IS(STARCAT_APP_BeginLoad("/cf/x.img", 0, false), CFE_STATUS_VALIDATION_FAILURE);
  CALLED(OS_close, 1);
  CALLED(CFE_EVS_SendEvent, 3);
}

static void TestLoadThatBreaksOff(void) {
  GiveFile(3);
  IS(STARCAT_APP_BeginLoad("/cf/x.img", 0, false), CFE_SUCCESS);
  IS(STARCAT_APP_BeginLoad("/cf/x.img", 0, false), CFE_SUCCESS); /* again, while it is read */
  CALLED(OS_close, 1);
  ONCE(OS_read, 0);
  STARCAT_APP_Wakeup(NULL);
  IS(SESSION.load, STARCAT_LOAD_FAILED);
  IS(LastEvent(), STARCAT_APP_LOAD_ERR_EID);
  CALLED(OS_read, 1);
  CALLED(starcat_load_piece, 0);
  GiveFile(3);
  IS(STARCAT_APP_BeginLoad("/cf/x.img", 0, false), CFE_SUCCESS);
  ONCE(starcat_load_piece, STARCAT_E_SHORT);
  STARCAT_APP_Wakeup(NULL);
  IS(SESSION.load, STARCAT_LOAD_FAILED);
  CALLED(OS_close, 3);
}

static void TestIdleWork(void) {
  static const struct {
    starcat_event_kind Event;
    uint16 Told;
  } Expected[] = {{STARCAT_EVENT_READY, STARCAT_APP_READY_INF_EID},
                  {STARCAT_EVENT_REFUSED, STARCAT_APP_REFUSED_ERR_EID},
                  {STARCAT_EVENT_MENDED, STARCAT_APP_MENDED_INF_EID},
                  {STARCAT_EVENT_FELL_BACK, STARCAT_APP_FALLBACK_ERR_EID},
                  {STARCAT_EVENT_NO_IMAGE, STARCAT_APP_NO_IMAGE_ERR_EID},
                  {STARCAT_EVENT_CHANGED, STARCAT_APP_SWITCH_INF_EID},
                  {STARCAT_EVENT_OTHER_LOST, STARCAT_APP_OTHER_ERR_EID}};
  static uint64 Word;
  SESSION.image.name = "name";
  SESSION.slots.bytes[0] = (uint8 *)&Word;
  SESSION.slots.size[0] = sizeof Word;
  STARCAT_APP_Wakeup(NULL);
  CALLED(starcat_do_idle_work, 1);
  CALLED(CFE_EVS_SendEvent, 0);
  for (uint32 n = 0; n < sizeof Expected / sizeof Expected[0]; n++) {
    ONCE(starcat_do_idle_work, Expected[n].Event);
    STARCAT_APP_Wakeup(NULL);
    IS(LastEvent(), Expected[n].Told);
  }
  CALLED(CFE_EVS_SendEvent, 7);
  CALLED(starcat_accept_load, 1);
  ONCE(starcat_do_idle_work, STARCAT_EVENT_READY);
  ONCE(starcat_accept_load, STARCAT_INCOMPLETE);
  STARCAT_APP_Wakeup(NULL);
  IS(LastEvent(), STARCAT_APP_REFUSED_ERR_EID);
  SESSION.slots.size[0] = 0; /* not trusted */
  ONCE(starcat_do_idle_work, STARCAT_EVENT_READY);
  STARCAT_APP_Wakeup(NULL);
  IS(LastEvent(), STARCAT_APP_REFUSED_ERR_EID);
  CALLED(starcat_accept_load, 2);
  CALLED(starcat_refuse_load, 2);
}

static void TestStart(void) {
  GiveFile(3);
  LATER(OS_stat, 2, OS_ERROR); /* no second image */
  STARCAT_APP_StartImages();
  CALLED(OS_read, 3);
  CALLED(OS_close, 1);
  CALLED(starcat_accept_image, 1);
  CALLED(starcat_prepare_session, 1);
  CALLED(starcat_start_session, 1);
  IS(SETTINGS.patch_capacity, STARCAT_APP_PATCH_BYTES);
  CALLED(CFE_EVS_SendEvent, 0);
}

static void TestStartOfTwo(void) {
  GiveFile(2);
  STARCAT_APP_StartImages();
  CALLED(starcat_accept_image, 2);
}

static void TestStartOfBadFiles(void) {
  GiveFile(3);
  ONCE(OS_OpenCreate, OS_ERROR);
  ONCE(OS_read, OS_ERROR); /* of the second one */
  STARCAT_APP_StartImages();
  CALLED(OS_close, 1);
  CALLED(starcat_accept_image, 0);
  GiveFile(STARCAT_APP_SLOT_BYTES / PIECE + 1);
  STARCAT_APP_StartImages();
  CALLED(OS_close, 1);
}

static void TestStartWithoutImage(void) {
  UT_SetDefaultReturnValue(UT_KEY(OS_stat), OS_ERROR);
  UT_SetDefaultReturnValue(UT_KEY(starcat_start_session), STARCAT_E_LAYOUT);
  STARCAT_APP_StartImages();
  IS(LastEvent(), STARCAT_APP_NO_IMAGE_ERR_EID);
}

void UtTest_Setup(void) {
  ADD(TestLoad);
  ADD(TestLoadThatCannotBegin);
  ADD(TestLoadThatBreaksOff);
  ADD(TestIdleWork);
  ADD(TestStart);
  ADD(TestStartOfTwo);
  ADD(TestStartOfBadFiles);
  ADD(TestStartWithoutImage);
}
