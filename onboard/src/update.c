/* Two slots for images: pieces, parity, patches. The size of an image alone determines which blocks
 * are check blocks, as the header can be damaged or missing.
 *
 * SPDX-License-Identifier: MIT
 */
#include "starcat_update.h"

#include "internal.h"

#define BLOCKS_OF_PARITY 32u /* blocks of an image per block of parity */
#define CHUNK 16u            /* words */
#define WORDS_OF_BLOCK (STARCAT_BLOCK_BYTES / 4u)
#define PATCH_HEADER_BYTES 44u
#define PATCH_CRC_AT 40u
#define PATCH_VERSION 2u
#define BYTES_OF_RUN 8u
#define STEP_UNITS 16u /* work of a step beside its bytes, in units of checking a byte */
#define SUM_UNITS 8u   /* of a number that is added */
#define ROW_UNITS 4u   /* of a row that is renumbered, beside one unit per halving of the runs */

typedef struct {
  const uint8_t *bytes;
  uint32_t blocks, data, groups; /* all blocks; data blocks; groups with one parity block each */
} blocks_of_image;

static uint32_t read_number(const uint8_t *bytes, size_t offset) {
  return *(const uint32_t *)(const void *)(bytes + offset);
}

/* The blocks of an image of `size` bytes; 0 if an image cannot have this size. */
static int lay_out_blocks(const uint8_t *bytes, size_t size, blocks_of_image *image) {
  if ((size % STARCAT_BLOCK_BYTES != 0u) || (size < 2u * STARCAT_BLOCK_BYTES) ||
      (size / STARCAT_BLOCK_BYTES >= 1048576u)) {
    return 0;
  }
  image->bytes = bytes;
  image->blocks = (uint32_t)(size / STARCAT_BLOCK_BYTES);
  image->data =
      image->blocks - (image->blocks + STARCAT_CRCS_OF_BLOCK) / (STARCAT_CRCS_OF_BLOCK + 1u);
  image->groups = (image->blocks + BLOCKS_OF_PARITY - 1u) / BLOCKS_OF_PARITY;
  return 1;
}

static const uint8_t *find_block(const blocks_of_image *image, uint32_t block) {
  return image->bytes + (size_t)block * STARCAT_BLOCK_BYTES;
}

static int is_data_block_sound(const blocks_of_image *image, uint32_t block) {
  return starcat_is_block_sound(image->bytes, image->data * STARCAT_BLOCK_BYTES, block);
}

size_t starcat_count_parity_bytes(size_t size) {
  blocks_of_image image;
  return lay_out_blocks(NULL, size, &image) ? (size_t)image.groups * STARCAT_BLOCK_BYTES : 0u;
}

/* Compute part of a block, at a word of it, from the other blocks of its group and their parity: the
 * XOR of all is 0. The blocks of a group are spread evenly, so that a burst of damage hits each
 * group once. The parity block lies behind the blocks of the image and belongs to its group. */
static void find_part(const blocks_of_image *image, uint32_t block, uint32_t at,
                      uint32_t part[CHUNK]) {
  const uint32_t group = block < image->blocks ? block % image->groups : block - image->blocks;
  for (uint32_t k = 0; k < CHUNK; k++) {
    part[k] = 0;
  }
  for (uint32_t other = group; other < image->blocks + image->groups; other += image->groups) {
    const uint32_t member = other < image->blocks ? other : image->blocks + group;
    if (member != block) {
      const uint32_t *words = (const uint32_t *)(const void *)find_block(image, member) + at;
      for (uint32_t k = 0; k < CHUNK; k++) {
        part[k] ^= words[k];
      }
    }
  }
}

/* Whether a block would be undamaged after its repair from its group. */
static int would_be_sound(const blocks_of_image *image, uint32_t block) {
  const uint32_t last = block < image->data ? CHUNK : CHUNK - 1u; /* words that the CRC covers */
  uint32_t part[CHUNK];
  uint32_t crc = 0;
  for (uint32_t at = 0; at < WORDS_OF_BLOCK; at += CHUNK) {
    find_part(image, block, at, part);
    crc = starcat_update_crc(crc, (const uint8_t *)part,
                             4u * (size_t)(at < WORDS_OF_BLOCK - CHUNK ? CHUNK : last));
  }
  if (block >= image->data) {
    return crc == part[CHUNK - 1u];
  }
  const uint8_t *check = find_block(image, image->data + block / STARCAT_CRCS_OF_BLOCK);
  return crc == read_number(check, 4u * (size_t)(block % STARCAT_CRCS_OF_BLOCK));
}

