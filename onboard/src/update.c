/* Two places for images: pieces, parity, patches. What is a check block follows from the size of an
 * image alone, as its header may be what is damaged or not there yet.
 *
 * SPDX-License-Identifier: MIT
 */
#include "starcat_update.h"

#include "internal.h"

#define BLOCKS_OF_PARITY 32u /* blocks of an image that one block of parity is for */
#define CHUNK 64u
#define PATCH_HEADER_BYTES 40u
#define BYTES_OF_RUN 8u

typedef struct {
  uint8_t *bytes;
  uint32_t blocks, data, groups; /* blocks; those of data; groups with a block of parity each */
} blocks_of_image;

static uint32_t u32_of(const uint8_t *bytes, size_t offset) {
  return *(const uint32_t *)(const void *)(bytes + offset);
}

/* The blocks of an image of so many bytes; 0 if none has so many. */
static int lay_out(uint8_t *bytes, size_t size, blocks_of_image *image) {
  if ((size % STARCAT_BLOCK_BYTES != 0u) || (size < 2u * STARCAT_BLOCK_BYTES) ||
      (size / STARCAT_BLOCK_BYTES >= 1048576u)) {
    return 0;
  }
  image->bytes = bytes;
  image->blocks = (uint32_t)(size / STARCAT_BLOCK_BYTES);
  image->data = image->blocks -
                (image->blocks + STARCAT_CRCS_OF_BLOCK) / (STARCAT_CRCS_OF_BLOCK + 1u);
  image->groups = (image->blocks + BLOCKS_OF_PARITY - 1u) / BLOCKS_OF_PARITY;
  return 1;
}

static uint8_t *block_at(const blocks_of_image *image, uint32_t block) {
  return image->bytes + (size_t)block * STARCAT_BLOCK_BYTES;
}

static int is_sound(const blocks_of_image *image, uint32_t block) {
  return starcat_block_is_sound(image->bytes, image->data * STARCAT_BLOCK_BYTES, block);
}

size_t starcat_parity_bytes(size_t size) {
  blocks_of_image image;
  return lay_out(NULL, size, &image) ? (size_t)image.groups * STARCAT_BLOCK_BYTES : 0u;
}

/* Part of a block as the others of its group and their parity have it: the sum of them all is 0.
 * Groups are every so many blocks, so that a burst of damage meets each but once. The block of
 * parity comes behind those of the image, and is one of its group. */
static void part_of(const blocks_of_image *image, uint32_t block, uint32_t at,
                    uint8_t part[CHUNK]) {
  const uint32_t group =
      block < image->blocks ? block % image->groups : block - image->blocks;
  for (uint32_t k = 0; k < CHUNK; k++) {
    part[k] = 0;
  }
  for (uint32_t other = group; other < image->blocks + image->groups; other += image->groups) {
    const uint32_t member = other < image->blocks ? other : image->blocks + group;
    if (member != block) {
      const uint8_t *bytes = block_at(image, member) + at;
      for (uint32_t k = 0; k < CHUNK; k++) {
        part[k] = (uint8_t)(part[k] ^ bytes[k]);
      }
    }
  }
}

/* Whether a block would be sound as its group has it. */
static int would_be_sound(const blocks_of_image *image, uint32_t block) {
  const uint32_t last = block < image->data ? CHUNK : CHUNK - 4u; /* bytes that a CRC is of */
  uint64_t part[CHUNK / 8u];
  uint8_t *bytes = (uint8_t *)part;
  uint32_t crc = 0;
  for (uint32_t at = 0; at < STARCAT_BLOCK_BYTES; at += CHUNK) {
    part_of(image, block, at, bytes);
    crc = starcat_crc32(crc, bytes, at < STARCAT_BLOCK_BYTES - CHUNK ? CHUNK : last);
  }
  if (block >= image->data) {
    return crc == u32_of(bytes, CHUNK - 4u);
  }
  const uint8_t *check = block_at(image, image->data + block / STARCAT_CRCS_OF_BLOCK);
  return crc == u32_of(check, 4u * (size_t)(block % STARCAT_CRCS_OF_BLOCK));
}

