/* Claim: starcat_open_image and starcat_scrub_image cause no run-time error on an image of BLOCKS
 * blocks of data, for any values of the other bytes, any scrubbed blocks, and with or without CRCs.
 *
 * Preconditions: `bytes` is aligned by 8 and has exactly the size of an image of BLOCKS blocks.
 * Magic, byte order, version and sizes pass check_start; otherwise the functions return before they
 * read anything else (start.c). Run for several BLOCKS.
 *
 * SPDX-License-Identifier: MIT
 */
#include "proof.h"

#define CHECKS ((BLOCKS + STARCAT_CRCS_OF_BLOCK - 1u) / STARCAT_CRCS_OF_BLOCK)
#define TOTAL ((BLOCKS + CHECKS) * STARCAT_BLOCK_BYTES)

static uint64_t words[TOTAL / 8u];

int main(void) {
  starcat_image image;
  uint32_t bad, *header = (uint32_t *)words;
  make_any(words, TOTAL);
  header[5] = TOTAL;
  header[6] = BLOCKS * STARCAT_BLOCK_BYTES;
  (void)starcat_open_image(&image, words, TOTAL, any_u32());
  (void)starcat_scrub_image(words, TOTAL, any_u32(), any_u32(), &bad);
  return 0;
}