/* Write a block as its group makes it, into the memory of the image. */
static void write_block(const blocks_of_image *image, uint32_t block, uint8_t *bytes) {
  uint8_t *into = bytes + (size_t)block * STARCAT_BLOCK_BYTES;
  uint32_t part[CHUNK];
  for (uint32_t at = 0; at < WORDS_OF_BLOCK; at += CHUNK) {
    find_part(image, block, at, part);
    uint32_t *words = (uint32_t *)(void *)into + at;
    for (uint32_t k = 0; k < CHUNK; k++) {
      words[k] = part[k];
    }
  }
}

/* Whether a block is as its group makes it. */
static int is_as_group(const blocks_of_image *image, uint32_t block) {
  uint32_t part[CHUNK];
  uint32_t differs = 0;
  for (uint32_t at = 0; at < WORDS_OF_BLOCK; at += CHUNK) {
    const uint32_t *words = (const uint32_t *)(const void *)find_block(image, block) + at;
    find_part(image, block, at, part);
    for (uint32_t k = 0; k < CHUNK; k++) {
      differs |= words[k] ^ part[k];
    }
  }
  return differs == 0u;
}

/* Check the memory of an image, and find its blocks. */
static starcat_status find_blocks(const void *bytes, size_t size, blocks_of_image *image) {
  if (bytes == NULL) {
    return STARCAT_E_NULL;
  }
  if (((uintptr_t)bytes & 7u) != 0u) {
    return STARCAT_E_ALIGNMENT;
  }
  return lay_out_blocks(bytes, size, image) != 0 ? STARCAT_OK : STARCAT_E_LAYOUT;
}

starcat_status starcat_mend_block(void *bytes, size_t size, uint32_t block) {
  blocks_of_image image;
  const starcat_status status = find_blocks(bytes, size, &image);
  if (status != STARCAT_OK) {
    return status;
  }
  if (block >= image.blocks) {
    return STARCAT_E_OPTIONS;
  }
  if (is_data_block_sound(&image, block) != 0) {
    return STARCAT_OK;
  }
  if (would_be_sound(&image, block) == 0) {
    return STARCAT_E_CRC;
  }
  write_block(&image, block, bytes);
  return STARCAT_OK;
}

starcat_status starcat_check_parity(const void *bytes, size_t size, uint32_t group) {
  blocks_of_image image;
  const starcat_status status = find_blocks(bytes, size, &image);
  if (status != STARCAT_OK) {
    return status;
  }
  if (group >= image.groups) {
    return STARCAT_E_OPTIONS;
  }
  return is_as_group(&image, image.blocks + group) != 0 ? STARCAT_OK : STARCAT_E_CRC;
}

starcat_status starcat_write_parity(void *bytes, size_t size, uint32_t group) {
  blocks_of_image image;
  const starcat_status status = find_blocks(bytes, size, &image);
  if (status != STARCAT_OK) {
    return status;
  }
  if (group >= image.groups) {
    return STARCAT_E_OPTIONS;
  }
  write_block(&image, image.blocks + group, bytes);
  return STARCAT_OK;
}

starcat_status starcat_mend_image(void *bytes, size_t size, uint32_t *n_mended) {
  blocks_of_image image;
  uint32_t left = 0;
  if (n_mended == NULL) {
    return STARCAT_E_NULL;
  }
  *n_mended = 0;
  const starcat_status status = find_blocks(bytes, size, &image);
  if (status != STARCAT_OK) {
    return status;
  }
  for (uint32_t n = 0; n < image.blocks; n++) {
    const uint32_t block = (n + image.data) % image.blocks; /* check blocks first */
    if (is_data_block_sound(&image, block) == 0) {
      const uint32_t mended = starcat_mend_block(bytes, size, block) == STARCAT_OK ? 1u : 0u;
      left += 1u - mended;
      *n_mended += mended;
    }
  }
  if (left > 0u) {
    return STARCAT_E_CRC;
  }
  for (uint32_t group = 0; group < image.groups; group++) {
    write_block(&image, image.blocks + group, bytes);
  }
  return STARCAT_OK;
}

