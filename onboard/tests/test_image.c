/* Opening images and finding damage in them: each error code of starcat_open_image and starcat_scrub_image.
 *
 * SPDX-License-Identifier: MIT
 */
#include <string.h>

#include "unit.h"

static starcat_status open_scratch(uint32_t flags) {
  return starcat_open_image(&unit_scratch.image, unit_scratch.bytes, unit_scratch.size, flags);
}

/* Change a number of a sound image, and put it back. */
static starcat_status with_u32(size_t at, uint32_t value) {
  uint32_t before;
  memcpy(&before, unit_scratch.bytes + at, 4);
  const starcat_status status = unit_open_with(at, value);
  memcpy(unit_scratch.bytes + at, &before, 4);
  sky_seal(unit_scratch.bytes);
  return status;
}

static starcat_status with_f64(size_t at, double value) {
  double before;
  memcpy(&before, unit_scratch.bytes + at, 8);
  memcpy(unit_scratch.bytes + at, &value, 8);
  sky_seal(unit_scratch.bytes);
  const starcat_status status = open_scratch(0);
  memcpy(unit_scratch.bytes + at, &before, 8);
  sky_seal(unit_scratch.bytes);
  return status;
}

/* The start of an image, before its sections can be trusted, is checked without the CRC. */
static starcat_status start_with(size_t at, uint32_t value) {
  uint32_t sound, bad = 1;
  memcpy(&sound, unit_scratch.bytes + at, 4);
  memcpy(unit_scratch.bytes + at, &value, 4);
  const starcat_status status = open_scratch(0);
  CHECK_IS(starcat_scrub_image(unit_scratch.bytes, unit_scratch.size, 0, 0, &bad), status);
  CHECK_IS(bad, 0); /* the header is in the first block */
  memcpy(unit_scratch.bytes + at, &sound, 4);
  return status;
}

static uint32_t header(size_t at) {
  uint32_t value;
  memcpy(&value, unit_scratch.bytes + at, 4);
  return value;
}

static void check_starts(void) {
  const uint32_t data = header(24), total = header(20);
  uint8_t *bytes = unit_scratch.bytes;
  CHECK_IS(starcat_open_image(NULL, bytes, unit_scratch.size, 0), STARCAT_E_NULL);
  CHECK_IS(starcat_open_image(&unit_scratch.image, NULL, unit_scratch.size, 0), STARCAT_E_NULL);
  CHECK_IS(starcat_open_image(&unit_scratch.image, bytes + 4, unit_scratch.size - 4u, 0),
           STARCAT_E_ALIGNMENT);
  CHECK_IS(starcat_open_image(&unit_scratch.image, bytes, 0, 0), STARCAT_E_SHORT);
  CHECK_IS(starcat_open_image(&unit_scratch.image, bytes, 511, 0), STARCAT_E_SHORT);
  CHECK_IS(starcat_open_image(&unit_scratch.image, bytes, 512, 0), STARCAT_E_SHORT);
  CHECK_IS(starcat_open_image(&unit_scratch.image, bytes, unit_scratch.size - 1u, 0),
           STARCAT_E_SHORT);
  CHECK_IS(start_with(0, 0), STARCAT_E_MAGIC);
  CHECK_IS(start_with(4, header(4) ^ 0x01010101u), STARCAT_E_MAGIC);
  CHECK_IS(start_with(8, 0), STARCAT_E_MAGIC);
  CHECK_IS(start_with(8, 0x04030201u), STARCAT_E_BYTE_ORDER);
  CHECK_IS(start_with(12, 0x00020002u), STARCAT_E_VERSION);
  CHECK_IS(start_with(16, 256), STARCAT_E_LAYOUT);
  CHECK_IS(start_with(24, data - 1u), STARCAT_E_LAYOUT);
  CHECK_IS(start_with(24, 0), STARCAT_E_LAYOUT);
  CHECK_IS(start_with(24, total + 4096u), STARCAT_E_LAYOUT);
  CHECK_IS(start_with(24, data - 4096u), STARCAT_E_LAYOUT);
  CHECK_IS(start_with(20, total + 4096u), STARCAT_E_SHORT);
  CHECK_IS(start_with(20, total - 4096u), STARCAT_E_LAYOUT);
  CHECK_IS(open_scratch(0), STARCAT_OK);
}

static void check_numbers(void) {
  const double nan = (double)NAN;
  CHECK_IS(with_u32(44, 3), STARCAT_E_LAYOUT);
  CHECK_IS(with_u32(48, 0), STARCAT_E_LAYOUT);
  CHECK_IS(with_u32(52, 0), STARCAT_E_LAYOUT);
  CHECK_IS(with_u32(48, 65536), STARCAT_E_LAYOUT);
  CHECK_IS(with_u32(52, 65536), STARCAT_E_LAYOUT);
  CHECK_IS(with_u32(40, 1), STARCAT_E_LAYOUT);
  CHECK_IS(with_u32(56, STARCAT_MAX_STARS + 1u), STARCAT_E_CAPACITY);
  CHECK_IS(with_u32(56, STARCAT_MAX_STARS), STARCAT_OK);
  CHECK_IS(with_f64(96, 0.0), STARCAT_E_LAYOUT);
  CHECK_IS(with_f64(96, nan), STARCAT_E_LAYOUT);
  CHECK_IS(with_f64(96, 1e-300), STARCAT_E_LAYOUT);
  CHECK_IS(with_f64(96, 1e300), STARCAT_E_LAYOUT);
  CHECK_IS(with_f64(96, 1e7), STARCAT_E_LAYOUT);
  CHECK_IS(with_f64(88, -1e7), STARCAT_E_LAYOUT);
  CHECK_IS(with_f64(88, 1e7), STARCAT_E_LAYOUT);
  CHECK_IS(with_f64(88, nan), STARCAT_E_LAYOUT);
}

