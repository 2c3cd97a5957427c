/* Calls that are made to take long, each described by a few bytes, so that the worst ones can be
 * looked for by changing these.
 *
 * SPDX-License-Identifier: MIT
 */
#ifndef STARCAT_WCET_ADVERSARY_H
#define STARCAT_WCET_ADVERSARY_H

#include "random_sky.h"

#define N_GENES 20u

/* A call, made of genes. */
typedef struct {
  starcat_camera camera;
  starcat_options options;
  sky_frame sky;
  starcat_real sigma_px[STARCAT_MAX_CENTROIDS];
  starcat_real uncertainty_rad;
  int is_tracked, has_magnitudes, has_sigma;
} adversary;

/* Draw genes: of a frame as a camera sends them, or of any kind. */
void adversary_draw(uint64_t *state, int is_ordinary, uint8_t genes[N_GENES]);

/* Change some genes. */
void adversary_mutate(uint64_t *state, uint8_t genes[N_GENES]);

/* Make the call that genes describe, for an opened image. */
void adversary_make(const starcat_image *image, const uint8_t genes[N_GENES], adversary *made);

/* Make it: the centroids, the camera and the options are in *made. */
starcat_status adversary_call(const starcat_image *image, const adversary *made,
                              starcat_workspace *work, starcat_result *result);

#endif