static starcat_status check_slots(const starcat_slots *slots) {
  if ((slots == NULL) || (slots->bytes[0] == NULL) || (slots->bytes[1] == NULL)) {
    return STARCAT_E_NULL;
  }
  return slots->active > 1u ? STARCAT_E_OPTIONS : STARCAT_OK;
}

/* Lay out an image of `size` bytes, and check the room for it and its parity. */
static starcat_status lay_out_image(const starcat_slots *slots, const uint8_t *bytes, size_t size,
                                    blocks_of_image *image) {
  if (lay_out_blocks(bytes, size, image) == 0) {
    return STARCAT_E_LAYOUT;
  }
  const size_t parity = (size_t)image->groups * STARCAT_BLOCK_BYTES;
  return (size > slots->capacity) || (parity > slots->capacity - size) ? STARCAT_E_SHORT
                                                                       : STARCAT_OK;
}

/* Check the room for an image of `size` bytes and its parity. */
static starcat_status check_size(const starcat_slots *slots, size_t size) {
  blocks_of_image unused;
  return lay_out_image(slots, NULL, size, &unused);
}

static void put_number(uint8_t *bytes, uint32_t number) {
  for (uint32_t k = 0; k < 4u; k++) {
    bytes[k] = (uint8_t)(number >> (8u * k));
  }
}

static uint32_t get_number(const uint8_t *bytes) {
  return (uint32_t)bytes[0] | (uint32_t)bytes[1] << 8 | (uint32_t)bytes[2] << 16 |
         (uint32_t)bytes[3] << 24;
}

/* Words of a record, least significant byte first; the last one is the CRC of the others. */
#define RECORD_MAGIC 0x53435253u
enum { MAGIC_WORD, SEQUENCE, ACTIVE, SIZES, CRCS = 5, ACCEPTANCES = 7, RECORD_WORDS = 9 };

starcat_status starcat_write_record(starcat_slots *slots, uint8_t record[STARCAT_RECORD_BYTES],
                                    uint32_t *place) {
  const starcat_status status = check_slots(slots);
  if (status != STARCAT_OK) {
    return status;
  }
  if ((record == NULL) || (place == NULL)) {
    return STARCAT_E_NULL;
  }
  slots->sequence++;
  put_number(record, RECORD_MAGIC);
  put_number(record + 4u * SEQUENCE, slots->sequence);
  put_number(record + 4u * ACTIVE, slots->active);
  for (uint32_t n = 0; n < 2u; n++) {
    put_number(record + 4u * (SIZES + n), (uint32_t)slots->size[n]);
    put_number(record + 4u * (CRCS + n), slots->crc[n]);
    put_number(record + 4u * (ACCEPTANCES + n), slots->acceptance[n]);
  }
  put_number(record + 4u * RECORD_WORDS, starcat_update_crc(0, record, 4u * RECORD_WORDS));
  *place = slots->sequence & 1u;
  return STARCAT_OK;
}

static int is_record_sound(const uint8_t *record) {
  return (get_number(record) == RECORD_MAGIC) && (get_number(record + 4u * ACTIVE) <= 1u) &&
         (get_number(record + 4u * RECORD_WORDS) ==
          starcat_update_crc(0, record, 4u * RECORD_WORDS));
}