/* Sizes of sections that contradict each other, for each section. */
static void check_sections(uint32_t n_sections) {
  CHECK_IS(with_u32(60, 17), STARCAT_E_LAYOUT);
  CHECK_IS(with_u32(60, n_sections - 1u), STARCAT_E_LAYOUT);
  CHECK_IS(with_u32(32, header(32) + 1u), STARCAT_E_LAYOUT);
  CHECK_IS(with_u32(36, header(36) + 1u), STARCAT_E_LAYOUT);
  CHECK_IS(with_u32(40, header(40) + 1u), STARCAT_E_LAYOUT);
  CHECK_IS(with_u32(48, header(48) + 1u), STARCAT_E_LAYOUT);
  CHECK_IS(with_u32(28, 3), STARCAT_E_LAYOUT);
  for (uint32_t n = 0; n < n_sections; n++) {
    const size_t entry = 256u + 16u * (size_t)n;
    CHECK_IS(with_u32(entry, 0), STARCAT_E_LAYOUT);
    CHECK_IS(with_u32(entry, 99), STARCAT_E_LAYOUT);
    CHECK_IS(with_u32(entry + 4u, header(entry + 4u) + 4u), STARCAT_E_LAYOUT);
    CHECK_IS(with_u32(entry + 4u, 0), STARCAT_E_LAYOUT);
    CHECK_IS(with_u32(entry + 4u, 0xffffffc0u), STARCAT_E_LAYOUT);
    CHECK_IS(with_u32(entry + 8u, 0), STARCAT_E_LAYOUT);
    CHECK_IS(with_u32(entry + 8u, 0xffffffffu), STARCAT_E_LAYOUT);
  }
  /* A kind of a later minor version is passed over. */
  CHECK_IS(with_u32(60, n_sections + 1u), STARCAT_E_LAYOUT);
  CHECK_IS(unit_open_with(260u + 16u * n_sections, 512), STARCAT_OK);
  CHECK_IS(unit_open_with(256u + 16u * n_sections, 77), STARCAT_OK);
  CHECK_IS(unit_open_with(60, n_sections + 1u), STARCAT_OK);
}

void test_open(void) {
  unit_copy(&unit_pyramid);
  check_starts();
  check_numbers();
  CHECK_IS(with_u32(28, 1), STARCAT_E_LAYOUT);
  check_sections(6);
  unit_copy(&unit_triangle);
  check_starts();
  check_numbers();
  CHECK_IS(with_u32(28, 2), STARCAT_E_LAYOUT);
  CHECK_IS(with_f64(104, 0.0), STARCAT_E_LAYOUT);
  CHECK_IS(with_f64(104, (double)NAN), STARCAT_E_LAYOUT);
  CHECK_IS(with_f64(104, 1e-300), STARCAT_E_LAYOUT);
  check_sections(7);
  CHECK_IS(unit_triangle.image.n_stars, SKY_STARS);
  CHECK(strcmp(unit_triangle.image.name, "sky-1.0.0") == 0);
  CHECK_IS(unit_triangle.image.manifest_sha256[31], 0xa5);
  char version[32];
  (void)sprintf(version, "%d.%d.%d", STARCAT_VERSION_MAJOR, STARCAT_VERSION_MINOR,
                STARCAT_VERSION_PATCH);
  CHECK(strcmp(version, STARCAT_VERSION) == 0);
  CHECK(strcmp(starcat_version(), STARCAT_VERSION) == 0);
  CHECK_IS(starcat_version_number(), STARCAT_VERSION_NUMBER);
}

/* Flip a bit; scrub has to find it, open has to refuse the image, and the block has to be named. */
static int is_found(size_t bit) {
  uint32_t bad = UINT32_MAX;
  uint8_t *byte = unit_scratch.bytes + bit / 8u;
  *byte = (uint8_t)(*byte ^ (1u << (bit % 8u)));
  const starcat_status status =
      starcat_scrub_image(unit_scratch.bytes, unit_scratch.size, 0, 0, &bad);
  const starcat_status opened = open_scratch(0);
  *byte = (uint8_t)(*byte ^ (1u << (bit % 8u)));
  return (status < 0) && (opened == status) && (bad == bit / 8u / 4096u);
}

