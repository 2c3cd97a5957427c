/* Sequences: answers the frames of sequences with sessions, and prints the answers. Used to compare
 * sessions that acquire over several frames with the ground's.
 *
 *   sequences IMAGE FRAMES NOISE_PX NOISE_MAG PRIOR_ERROR_RAD
 *
 * A frame is a line "count first" (first 1: a new session begins with it) and `count` lines
 * "x y mag". It prints one line per frame: status, mode, logarithm of the bound, matched, steps, then
 * the quaternion of the attitude.
 *
 * SPDX-License-Identifier: MIT
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "starcat_session.h"

static uint64_t image_words[(1u << 24) / 8u];
static starcat_session session;

int main(int argc, char **argv) {
  static starcat_real x[STARCAT_MAX_CENTROIDS], y[STARCAT_MAX_CENTROIDS];
  static starcat_real magnitudes[STARCAT_MAX_CENTROIDS];
  starcat_settings settings;
  starcat_answer answer;
  unsigned count = 0, first = 0;
  uint64_t now = 0;
  if (argc != 6) {
    (void)fprintf(stderr, "sequences IMAGE FRAMES NOISE_PX NOISE_MAG PRIOR_ERROR_RAD\n");
    return 2;
  }
  FILE *image = fopen(argv[1], "rb"), *frames = fopen(argv[2], "r");
  if ((image == NULL) || (frames == NULL)) {
    (void)fprintf(stderr, "cannot open the image or the frames\n");
    return 2;
  }
  const size_t size = fread(image_words, 1, sizeof image_words, image);
  (void)starcat_set_default_settings(&settings);
  settings.options.noise_px = (starcat_real)strtod(argv[3], NULL);
  settings.options.noise_mag = (starcat_real)strtod(argv[4], NULL);
  settings.prior_error_rad = (starcat_real)strtod(argv[5], NULL);
  settings.prior_age = 1000;
  settings.max_steps_identify = 400000000u; /* as on the ground */
  settings.max_steps_confirm = settings.max_steps_identify;
  while (fscanf(frames, "%u %u", &count, &first) == 2) {
    const starcat_frame frame = {count, x, y, magnitudes, NULL};
    for (unsigned i = 0; i < count; i++) {
      double place[3] = {0.0, 0.0, 0.0};
      if (fscanf(frames, "%lf %lf %lf", place, place + 1, place + 2) != 3) {
        return 2;
      }
      if (i < STARCAT_MAX_CENTROIDS) {
        x[i] = (starcat_real)place[0];
        y[i] = (starcat_real)place[1];
        magnitudes[i] = (starcat_real)place[2];
      }
    }
    if ((first != 0u) &&
        ((starcat_prepare_session(&session, &settings) != STARCAT_OK) ||
         (starcat_use_image(&session, image_words, size) != STARCAT_OK))) {
      (void)fprintf(stderr, "the settings or the image are refused\n");
      return 2;
    }
    now++;
    (void)starcat_answer_frame(&session, &frame, now, &answer);
    (void)printf("%d %d %.12g %u %u", (int)answer.status, (int)answer.mode,
                 (double)answer.result.log_chance, (unsigned)answer.result.n_matched,
                 (unsigned)answer.steps);
    for (unsigned n = 0; n < 4u; n++) {
      (void)printf(" %.15g", (double)answer.result.q_body_from_icrs[n]);
    }
    (void)printf("\n");
  }
  (void)fclose(image);
  (void)fclose(frames);
  return 0;
}
