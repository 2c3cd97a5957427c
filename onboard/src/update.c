/* Two slots for images: pieces, parity, patches. The size of an image alone determines which blocks
 * are check blocks, as the header can be damaged or missing.
 *
 * SPDX-License-Identifier: MIT
 */
#include "starcat_update.h"

#include "internal.h"

#define BLOCKS_OF_PARITY 32u /* blocks of an image per block of parity */
#define CHUNK 64u
#define PATCH_HEADER_BYTES 40u
#define BYTES_OF_RUN 8u

typedef struct {
  uint8_t *bytes;
  uint32_t blocks, data, groups; /* all blocks; data blocks; groups with one parity block each */
} blocks_of_image;

static uint32_t read_number(const uint8_t *bytes, size_t offset) {
  return *(const uint32_t *)(const void *)(bytes + offset);
}

/* The blocks of an image of `size` bytes; 0 if an image cannot have this size. */
static int lay_out_blocks(uint8_t *bytes, size_t size, blocks_of_image *image) {
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

static uint8_t *find_block(const blocks_of_image *image, uint32_t block) {
  return image->bytes + (size_t)block * STARCAT_BLOCK_BYTES;
}

static int is_data_block_sound(const blocks_of_image *image, uint32_t block) {
  return starcat_is_block_sound(image->bytes, image->data * STARCAT_BLOCK_BYTES, block);
}

size_t starcat_count_parity_bytes(size_t size) {
  blocks_of_image image;
  return lay_out_blocks(NULL, size, &image) ? (size_t)image.groups * STARCAT_BLOCK_BYTES : 0u;
}

/* Compute part of a block from the other blocks of its group and their parity: the XOR of all is 0.
 * The blocks of a group are spread evenly, so that a burst of damage hits each group once. The
 * parity block lies behind the blocks of the image and belongs to its group. */
static void find_part(const blocks_of_image *image, uint32_t block, uint32_t at,
                      uint8_t part[CHUNK]) {
  const uint32_t group = block < image->blocks ? block % image->groups : block - image->blocks;
  for (uint32_t k = 0; k < CHUNK; k++) {
    part[k] = 0;
  }
  for (uint32_t other = group; other < image->blocks + image->groups; other += image->groups) {
    const uint32_t member = other < image->blocks ? other : image->blocks + group;
    if (member != block) {
      const uint8_t *bytes = find_block(image, member) + at;
      for (uint32_t k = 0; k < CHUNK; k++) {
        part[k] = (uint8_t)(part[k] ^ bytes[k]);
      }
    }
  }
}

/* Whether a block would be undamaged after its repair from its group. */
static int would_be_sound(const blocks_of_image *image, uint32_t block) {
  const uint32_t last = block < image->data ? CHUNK : CHUNK - 4u; /* bytes that the CRC covers */
  uint64_t part[CHUNK / 8u];
  uint8_t *bytes = (uint8_t *)part;
  uint32_t crc = 0;
  for (uint32_t at = 0; at < STARCAT_BLOCK_BYTES; at += CHUNK) {
    find_part(image, block, at, bytes);
    crc = starcat_update_crc(crc, bytes, at < STARCAT_BLOCK_BYTES - CHUNK ? CHUNK : last);
  }
  if (block >= image->data) {
    return crc == read_number(bytes, CHUNK - 4u);
  }
  const uint8_t *check = find_block(image, image->data + block / STARCAT_CRCS_OF_BLOCK);
  return crc == read_number(check, 4u * (size_t)(block % STARCAT_CRCS_OF_BLOCK));
}

static void write_block(const blocks_of_image *image, uint32_t block) {
  uint8_t part[CHUNK];
  for (uint32_t at = 0; at < STARCAT_BLOCK_BYTES; at += CHUNK) {
    find_part(image, block, at, part);
    uint8_t *bytes = find_block(image, block) + at;
    for (uint32_t k = 0; k < CHUNK; k++) {
      bytes[k] = part[k];
    }
  }
}

starcat_status starcat_mend_image(void *bytes, size_t size, uint32_t *n_mended) {
  blocks_of_image image;
  uint32_t left = 0;
  if ((bytes == NULL) || (n_mended == NULL)) {
    return STARCAT_E_NULL;
  }
  *n_mended = 0;
  if (((uintptr_t)bytes & 7u) != 0u) {
    return STARCAT_E_ALIGNMENT;
  }
  if (!lay_out_blocks(bytes, size, &image)) {
    return STARCAT_E_LAYOUT;
  }
  for (uint32_t n = 0; n < image.blocks; n++) {
    const uint32_t block = (n + image.data) % image.blocks; /* check blocks first */
    if (!is_data_block_sound(&image, block)) {
      if (!would_be_sound(&image, block)) {
        left++;
      } else {
        write_block(&image, block);
        *n_mended += 1u;
      }
    }
  }
  if (left > 0u) {
    return STARCAT_E_CRC;
  }
  for (uint32_t group = 0; group < image.groups; group++) {
    write_block(&image, image.blocks + group);
  }
  return STARCAT_OK;
}

static starcat_status check_slots(const starcat_slots *slots) {
  if ((slots == NULL) || (slots->bytes[0] == NULL) || (slots->bytes[1] == NULL)) {
    return STARCAT_E_NULL;
  }
  return slots->active > 1u ? STARCAT_E_OPTIONS : STARCAT_OK;
}

/* Check the room for an image of `size` bytes and its parity. */
static starcat_status check_size(const starcat_slots *slots, size_t size) {
  const size_t parity = starcat_count_parity_bytes(size);
  if (parity == 0u) {
    return STARCAT_E_LAYOUT;
  }
  return (size > slots->capacity) || (parity > slots->capacity - size) ? STARCAT_E_SHORT
                                                                       : STARCAT_OK;
}

/* Repair the image of a slot, write its parity, and open it. */
static starcat_status use_slot(const starcat_slots *slots, uint32_t slot, starcat_image *image) {
  uint32_t n_mended = 0;
  starcat_status status = check_size(slots, slots->size[slot]);
  if (status == STARCAT_OK) {
    status = starcat_mend_image(slots->bytes[slot], slots->size[slot], &n_mended);
  }
  if (status == STARCAT_OK) {
    status = starcat_open_image(image, slots->bytes[slot], slots->size[slot], STARCAT_SKIP_CRC);
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
    slots->size[1u - slots->active] = size;
    slots->coming_crc = crc;
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
  if ((offset > slots->size[other]) || (count > slots->size[other] - offset)) {
    return STARCAT_E_SHORT;
  }
  for (size_t n = 0; n < count; n++) {
    slots->bytes[other][offset + n] = bytes[n];
  }
  return STARCAT_OK;
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
  if (!lay_out_blocks(slots->bytes[other], slots->size[other], &image)) {
    return STARCAT_E_LAYOUT;
  }
  for (uint32_t n = image.data; n < image.blocks; n++) {
    const uint8_t *check = find_block(&image, n);
    if (!starcat_is_check_block_sound(check) ||
        ((slots->coming_crc != 0u) &&
         (read_number(check, STARCAT_WHOLE_AT) != slots->coming_crc))) {
      *block = n;
      return STARCAT_INCOMPLETE;
    }
  }
  for (uint32_t n = first; n < image.data; n++) {
    if (!is_data_block_sound(&image, n)) {
      *block = n;
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
    slots->coming_crc = 0;
  }
  return status;
}

/* State of a patch that is being applied. Positions are offsets in the old and in the new image. */
typedef struct {
  const uint8_t *next, *end; /* unread part of the patch */
  const uint8_t *old;
  uint8_t *made;
  uint32_t old_bytes, old_at, made_bytes, made_at;
  const uint32_t *runs; /* first row of each run of stars, and the shift of its rows */
  uint32_t n_runs;
} patching;

/* Kinds of steps; kinds 2 to 5 have numbers of two, four, two and four bytes. */
#define LITERAL 0u
#define COPY 1u
#define ADD_16 4u
#define ZEROS 6u

/* The next number, seven bits per byte, the lowest first; 0 beyond the end of the patch. */
static uint32_t take_number(patching *patch) {
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
static uint32_t take_difference(patching *patch) {
  const uint32_t number = take_number(patch);
  return (number >> 1) ^ (0u - (number & 1u));
}

/* Row in the new image of a star of the old image. */
static uint32_t renumber_row(const patching *patch, uint32_t row) {
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

static void renumber_features(patching *patch, uint32_t count, uint32_t width) {
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
static void add_differences(patching *patch, uint32_t count, uint32_t width) {
  uint32_t shift = 0, same = 0;
  for (uint32_t n = 0; n < count; n++) {
    const uint8_t *from = patch->old + patch->old_at + (size_t)n * width;
    uint8_t *to = patch->made + patch->made_at + (size_t)n * width;
    if (same > 0u) {
      same--;
    } else {
      const uint32_t change = take_difference(patch);
      shift += change;
      same = change == 0u ? take_number(patch) : 0u;
    }
    if (width == 2u) {
      *(uint16_t *)(void *)to = (uint16_t)(*(const uint16_t *)(const void *)from + shift);
    } else {
      *(uint32_t *)(void *)to = *(const uint32_t *)(const void *)from + shift;
    }
  }
}

static void copy_bytes(patching *patch, const uint8_t *from, uint32_t count) {
  for (uint32_t n = 0; n < count; n++) {
    patch->made[patch->made_at + n] = from == NULL ? 0u : from[n];
  }
}

/* Execute the next step of a patch; 0 if it is invalid. */
static int apply_step(patching *patch) {
  static const uint8_t width_of[8] = {1, 1, 2, 4, 2, 4, 1, 0};
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
    copy_bytes(patch, patch->next, bytes);
    patch->next += bytes;
  } else if (kind == ZEROS) {
    copy_bytes(patch, NULL, bytes);
  } else {
    patch->old_at += take_difference(patch);
    if ((patch->old_at > patch->old_bytes) || (bytes > patch->old_bytes - patch->old_at) ||
        ((patch->old_at | patch->made_at) % width != 0u)) {
      return 0;
    }
    if (kind == COPY) {
      copy_bytes(patch, patch->old + patch->old_at, bytes);
    } else if (kind < ADD_16) {
      renumber_features(patch, count, width);
    } else {
      add_differences(patch, count, width);
    }
    patch->old_at += bytes;
  }
  patch->made_at += bytes;
  return 1;
}

/* Check that a patch is for this image, and find its parts. */
static starcat_status begin_patch(const starcat_slots *slots, const uint8_t *bytes, size_t size,
                                  patching *patch) {
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
  const uint32_t n_runs = read_number(bytes, 32), patch_bytes = read_number(bytes, 36);
  if ((check_size(slots, old_bytes) != STARCAT_OK) || (read_number(bytes, 12) != 1u) ||
      (read_number(bytes, 16) != old_bytes) ||
      (read_number(bytes, 20) !=
       read_number(old, old_bytes - STARCAT_BLOCK_BYTES + STARCAT_WHOLE_AT))) {
    return STARCAT_E_VERSION;
  }
  if (patch_bytes > size) {
    return STARCAT_E_SHORT;
  }
  if ((patch_bytes < PATCH_HEADER_BYTES) ||
      (n_runs > (patch_bytes - PATCH_HEADER_BYTES) / BYTES_OF_RUN)) {
    return STARCAT_E_LAYOUT;
  }
  patch->runs = (const uint32_t *)(const void *)(bytes + PATCH_HEADER_BYTES);
  patch->n_runs = n_runs;
  patch->next = bytes + PATCH_HEADER_BYTES + (size_t)n_runs * BYTES_OF_RUN;
  patch->end = bytes + patch_bytes;
  patch->old = old;
  patch->old_bytes = (uint32_t)old_bytes;
  patch->old_at = 0;
  patch->made = slots->bytes[1u - slots->active];
  patch->made_bytes = read_number(bytes, 24);
  patch->made_at = 0;
  return STARCAT_OK;
}

starcat_status starcat_apply_patch(starcat_slots *slots, const void *patch, size_t size) {
  patching work;
  uint32_t block = 0;
  starcat_status status = check_slots(slots);
  if (status != STARCAT_OK) {
    return status;
  }
  if (patch == NULL) {
    return STARCAT_E_NULL;
  }
  if (((uintptr_t)patch & 3u) != 0u) {
    return STARCAT_E_ALIGNMENT;
  }
  status = begin_patch(slots, patch, size, &work);
  if (status == STARCAT_OK) {
    status = starcat_receive_image(slots, work.made_bytes, read_number(patch, 28));
  }
  if (status != STARCAT_OK) {
    return status;
  }
  while (work.made_at < work.made_bytes) {
    if (!apply_step(&work)) {
      return STARCAT_E_LAYOUT;
    }
  }
  status = starcat_find_missing_block(slots, 0, &block);
  return status == STARCAT_INCOMPLETE ? STARCAT_E_CRC : status; /* the patched image is damaged */
}
