/* starcat onboard, next to the matcher: two slots for images, one in use and one for its successor.
 *
 * An image is received in pieces of any size and order. A transfer can continue after a break. When
 * the image is complete, the application examines it (its signature, say) and accepts it. An image
 * that was not accepted is never used and never fallen back to, also after a restart. The parity of
 * an image is written behind it, one block for each 32, and repairs damaged blocks. A patch makes
 * the next image from the one in use; docs/onboard-format.md describes every byte of a patch.
 *
 * Slots are memory that can be written like any other memory. While one of these calls writes a
 * slot, no call of starcat.h may use that slot. Calls write the slot that is not in use;
 * starcat_start_image and the calls that mend also write damaged blocks of the slot they are given.
 *
 * Calls of a whole image (start, switch, mend_image, apply_patch) take as long as the image is
 * large. The others take a block, or the stated number of units, and fit into a tick.
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

/* The value of starcat_slots.acceptance of an accepted image. Any other value: not accepted. */
#define STARCAT_ACCEPTED 0xacce97edu

/* Bytes of a record of the slots. */
#define STARCAT_RECORD_BYTES 40u

/* Two slots. The application sets `bytes` and `capacity`, and the other fields to zeros or by
 * starcat_read_record. Calls change the other fields, which have to be kept over a restart. */
typedef struct {
  uint8_t *bytes[2]; /* each at a multiple of 8 */
  size_t capacity;   /* size of each slot: the largest image and its parity */
  size_t size[2];    /* bytes of the image in each slot, without parity; 0: none */
  uint32_t crc[2];   /* CRC-32 of all data of the image, as stated or accepted; 0: not stated */
  uint32_t acceptance[2]; /* STARCAT_ACCEPTED: the application has accepted the image */
  uint32_t active;        /* the slot in use, 0 or 1 */
  uint32_t sequence;      /* records written so far */
} starcat_slots;

/* Bytes of the parity of an image of `size` bytes. */
size_t starcat_count_parity_bytes(size_t size);

/* Write what has to be kept over a restart into a record. `place`, 0 or 1, is where to store it: the
 * records of one place and of the other alternate, so that the last one but one is whole while a
 * record is stored. */
starcat_status starcat_write_record(starcat_slots *slots, uint8_t record[STARCAT_RECORD_BYTES],
                                    uint32_t *place);

/* Take the newer of two records that are undamaged. STARCAT_E_CRC: none is, and `slots` is
 * unchanged. */
starcat_status starcat_read_record(starcat_slots *slots, const uint8_t first[STARCAT_RECORD_BYTES],
                                   const uint8_t second[STARCAT_RECORD_BYTES]);

/* Accept the image of a slot, of which starcat_slots.size is set and whose CRC-32 of all data is
 * `crc`: it can be started, switched to and fallen back to from now on. An image with another CRC is
 * not used. STARCAT_E_LAYOUT: the slot is empty. */
starcat_status starcat_accept_image(starcat_slots *slots, uint32_t slot, uint32_t crc);

/* Withdraw the acceptance of a slot and empty it. */
starcat_status starcat_refuse_image(starcat_slots *slots, uint32_t slot);

/* Open the image of the active slot. If it cannot be used, open the image of the other slot and
 * make that slot active. Damaged blocks are repaired first. If neither can be used: the status of
 * the slot that was active. STARCAT_INCOMPLETE: its image was not accepted. */
starcat_status starcat_start_image(starcat_slots *slots, starcat_image *image);

/* Prepare the other slot for an image of `size` bytes; the image in it is no longer accepted. Store
 * the record before the first piece. The slot is not cleared, so that an interrupted transfer can
 * continue. `crc`, 8 bytes before the end of the image, is the CRC-32 of all of its data and
 * distinguishes it from other images; 0: not stated. STARCAT_E_SHORT: the slot is too small.
 * STARCAT_E_LAYOUT: an image cannot have this size. */
starcat_status starcat_receive_image(starcat_slots *slots, size_t size, uint32_t crc);

/* Write `count` bytes at `offset` of the image being received. STARCAT_E_SHORT: beyond its end.
 * STARCAT_E_OPTIONS: the image of the slot was accepted, and none is being received. */
starcat_status starcat_put_piece(starcat_slots *slots, size_t offset, const uint8_t *bytes,
                                 size_t count);

