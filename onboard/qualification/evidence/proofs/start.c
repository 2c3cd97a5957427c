/* Claim: for any first 512 bytes and any size, starcat_open_image and starcat_scrub_image read only
 * within `size` until sizes have been checked, and refuse the image or continue.
 *
 * Preconditions: the pointers are null or point to memory of their size; `bytes` has 512 bytes, or
 * 0 if `size` is below 512. The header states sizes for which nothing follows beyond the 512 bytes
 * that exist.
 *
 * SPDX-License-Identifier: MIT
 */
#include "proof.h"

static uint64_t words[64];

int main(void) {
  starcat_image image;
  uint32_t bad, first = any_u32(), count = any_u32(), flags = any_u32();
  const int is_null = any(0, 1);
  make_any(words, sizeof words);
  /* Beyond the end of the array: not one byte may be read. */
  const size_t few = (size_t)any(0, 511);
  (void)starcat_open_image(&image, words + 64, few, flags);
  (void)starcat_scrub_image(words + 64, few, first, count, &bad);
  (void)starcat_scrub_image(words + 64, few, first, count, NULL);
  (void)starcat_open_image(is_null ? NULL : &image, NULL, any_size(), flags);
  (void)starcat_scrub_image(NULL, any_size(), first, count, &bad);
  /* 512 bytes: every header is refused, since an image has 8192 at least. */
  (void)starcat_open_image(&image, words, 512, flags);
  (void)starcat_scrub_image(words, 512, first, count, &bad);
  return 0;
}