static void write_block(const blocks_of_image *image, uint32_t block) {
  uint8_t part[CHUNK];
  for (uint32_t at = 0; at < STARCAT_BLOCK_BYTES; at += CHUNK) {
    part_of(image, block, at, part);
    uint8_t *bytes = block_at(image, block) + at;
    for (uint32_t k = 0; k < CHUNK; k++) {
      bytes[k] = part[k];
    }
  }
}

starcat_status starcat_mend(void *bytes, size_t size, uint32_t *n_mended) {
  blocks_of_image image;
  uint32_t left = 0;
  if ((bytes == NULL) || (n_mended == NULL)) {
    return STARCAT_E_NULL;
  }
  *n_mended = 0;
  if (((uintptr_t)bytes & 7u) != 0u) {
    return STARCAT_E_ALIGNMENT;
  }
  if (!lay_out(bytes, size, &image)) {
    return STARCAT_E_LAYOUT;
  }
  for (uint32_t n = 0; n < image.blocks; n++) {
    const uint32_t block = (n + image.data) % image.blocks; /* check blocks first */
    if (!is_sound(&image, block)) {
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
  return STARCAT_IDENTIFIED;
}

static starcat_status check_places(const starcat_places *places) {
  if ((places == NULL) || (places->bytes[0] == NULL) || (places->bytes[1] == NULL)) {
    return STARCAT_E_NULL;
  }
  return places->active > 1u ? STARCAT_E_OPTIONS : STARCAT_IDENTIFIED;
}

/* Room for an image of so many bytes and its parity. */
static starcat_status check_size(const starcat_places *places, size_t size) {
  const size_t parity = starcat_parity_bytes(size);
  if (parity == 0u) {
    return STARCAT_E_LAYOUT;
  }
  return (size > places->capacity) || (parity > places->capacity - size) ? STARCAT_E_SHORT
                                                                         : STARCAT_IDENTIFIED;
}

/* Mend the image of a place, write its parity, and open it. */
static starcat_status use_place(const starcat_places *places, uint32_t place,
                                starcat_image *image) {
  uint32_t n_mended = 0;
  starcat_status status = check_size(places, places->size[place]);
  if (status == STARCAT_IDENTIFIED) {
    status = starcat_mend(places->bytes[place], places->size[place], &n_mended);
  }
  if (status == STARCAT_IDENTIFIED) {
    status = starcat_open(image, places->bytes[place], places->size[place], STARCAT_SKIP_CRC);
  }
  return status;
}

starcat_status starcat_start(starcat_places *places, starcat_image *image) {
  starcat_status status = check_places(places);
  if (status != STARCAT_IDENTIFIED) {
    return status;
  }
  if (image == NULL) {
    return STARCAT_E_NULL;
  }
  status = use_place(places, places->active, image);
  if (status != STARCAT_IDENTIFIED) {
    const uint32_t other = 1u - places->active;
    if (use_place(places, other, image) == STARCAT_IDENTIFIED) {
      places->active = other;
      status = STARCAT_IDENTIFIED;
    }
  }
  return status;
}

starcat_status starcat_receive(starcat_places *places, size_t size, uint32_t crc) {
  starcat_status status = check_places(places);
  if (status == STARCAT_IDENTIFIED) {
    status = check_size(places, size);
  }
  if (status == STARCAT_IDENTIFIED) {
    places->size[1u - places->active] = size;
    places->coming_crc = crc;
  }
  return status;
}

starcat_status starcat_put(starcat_places *places, size_t offset, const uint8_t *bytes,
                           size_t count) {
  const starcat_status status = check_places(places);
  if (status != STARCAT_IDENTIFIED) {
    return status;
  }
  if (bytes == NULL) {
    return STARCAT_E_NULL;
  }
  const uint32_t other = 1u - places->active;
  if ((offset > places->size[other]) || (count > places->size[other] - offset)) {
    return STARCAT_E_SHORT;
  }
  for (size_t n = 0; n < count; n++) {
    places->bytes[other][offset + n] = bytes[n];
  }
  return STARCAT_IDENTIFIED;
}

starcat_status starcat_missing(const starcat_places *places, uint32_t first, uint32_t *block) {
  blocks_of_image image;
  const starcat_status status = check_places(places);
  if (status != STARCAT_IDENTIFIED) {
    return status;
  }
  if (block == NULL) {
    return STARCAT_E_NULL;
  }
  const uint32_t other = 1u - places->active;
  if (!lay_out(places->bytes[other], places->size[other], &image)) {
    return STARCAT_E_LAYOUT;
  }
  for (uint32_t n = image.data; n < image.blocks; n++) {
    const uint8_t *check = block_at(&image, n);
    if (!starcat_is_sound(check) || ((places->coming_crc != 0u) &&
                                     (u32_of(check, STARCAT_WHOLE_AT) != places->coming_crc))) {
      *block = n;
      return STARCAT_E_CRC;
    }
  }
  for (uint32_t n = first; n < image.data; n++) {
    if (!is_sound(&image, n)) {
      *block = n;
      return STARCAT_E_CRC;
    }
  }
  *block = image.blocks;
  return STARCAT_IDENTIFIED;
}

starcat_status starcat_switch(starcat_places *places, starcat_image *image) {
  uint32_t block = 0;
  starcat_status status = starcat_missing(places, 0, &block);
  if ((status == STARCAT_IDENTIFIED) && (image == NULL)) {
    status = STARCAT_E_NULL;
  }
  if (status == STARCAT_IDENTIFIED) {
    status = use_place(places, 1u - places->active, image);
  }
  if (status == STARCAT_IDENTIFIED) {
    places->active = 1u - places->active;
    places->coming_crc = 0;
  }
  return status;
}

/* A patch that is being applied. Positions are bytes of the old image and of the new one. */
typedef struct {
  const uint8_t *next, *end; /* of the patch */
  const uint8_t *old;
  uint8_t *made;
  uint32_t old_bytes, old_at, made_bytes, made_at;
  const uint32_t *runs; /* first row of each run of stars, and what is added to its rows */
  uint32_t n_runs;
} patching;

/* Kinds of steps; 2 to 5 are numbers of two bytes, of four, of two, of four. */
#define LITERAL 0u
#define COPY 1u
#define ADD_16 4u
#define ZEROS 6u

/* The next number, seven bits a byte, the lowest first; 0 beyond the end of the patch. */
static uint32_t next_number(patching *patch) {
  uint32_t number = 0, bits = 0, byte = 0x80;
  while ((byte >= 0x80u) && (bits < 32u) && (patch->next < patch->end)) {
    byte = *patch->next;
    patch->next += 1;
    number |= (byte & 0x7fu) << bits;
    bits += 7u;
  }
  return number;
}

/* The next number that may be below 0, whose lowest bit says so. */
static uint32_t next_difference(patching *patch) {
  const uint32_t number = next_number(patch);
  return (number >> 1) ^ (0u - (number & 1u));
}

/* The row of a star of the old image in the new one. */
static uint32_t renumbered(const patching *patch, uint32_t row) {
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

static void renumber(patching *patch, uint32_t count, uint32_t width) {
  for (uint32_t n = 0; n < count; n++) {
    const uint8_t *from = patch->old + patch->old_at + (size_t)n * width;
    uint8_t *to = patch->made + patch->made_at + (size_t)n * width;
    if (width == 2u) {
      *(uint16_t *)(void *)to =
          (uint16_t)renumbered(patch, *(const uint16_t *)(const void *)from);
    } else {
      *(uint32_t *)(void *)to = renumbered(patch, *(const uint32_t *)(const void *)from);
    }
  }
}

/* Numbers that differ from the old ones by a shift, which itself changes from one to the next by
 * the numbers of the patch; after a 0 comes how many more do not change it. */
static void add(patching *patch, uint32_t count, uint32_t width) {
  uint32_t shift = 0, same = 0;
  for (uint32_t n = 0; n < count; n++) {
    const uint8_t *from = patch->old + patch->old_at + (size_t)n * width;
    uint8_t *to = patch->made + patch->made_at + (size_t)n * width;
    if (same > 0u) {
      same--;
    } else {
      const uint32_t change = next_difference(patch);
      shift += change;
      same = change == 0u ? next_number(patch) : 0u;
    }
    if (width == 2u) {
      *(uint16_t *)(void *)to = (uint16_t)(*(const uint16_t *)(const void *)from + shift);
    } else {
      *(uint32_t *)(void *)to = *(const uint32_t *)(const void *)from + shift;
    }
  }
}

static void copy(patching *patch, const uint8_t *from, uint32_t count) {
  for (uint32_t n = 0; n < count; n++) {
    patch->made[patch->made_at + n] = from == NULL ? 0u : from[n];
  }
}

/* Carry out the next step of a patch; 0 if it cannot be. */
static int apply_step(patching *patch) {
  static const uint8_t width_of[8] = {1, 1, 2, 4, 2, 4, 1, 0};
  const uint32_t token = next_number(patch), kind = token & 7u, count = token >> 3;
  const uint32_t width = width_of[kind], room = patch->made_bytes - patch->made_at;
  if ((width == 0u) || (count == 0u) || (count > room / width)) {
    return 0;
  }
  const uint32_t bytes = count * width;
  if (kind == LITERAL) {
    if (bytes > (size_t)(patch->end - patch->next)) {
      return 0;
    }
    copy(patch, patch->next, bytes);
    patch->next += bytes;
  } else if (kind == ZEROS) {
    copy(patch, NULL, bytes);
  } else {
    patch->old_at += next_difference(patch);
    if ((patch->old_at > patch->old_bytes) || (bytes > patch->old_bytes - patch->old_at) ||
        ((patch->old_at | patch->made_at) % width != 0u)) {
      return 0;
    }
    if (kind == COPY) {
      copy(patch, patch->old + patch->old_at, bytes);
    } else if (kind < ADD_16) {
      renumber(patch, count, width);
    } else {
      add(patch, count, width);
    }
    patch->old_at += bytes;
  }
  patch->made_at += bytes;
  return 1;
}

/* Check that a patch is for an image, and find its parts. */
static starcat_status begin_patch(const starcat_places *places, const uint8_t *bytes, size_t size,
                                  patching *patch) {
  const char magic[8] = "STARPAT";
  const uint8_t *old = places->bytes[places->active];
  const size_t old_bytes = places->size[places->active];
  if (size < PATCH_HEADER_BYTES) {
    return STARCAT_E_SHORT;
  }
  for (uint32_t n = 0; n < 8u; n++) {
    if (bytes[n] != (uint8_t)magic[n]) {
      return STARCAT_E_MAGIC;
    }
  }
  if (u32_of(bytes, 8) != STARCAT_BYTE_ORDER) {
    return STARCAT_E_BYTE_ORDER;
  }
  const uint32_t n_runs = u32_of(bytes, 32), patch_bytes = u32_of(bytes, 36);
  if ((check_size(places, old_bytes) != STARCAT_IDENTIFIED) || (u32_of(bytes, 12) != 1u) ||
      (u32_of(bytes, 16) != old_bytes) ||
      (u32_of(bytes, 20) !=
       u32_of(old, old_bytes - STARCAT_BLOCK_BYTES + STARCAT_WHOLE_AT))) {
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
  patch->made = places->bytes[1u - places->active];
  patch->made_bytes = u32_of(bytes, 24);
  patch->made_at = 0;
  return STARCAT_IDENTIFIED;
}

starcat_status starcat_patch(starcat_places *places, const void *patch, size_t size) {
  patching work;
  uint32_t block = 0;
  starcat_status status = check_places(places);
  if (status != STARCAT_IDENTIFIED) {
    return status;
  }
  if (patch == NULL) {
    return STARCAT_E_NULL;
  }
  if (((uintptr_t)patch & 3u) != 0u) {
    return STARCAT_E_ALIGNMENT;
  }
  status = begin_patch(places, patch, size, &work);
  if (status == STARCAT_IDENTIFIED) {
    status = starcat_receive(places, work.made_bytes, u32_of(patch, 28));
  }
  if (status != STARCAT_IDENTIFIED) {
    return status;
  }
  while (work.made_at < work.made_bytes) {
    if (!apply_step(&work)) {
      return STARCAT_E_LAYOUT;
    }
  }
  return starcat_missing(places, 0, &block);
}
