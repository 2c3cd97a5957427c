/* Images: read at the start, scrubbed and loaded in idle time, a few blocks a tick, so that no frame
 * waits for long.
 *
 * SPDX-License-Identifier: MIT
 */
#include "starcat_app.h"

#include <string.h>

#define HK (STARCAT_APP_Data.HkTlm.Payload)
#define STARCAT_PIECE_BYTES 4096u /* of a block of an image, the unit in which it is checked */

/* The two slots, as words: images begin at a multiple of 8. */
static uint64 Memory[2][STARCAT_APP_SLOT_BYTES / sizeof(uint64)];

/* A patch as it is read; it is applied when it is whole. */
static uint32 Patch[STARCAT_APP_PATCH_BYTES / sizeof(uint32)];

/* After a start, a switch or damage: what is known of the image in use. */
void STARCAT_APP_ImageInUse(starcat_status Status) {
  STARCAT_APP_Data_t *Data = &STARCAT_APP_Data;
  Data->HasImage = Status == STARCAT_OK;
  Data->HasPrior = false;
  HK.ImageStatus = (int16)Status;
  HK.ActiveSlot = (uint8)Data->Slots.active;
  HK.ScrubBlock = 0;
  HK.ImageBytes = 0;
  memset(HK.ImageName, 0, sizeof HK.ImageName);
  memset(HK.ImageDigest, 0, sizeof HK.ImageDigest);
  if (Data->HasImage) {
    HK.ImageBytes = (uint32)Data->Slots.size[Data->Slots.active];
    memcpy(HK.ImageName, Data->Image.name, sizeof HK.ImageName);
    memcpy(HK.ImageDigest, Data->Image.manifest_sha256, sizeof HK.ImageDigest);
    if (HK.CameraSource == STARCAT_APP_CAMERA_OF_IMAGE) {
      starcat_get_camera(&Data->Image, &Data->Camera);
    }
  }
}

static void EndLoad(uint8 State) {
  (void)OS_close(STARCAT_APP_Data.LoadFile);
  HK.LoadState = State;
}

