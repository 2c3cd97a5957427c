/* What the parts of the unit test share.
 *
 * SPDX-License-Identifier: MIT
 */
#ifndef STARCAT_TESTS_UNIT_H
#define STARCAT_TESTS_UNIT_H

#include "check.h"
#include "random_sky.h"

#ifdef STARCAT_SINGLE
#define IF_SINGLE(single, dbl) (single)
#else
#define IF_SINGLE(single, dbl) (dbl)
#endif

/* An image in memory that is aligned, opened, and what a call needs beside it. */
typedef struct {
  uint64_t words[SKY_MOST_BYTES / 8u + 1u];
  uint8_t *bytes;
  size_t size;
  starcat_image image;
  starcat_camera camera;
  starcat_options options;
} unit_sky;

/* Two images of the same sky, one of a sky of five times the stars, and one to be damaged. */
extern unit_sky unit_triangle, unit_pyramid, unit_crowded, unit_scratch;
extern starcat_workspace unit_work;
extern starcat_result unit_result;

/* Copy an image into unit_scratch, so that a test can damage it. */
void unit_copy(const unit_sky *from);

/* Write a number into the scratch image, seal it again, and open it. */
starcat_status unit_open_with(size_t at, uint32_t value);

/* A frame of the sky as the library is given it, what that is identified as, the stars of the answer
 * that are others than the true ones, and the true attitude. */
starcat_frame unit_frame_of(const sky_frame *truth);
starcat_status unit_identify(const unit_sky *sky, const sky_frame *truth);
uint32_t unit_wrong_stars(const sky_frame *truth);
double unit_error_rad(const sky_frame *truth); /* of the boresight of the answer */
void unit_matrix_of(const sky_frame *truth, starcat_real m[9]);

void test_open(void);
void test_scrub(void);
void test_damaged(void);
void test_errors(void);
void test_dropped(void);
void test_identify(void);
void test_track(void);
void test_budget(void);
void test_attitude(void);
void test_camera(void);
void test_kernels(void);
void test_rare(void);
void test_answer(void);
void test_crowded(void);
void test_scale(void);
void test_shape(void);
void test_votes(void);
void test_update(void);
void test_session(void);

#endif