/* Find a block of 4096 bytes that is not complete: one of the check blocks at the end of the image,
 * which are needed to check the others, else the first from `first` on. STARCAT_INCOMPLETE: `block`
 * is the missing block. STARCAT_OK: none is missing; `block` is the number of blocks. */
starcat_status starcat_find_missing_block(const starcat_slots *slots, uint32_t first,
                                          uint32_t *block);

/* Check `count` blocks of the image of a slot from `first` on, in the order in which they need each
 * other: place 0 is the first check block, and data blocks follow the last check block. `block` is
 * the damaged block. STARCAT_INCOMPLETE: a check block is damaged or of another image than
 * starcat_slots.crc states; STARCAT_E_CRC: another block is. */
starcat_status starcat_check_blocks(const starcat_slots *slots, uint32_t slot, uint32_t first,
                                    uint32_t count, uint32_t *block);

/* Check every block of the image of the other slot, open it and make that slot active. If it cannot
 * be used (STARCAT_INCOMPLETE: not received completely, or not accepted), only `image` changes and
 * must be opened again with starcat_start_image. A second call goes back to the previous image. */
starcat_status starcat_switch_image(starcat_slots *slots, starcat_image *image);

/* Repair one block of an image of exactly `size` bytes from the parity behind it; the memory must
 * have room for it. STARCAT_OK: the block is sound now. STARCAT_E_CRC: it cannot be repaired and is
 * unchanged. STARCAT_E_OPTIONS: there is no such block. */
starcat_status starcat_mend_block(void *bytes, size_t size, uint32_t block);

/* Check or write the parity of one group: of blocks `group`, `group` + groups, and so on, where
 * groups is the number of blocks of the parity. Write it only if the blocks of the group are sound.
 * STARCAT_E_CRC: the parity is damaged, or a block of the group is. */
starcat_status starcat_check_parity(const void *bytes, size_t size, uint32_t group);
starcat_status starcat_write_parity(void *bytes, size_t size, uint32_t group);

/* Repair damaged blocks of an image as starcat_mend_block does. If no block is damaged afterwards,
 * the parity is written. `n_mended` counts the repaired blocks. STARCAT_E_CRC: some cannot be
 * repaired and are unchanged. */
starcat_status starcat_mend_image(void *bytes, size_t size, uint32_t *n_mended);

/* A patch that is being applied. Its fields are for the calls below. */
typedef struct {
  const uint8_t *patch, *next, *end; /* unread part of the patch */
  const uint8_t *old;
  uint8_t *made;
  uint32_t old_bytes, old_at, made_bytes, made_crc, made_at;
  const uint32_t *runs; /* first row of each run of stars, and the shift of its rows */
  uint32_t n_runs, row_units;
  uint32_t patch_bytes, patch_crc, checked, crc; /* bytes checked so far, and their CRC */
  uint32_t block;                                /* next block of the old image to check */
  uint32_t kind, left, shift, same;              /* the step that is being executed */
} starcat_patching;

/* Begin to apply a patch, which begins at a multiple of 4, to the active image. Nothing is written.
 * STARCAT_E_VERSION: the patch is for another image, or another version of the format. */
starcat_status starcat_begin_patch(const starcat_slots *slots, const void *patch, size_t size,
                                   starcat_patching *work);

/* Check the patch by its CRC and the blocks of the active image by theirs, about `units` bytes of
 * them at a time (at least a block). STARCAT_INCOMPLETE: there is more to check. STARCAT_E_CRC: the
 * patch or the active image is damaged. */
starcat_status starcat_check_patch(starcat_patching *work, uint32_t units);

/* Make the next part of the new image in the other slot, after starcat_check_patch returned
 * STARCAT_OK and starcat_receive_image was called for `made_bytes` and `made_crc`. A unit is the
 * work of checking a byte; a number that is renumbered takes several. STARCAT_INCOMPLETE: there is
 * more to make. STARCAT_E_LAYOUT: the steps are invalid. STARCAT_E_OPTIONS: an image that was
 * accepted is in the slot. */
starcat_status starcat_run_patch(const starcat_slots *slots, starcat_patching *work,
                                 uint32_t units);

/* Do all of this at once, and check the new image. It is used after it was accepted.
 * STARCAT_E_LAYOUT, STARCAT_E_CRC: the patch or the active image is damaged; unless the steps of a
 * patch with a right CRC are invalid, nothing was written. */
starcat_status starcat_apply_patch(starcat_slots *slots, const void *patch, size_t size);

#ifdef __cplusplus
}
#endif
#endif