/* Open the file of an image and prepare the other slot for it, or the file of a patch. */
CFE_Status_t STARCAT_APP_BeginLoad(const char *Path, uint32 Crc, bool IsPatch) {
  os_fstat_t Found;
  memset(&Found, 0, sizeof Found);
  if (HK.LoadState == STARCAT_APP_LOAD_READING) {
    EndLoad(STARCAT_APP_LOAD_FAILED);
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
  starcat_status Fits = Found.FileSize <= sizeof Patch ? STARCAT_OK : STARCAT_E_SHORT;
  if (!IsPatch) {
    Fits = starcat_receive_image(&STARCAT_APP_Data.Slots, Found.FileSize, Crc);
  }
  if (Fits != STARCAT_OK) {
    EndLoad(STARCAT_APP_LOAD_FAILED);
    CFE_EVS_SendEvent(STARCAT_APP_LOAD_ERR_EID, CFE_EVS_EventType_ERROR,
                      "STARCAT: %lu bytes of %s are no image, or too many, status %d",
                      (unsigned long)Found.FileSize, Path, (int)Fits);
    return CFE_STATUS_VALIDATION_FAILURE;
  }
  HK.LoadState = STARCAT_APP_LOAD_READING;
  HK.LoadBytes = 0;
  HK.LoadSize = (uint32)Found.FileSize;
  STARCAT_APP_Data.IsPatch = IsPatch;
  STARCAT_APP_Data.CheckBlock = 0;
  CFE_EVS_SendEvent(STARCAT_APP_LOAD_INF_EID, CFE_EVS_EventType_INFORMATION,
                    "STARCAT: %lu bytes of %s are being read", (unsigned long)HK.LoadSize, Path);
  return CFE_SUCCESS;
}

/* Read a piece of the new image into its slot, or of a patch. */
static void ReadPiece(void) {
  static uint8 Piece[STARCAT_PIECE_BYTES];
  const int32 Count = OS_read(STARCAT_APP_Data.LoadFile, Piece, sizeof Piece);
  starcat_status Status = STARCAT_E_SHORT;
  if ((Count > 0) && STARCAT_APP_Data.IsPatch) {
    if ((uint32)Count <= sizeof Patch - HK.LoadBytes) {
      memcpy((uint8 *)Patch + HK.LoadBytes, Piece, (size_t)Count);
      Status = STARCAT_OK;
    }
  } else if (Count > 0) {
    Status = starcat_put_piece(&STARCAT_APP_Data.Slots, HK.LoadBytes, Piece, (size_t)Count);
  }
  if (Status != STARCAT_OK) {
    EndLoad(STARCAT_APP_LOAD_FAILED);
    CFE_EVS_SendEvent(STARCAT_APP_LOAD_ERR_EID, CFE_EVS_EventType_ERROR,
                      "STARCAT: the new image cannot be read at byte %lu, RC = %ld, status %d",
                      (unsigned long)HK.LoadBytes, (long)Count, (int)Status);
    return;
  }
  HK.LoadBytes += (uint32)Count;
  if (HK.LoadBytes >= HK.LoadSize) {
    EndLoad(STARCAT_APP_LOAD_CHECKING);
  }
}

/* Check some blocks of the new image: those of checks first, as they tell of the others. A patch is
 * applied instead, which makes and checks the new image in one go. */
static void CheckLoaded(void) {
  STARCAT_APP_Data_t *Data = &STARCAT_APP_Data;
  const uint32 Blocks = Data->IsPatch ? 0u : HK.LoadSize / STARCAT_PIECE_BYTES;
  uint32_t Bad = 0;
  starcat_status Status = Data->IsPatch ? starcat_apply_patch(&Data->Slots, Patch, HK.LoadSize)
                                        : starcat_find_missing_block(&Data->Slots, Blocks, &Bad);
  if ((Status == STARCAT_OK) && !Data->IsPatch) {
    Status = starcat_scrub_image(Data->Slots.bytes[1u - Data->Slots.active], HK.LoadSize,
                           Data->CheckBlock, Data->Config.ScrubBlocks, &Bad);
  }
  Data->CheckBlock += Data->Config.ScrubBlocks;
  if (Status != STARCAT_OK) {
    HK.LoadState = STARCAT_APP_LOAD_FAILED;
    CFE_EVS_SendEvent(STARCAT_APP_REFUSED_ERR_EID, CFE_EVS_EventType_ERROR,
                      "STARCAT: the new image, or patch, is refused, block %lu, status %d",
                      (unsigned long)Bad, (int)Status);
  } else if (Data->CheckBlock >= Blocks) {
    HK.LoadState = STARCAT_APP_LOAD_READY;
    CFE_EVS_SendEvent(STARCAT_APP_READY_INF_EID, CFE_EVS_EventType_INFORMATION,
                      "STARCAT: the new image is whole");
  }
}

/* Make damage of the image in use good from parity; where that cannot be, use the other image. */
static void Repair(uint32 Block) {
  starcat_slots *Slots = &STARCAT_APP_Data.Slots;
  const uint32 Active = Slots->active;
  uint32_t Mended = 0;
  HK.DamageFound++;
  starcat_status Status = starcat_mend_image(Slots->bytes[Active], Slots->size[Active], &Mended);
  HK.BlocksMended += Mended;
  if (Status == STARCAT_OK) {
    CFE_EVS_SendEvent(STARCAT_APP_MENDED_INF_EID, CFE_EVS_EventType_INFORMATION,
                      "STARCAT: block %lu was damaged, %lu blocks were mended",
                      (unsigned long)Block, (unsigned long)Mended);
    return;
  }
  Status = starcat_start_image(Slots, &STARCAT_APP_Data.Image);
  STARCAT_APP_ImageInUse(Status);
  if (Status == STARCAT_OK) {
    HK.FallBacks++;
    CFE_EVS_SendEvent(STARCAT_APP_FALLBACK_ERR_EID, CFE_EVS_EventType_ERROR,
                      "STARCAT: block %lu is damaged beyond its parity, slot %u took over",
                      (unsigned long)Block, (unsigned int)HK.ActiveSlot);
  } else {
    CFE_EVS_SendEvent(STARCAT_APP_NO_IMAGE_ERR_EID, CFE_EVS_EventType_CRITICAL,
                      "STARCAT: block %lu is damaged beyond its parity, no image is left, status %d",
                      (unsigned long)Block, (int)Status);
  }
}

static void Scrub(void) {
  STARCAT_APP_Data_t *Data = &STARCAT_APP_Data;
  const uint32 Active = Data->Slots.active;
  uint32_t Bad = 0;
  const starcat_status Status =
      starcat_scrub_image(Data->Slots.bytes[Active], Data->Slots.size[Active], HK.ScrubBlock,
                    Data->Config.ScrubBlocks, &Bad);
  if (Status != STARCAT_OK) {
    Repair(Bad); /* the same blocks are checked again in the next tick */
    return;
  }
  HK.ScrubBlock += Data->Config.ScrubBlocks;
  if (HK.ScrubBlock >= Data->Image.total_bytes / STARCAT_PIECE_BYTES) {
    HK.ScrubBlock = 0;
    HK.ScrubPasses++;
  }
}

/* A tick of idle time. */
void STARCAT_APP_Wakeup(const STARCAT_APP_WakeupCmd_t *Msg) {
  (void)Msg;
  CFE_ES_PerfLogEntry(STARCAT_APP_SCRUB_PERF_ID);
  if (HK.LoadState == STARCAT_APP_LOAD_CHECKING) {
    CheckLoaded();
  } else if (HK.LoadState == STARCAT_APP_LOAD_READING) {
    for (uint32 n = 0; (n < STARCAT_APP_Data.Config.LoadPieces) &&
                       (HK.LoadState == STARCAT_APP_LOAD_READING);
         n++) {
      ReadPiece();
    }
  } else if (STARCAT_APP_Data.HasImage) {
    Scrub();
  }
  CFE_ES_PerfLogExit(STARCAT_APP_SCRUB_PERF_ID);
}

/* Read a file whole into the slot that is not `Active` then. */
static void ReadImage(const char *Path, uint32 Active) {
  STARCAT_APP_Data.Slots.active = Active;
  if (STARCAT_APP_BeginLoad(Path, 0, false) != CFE_SUCCESS) {
    return;
  }
  while (HK.LoadState == STARCAT_APP_LOAD_READING) {
    ReadPiece();
  }
}

/* Read the images of the start, and open the first one that can be used. */
void STARCAT_APP_StartImages(void) {
  starcat_slots *Slots = &STARCAT_APP_Data.Slots;
  os_fstat_t Found;
  Slots->bytes[0] = (uint8 *)Memory[0];
  Slots->bytes[1] = (uint8 *)Memory[1];
  Slots->capacity = sizeof Memory[0];
  ReadImage(STARCAT_APP_IMAGE_FILE, 1);
  if (OS_stat(STARCAT_APP_OTHER_IMAGE_FILE, &Found) == OS_SUCCESS) {
    ReadImage(STARCAT_APP_OTHER_IMAGE_FILE, 0);
  }
  Slots->active = 0;
  HK.LoadState = STARCAT_APP_LOAD_NONE;
  const starcat_status Status = starcat_start_image(Slots, &STARCAT_APP_Data.Image);
  STARCAT_APP_ImageInUse(Status);
  if (Status != STARCAT_OK) {
    CFE_EVS_SendEvent(STARCAT_APP_NO_IMAGE_ERR_EID, CFE_EVS_EventType_CRITICAL,
                      "STARCAT: no image can be used, status %d", (int)Status);
  }
}
