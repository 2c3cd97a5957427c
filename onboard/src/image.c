/* The image: opening it in place, and finding damaged blocks. docs/onboard-format.md describes
 * every byte.
 *
 * SPDX-License-Identifier: MIT
 */
#include "internal.h"

#define N_SECTIONS 16u
#define N_KINDS 9u
#define SECTION_TABLE 256u
#define SECTION_ALIGNMENT 64u
#define MANIFEST_AT 128u
#define NAME_AT 160u
#define MOST_EXPONENT (1023u + 40u)
#define OUT_OF_RANGE R(1e13)

enum { DIRECTIONS = 1, MAGNITUDES, STAR_IDS, GRID, KVECTOR, TRIANGLES, RADII, PAIRS };

const char *starcat_version(void) { return STARCAT_VERSION; }
uint32_t starcat_version_number(void) { return STARCAT_VERSION_NUMBER; }

static uint16_t read_u16(const uint8_t *bytes, size_t offset) {
  return *(const uint16_t *)(const void *)(bytes + offset);
}

static uint32_t read_u32(const uint8_t *bytes, size_t offset) {
  return *(const uint32_t *)(const void *)(bytes + offset);
}

/* Read a number; a large one if its exponent is too large for a valid image (it might overflow). */
static real read_f64(const uint8_t *bytes, size_t offset) {
  const uint64_t bits = *(const uint64_t *)(const void *)(bytes + offset);
  if ((bits >> 52 & 0x7ffu) > MOST_EXPONENT) {
    return OUT_OF_RANGE;
  }
  return (real) * (const double *)(const void *)(bytes + offset);
}

/* CRC-32 of zlib, PNG and Ethernet, four bits at a time. */
uint32_t starcat_update_crc(uint32_t crc, const uint8_t *bytes, size_t count) {
  static const uint32_t table[16] = {0x00000000u, 0x1db71064u, 0x3b6e20c8u, 0x26d930acu,
                                     0x76dc4190u, 0x6b6b51f4u, 0x4db26158u, 0x5005713cu,
                                     0xedb88320u, 0xf00f9344u, 0xd6d6a3e8u, 0xcb61b38cu,
                                     0x9b64c2b0u, 0x86d3d2d4u, 0xa00ae278u, 0xbdbdf21cu};
  uint32_t left = ~crc;
  for (size_t n = 0; n < count; n++) {
    left ^= bytes[n];
    left = (left >> 4) ^ table[left & 15u];
    left = (left >> 4) ^ table[left & 15u];
  }
  return ~left;
}

/* Check the first bytes, so that the sizes in them can be trusted. */
static starcat_status check_start(const void *bytes, size_t size) {
  const uint8_t *image = bytes;
  const char magic[8] = STARCAT_MAGIC;
  if (bytes == NULL) {
    return STARCAT_E_NULL;
  }
  if (((uintptr_t)bytes & 7u) != 0u) {
    return STARCAT_E_ALIGNMENT;
  }
  if (size < STARCAT_HEADER_BYTES) {
    return STARCAT_E_SHORT;
  }
  for (uint32_t n = 0; n < 8u; n++) {
    if (image[n] != (uint8_t)magic[n]) {
      return STARCAT_E_MAGIC;
    }
  }
  if (read_u32(image, 8) != STARCAT_BYTE_ORDER) {
    return read_u32(image, 8) == STARCAT_BYTE_ORDER_SWAPPED ? STARCAT_E_BYTE_ORDER
                                                            : STARCAT_E_MAGIC;
  }
  if (read_u16(image, 12) != STARCAT_FORMAT_MAJOR) {
    return STARCAT_E_VERSION;
  }
  const uint32_t total = read_u32(image, 20), data = read_u32(image, 24);
  if (size < total) {
    return STARCAT_E_SHORT;
  }
  const uint32_t blocks = data / STARCAT_BLOCK_BYTES;
  const uint32_t checks = (blocks + STARCAT_CRCS_OF_BLOCK - 1u) / STARCAT_CRCS_OF_BLOCK;
  if ((read_u32(image, 16) != STARCAT_HEADER_BYTES) || (data % STARCAT_BLOCK_BYTES != 0u) ||
      (data == 0u) || (total < data) || (total - data != checks * STARCAT_BLOCK_BYTES)) {
    return STARCAT_E_LAYOUT;
  }
  return STARCAT_OK;
}