starcat_status starcat_read_record(starcat_slots *slots, const uint8_t first[STARCAT_RECORD_BYTES],
                                   const uint8_t second[STARCAT_RECORD_BYTES]) {
  if ((slots == NULL) || (first == NULL) || (second == NULL)) {
    return STARCAT_E_NULL;
  }
  const int has_first = is_record_sound(first), has_second = is_record_sound(second);
  if ((has_first == 0) && (has_second == 0)) {
    return STARCAT_E_CRC;
  }
  /* The sequence may have passed its largest number. */
  const uint32_t ahead = get_number(second + 4u * SEQUENCE) - get_number(first + 4u * SEQUENCE);
  const uint8_t *record =
      (has_second != 0) && ((has_first == 0) || (ahead < 0x80000000u)) ? second : first;
  slots->sequence = get_number(record + 4u * SEQUENCE);
  slots->active = get_number(record + 4u * ACTIVE);
  for (uint32_t n = 0; n < 2u; n++) {
    slots->size[n] = get_number(record + 4u * (SIZES + n));
    slots->crc[n] = get_number(record + 4u * (CRCS + n));
    slots->acceptance[n] = get_number(record + 4u * (ACCEPTANCES + n));
  }
  return STARCAT_OK;
}

/* Check the slots and the number of one of them. */
static starcat_status check_slot(const starcat_slots *slots, uint32_t slot) {
  const starcat_status status = check_slots(slots);
  return (status == STARCAT_OK) && (slot > 1u) ? STARCAT_E_OPTIONS : status;
}

starcat_status starcat_accept_image(starcat_slots *slots, uint32_t slot, uint32_t crc) {
  starcat_status status = check_slot(slots, slot);
  if (status == STARCAT_OK) {
    status = check_size(slots, slots->size[slot]);
  }
  if (status == STARCAT_OK) {
    slots->crc[slot] = crc;
    slots->acceptance[slot] = STARCAT_ACCEPTED;
  }
  return status;
}

starcat_status starcat_refuse_image(starcat_slots *slots, uint32_t slot) {
  const starcat_status status = check_slot(slots, slot);
  if (status == STARCAT_OK) {
    slots->size[slot] = 0;
    slots->crc[slot] = 0;
    slots->acceptance[slot] = 0;
  }
  return status;
}

/* CRC-32 of all data of an image, as its last check block states it. */
static uint32_t read_whole_crc(const uint8_t *bytes, size_t size) {
  return read_number(bytes, size - STARCAT_BLOCK_BYTES + STARCAT_WHOLE_AT);
}

/* Repair the accepted image of a slot, write its parity, and open it. */
static starcat_status use_slot(const starcat_slots *slots, uint32_t slot, starcat_image *image) {
  const uint8_t *bytes = slots->bytes[slot];
  const size_t size = slots->size[slot];
  uint32_t n_mended = 0;
  starcat_status status = check_size(slots, size);
  if ((status == STARCAT_OK) && (slots->acceptance[slot] != STARCAT_ACCEPTED)) {
    status = STARCAT_INCOMPLETE;
  }
  if (status == STARCAT_OK) {
    status = starcat_mend_image(slots->bytes[slot], size, &n_mended);
  }
  if ((status == STARCAT_OK) && (read_whole_crc(bytes, size) != slots->crc[slot])) {
    status = STARCAT_INCOMPLETE; /* another image than the accepted one */
  }
  if (status == STARCAT_OK) {
    status = starcat_open_image(image, bytes, size, STARCAT_SKIP_CRC);
  }
  return status;
}

starcat_status starcat_start_image(starcat_slots *slots, starcat_image *image) {
  starcat_status status = check_slots(slots);
  if (status != STARCAT_OK) {
    return status;
  }
  if (image == NULL) {
    return STARCAT_E_NULL;
  }
  status = use_slot(slots, slots->active, image);
  if (status != STARCAT_OK) {
    const uint32_t other = 1u - slots->active;
    if (use_slot(slots, other, image) == STARCAT_OK) {
      slots->active = other;
      status = STARCAT_OK;
    }
  }
  return status;
}

starcat_status starcat_receive_image(starcat_slots *slots, size_t size, uint32_t crc) {
  starcat_status status = check_slots(slots);
  if (status == STARCAT_OK) {
    status = check_size(slots, size);
  }
  if (status == STARCAT_OK) {
    const uint32_t other = 1u - slots->active;
    slots->size[other] = size;
    slots->crc[other] = crc;
    slots->acceptance[other] = 0;
  }
  return status;
}

