/* Flips the bits of an image one at a time, and counts flips that starcat_scrub_image does not find
 * or whose block it does not name.
 *
 *   flips IMAGE COUNT
 *
 * SPDX-License-Identifier: MIT
 */
#include <stdio.h>
#include <stdlib.h>

#include "random_sky.h"

int main(int argc, char **argv) {
  uint64_t state = 7;
  uint32_t missed = 0, bad = 0;
  FILE *file = argc == 3 ? fopen(argv[1], "rb") : NULL;
  if ((file == NULL) || (fseek(file, 0, SEEK_END) != 0)) {
    (void)fprintf(stderr, "flips IMAGE COUNT\n");
    return 2;
  }
  const size_t size = (size_t)ftell(file);
  uint8_t *bytes = malloc(size);
  rewind(file);
  if ((bytes == NULL) || (fread(bytes, 1, size, file) != size) ||
      (starcat_scrub_image(bytes, size, 0, 0, &bad) != STARCAT_OK)) {
    (void)fprintf(stderr, "%s: not a sound image\n", argv[1]);
    return 2;
  }
  const int count = atoi(argv[2]);
  for (int n = 0; n < count; n++) {
    const size_t at = (size_t)(sky_uniform(&state) * (double)size);
    const uint8_t bit = (uint8_t)(1u << (unsigned)(8.0 * sky_uniform(&state)));
    bytes[at] = (uint8_t)(bytes[at] ^ bit);
    missed +=
        (uint32_t)((starcat_scrub_image(bytes, size, 0, 0, &bad) >= 0) || (bad != at / 4096u));
    bytes[at] = (uint8_t)(bytes[at] ^ bit);
  }
  (void)printf("%d flips, %u missed\n", count, (unsigned)missed);
  (void)fclose(file);
  free(bytes);
  return missed == 0u ? 0 : 1;
}
