/* SPDX-License-Identifier: MIT */
#include "coveragetest_starcat.h"

#define PIECE 4096

static char Name[STARCAT_APP_NAME_LEN] = "name";
static uint8 Digest[32] = {1, 2, 3};

/* A file of so many pieces, given to the next load. */
static void GiveFile(uint32 Pieces) {
  os_fstat_t Found[3];
  memset(Found, 0, sizeof Found);
  Found[0].FileSize = Found[1].FileSize = Found[2].FileSize = Pieces * PIECE;
  UT_ResetState(UT_KEY(OS_stat));
  UT_SetDataBuffer(UT_KEY(OS_stat), Found, sizeof Found, true);
  UT_SetDefaultReturnValue(UT_KEY(OS_read), PIECE);
  STARCAT_APP_Data.Config.LoadPieces = 2;
  STARCAT_APP_Data.Config.ScrubBlocks = 2;
  STARCAT_APP_Data.Image.name = Name;
  STARCAT_APP_Data.Image.manifest_sha256 = Digest;
  STARCAT_APP_Data.Image.total_bytes = 3 * PIECE;
}

static void TestLoad(void) {
  GiveFile(3);
  IS(STARCAT_APP_BeginLoad("/cf/x.img", 0, false), CFE_SUCCESS);
  IS(LastEvent(), STARCAT_APP_LOAD_INF_EID);
  IS(HK.LoadState, STARCAT_APP_LOAD_READING);
  IS(HK.LoadSize, 3 * PIECE);
  STARCAT_APP_Wakeup(NULL);
  CALLED(starcat_put_piece, 2);
  IS(HK.LoadBytes, 2 * PIECE);
  STARCAT_APP_Wakeup(NULL);
  CALLED(starcat_put_piece, 3);
  CALLED(OS_close, 1);
  IS(HK.LoadState, STARCAT_APP_LOAD_CHECKING);
  STARCAT_APP_Wakeup(NULL);
  IS(HK.LoadState, STARCAT_APP_LOAD_CHECKING);
  STARCAT_APP_Wakeup(NULL);
  IS(HK.LoadState, STARCAT_APP_LOAD_READY);
  IS(LastEvent(), STARCAT_APP_READY_INF_EID);
  CALLED(starcat_scrub_image, 2);
  STARCAT_APP_Wakeup(NULL); /* scrubs again */
  IS(HK.ScrubBlock, 2);
  CALLED(CFE_ES_PerfLogAdd, 10);
}

static void TestLoadThatCannotBegin(void) {
  ONCE(OS_stat, OS_ERROR);
  IS(STARCAT_APP_BeginLoad("/cf/x.img", 0, false), CFE_STATUS_EXTERNAL_RESOURCE_FAIL);
  ONCE(OS_OpenCreate, OS_ERROR);
  IS(STARCAT_APP_BeginLoad("/cf/x.img", 0, false), CFE_STATUS_EXTERNAL_RESOURCE_FAIL);
  IS(LastEvent(), STARCAT_APP_LOAD_ERR_EID);
  IS(HK.LoadState, STARCAT_APP_LOAD_NONE);
  ONCE(starcat_receive_image, STARCAT_E_SHORT);
  IS(STARCAT_APP_BeginLoad("/cf/x.img", 0, false), CFE_STATUS_VALIDATION_FAILURE);
  IS(HK.LoadState, STARCAT_APP_LOAD_FAILED);
  CALLED(CFE_EVS_SendEvent, 3);
}

static void TestLoadThatBreaksOff(void) {
  GiveFile(3);
  IS(STARCAT_APP_BeginLoad("/cf/x.img", 0, false), CFE_SUCCESS);
  IS(STARCAT_APP_BeginLoad("/cf/x.img", 0, false), CFE_SUCCESS); /* anew, while it is read */
  CALLED(OS_close, 1);
  ONCE(OS_read, 0);
  STARCAT_APP_Wakeup(NULL);
  IS(HK.LoadState, STARCAT_APP_LOAD_FAILED);
  IS(LastEvent(), STARCAT_APP_LOAD_ERR_EID);
  CALLED(OS_read, 1);
  CALLED(starcat_put_piece, 0);
  GiveFile(3);
  IS(STARCAT_APP_BeginLoad("/cf/x.img", 0, false), CFE_SUCCESS);
  ONCE(starcat_put_piece, STARCAT_E_SHORT);
  STARCAT_APP_Wakeup(NULL);
  IS(HK.LoadState, STARCAT_APP_LOAD_FAILED);
}

static void TestLoadOfADamagedImage(void) {
  GiveFile(1);
  IS(STARCAT_APP_BeginLoad("/cf/x.img", 0, false), CFE_SUCCESS);
  STARCAT_APP_Wakeup(NULL);
  IS(HK.LoadState, STARCAT_APP_LOAD_CHECKING);
  ONCE(starcat_find_missing_block, STARCAT_E_CRC);
  STARCAT_APP_Wakeup(NULL);
  IS(HK.LoadState, STARCAT_APP_LOAD_FAILED);
  IS(LastEvent(), STARCAT_APP_REFUSED_ERR_EID);
  GiveFile(1);
  IS(STARCAT_APP_BeginLoad("/cf/x.img", 0, false), CFE_SUCCESS);
  STARCAT_APP_Wakeup(NULL);
  ONCE(starcat_scrub_image, STARCAT_E_CRC);
  STARCAT_APP_Wakeup(NULL);
  IS(HK.LoadState, STARCAT_APP_LOAD_FAILED);
}