starcat_status starcat_put_piece(starcat_slots *slots, size_t offset, const uint8_t *bytes,
                                 size_t count) {
  const starcat_status status = check_slots(slots);
  if (status != STARCAT_OK) {
    return status;
  }
  if (bytes == NULL) {
    return STARCAT_E_NULL;
  }
  const uint32_t other = 1u - slots->active;
  if (slots->acceptance[other] != 0u) {
    return STARCAT_E_OPTIONS;
  }
  if ((offset > slots->size[other]) || (count > slots->size[other] - offset)) {
    return STARCAT_E_SHORT;
  }
  for (size_t n = 0; n < count; n++) {
    slots->bytes[other][offset + n] = bytes[n];
  }
  return STARCAT_OK;
}

/* The block at a place of the order in which blocks are checked, and whether it is damaged. */
static starcat_status check_place(const starcat_slots *slots, uint32_t slot,
                                  const blocks_of_image *image, uint32_t place, uint32_t *block) {
  const uint32_t checks = image->blocks - image->data;
  *block = place < checks ? image->data + place : place - checks;
  if (place < checks) {
    const uint8_t *check = find_block(image, *block);
    const int is_whole =
        (slots->crc[slot] == 0u) || (read_number(check, STARCAT_WHOLE_AT) == slots->crc[slot]);
    return (starcat_is_check_block_sound(check) != 0) && is_whole ? STARCAT_OK : STARCAT_INCOMPLETE;
  }
  return is_data_block_sound(image, *block) != 0 ? STARCAT_OK : STARCAT_E_CRC;
}

starcat_status starcat_check_blocks(const starcat_slots *slots, uint32_t slot, uint32_t first,
                                    uint32_t count, uint32_t *block) {
  blocks_of_image image;
  starcat_status status = check_slot(slots, slot);
  if (status != STARCAT_OK) {
    return status;
  }
  if (block == NULL) {
    return STARCAT_E_NULL;
  }
  *block = 0;
  if (lay_out_image(slots, slots->bytes[slot], slots->size[slot], &image) != STARCAT_OK) {
    return STARCAT_E_LAYOUT;
  }
  for (uint32_t n = first; (status == STARCAT_OK) && (n < image.blocks) && (n - first < count);
       n++) {
    status = check_place(slots, slot, &image, n, block);
  }
  return status;
}

starcat_status starcat_find_missing_block(const starcat_slots *slots, uint32_t first,
                                          uint32_t *block) {
  blocks_of_image image;
  const starcat_status status = check_slots(slots);
  if (status != STARCAT_OK) {
    return status;
  }
  if (block == NULL) {
    return STARCAT_E_NULL;
  }
  const uint32_t other = 1u - slots->active;
  if (lay_out_image(slots, slots->bytes[other], slots->size[other], &image) != STARCAT_OK) {
    return STARCAT_E_LAYOUT;
  }
  const uint32_t checks = image.blocks - image.data;
  for (uint32_t n = 0; n < image.blocks; n++) {
    if (((n < checks) || (n - checks >= first)) &&
        (check_place(slots, other, &image, n, block) != STARCAT_OK)) {
      return STARCAT_INCOMPLETE;
    }
  }
  *block = image.blocks;
  return STARCAT_OK;
}

starcat_status starcat_switch_image(starcat_slots *slots, starcat_image *image) {
  uint32_t block = 0;
  starcat_status status = starcat_find_missing_block(slots, 0, &block);
  if ((status == STARCAT_OK) && (image == NULL)) {
    status = STARCAT_E_NULL;
  }
  if (status == STARCAT_OK) {
    status = use_slot(slots, 1u - slots->active, image);
  }
  if (status == STARCAT_OK) {
    slots->active = 1u - slots->active;
  }
  return status;
}

/* Kinds of steps; kinds 2 to 5 have numbers of two, four, two and four bytes. */
#define LITERAL 0u
#define COPY 1u
#define ADD_16 4u
#define ZEROS 6u

/* The next number, seven bits per byte, the lowest first; 0 beyond the end of the patch. */
static uint32_t take_number(starcat_patching *patch) {
  uint32_t number = 0, bits = 0, byte = 0x80;
  while ((byte >= 0x80u) && (bits < 32u) && (patch->next < patch->end)) {
    byte = *patch->next;
    patch->next += 1;
    number |= (byte & 0x7fu) << bits;
    bits += 7u;
  }
  return number;
}