/* A check block is damaged if the CRC of its other bytes differs from its last four bytes. */
int starcat_is_check_block_sound(const uint8_t *block) {
  return starcat_update_crc(0, block, STARCAT_OWN_AT) == read_u32(block, STARCAT_OWN_AT);
}

int starcat_is_block_sound(const uint8_t *image, uint32_t data, uint32_t block) {
  const uint32_t blocks = data / STARCAT_BLOCK_BYTES;
  const uint8_t *at = image + (size_t)block * STARCAT_BLOCK_BYTES;
  if (block >= blocks) {
    return starcat_is_check_block_sound(at);
  }
  const uint8_t *check =
      image + data + (size_t)(block / STARCAT_CRCS_OF_BLOCK) * STARCAT_BLOCK_BYTES;
  /* If the check block itself is damaged, that block is reported, not this one. */
  return (starcat_update_crc(0, at, STARCAT_BLOCK_BYTES) ==
          read_u32(check, 4u * (size_t)(block % STARCAT_CRCS_OF_BLOCK))) ||
         !starcat_is_check_block_sound(check);
}

starcat_status starcat_scrub_image(const void *bytes, size_t size, uint32_t first, uint32_t count,
                                   uint32_t *bad_block) {
  const uint8_t *image = bytes;
  const starcat_status status = check_start(bytes, size);
  if (bad_block == NULL) {
    return STARCAT_E_NULL;
  }
  *bad_block = 0;
  if (status != STARCAT_OK) {
    return status;
  }
  const uint32_t data = read_u32(image, 24);
  const uint32_t blocks = read_u32(image, 20) / STARCAT_BLOCK_BYTES;
  const uint32_t most = count == 0u ? blocks : count;
  for (uint32_t block = first; (block < blocks) && (block - first < most); block++) {
    if (!starcat_is_block_sound(image, data, block)) {
      *bad_block = block;
      return STARCAT_E_CRC;
    }
  }
  return STARCAT_OK;
}

/* Sections of an image, found and checked. */
typedef struct {
  const uint8_t *at[N_KINDS];
  uint32_t bytes[N_KINDS];
} sections;

static int find_sections(const uint8_t *image, uint32_t data, sections *found) {
  const uint32_t count = read_u32(image, 60);
  for (uint32_t kind = 0; kind < N_KINDS; kind++) {
    found->at[kind] = NULL;
    found->bytes[kind] = 0;
  }
  if (count > N_SECTIONS) {
    return 0;
  }
  for (uint32_t n = 0; n < count; n++) {
    const size_t entry = SECTION_TABLE + 16u * (size_t)n;
    const uint32_t kind = read_u32(image, entry), offset = read_u32(image, entry + 4u);
    const uint32_t bytes = read_u32(image, entry + 8u);
    if ((offset % SECTION_ALIGNMENT != 0u) || (offset < STARCAT_HEADER_BYTES) || (offset > data) ||
        (bytes > data - offset)) {
      return 0;
    }
    if (kind < N_KINDS) { /* a later minor version can have others */
      found->at[kind] = image + offset;
      found->bytes[kind] = bytes;
    }
  }
  return 1;
}

static int has_section(const sections *found, uint32_t kind, uint64_t count, uint64_t element) {
  return (found->at[kind] != NULL) && ((uint64_t)found->bytes[kind] == count * element);
}

