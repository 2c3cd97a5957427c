/* Writes what the other programs read: images of the made-up sky in the byte order of the machine,
 * and frames of it.
 *
 *   frames PREFIX COUNT
 *
 * writes PREFIX-triangle.img, PREFIX-pyramid.img, PREFIX-frames.txt with COUNT frames as replay.c
 * reads them, and PREFIX-frame.txt with the centroids of the first one, each a line "x y
 * magnitude".
 *
 * SPDX-License-Identifier: MIT
 */
#include <stdio.h>
#include <stdlib.h>

#include "random_sky.h"

static uint64_t words[SKY_MOST_BYTES / 8u];

static FILE *create(const char *prefix, const char *name) {
  char path[1024];
  (void)snprintf(path, sizeof path, "%s-%s", prefix, name);
  FILE *file = fopen(path, "wb");
  if (file == NULL) {
    perror(path);
    exit(2);
  }
  return file;
}

static void write_frame(FILE *file, const sky_frame *frame) {
  for (uint32_t i = 0; i < frame->count; i++) {
    (void)fprintf(file, "%a %a %a\n", (double)frame->x[i], (double)frame->y[i],
                  (double)frame->magnitudes[i]);
  }
}

int main(int argc, char **argv) {
  static const char *const names[2] = {"triangle.img", "pyramid.img"};
  starcat_image image;
  starcat_camera camera;
  uint64_t state = 1;
  if (argc != 3) {
    (void)fprintf(stderr, "frames PREFIX COUNT\n");
    return 2;
  }
  for (uint32_t n = 0; n < 2u; n++) {
    const sky_recipe recipe = {n + 1u, 2, SKY_STARS, n == 0u ? 0.42 : 0.698, 8};
    const size_t size = sky_image(&recipe, (uint8_t *)words);
    FILE *file = create(argv[1], names[n]);
    (void)fwrite(words, 1, size, file);
    (void)fclose(file);
    if (starcat_open_image(&image, words, size, 0) != STARCAT_OK) {
      return 1;
    }
  }
  (void)starcat_get_camera(&image, &camera);
  FILE *frames = create(argv[1], "frames.txt"), *first = create(argv[1], "frame.txt");
  for (int n = 0; n < atoi(argv[2]); n++) {
    sky_frame frame;
    sky_look(&image, &camera, &state, 0.3, SKY_SPOTS, (uint32_t)n % 4u, &frame);
    const starcat_real *q = frame.q_body_from_icrs;
    (void)fprintf(frames, "%u %a %a %a %a\n", (unsigned)frame.count, (double)q[0], (double)q[1],
                  (double)q[2], (double)q[3]);
    write_frame(frames, &frame);
    if (n == 0) {
      write_frame(first, &frame);
    }
  }
  return (fclose(frames) != 0) || (fclose(first) != 0);
}