/* The next signed number; its lowest bit is the sign. */
static uint32_t take_difference(starcat_patching *patch) {
  const uint32_t number = take_number(patch);
  return (number >> 1) ^ (0u - (number & 1u));
}

/* Row in the new image of a star of the old image. */
static uint32_t renumber_row(const starcat_patching *patch, uint32_t row) {
  uint32_t low = 0, high = patch->n_runs;
  while (low < high) {
    const uint32_t middle = low + (high - low) / 2u;
    if (patch->runs[2u * middle] <= row) {
      low = middle + 1u;
    } else {
      high = middle;
    }
  }
  return low == 0u ? row : row + patch->runs[2u * low - 1u];
}

/* Write `count` rows of stars, renumbered. */
static void renumber_features(starcat_patching *patch, uint32_t count, uint32_t width) {
  for (uint32_t n = 0; n < count; n++) {
    const uint8_t *from = patch->old + patch->old_at + (size_t)n * width;
    uint8_t *to = patch->made + patch->made_at + (size_t)n * width;
    if (width == 2u) {
      *(uint16_t *)(void *)to =
          (uint16_t)renumber_row(patch, *(const uint16_t *)(const void *)from);
    } else {
      *(uint32_t *)(void *)to = renumber_row(patch, *(const uint32_t *)(const void *)from);
    }
  }
}

/* Write numbers that differ from the old ones by a shift. The patch has the changes of the shift
 * from one number to the next; a change of 0 is followed by the count of further zeros. */
static void add_differences(starcat_patching *patch, uint32_t count, uint32_t width) {
  for (uint32_t n = 0; n < count; n++) {
    const uint8_t *from = patch->old + patch->old_at + (size_t)n * width;
    uint8_t *to = patch->made + patch->made_at + (size_t)n * width;
    if (patch->same > 0u) {
      patch->same--;
    } else {
      const uint32_t change = take_difference(patch);
      patch->shift += change;
      patch->same = change == 0u ? take_number(patch) : 0u;
    }
    if (width == 2u) {
      *(uint16_t *)(void *)to = (uint16_t)(*(const uint16_t *)(const void *)from + patch->shift);
    } else {
      *(uint32_t *)(void *)to = *(const uint32_t *)(const void *)from + patch->shift;
    }
  }
}

static void copy_bytes(starcat_patching *patch, const uint8_t *from, uint32_t count) {
  uint8_t *to = patch->made + patch->made_at;
  for (uint32_t n = 0; n < count; n++) {
    to[n] = from[n];
  }
}

static void write_zeros(starcat_patching *patch, uint32_t count) {
  uint8_t *to = patch->made + patch->made_at;
  for (uint32_t n = 0; n < count; n++) {
    to[n] = 0;
  }
}

static const uint8_t width_of[8] = {1, 1, 2, 4, 2, 4, 1, 0};

/* Read the next step of a patch; 0 if it is invalid. */
static int begin_step(starcat_patching *patch) {
  const uint32_t token = take_number(patch), kind = token & 7u, count = token >> 3;
  const uint32_t width = width_of[kind], room = patch->made_bytes - patch->made_at;
  if ((width == 0u) || (count == 0u) || (count > room / width)) {
    return 0;
  }
  const uint32_t bytes = count * width;
  if (kind == LITERAL) {
    if (bytes > (size_t)(patch->end - patch->next)) {
      return 0;
    }
  } else if (kind != ZEROS) {
    patch->old_at += take_difference(patch);
    if ((patch->old_at > patch->old_bytes) || (bytes > patch->old_bytes - patch->old_at) ||
        ((patch->old_at | patch->made_at) % width != 0u)) {
      return 0;
    }
  } else {
    /* zeros need nothing else */
  }
  patch->kind = kind;
  patch->left = count;
  patch->shift = 0;
  patch->same = 0;
  return 1;
}

/* Units of work of a number of the step that is being executed. */
static uint32_t count_units(const starcat_patching *patch) {
  if ((patch->kind == LITERAL) || (patch->kind == COPY) || (patch->kind == ZEROS)) {
    return 1;
  }
  return patch->kind < ADD_16 ? patch->row_units : SUM_UNITS;
}

