/* starcat onboard, beside the matcher: two places for images, one in use and one for its successor.
 *
 * An image comes in pieces of any size and order, is resumed after a break, and is used when it is
 * whole; the other one stays to fall back on. A damaged block is made anew from parity, which every
 * image of `starcat export` carries behind its last block: one block in 33. A patch makes the next
 * image of the one in use. docs/onboard-format.md describes every byte of both.
 *
 * Places are memory that can be written as memory is. Nothing here is called while a call of
 * starcat.h works in the place that it writes.
 *
 * SPDX-License-Identifier: MIT
 */
#ifndef STARCAT_UPDATE_H
#define STARCAT_UPDATE_H

#include "starcat.h"

#ifdef __cplusplus
extern "C" {
#endif

#define STARCAT_PIECE_BYTES 4096u /* of a block, the unit in which an image is checked */

/* Two places. Set bytes and capacity, and the rest to 0 or to what was kept from before. */
typedef struct {
  uint8_t *bytes[2];   /* each at a multiple of 8 */
  size_t capacity;     /* bytes of a place */
  size_t size[2];      /* bytes of the image in a place, with its parity; 0: none */
  uint32_t active;     /* the place in use, 0 or 1 */
} starcat_places;

/* Open an image: the one of the active place, or, where that cannot be used and its parity does not
 * mend it, the other one, which then is the active one. The status of the active one is returned if
 * neither can be used. Called at the start, and after damage was found. */
starcat_status starcat_start(starcat_places *places, starcat_image *image);

/* Prepare the other place for an image of `size` bytes, parity included. What is there stays, so
 * that a transfer that was broken off goes on. STARCAT_E_SHORT: the place is too small. */
starcat_status starcat_receive(starcat_places *places, size_t size);

/* Write a piece at `offset` of the image that is received. */
starcat_status starcat_put(starcat_places *places, size_t offset, const uint8_t *bytes,
                           size_t count);

/* Find the next block, from `first` on, that has not been received whole: its number, or the number
 * of blocks if there is none. Blocks of checks come first, as they tell of the others. */
starcat_status starcat_missing(const starcat_places *places, uint32_t first, uint32_t *block);

/* Open the image of the other place, every block checked, and make that place the active one. If it
 * cannot be used its status is returned and nothing changes. Called again, it falls back. */
starcat_status starcat_switch(starcat_places *places, starcat_image *image);

/* Make damaged blocks of an image of exactly `size` bytes anew from its parity. `n_mended` counts
 * blocks that were written; STARCAT_E_CRC: some cannot be mended, and are as they were.
 * STARCAT_E_SHORT: the image has no parity. */
starcat_status starcat_mend(void *bytes, size_t size, uint32_t *n_mended);

/* Make the next image, in the other place, of the active one and a patch of `starcat export
 * --patch-from`. STARCAT_E_VERSION: the patch is not for the active image. */
starcat_status starcat_patch(starcat_places *places, const uint8_t *patch, size_t size);

#ifdef __cplusplus
}
#endif
#endif
