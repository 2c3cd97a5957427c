/* Many frames in one call, for the ground: see many.c.
 *
 * SPDX-License-Identifier: MIT
 */
#ifndef STARCAT_MANY_H
#define STARCAT_MANY_H

#include "starcat.h"

/* Frames, one after the other: the centroids of frame n are rows starts[n] to starts[n + 1]. */
typedef struct {
  uint32_t count;
  const int64_t *starts;
  const double *x_px;
  const double *y_px;
  const double *magnitudes; /* null: none known */
  const double *q_prior;    /* four a frame; null: lost in space */
  double uncertainty_rad;
  const double *directions; /* of the image's stars before they were rounded; null: the image's */
} starcat_frames;

/* The answer to one frame. */
typedef struct {
  int32_t status;
  int32_t n_matched;
  int64_t steps;
  double q_body_from_icrs[4];
  double matrix[9];
  double residual_rad;
  double log_chance;
  double seconds; /* that the library took */
} starcat_answer;

/* Identify the stars of many frames: an answer a frame, a number a centroid. */
void starcat_many(const starcat_image *image, const starcat_camera *camera,
                  const starcat_options *options, const starcat_frames *frames,
                  starcat_answer *answers, int32_t *stars, starcat_workspace *work,
                  starcat_result *result);

#endif