/* Write the next `count` numbers of a step. */
static void continue_step(starcat_patching *patch, uint32_t count) {
  const uint32_t width = width_of[patch->kind], bytes = count * width;
  if (patch->kind == LITERAL) {
    copy_bytes(patch, patch->next, bytes);
    patch->next += bytes;
  } else if (patch->kind == ZEROS) {
    write_zeros(patch, bytes);
  } else {
    if (patch->kind == COPY) {
      copy_bytes(patch, patch->old + patch->old_at, bytes);
    } else if (patch->kind < ADD_16) {
      renumber_features(patch, count, width);
    } else {
      add_differences(patch, count, width);
    }
    patch->old_at += bytes;
  }
  patch->made_at += bytes;
  patch->left -= count;
}

/* Check that a patch is for the active image, by its header. */
static starcat_status check_patch_header(const starcat_slots *slots, const uint8_t *bytes,
                                         size_t size) {
  const char magic[8] = "STARPAT";
  const uint8_t *old = slots->bytes[slots->active];
  const size_t old_bytes = slots->size[slots->active];
  if (size < PATCH_HEADER_BYTES) {
    return STARCAT_E_SHORT;
  }
  for (uint32_t n = 0; n < 8u; n++) {
    if (bytes[n] != (uint8_t)magic[n]) {
      return STARCAT_E_MAGIC;
    }
  }
  if (read_number(bytes, 8) != STARCAT_BYTE_ORDER) {
    return STARCAT_E_BYTE_ORDER;
  }
  if ((check_size(slots, old_bytes) != STARCAT_OK) || (read_number(bytes, 12) != PATCH_VERSION) ||
      (read_number(bytes, 16) != old_bytes) ||
      (read_number(bytes, 20) != read_whole_crc(old, old_bytes))) {
    return STARCAT_E_VERSION;
  }
  const uint32_t n_runs = read_number(bytes, 32), patch_bytes = read_number(bytes, 36);
  if (patch_bytes > size) {
    return STARCAT_E_SHORT;
  }
  if ((patch_bytes < PATCH_HEADER_BYTES) ||
      (n_runs > (patch_bytes - PATCH_HEADER_BYTES) / BYTES_OF_RUN)) {
    return STARCAT_E_LAYOUT;
  }
  return check_size(slots, read_number(bytes, 24));
}

starcat_status starcat_begin_patch(const starcat_slots *slots, const void *patch, size_t size,
                                   starcat_patching *work) {
  const uint8_t *bytes = patch;
  starcat_status status = check_slots(slots);
  if (status != STARCAT_OK) {
    return status;
  }
  if ((patch == NULL) || (work == NULL)) {
    return STARCAT_E_NULL;
  }
  if (((uintptr_t)patch & 3u) != 0u) {
    return STARCAT_E_ALIGNMENT;
  }
  status = check_patch_header(slots, bytes, size);
  if (status != STARCAT_OK) {
    return status;
  }
  work->patch = bytes;
  work->n_runs = read_number(bytes, 32);
  work->runs = (const uint32_t *)(const void *)(bytes + PATCH_HEADER_BYTES);
  work->next = bytes + PATCH_HEADER_BYTES + (size_t)work->n_runs * BYTES_OF_RUN;
  work->patch_bytes = read_number(bytes, 36);
  work->patch_crc = read_number(bytes, PATCH_CRC_AT);
  work->end = bytes + work->patch_bytes;
  work->old = slots->bytes[slots->active];
  work->old_bytes = (uint32_t)slots->size[slots->active];
  work->old_at = 0;
  work->made = slots->bytes[1u - slots->active];
  work->made_bytes = read_number(bytes, 24);
  work->made_crc = read_number(bytes, 28);
  work->made_at = 0;
  work->row_units = ROW_UNITS;
  for (uint32_t runs = work->n_runs; runs > 0u; runs /= 2u) {
    work->row_units++;
  }
  work->checked = 0;
  work->crc = 0;
  work->block = 0;
  work->kind = LITERAL;
  work->left = 0;
  work->shift = 0;
  work->same = 0;
  return STARCAT_OK;
}

