/* starcat onboard, next to the matcher: two slots for images, one in use and one for its successor.
 *
 * An image is received in pieces of any size and order. A transfer can continue after a break. The
 * new image is used when it is complete; the previous image stays as a fallback. The parity of a
 * complete image is written behind it, one block for each 32, and repairs damaged blocks. A patch
 * makes the next image from the one in use; docs/onboard-format.md describes every byte of a patch.
 *
 * Slots are memory that can be written like any other memory. While one of these calls writes a
 * slot, no call of starcat.h may use that slot. Calls write the slot that is not in use;
 * starcat_start_image and starcat_mend_image also write damaged blocks of the slot they are given.
 *
 * SPDX-License-Identifier: MIT
 */
#ifndef STARCAT_UPDATE_H
#define STARCAT_UPDATE_H

#include "starcat.h"

#ifdef __cplusplus
extern "C" {
#endif

#define starcat_start_image STARCAT_SYMBOL(starcat_start_image)
#define starcat_switch_image STARCAT_SYMBOL(starcat_switch_image)

/* Two slots. Set all fields before the first call: `size` and `active` as kept from before, or 0.
 * Calls change `size`, `active` and `coming_crc`: keep these three over a restart. */
typedef struct {
  uint8_t *bytes[2];   /* each at a multiple of 8 */
  size_t capacity;     /* size of each slot: the largest image and its parity */
  size_t size[2];      /* bytes of the image in each slot, without parity; 0: none */
  uint32_t active;     /* the slot in use, 0 or 1 */
  uint32_t coming_crc; /* CRC of the image being received; 0: not stated, or none */
} starcat_slots;

/* Bytes of the parity of an image of `size` bytes. */
size_t starcat_count_parity_bytes(size_t size);

/* Open the image of the active slot. If it cannot be used, open the image of the other slot and
 * make that slot active. Damaged blocks are repaired first. If neither can be used: the status of
 * the slot that was active. Call it at the start, and after starcat_scrub_image found damage. */
starcat_status starcat_start_image(starcat_slots *slots, starcat_image *image);

/* Prepare the other slot for an image of `size` bytes. The slot is not cleared, so that an
 * interrupted transfer can continue. `crc`, 8 bytes before the end of the image, is the CRC-32 of
 * all of its data and distinguishes it from other images; 0: not stated. STARCAT_E_SHORT: the slot
 * is too small. STARCAT_E_LAYOUT: an image cannot have this size. */
starcat_status starcat_receive_image(starcat_slots *slots, size_t size, uint32_t crc);

/* Write `count` bytes at `offset` of the image being received. STARCAT_E_SHORT: beyond its end. */
starcat_status starcat_put_piece(starcat_slots *slots, size_t offset, const uint8_t *bytes,
                                 size_t count);

/* Find a block of 4096 bytes that is not complete: one of the check blocks at the end of the image,
 * which are needed to check the others, else the first from `first` on. STARCAT_INCOMPLETE: `block`
 * is the missing block. STARCAT_OK: none is missing; `block` is the number of blocks. */
starcat_status starcat_find_missing_block(const starcat_slots *slots, uint32_t first,
                                          uint32_t *block);

/* Check every block of the image of the other slot, open it and make that slot active. If it cannot
 * be used (STARCAT_INCOMPLETE: not received completely), only `image` changes and must be opened
 * again with starcat_start_image. A second call goes back to the previous image. */
starcat_status starcat_switch_image(starcat_slots *slots, starcat_image *image);

/* Repair damaged blocks of an image of exactly `size` bytes from the parity behind it; the memory
 * must have room for it. If no block is damaged afterwards, the parity is written. `n_mended`
 * counts the repaired blocks. STARCAT_E_CRC: some cannot be repaired and are unchanged. */
starcat_status starcat_mend_image(void *bytes, size_t size, uint32_t *n_mended);

/* Make the next image in the other slot from the active image and a patch of `starcat export
 * --patch-from`. The patch begins at a multiple of 4. starcat_switch_image takes the image into
 * use. STARCAT_E_VERSION: the patch is for another image, or another version of the format.
 * STARCAT_E_LAYOUT, STARCAT_E_CRC: the patch or the active image is damaged. */
starcat_status starcat_apply_patch(starcat_slots *slots, const void *patch, size_t size);

#ifdef __cplusplus
}
#endif
#endif
