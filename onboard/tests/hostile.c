/* Frames, cameras, options and priors that no camera would send, with floating-point traps on: what
 * fuzz_centroids.c makes of bytes, of random ones, so that no fuzzer is needed.
 *
 *   hostile COUNT
 *
 * SPDX-License-Identifier: MIT
 */
#include <stdio.h>

#include "fuzz.h"

#define MOST 600u

int LLVMFuzzerInitialize(int *argc, char ***argv);
int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

int main(int argc, char **argv) {
  const long count = argc == 2 ? strtol(argv[1], NULL, 10) : 0;
  uint64_t state = 1;
  if (count <= 0) {
    (void)fprintf(stderr, "hostile COUNT\n");
    return 2;
  }
  (void)LLVMFuzzerInitialize(&argc, &argv);
  for (long n = 0; n < count; n++) {
    uint8_t bytes[MOST];
    /* A zero leaves what it is for as it was: from a change in a hundred to changes everywhere. */
    const double changes = sky_uniform(&state) * sky_uniform(&state) * sky_uniform(&state);
    for (size_t k = 0; k < MOST; k++) {
      const double byte = 256.0 * sky_uniform(&state);
      /* The first three choose the sky, where the camera looks, and how many spots are false. */
      bytes[k] = (uint8_t)((k < 3u) || (sky_uniform(&state) < changes) ? byte : 0.0);
    }
    (void)LLVMFuzzerTestOneInput(bytes, MOST);
  }
  (void)printf("%ld hostile frames, no floating-point trap\n", count);
  return 0;
}
