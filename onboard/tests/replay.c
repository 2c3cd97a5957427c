/* Replay: identifies the frames of a text file with an image, and prints the results.
 *
 *   replay IMAGE FRAMES [identify|track] [repeats [noise_px noise_mag max_steps]]
 *
 * A frame is a line "count q0 q1 q2 q3" (the prior, for tracking) and `count` lines "x y mag". It
 * prints one line per frame: status, matched, tried, steps, then the star of each centroid. Used to
 * compare compilers and processors, and to count instructions.
 *
 * SPDX-License-Identifier: MIT
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "starcat.h"

#define PRIOR_RAD ((starcat_real)0.00872664625997164788)

static void *read_whole(const char *path, size_t *size) {
  FILE *file = fopen(path, "rb");
  char *bytes = NULL;
  *size = 0;
  if (file != NULL) {
    (void)fseek(file, 0, SEEK_END);
    *size = (size_t)ftell(file);
    rewind(file);
    bytes = malloc(*size + 1u);
    if (bytes != NULL) {
      *size = fread(bytes, 1, *size, file);
      bytes[*size] = 0;
    }
    (void)fclose(file);
  }
  return bytes;
}

static starcat_real number(char **at) { return (starcat_real)strtod(*at, at); }

int main(int argc, char **argv) {
  static starcat_workspace work;
  static starcat_result result;
  static starcat_real x[STARCAT_MAX_CENTROIDS], y[STARCAT_MAX_CENTROIDS];
  static starcat_real magnitudes[STARCAT_MAX_CENTROIDS];
  starcat_image image;
  starcat_camera camera;
  starcat_options options;
  size_t size = 0, unused = 0;
  if (argc < 3) {
    (void)fprintf(
        stderr, "replay IMAGE FRAMES [identify|track] [repeats [noise_px noise_mag max_steps]]\n");
    return 2;
  }
  const int is_tracked = (argc > 3) && (strcmp(argv[3], "track") == 0);
  const int repeats = argc > 4 ? atoi(argv[4]) : 1;
  void *bytes = read_whole(argv[1], &size);
  char *text = read_whole(argv[2], &unused);
  const starcat_status opened = starcat_open_image(&image, bytes, size, 0);
  if ((text == NULL) || (opened != STARCAT_OK)) {
    (void)fprintf(stderr, "cannot open: %d\n", (int)opened);
    return 2;
  }
  (void)starcat_get_camera(&image, &camera);
  (void)starcat_set_default_options(&options);
  if (argc > 7) {
    options.noise_px = (starcat_real)strtod(argv[5], NULL);
    options.noise_mag = (starcat_real)strtod(argv[6], NULL);
    options.max_steps = (uint32_t)strtoul(argv[7], NULL, 10);
  }
  for (char *at = text; strspn(at, " \r\n") < strlen(at);) {
    const uint32_t count = (uint32_t)strtoul(at, &at, 10);
    const starcat_real prior[4] = {number(&at), number(&at), number(&at), number(&at)};
    const starcat_frame frame = {count, x, y, magnitudes, NULL};
    starcat_status status = STARCAT_NO_MATCH;
    for (uint32_t i = 0; (i < count) && (i < STARCAT_MAX_CENTROIDS); i++) {
      x[i] = number(&at);
      y[i] = number(&at);
      magnitudes[i] = number(&at);
    }
    for (int n = 0; n < repeats; n++) {
      status = is_tracked
                   ? starcat_track_frame(&image, &camera, &options, &frame, prior, PRIOR_RAD, &work,
                                         &result)
                   : starcat_identify_frame(&image, &camera, &options, &frame, &work, &result);
    }
    (void)printf("%d %u %u %u", (int)status, (unsigned)result.n_matched, (unsigned)result.n_tried,
                 (unsigned)result.steps);
    for (uint32_t i = 0; i < count; i++) {
      (void)printf(" %d", (int)result.star[i]);
    }
    (void)printf("\n");
  }
  free(bytes);
  free(text);
  return 0;
}
