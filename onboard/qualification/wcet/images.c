/* Writes the images that the frames are sought in, of made-up skies: PREFIX-0.img and so on.
 *
 * SPDX-License-Identifier: MIT
 */
#include <stdio.h>

#include "random_sky.h"

static uint64_t words[SKY_MOST_BYTES / 8u];

int main(int argc, char **argv) {
  /* Triangles and pairs of few stars, and of many in a narrow reach. */
  static const sky_recipe recipes[4] = {{1, 2, SKY_STARS, 0.42, 8},
                                        {2, 2, SKY_STARS, 0.698, 8},
                                        {1, 2, 700, 0.17, 9},
                                        {2, 4, 1500, 0.18, 8}};
  for (unsigned n = 0; (argc == 2) && (n < 4u); n++) {
    char path[1024];
    const size_t size = sky_image(&recipes[n], (uint8_t *)words);
    (void)snprintf(path, sizeof path, "%s-%u.img", argv[1], n);
    FILE *file = fopen(path, "wb");
    if ((file == NULL) || (fwrite(words, 1, size, file) != size) || (fclose(file) != 0)) {
      perror(path);
      return 2;
    }
  }
  return argc == 2 ? 0 : 2;
}
