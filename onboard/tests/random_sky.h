/* A made-up sky for the tests: random stars, the image of them, and frames of them. It is written
 * by docs/onboard-format.md alone and shares no code with the library.
 *
 * SPDX-License-Identifier: MIT
 */
#ifndef STARCAT_TESTS_RANDOM_SKY_H
#define STARCAT_TESTS_RANDOM_SKY_H

#include <stddef.h>
#include <stdint.h>

#include "starcat.h"

#define SKY_STARS 300u
#define SKY_MOST_STARS 1600u
#define SKY_SPOTS 12u
#define SKY_MOST_BYTES 600000u

/* What an image is made of. Written in the byte order of the machine. */
typedef struct {
  uint32_t method;      /* 1 triangle, 2 pyramid */
  uint32_t index_bytes; /* 2 or 4 */
  uint32_t n_stars;     /* up to SKY_MOST_STARS */
  double longest_rad;   /* longest side of a triangle, or longest pair */
  uint64_t seed;
} sky_recipe;

/* A frame and its truth. Magnitudes equal the magnitudes of the stars; false spots are fainter. */
typedef struct {
  uint32_t count;
  starcat_real x[STARCAT_MAX_CENTROIDS], y[STARCAT_MAX_CENTROIDS];
  starcat_real magnitudes[STARCAT_MAX_CENTROIDS];
  int32_t star[STARCAT_MAX_CENTROIDS]; /* row in the image; -1: a false spot */
  double matrix[9];
  starcat_real q_body_from_icrs[4];
} sky_frame;

/* The next number of a sequence of SplitMix64, uniform from 0 to 1, or normal. */
double sky_uniform(uint64_t *state);
double sky_normal(uint64_t *state);

/* A random rotation, and the quaternion that belongs to it. */
void sky_rotation(uint64_t *state, double m[9], double q[4]);

/* Write an image into `bytes`, aligned by 8, of SKY_MOST_BYTES. Returns its size. */
size_t sky_image(const sky_recipe *recipe, uint8_t *bytes);

/* Write the CRCs of an image again, after bytes of it were changed. */
void sky_seal(uint8_t *bytes);

/* Observe the stars of an opened image from a random attitude: up to `n_spots` - `n_false` stars
 * with an error of `noise_px` on each axis, and `n_false` false spots. */
void sky_look(const starcat_image *image, const starcat_camera *camera, uint64_t *state,
              double noise_px, uint32_t n_spots, uint32_t n_false, sky_frame *frame);

#endif
