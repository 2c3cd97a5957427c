/* Images: read at the start, loaded by commands, and looked after in idle time, a few blocks a tick, so
 * that no frame waits for long.
 *
 * SPDX-License-Identifier: MIT
 */
#include "starcat_app.h"

#include <string.h>

#define PIECE_BYTES 4096u
#define SESSION (STARCAT_APP_Data.Session)
#define SETTINGS (STARCAT_APP_Data.Settings)

/* The two slots, as words: images begin at a multiple of 8. */
static uint64 Memory[2][STARCAT_APP_SLOT_BYTES / sizeof(uint64)];

/* A patch as it is read; it is applied when it is whole. */
static uint32 Patch[STARCAT_APP_PATCH_BYTES / sizeof(uint32)];

/* Open the file of an image, or of a patch, and prepare the session for it. */
CFE_Status_t STARCAT_APP_BeginLoad(const char *Path, uint32 Crc, bool IsPatch) {
  os_fstat_t Found;
  memset(&Found, 0, sizeof Found);
  if (SESSION.load == STARCAT_LOAD_READING) {
    (void)starcat_refuse_load(&SESSION);
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
    (void)starcat_refuse_load(&SESSION);
    CFE_EVS_SendEvent(STARCAT_APP_LOAD_ERR_EID, CFE_EVS_EventType_ERROR,
                      "STARCAT: the new image cannot be read at byte %lu, RC = %ld, status %d",
                      (unsigned long)SESSION.load_bytes, (long)Count, (int)Status);
  }
  return false;
}

/* Accept the new image, which is whole, if the mission trusts it. */
static void Decide(uint32 Slot) {
  const starcat_slots *Slots = &SESSION.slots;
  if (STARCAT_APP_IS_TRUSTED(Slots->bytes[Slot], Slots->size[Slot]) &&
      (starcat_accept_load(&SESSION) == STARCAT_OK)) {
    CFE_EVS_SendEvent(STARCAT_APP_READY_INF_EID, CFE_EVS_EventType_INFORMATION,
                      "STARCAT: the new image is whole and accepted");
  } else {
    (void)starcat_refuse_load(&SESSION);
    CFE_EVS_SendEvent(STARCAT_APP_REFUSED_ERR_EID, CFE_EVS_EventType_ERROR,
                      "STARCAT: the new image is whole, but not trusted");
  }
}

/* Tell what idle work came to. */
static void TellEvent(const starcat_event *Event) {
  const unsigned long Block = Event->block;
  const int Status = (int)Event->status;
  switch (Event->kind) {
    case STARCAT_EVENT_READY:
      Decide(Event->slot);
      break;
    case STARCAT_EVENT_CHANGED:
      CFE_EVS_SendEvent(STARCAT_APP_SWITCH_INF_EID, CFE_EVS_EventType_INFORMATION,
                        "STARCAT: image %.*s of slot %u is in use", STARCAT_APP_NAME_LEN,
                        SESSION.image.name, (unsigned int)SESSION.slots.active);
      break;
    case STARCAT_EVENT_OTHER_LOST:
      CFE_EVS_SendEvent(STARCAT_APP_OTHER_ERR_EID, CFE_EVS_EventType_ERROR,
                        "STARCAT: block %lu of the other image is damaged beyond its parity",
                        Block);
      break;
    case STARCAT_EVENT_REFUSED:
      CFE_EVS_SendEvent(STARCAT_APP_REFUSED_ERR_EID, CFE_EVS_EventType_ERROR,
                        "STARCAT: the new image, or patch, is refused, block %lu, status %d", Block,
                        Status);
      break;
    case STARCAT_EVENT_MENDED:
      CFE_EVS_SendEvent(STARCAT_APP_MENDED_INF_EID, CFE_EVS_EventType_INFORMATION,
                        "STARCAT: block %lu of slot %u was damaged and is mended", Block,
                        (unsigned int)Event->slot);
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
    starcat_event Event;
    (void)starcat_do_idle_work(&SESSION, &Event);
    TellEvent(&Event);
  }
  CFE_ES_PerfLogExit(STARCAT_APP_SCRUB_PERF_ID);
}

/* Read a file whole into a slot, and accept it: what is in /cf at the start is trusted. */
static void ReadImage(const char *Path, starcat_slots *Slots, uint32 Slot) {
  os_fstat_t Found;
  osal_id_t File;
  size_t Size = 0;
  memset(&Found, 0, sizeof Found);
  if ((OS_stat(Path, &Found) != OS_SUCCESS) || (Found.FileSize > Slots->capacity) ||
      (OS_OpenCreate(&File, Path, OS_FILE_FLAG_NONE, OS_READ_ONLY) != OS_SUCCESS)) {
    return;
  }
  int32 Count = 1;
  while ((Count > 0) && (Size < Found.FileSize)) {
    Count = OS_read(File, Slots->bytes[Slot] + Size, Found.FileSize - Size);
    Size += Count > 0 ? (size_t)Count : 0u;
  }
  (void)OS_close(File);
  if (Size >= 2u * PIECE_BYTES) { /* as many as an image has at least; its CRC is 8 bytes before */
    uint32 Crc;
    memcpy(&Crc, Slots->bytes[Slot] + Size - 8u, sizeof Crc);
    Slots->size[Slot] = Size;
    (void)starcat_accept_image(Slots, Slot, Crc);
  }
}

/* Read the images of the start, and take the first one that can be used into use. */
void STARCAT_APP_StartImages(void) {
  starcat_slots Slots;
  memset(&Slots, 0, sizeof Slots);
  Slots.bytes[0] = (uint8 *)Memory[0];
  Slots.bytes[1] = (uint8 *)Memory[1];
  Slots.capacity = sizeof Memory[0];
  (void)starcat_set_default_settings(&SETTINGS);
  SETTINGS.patch = Patch;
  SETTINGS.patch_capacity = sizeof Patch;
  (void)starcat_prepare_session(&SESSION, &SETTINGS);
  ReadImage(STARCAT_APP_IMAGE_FILE, &Slots, 0);
  ReadImage(STARCAT_APP_OTHER_IMAGE_FILE, &Slots, 1);
  const starcat_status Status = starcat_start_session(&SESSION, &Slots);
  if (Status != STARCAT_OK) {
    CFE_EVS_SendEvent(STARCAT_APP_NO_IMAGE_ERR_EID, CFE_EVS_EventType_CRITICAL,
                      "STARCAT: no image can be used, status %d", (int)Status);
  }
}
