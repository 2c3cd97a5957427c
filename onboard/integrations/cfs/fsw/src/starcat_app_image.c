/* Images: read at the start, loaded by commands, and looked after in idle time, a few blocks a tick, so
 * that no frame waits for long.
 *
 * SPDX-License-Identifier: MIT
 */
#include "starcat_app.h"

#include <string.h>

#define PIECE_BYTES 4096u
#define SESSION (STARCAT_APP_Data.Session)

/* The two slots, as words: images begin at a multiple of 8. */
static uint64 Memory[2][STARCAT_APP_SLOT_BYTES / sizeof(uint64)];

/* A patch as it is read; it is applied when it is whole. */
static uint32 Patch[STARCAT_APP_PATCH_BYTES / sizeof(uint32)];

/* Open the file of an image, or of a patch, and prepare the session for it. */
CFE_Status_t STARCAT_APP_BeginLoad(const char *Path, uint32 Crc, bool IsPatch) {
  os_fstat_t Found;
  memset(&Found, 0, sizeof Found);
  if (SESSION.load == STARCAT_LOAD_READING) {
    SESSION.load = STARCAT_LOAD_FAILED;
    (void)OS_close(STARCAT_APP_Data.LoadFile);
  }
  int32 Status = OS_stat(Path, &Found);
  if (Status == OS_SUCCESS) {
    Status = OS_OpenCreate(&STARCAT_APP_Data.LoadFile, Path, OS_FILE_FLAG_NONE, OS_READ_ONLY);
  }
  if (Status != OS_SUCCESS) {
    CFE_EVS_SendEvent(STARCAT_APP_LOAD_ERR_EID, CFE_EVS_EventType_ERROR,
                      "STARCAT: %s cannot be opened, RC = %ld", Path, (long)Status);
    return CFE_STATUS_EXTERNAL_RESOURCE_FAIL;
  }
  const starcat_status Fits = IsPatch ? starcat_begin_patch_load(&SESSION, Found.FileSize)
                                      : starcat_begin_load(&SESSION, Found.FileSize, Crc);
  if (Fits != STARCAT_OK) {
    (void)OS_close(STARCAT_APP_Data.LoadFile);
    CFE_EVS_SendEvent(STARCAT_APP_LOAD_ERR_EID, CFE_EVS_EventType_ERROR,
                      "STARCAT: %lu bytes of %s are no image, or too many, status %d",
                      (unsigned long)Found.FileSize, Path, (int)Fits);
    return CFE_STATUS_VALIDATION_FAILURE;
  }
  CFE_EVS_SendEvent(STARCAT_APP_LOAD_INF_EID, CFE_EVS_EventType_INFORMATION,
                    "STARCAT: %lu bytes of %s are being read", (unsigned long)Found.FileSize, Path);
  return CFE_SUCCESS;
}

/* Read a piece of the file. Returns whether there is more to come. */
static bool ReadPiece(void) {
  static uint8 Piece[PIECE_BYTES];
  const int32 Count = OS_read(STARCAT_APP_Data.LoadFile, Piece, sizeof Piece);
  starcat_status Status = STARCAT_E_SHORT;
  if (Count > 0) {
    Status = starcat_load_piece(&SESSION, Piece, (size_t)Count);
  }
  if (Status == STARCAT_INCOMPLETE) {
    return true;
  }
  (void)OS_close(STARCAT_APP_Data.LoadFile);
  if (Status != STARCAT_OK) {
    SESSION.load = STARCAT_LOAD_FAILED;
    CFE_EVS_SendEvent(STARCAT_APP_LOAD_ERR_EID, CFE_EVS_EventType_ERROR,
                      "STARCAT: the new image cannot be read at byte %lu, RC = %ld, status %d",
                      (unsigned long)SESSION.load_bytes, (long)Count, (int)Status);
  }
  return false;
}

