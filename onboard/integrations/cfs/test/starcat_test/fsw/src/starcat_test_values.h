/* What the test app, its table and the check of the recording have to agree upon.
 *
 * SPDX-License-Identifier: MIT
 */
#ifndef STARCAT_TEST_VALUES_H
#define STARCAT_TEST_VALUES_H

/* Frames of a recording: of two skies, and of a slow slew over the first one. */
#define TEST_FRAMES_A     450
#define TEST_FRAMES_SLEW  200
#define TEST_FRAMES_B     350
#define TEST_FRAMES       (TEST_FRAMES_A + TEST_FRAMES_SLEW + TEST_FRAMES_B)
#define TEST_FIRST_SLEW   TEST_FRAMES_A
#define TEST_FIRST_B      (TEST_FRAMES_A + TEST_FRAMES_SLEW)
#define TEST_FIRST_EXTRA  1000000 /* frames that no answer is to be found for */
#define TEST_MISS_PERIODS 20      /* 100 ms each: frames, between two of which is such a gap */

#define TEST_IMAGE_A "sky-a-1.0.0"
#define TEST_IMAGE_B "sky-b-1.0.0"
#define TEST_PATCHED "sky-a-1.0.1" /* the first one by a patch: another name, the same stars */

/* The table that the app uses in flight; its camera is the camera of the images. */
#define TEST_NOISE_PX   0.4
#define TEST_PRIOR_RAD  0.01
#define TEST_AGE_MS     1000
#define TEST_BUDGET     40

/* The table that it starts with: fsw/tables/starcat_app_tbl.c. */
#define FIRST_PRIOR_RAD 0.009
#define FIRST_AGE_MS    2000

#endif