/* Damage in two blocks is found by scrubbing each of them. */
static void check_parts(void) {
  const uint32_t blocks = (uint32_t)(unit_scratch.size / 4096u);
  uint32_t bad = 0;
  uint8_t *bytes = unit_scratch.bytes;
  bytes[4096] ^= 1u;
  bytes[2u * 4096u] ^= 1u;
  CHECK_IS(starcat_scrub_image(bytes, unit_scratch.size, 0, 1, &bad), STARCAT_OK);
  CHECK_IS(starcat_scrub_image(bytes, unit_scratch.size, 1, 1, &bad), STARCAT_E_CRC);
  CHECK_IS(bad, 1);
  CHECK_IS(starcat_scrub_image(bytes, unit_scratch.size, 2, UINT32_MAX, &bad), STARCAT_E_CRC);
  CHECK_IS(bad, 2);
  CHECK_IS(starcat_scrub_image(bytes, unit_scratch.size, 3, 0, &bad), STARCAT_OK);
  CHECK_IS(starcat_scrub_image(bytes, unit_scratch.size, blocks, 5, &bad), STARCAT_OK);
  CHECK_IS(starcat_scrub_image(bytes, unit_scratch.size, UINT32_MAX, 5, &bad), STARCAT_OK);
  /* An application can skip the CRC. */
  CHECK_IS(open_scratch(STARCAT_SKIP_CRC), STARCAT_OK);
  CHECK_IS(open_scratch(0), STARCAT_E_CRC);
  /* A damaged check block is named itself, not the blocks that it was to check. */
  bytes[4096] ^= 1u;
  bytes[2u * 4096u] ^= 1u;
  bytes[unit_scratch.size - 4096u] ^= 1u;
  CHECK_IS(starcat_scrub_image(bytes, unit_scratch.size, 0, 0, &bad), STARCAT_E_CRC);
  CHECK_IS(bad, blocks - 1u);
  bytes[unit_scratch.size - 4096u] ^= 1u;
}

void test_scrub(void) {
  uint32_t bad = 0, missed = 0;
  uint64_t state = 1;
  unit_copy(&unit_pyramid);
  CHECK_IS(starcat_scrub_image(unit_scratch.bytes, unit_scratch.size, 0, 0, NULL), STARCAT_E_NULL);
  CHECK_IS(starcat_scrub_image(NULL, unit_scratch.size, 0, 0, &bad), STARCAT_E_NULL);
  CHECK_IS(starcat_scrub_image(unit_scratch.bytes, 100, 0, 0, &bad), STARCAT_E_SHORT);
  CHECK_IS(starcat_scrub_image(unit_scratch.bytes + 1, 512, 0, 0, &bad), STARCAT_E_ALIGNMENT);
  CHECK_IS(starcat_scrub_image(unit_scratch.bytes, unit_scratch.size, 0, 0, &bad), STARCAT_OK);
  check_parts();
  for (uint32_t n = 0; n < 64u; n++) { /* sizes and version */
    missed += (uint32_t)!is_found(n * 8u + 1u);
  }
  for (uint32_t n = 0; n < 300u; n++) {
    missed += (uint32_t)!is_found((size_t)(sky_uniform(&state) * 8.0 * (double)unit_scratch.size));
  }
  CHECK_IS(missed, 0);
}

/* Look at the scratch sky with whatever the image says, and expect no more than that it ends. */
static void use_scratch(void) {
  uint64_t state = 5;
  sky_frame truth;
  for (uint32_t n = 0; n < 3u; n++) {
    sky_look(&unit_triangle.image, &unit_triangle.camera, &state, 0.2, SKY_SPOTS, 2, &truth);
    const starcat_frame frame = {truth.count, truth.x, truth.y, n == 1u ? NULL : truth.magnitudes,
                                 NULL};
    unit_scratch.options.max_steps = 20000;
    (void)starcat_identify_frame(&unit_scratch.image, &unit_scratch.camera, &unit_scratch.options,
                                 &frame, &unit_work, &unit_result);
    CHECK(unit_result.steps <= 20000u);
    (void)starcat_track_frame(&unit_scratch.image, &unit_scratch.camera, &unit_scratch.options,
                              &frame, truth.q_body_from_icrs, (starcat_real)0.01, &unit_work,
                              &unit_result);
    CHECK(unit_result.steps <= 20000u);
  }
}

/* An image whose CRC was not checked: rows, offsets and lines that lead outside. */
void test_damaged(void) {
  const unit_sky *skies[2] = {&unit_triangle, &unit_pyramid};
  for (uint32_t n = 0; n < 2u; n++) {
    for (uint32_t section = 0; section < 7u - n; section++) {
      for (uint32_t value = 0; value < 3u; value++) {
        static const uint8_t fillings[3] = {0xff, 0x00, 0x7f};
        unit_copy(skies[n]);
        const uint32_t at = header(260u + 16u * (size_t)section);
        memset(unit_scratch.bytes + at, fillings[value], header(264u + 16u * (size_t)section));
        CHECK_IS(open_scratch(0), STARCAT_E_CRC);
        CHECK_IS(open_scratch(STARCAT_SKIP_CRC), STARCAT_OK);
        use_scratch();
      }
    }
  }
  unit_copy(&unit_triangle);
}