static void TestPatch(void) {
  GiveFile(1);
  IS(STARCAT_APP_BeginLoad("/cf/x.patch", 0, true), CFE_SUCCESS);
  CALLED(starcat_receive_image, 0);
  STARCAT_APP_Wakeup(NULL);
  CALLED(starcat_put_piece, 0);
  IS(HK.LoadState, STARCAT_APP_LOAD_CHECKING);
  STARCAT_APP_Wakeup(NULL);
  CALLED(starcat_apply_patch, 1);
  CALLED(starcat_find_missing_block, 0);
  CALLED(starcat_scrub_image, 0);
  IS(HK.LoadState, STARCAT_APP_LOAD_READY);
  GiveFile(1);
  IS(STARCAT_APP_BeginLoad("/cf/x.patch", 0, true), CFE_SUCCESS);
  STARCAT_APP_Wakeup(NULL);
  ONCE(starcat_apply_patch, STARCAT_E_VERSION);
  STARCAT_APP_Wakeup(NULL);
  IS(HK.LoadState, STARCAT_APP_LOAD_FAILED);
  IS(LastEvent(), STARCAT_APP_REFUSED_ERR_EID);
}

static void TestPatchThatIsTooLarge(void) {
  GiveFile(1 + STARCAT_APP_PATCH_BYTES / PIECE);
  IS(STARCAT_APP_BeginLoad("/cf/x.patch", 0, true), CFE_STATUS_VALIDATION_FAILURE);
  IS(HK.LoadState, STARCAT_APP_LOAD_FAILED);
  GiveFile(STARCAT_APP_PATCH_BYTES / PIECE);
  IS(STARCAT_APP_BeginLoad("/cf/x.patch", 0, true), CFE_SUCCESS);
  HK.LoadBytes = STARCAT_APP_PATCH_BYTES - 1; /* a file that grew while it was read */
  STARCAT_APP_Wakeup(NULL);
  IS(HK.LoadState, STARCAT_APP_LOAD_FAILED);
  IS(LastEvent(), STARCAT_APP_LOAD_ERR_EID);
}

static void TestScrub(void) {
  GiveFile(3);
  STARCAT_APP_Wakeup(NULL);
  IS(HK.ScrubBlock, 2);
  STARCAT_APP_Wakeup(NULL);
  IS(HK.ScrubBlock, 0);
  IS(HK.ScrubPasses, 1);
  STARCAT_APP_Data.HasImage = false;
  STARCAT_APP_Wakeup(NULL);
  CALLED(starcat_scrub_image, 2);
}

static void TestMend(void) {
  GiveFile(3);
  ONCE(starcat_scrub_image, STARCAT_E_CRC);
  STARCAT_APP_Wakeup(NULL);
  IS(HK.DamageFound, 1);
  IS(HK.BlocksMended, 2);
  IS(HK.ScrubBlock, 0);
  IS(LastEvent(), STARCAT_APP_MENDED_INF_EID);
  CALLED(starcat_start_image, 0);
}

static void TestFallBack(void) {
  GiveFile(3);
  HK.CameraSource = STARCAT_APP_CAMERA_OF_TABLE;
  ONCE(starcat_scrub_image, STARCAT_E_CRC);
  ONCE(starcat_mend_image, STARCAT_E_CRC);
  STARCAT_APP_Wakeup(NULL);
  IS(HK.FallBacks, 1);
  IS(HK.ImageStatus, STARCAT_OK);
  IS(LastEvent(), STARCAT_APP_FALLBACK_ERR_EID);
  CALLED(starcat_get_camera, 0);
  ONCE(starcat_scrub_image, STARCAT_E_CRC);
  ONCE(starcat_mend_image, STARCAT_E_CRC);
  ONCE(starcat_start_image, STARCAT_E_CRC);
  STARCAT_APP_Wakeup(NULL);
  IS(HK.FallBacks, 1);
  IS(HK.ImageStatus, STARCAT_E_CRC);
  IS(HK.ImageBytes, 0);
  IS(HK.ImageName[0], 0);
  IS(STARCAT_APP_Data.HasImage, false);
  IS(LastEvent(), STARCAT_APP_NO_IMAGE_ERR_EID);
}

static void TestStart(void) {
  GiveFile(3);
  ONCE(OS_stat, OS_SUCCESS);
  LATER(OS_stat, 1, OS_ERROR); /* no second image */
  STARCAT_APP_StartImages();
  IS(HK.ImageStatus, STARCAT_OK);
  IS(HK.ImageName[0], 'n');
  IS(HK.ImageDigest[2], 3);
  IS(STARCAT_APP_Data.Camera.focal_length_px, 1234);
  IS(HK.LoadState, STARCAT_APP_LOAD_NONE);
  CALLED(starcat_put_piece, 3);
}

static void TestStartOfTwo(void) {
  GiveFile(2);
  STARCAT_APP_StartImages();
  CALLED(starcat_put_piece, 4);
  IS(STARCAT_APP_Data.Slots.active, 0);
}

static void TestStartWithoutImage(void) {
  UT_SetDefaultReturnValue(UT_KEY(OS_stat), OS_ERROR);
  UT_SetDefaultReturnValue(UT_KEY(starcat_start_image), STARCAT_E_LAYOUT);
  STARCAT_APP_StartImages();
  IS(STARCAT_APP_Data.HasImage, false);
  IS(HK.ImageStatus, STARCAT_E_LAYOUT);
  IS(LastEvent(), STARCAT_APP_NO_IMAGE_ERR_EID);
}

void UtTest_Setup(void) {
  ADD(TestLoad);
  ADD(TestLoadThatCannotBegin);
  ADD(TestLoadThatBreaksOff);
  ADD(TestLoadOfADamagedImage);
  ADD(TestPatch);
  ADD(TestPatchThatIsTooLarge);
  ADD(TestScrub);
  ADD(TestMend);
  ADD(TestFallBack);
  ADD(TestStart);
  ADD(TestStartOfTwo);
  ADD(TestStartWithoutImage);
}