static int is_complete(const starcat_image *image, const sections *found) {
  const uint64_t cells = (uint64_t)image->grid_bands * image->grid_sectors + 1u;
  const uint64_t stars = image->n_stars, index = image->index_bytes;
  const int common = has_section(found, DIRECTIONS, stars, 12) &&
                     has_section(found, MAGNITUDES, stars, 2) &&
                     has_section(found, STAR_IDS, stars, 8) && has_section(found, GRID, cells, 4) &&
                     has_section(found, KVECTOR, image->n_kvector, 4);
  if (image->method == STARCAT_TRIANGLE) {
    return common && has_section(found, TRIANGLES, image->n_features, 3u * index) &&
           has_section(found, RADII, image->n_features, 2) &&
           starcat_is_between(image->radius_quantum_rad, R(1e-15), R(1e6));
  }
  return common && (image->method == STARCAT_PYRAMID) &&
         has_section(found, PAIRS, image->n_features, 2u * index);
}

static void read_numbers(const uint8_t *bytes, starcat_image *image) {
  image->bytes = bytes;
  image->total_bytes = read_u32(bytes, 20);
  image->data_bytes = read_u32(bytes, 24);
  image->method = read_u32(bytes, 28);
  image->n_stars = read_u32(bytes, 32);
  image->n_features = read_u32(bytes, 36);
  image->n_kvector = read_u32(bytes, 40);
  image->index_bytes = read_u32(bytes, 44);
  image->grid_bands = read_u32(bytes, 48);
  image->grid_sectors = read_u32(bytes, 52);
  image->width_px = (real)read_u32(bytes, 64);
  image->height_px = (real)read_u32(bytes, 68);
  image->focal_length_px = read_f64(bytes, 72);
  image->epoch_jyear = read_f64(bytes, 80);
  image->kvector_intercept = read_f64(bytes, 88);
  image->kvector_slope = read_f64(bytes, 96);
  image->radius_quantum_rad = read_f64(bytes, 104);
  image->longest_rad = read_f64(bytes, 112);
  image->manifest_sha256 = bytes + MANIFEST_AT;
  image->name = (const char *)(bytes + NAME_AT);
}

static starcat_status check_numbers(const starcat_image *image) {
  if ((image->index_bytes != 2u) && (image->index_bytes != 4u)) {
    return STARCAT_E_LAYOUT;
  }
  if ((image->grid_bands == 0u) || (image->grid_sectors == 0u) || (image->n_kvector < 2u) ||
      (image->grid_bands > 65535u) || (image->grid_sectors > 65535u) ||
      !starcat_is_between(image->kvector_slope, R(1e-25), R(1e6)) ||
      !starcat_is_between(image->kvector_intercept, R(-1e6), R(1e6))) {
    return STARCAT_E_LAYOUT;
  }
  return read_u32(image->bytes, 56) > STARCAT_MAX_STARS ? STARCAT_E_CAPACITY : STARCAT_OK;
}

starcat_status starcat_open_image(starcat_image *image, const void *bytes, size_t size,
                                  uint32_t flags) {
  uint32_t bad = 0;
  sections found;
  if (image == NULL) {
    return STARCAT_E_NULL;
  }
  starcat_status status = check_start(bytes, size);
  if ((status == STARCAT_OK) && ((flags & STARCAT_SKIP_CRC) == 0u)) {
    status = starcat_scrub_image(bytes, size, 0, 0, &bad);
  }
  if (status != STARCAT_OK) {
    return status;
  }
  read_numbers(bytes, image);
  status = check_numbers(image);
  if (status != STARCAT_OK) {
    return status;
  }
  if (!find_sections(image->bytes, image->data_bytes, &found) || !is_complete(image, &found)) {
    return STARCAT_E_LAYOUT;
  }
  image->directions = (const int32_t *)(const void *)found.at[DIRECTIONS];
  image->magnitudes = (const int16_t *)(const void *)found.at[MAGNITUDES];
  image->star_ids = (const int64_t *)(const void *)found.at[STAR_IDS];
  image->grid = (const uint32_t *)(const void *)found.at[GRID];
  image->kvector = (const uint32_t *)(const void *)found.at[KVECTOR];
  image->features = found.at[image->method == STARCAT_TRIANGLE ? TRIANGLES : PAIRS];
  image->radii = (const uint16_t *)(const void *)found.at[RADII];
  image->neighbours = NULL;
  return STARCAT_OK;
}
