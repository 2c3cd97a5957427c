/* starcat onboard, beside the matcher: two slots for images, one in use and one for its successor.
 *
 * An image comes in pieces of any size and order, goes on after a break, and is used when it is
 * whole; the one before stays to fall back on. Behind an image that is whole its parity is written,
 * one block for each 32, of which damaged blocks are made anew. A patch makes the next image of the
 * one in use; docs/onboard-format.md describes every byte of it.
 *
 * Slots are memory that can be written as memory is. No call of starcat.h may work in a slot while
 * one of these writes it: they write the slot that is not in use, and starcat_start_image and
 * starcat_mend_image damaged blocks of the one they are given.
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

/* Two slots. Set all of it before the first call: sizes and what is in use as they were kept, or
 * 0. Calls change size, active and coming_crc, which are what to keep over a restart. */
typedef struct {
  uint8_t *bytes[2];   /* each at a multiple of 8 */
  size_t capacity;     /* of a slot: largest image and its parity */
  size_t size[2];      /* of the image in a slot, without its parity; 0: none */
  uint32_t active;     /* the slot in use, 0 or 1 */
  uint32_t coming_crc; /* of the image that is being received; 0: not stated, or none */
} starcat_slots;

/* Bytes of the parity of an image of `size` bytes. */
size_t starcat_count_parity_bytes(size_t size);

/* Open the image of the active slot, of the other one if the active one cannot be used; that one
 * is the active one then. Damaged blocks are mended before. If neither can be used: the status of
 * the one that was active. Called at the start, and after starcat_scrub_image found damage. */
starcat_status starcat_start_image(starcat_slots *slots, starcat_image *image);

/* Prepare the other slot for an image of `size` bytes. What is there stays, so that a transfer
 * that was broken off goes on. `crc` is the number that is 8 bytes before the end of the image, the
 * CRC-32 of all of its data, by which it is told from others; 0: not stated.
 * STARCAT_E_SHORT: the slot is too small. STARCAT_E_LAYOUT: no image has so many bytes. */
starcat_status starcat_receive_image(starcat_slots *slots, size_t size, uint32_t crc);

/* Write `count` bytes at `offset` of the image that is received. STARCAT_E_SHORT: beyond its end. */
starcat_status starcat_put_piece(starcat_slots *slots, size_t offset, const uint8_t *bytes,
                                 size_t count);

/* Find a block of 4096 bytes that has not been received whole: one of the check blocks at the end
 * of the image, by which the others are told, else the first from `first` on. STARCAT_INCOMPLETE:
 * there is one, its number in `block`. STARCAT_OK: there is none, and `block` is their number. */
starcat_status starcat_find_missing_block(const starcat_slots *slots, uint32_t first,
                                          uint32_t *block);

/* Open the image of the other slot, every block checked, and make that slot the active one. If it
 * cannot be used (STARCAT_INCOMPLETE: it has not been received whole) nothing changes but `image`, which has to be opened again by starcat_start_image. Called
 * once more it falls back. */
starcat_status starcat_switch_image(starcat_slots *slots, starcat_image *image);

/* Make damaged blocks of an image of exactly `size` bytes, behind which is room for its parity,
 * anew from the parity; write the parity if no block is damaged then. `n_mended` counts blocks of
 * the image that were written. STARCAT_E_CRC: some cannot be mended, and are as they were. */
starcat_status starcat_mend_image(void *bytes, size_t size, uint32_t *n_mended);

/* Make the next image in the other slot, of the active one and a patch of `starcat export
 * --patch-from`, which begins at a multiple of 4; starcat_switch_image takes it into use.
 * STARCAT_E_VERSION: the patch is for another image, or another version of the format.
 * STARCAT_E_LAYOUT, STARCAT_E_CRC: it is damaged, or the active image is. */
starcat_status starcat_apply_patch(starcat_slots *slots, const void *patch, size_t size);

#ifdef __cplusplus
}
#endif
#endif
