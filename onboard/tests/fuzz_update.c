/* libFuzzer: two slots and all that comes by radio: pieces, sizes, patches, damage, in any order.
 *
 * SPDX-License-Identifier: MIT
 */
#include "fuzz.h"
#include "internal.h"
#include "starcat_update.h"

#define BLOCK 4096u

int LLVMFuzzerInitialize(int *argc, char ***argv);
int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static uint64_t sound[SKY_MOST_BYTES / 8u];
static size_t sound_size;

int LLVMFuzzerInitialize(int *argc, char ***argv) {
  const sky_recipe recipe = {1, 2, 60, 0.5, 8};
  (void)argc;
  (void)argv;
  sound_size = sky_image(&recipe, (uint8_t *)sound);
  return 0;
}

static uint32_t sound_crc(void) {
  uint32_t crc;
  memcpy(&crc, (const uint8_t *)sound + sound_size - 8u, 4);
  return crc;
}

/* A patch from the image in use to one of the same size: its head is valid except for a few bytes,
 * and its steps come from the fuzzer. */
static void apply(starcat_slots *slots, fuzz_bytes *bytes) {
  const size_t count = fuzz_number(bytes, 2) % 2048u, size = 44u + count;
  const uint32_t words[8] = {0x01020304u,          2, (uint32_t)sound_size,       0,
                             (uint32_t)sound_size, 0, fuzz_number(bytes, 1) % 8u, (uint32_t)size};
  uint8_t *patch = malloc(size);
  if (patch != NULL) {
    memcpy(patch, "STARPAT", 8);
    memcpy(patch + 8, words, sizeof words);
    memcpy(patch + 20, (const uint8_t *)sound + sound_size - 8u, 4);
    fuzz_take(bytes, patch + 44, count);
    const uint32_t crc = starcat_update_crc(starcat_update_crc(0, patch, 40), patch + 44, count);
    memcpy(patch + 40, &crc, 4);
    for (uint32_t n = fuzz_number(bytes, 1) % 4u; n > 0u; n--) {
      patch[fuzz_number(bytes, 1) % 44u] = (uint8_t)fuzz_number(bytes, 1);
    }
    (void)starcat_apply_patch(slots, patch, size);
    free(patch);
  }
}

static void step(starcat_slots *slots, starcat_image *image, fuzz_bytes *bytes) {
  const size_t at = fuzz_number(bytes, 3), count = fuzz_number(bytes, 2);
  uint8_t piece[64];
  uint32_t block, n_mended;
  switch (fuzz_number(bytes, 1) % 8u) {
    case 0:
      (void)starcat_receive_image(slots, fuzz_number(bytes, 1) % 32u * BLOCK, (uint32_t)count % 2u);
      break;
    case 1:
      (void)starcat_receive_image(slots, sound_size, 0);
      (void)starcat_put_piece(slots, at % sound_size / BLOCK * BLOCK,
                              (const uint8_t *)sound + at % sound_size / BLOCK * BLOCK, count);
      break;
    case 2:
      fuzz_take(bytes, piece, sizeof piece);
      (void)starcat_put_piece(slots, at, piece, count % (sizeof piece + 1u));
      break;
    case 3:
      (void)starcat_accept_image(slots, 1u - slots->active, sound_crc());
      (void)starcat_switch_image(slots, image);
      break;
    case 4:
      slots->bytes[count % 2u][at % slots->capacity] ^= (uint8_t)(1u << (at % 8u));
      break;
    case 5:
      (void)starcat_mend_image(slots->bytes[slots->active], slots->size[slots->active], &n_mended);
      break;
    case 6:
      apply(slots, bytes);
      break;
    default:
      (void)starcat_start_image(slots, image);
      break;
  }
  (void)starcat_find_missing_block(slots, (uint32_t)at, &block);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size) {
  fuzz_bytes bytes = {data, size};
  starcat_image image;
  const size_t capacity = sound_size + starcat_count_parity_bytes(sound_size);
  starcat_slots slots = {{malloc(capacity), malloc(capacity)},
                         capacity,
                         {sound_size, 0},
                         {0, 0},
                         {STARCAT_ACCEPTED, 0},
                         0,
                         0};
  traps_on();
  if ((slots.bytes[0] != NULL) && (slots.bytes[1] != NULL)) {
    memcpy(slots.bytes[0], sound, sound_size);
    memset(slots.bytes[1], 0, capacity);
    slots.crc[0] = sound_crc();
    if (starcat_start_image(&slots, &image) != STARCAT_OK) {
      abort();
    }
    for (uint32_t n = 0; (n < 16u) && (bytes.left > 0u); n++) {
      step(&slots, &image, &bytes);
    }
    /* Whatever came, the image that is opened is a whole one. */
    uint32_t bad;
    if ((starcat_start_image(&slots, &image) == STARCAT_OK) &&
        (starcat_scrub_image(slots.bytes[slots.active], slots.size[slots.active], 0, 0, &bad) !=
         STARCAT_OK)) {
      abort();
    }
  }
  free(slots.bytes[0]);
  free(slots.bytes[1]);
  traps_off();
  return 0;
}