/* Tell what idle work came to. */
static void TellEvent(starcat_event Event) {
  const unsigned long Block = SESSION.event_block;
  const int Status = (int)SESSION.event_status;
  switch (Event) {
    case STARCAT_EVENT_READY:
      CFE_EVS_SendEvent(STARCAT_APP_READY_INF_EID, CFE_EVS_EventType_INFORMATION,
                        "STARCAT: the new image is whole");
      break;
    case STARCAT_EVENT_REFUSED:
      CFE_EVS_SendEvent(STARCAT_APP_REFUSED_ERR_EID, CFE_EVS_EventType_ERROR,
                        "STARCAT: the new image, or patch, is refused, block %lu, status %d", Block,
                        Status);
      break;
    case STARCAT_EVENT_MENDED:
      CFE_EVS_SendEvent(STARCAT_APP_MENDED_INF_EID, CFE_EVS_EventType_INFORMATION,
                        "STARCAT: block %lu was damaged, %lu blocks were mended", Block,
                        (unsigned long)SESSION.event_mended);
      break;
    case STARCAT_EVENT_FELL_BACK:
      CFE_EVS_SendEvent(STARCAT_APP_FALLBACK_ERR_EID, CFE_EVS_EventType_ERROR,
                        "STARCAT: block %lu is damaged beyond its parity, slot %u took over", Block,
                        (unsigned int)SESSION.slots.active);
      break;
    case STARCAT_EVENT_NO_IMAGE:
      CFE_EVS_SendEvent(
          STARCAT_APP_NO_IMAGE_ERR_EID, CFE_EVS_EventType_CRITICAL,
          "STARCAT: block %lu is damaged beyond its parity, no image is left, status %d", Block,
          Status);
      break;
    default:
      break;
  }
}

/* A tick of idle time. */
void STARCAT_APP_Wakeup(const STARCAT_APP_WakeupCmd_t *Msg) {
  (void)Msg;
  CFE_ES_PerfLogEntry(STARCAT_APP_SCRUB_PERF_ID);
  if (SESSION.load == STARCAT_LOAD_READING) {
    for (uint32 n = 0; (n < STARCAT_APP_Data.Config.LoadPieces) && ReadPiece(); n++) {
    }
  } else {
    TellEvent(starcat_do_idle_work(&SESSION));
  }
  CFE_ES_PerfLogExit(STARCAT_APP_SCRUB_PERF_ID);
}

/* Read a file whole into the slot that is not `Active` then. */
static void ReadImage(const char *Path, uint32 Active) {
  SESSION.slots.active = Active;
  if (STARCAT_APP_BeginLoad(Path, 0, false) == CFE_SUCCESS) {
    while (ReadPiece()) {
    }
  }
}

/* Read the images of the start, and take the first one that can be used into use. */
void STARCAT_APP_StartImages(void) {
  os_fstat_t Found;
  starcat_prepare_session(&SESSION);
  SESSION.slots.bytes[0] = (uint8 *)Memory[0];
  SESSION.slots.bytes[1] = (uint8 *)Memory[1];
  SESSION.slots.capacity = sizeof Memory[0];
  SESSION.patch = Patch;
  SESSION.patch_capacity = sizeof Patch;
  ReadImage(STARCAT_APP_IMAGE_FILE, 1);
  if (OS_stat(STARCAT_APP_OTHER_IMAGE_FILE, &Found) == OS_SUCCESS) {
    ReadImage(STARCAT_APP_OTHER_IMAGE_FILE, 0);
  }
  SESSION.slots.active = 0;
  SESSION.load = STARCAT_LOAD_NONE;
  const starcat_status Status = starcat_start_session(&SESSION);
  if (Status != STARCAT_OK) {
    CFE_EVS_SendEvent(STARCAT_APP_NO_IMAGE_ERR_EID, CFE_EVS_EventType_CRITICAL,
                      "STARCAT: no image can be used, status %d", (int)Status);
  }
}
