/* Many frames in one call, so that a program in Python pays for a call once, and its other threads
 * run meanwhile. Not part of the library that flies.
 *
 * SPDX-License-Identifier: MIT
 */
#include <time.h>

#include "internal.h"
#include "many.h"

static double now_s(void) {
  struct timespec now = {0, 0};
#ifdef CLOCK_MONOTONIC
  (void)clock_gettime(CLOCK_MONOTONIC, &now);
#else
  (void)timespec_get(&now, TIME_UTC);
#endif
  return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

/* Fit the attitude once more, with directions that were not rounded. */
static void fit_again(const double *directions, const starcat_workspace *work,
                      starcat_result *result) {
  double body[STARCAT_MAX_CENTROIDS][3] = {{0}}, icrs[STARCAT_MAX_CENTROIDS][3] = {{0}};
  double square = 0.0;
  uint32_t n = 0;
  for (uint32_t i = 0; i < work->count; i++) {
    if (work->best.star[i] >= 0) {
      for (size_t k = 0; k < 3u; k++) {
        body[n][k] = work->body[i][k];
        icrs[n][k] = directions[3u * (size_t)work->best.star[i] + k];
      }
      n++;
    }
  }
  sc_refine(result->matrix, &body[0][0], &icrs[0][0], NULL, n, 4);
  sc_quaternion(result->matrix, result->q_body_from_icrs);
  sc_matrix(result->q_body_from_icrs, result->matrix);
  for (uint32_t i = 0; i < n; i++) {
    double turned[3];
    sc_turn(result->matrix, icrs[i], turned);
    square += sc_chord_square(body[i], turned);
  }
  result->residual_rad = sqrt(square / (double)n);
}

void starcat_many(const starcat_image *image, const starcat_camera *camera,
                  const starcat_options *options, const starcat_frames *frames,
                  starcat_answer *answers, int32_t *stars, starcat_workspace *work,
                  starcat_result *result) {
  for (uint32_t n = 0; n < frames->count; n++) {
    const int64_t start = frames->starts[n], stop = frames->starts[n + 1u];
    const double *magnitudes = frames->magnitudes;
    const starcat_frame frame = {(uint32_t)(stop - start), frames->x_px + start,
                                 frames->y_px + start,
                                 magnitudes == NULL ? NULL : magnitudes + start};
    starcat_answer *answer = answers + n;
    const double begun_s = now_s();
    const starcat_status status =
        frames->q_prior == NULL
            ? starcat_identify(image, camera, options, &frame, work, result)
            : starcat_track(image, camera, options, &frame, frames->q_prior + 4u * (size_t)n,
                            frames->uncertainty_rad, work, result);
    answer->seconds = now_s() - begun_s;
    answer->status = (int32_t)status;
    answer->steps = (int64_t)result->steps;
    const int has_stars = (status >= 0) || (status == STARCAT_E_BUDGET);
    for (int64_t i = 0; has_stars && (i < stop - start); i++) {
      stars[start + i] = result->star[i];
    }
    if (status == STARCAT_IDENTIFIED) {
      if (frames->directions != NULL) {
        fit_again(frames->directions, work, result);
      }
      answer->n_matched = (int32_t)result->n_matched;
      answer->residual_rad = result->residual_rad;
      answer->log_chance = result->log_chance;
      for (size_t k = 0; k < 9u; k++) {
        answer->matrix[k] = result->matrix[k];
      }
      for (size_t k = 0; k < 4u; k++) {
        answer->q_body_from_icrs[k] = result->q_body_from_icrs[k];
      }
    }
  }
}