/* Continue the CRC of a patch, which is of all bytes but those of the CRC. */
static void check_bytes(starcat_patching *work, uint32_t count) {
  const uint32_t end = work->checked < PATCH_CRC_AT ? PATCH_CRC_AT : work->patch_bytes;
  const uint32_t left = end - work->checked, now = count < left ? count : left;
  work->crc = starcat_update_crc(work->crc, work->patch + work->checked, now);
  work->checked += now;
  if (work->checked == PATCH_CRC_AT) {
    work->checked = PATCH_HEADER_BYTES;
  }
}

starcat_status starcat_check_patch(starcat_patching *work, uint32_t units) {
  blocks_of_image image;
  if (work == NULL) {
    return STARCAT_E_NULL;
  }
  if (work->checked < work->patch_bytes) {
    check_bytes(work, units < STARCAT_BLOCK_BYTES ? STARCAT_BLOCK_BYTES : units);
    return (work->checked == work->patch_bytes) && (work->crc != work->patch_crc)
               ? STARCAT_E_CRC
               : STARCAT_INCOMPLETE;
  }
  if (!lay_out_blocks(work->old, work->old_bytes, &image)) {
    return STARCAT_E_LAYOUT; /* starcat_begin_patch was not called */
  }
  const uint32_t some = units / STARCAT_BLOCK_BYTES;
  const uint32_t end = work->block + (some > 0u ? some : 1u);
  while ((work->block < image.blocks) && (work->block < end)) {
    if (is_data_block_sound(&image, work->block) == 0) {
      return STARCAT_E_CRC;
    }
    work->block++;
  }
  return work->block < image.blocks ? STARCAT_INCOMPLETE : STARCAT_OK;
}

starcat_status starcat_run_patch(const starcat_slots *slots, starcat_patching *work,
                                 uint32_t units) {
  const starcat_status status = check_slots(slots);
  if (status != STARCAT_OK) {
    return status;
  }
  if (work == NULL) {
    return STARCAT_E_NULL;
  }
  const uint32_t other = 1u - slots->active;
  if ((slots->bytes[other] != work->made) || (slots->size[other] != work->made_bytes) ||
      (slots->acceptance[other] != 0u)) {
    return STARCAT_E_OPTIONS;
  }
  uint32_t left = units < STARCAT_BLOCK_BYTES ? STARCAT_BLOCK_BYTES : units;
  while ((work->made_at < work->made_bytes) && (left >= STEP_UNITS)) {
    if (work->left == 0u) {
      left -= STEP_UNITS;
      if (begin_step(work) == 0) {
        return STARCAT_E_LAYOUT;
      }
    }
    const uint32_t most = left / count_units(work);
    const uint32_t count = most < work->left ? most : work->left;
    continue_step(work, count);
    left -= count < most ? count * count_units(work) : left;
  }
  return work->made_at < work->made_bytes ? STARCAT_INCOMPLETE : STARCAT_OK;
}

starcat_status starcat_apply_patch(starcat_slots *slots, const void *patch, size_t size) {
  starcat_patching work;
  uint32_t block = 0;
  starcat_status status = starcat_begin_patch(slots, patch, size, &work);
  if (status == STARCAT_OK) {
    status = STARCAT_INCOMPLETE;
  }
  while (status == STARCAT_INCOMPLETE) {
    status = starcat_check_patch(&work, STARCAT_BLOCK_BYTES);
  }
  if (status == STARCAT_OK) {
    status = starcat_receive_image(slots, work.made_bytes, work.made_crc);
  }
  if (status != STARCAT_OK) {
    return status;
  }
  status = STARCAT_INCOMPLETE;
  while (status == STARCAT_INCOMPLETE) {
    status = starcat_run_patch(slots, &work, STARCAT_BLOCK_BYTES);
  }
  if (status == STARCAT_OK) {
    status = starcat_find_missing_block(slots, 0, &block);
    status = status == STARCAT_INCOMPLETE ? STARCAT_E_CRC : status; /* a damaged image was made */
  }
  return status;
}
