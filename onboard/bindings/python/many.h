/* One frame or many in one call, for the ground: see many.c.
 *
 * SPDX-License-Identifier: MIT
 */
#ifndef STARCAT_MANY_H
#define STARCAT_MANY_H

#include "starcat.h"

/* Inputs that all frames of a camera share. */
typedef struct {
  const starcat_image *image;
  const starcat_camera *camera;
  const starcat_options *options;
  const int32_t *rows; /* row in the database of each star of the image */
} starcat_search;

/* The answer to one frame. Python makes its record from these fields by name, and reads the fields
 * with a single number in this order. */
typedef struct {
  int32_t status;
  int32_t reason;
  int32_t n_matched; /* if not identified: of the best agreement, like chance and share */
  int32_t n_usable;
  int64_t steps;
  double seconds; /* time in the library */
  double chance;  /* bound on the probability that chance agrees as well */
  double share;
  double focal_length_px;
  double residual_arcsec;
  double reduced_chi_square; /* NaN if no noise is stated */
  double q_body_from_icrs[4];
  double matrix[3][3];
  double covariance_arcsec2[3][3]; /* NaN if the stars determine no attitude */
  double shape[6];
  int64_t n_shape; /* number of terms that were fitted; 0: none */
} starcat_frame_answer;

/* Memory of one call at a time: working memory, and the results of starcat_identify_one. */
typedef struct {
  starcat_frame_answer answer;
  int32_t stars[3 * STARCAT_MAX_CENTROIDS]; /* the star_ids of the frame's centroids, then stars */
  double x_px[STARCAT_MAX_CENTROIDS];
  double y_px[STARCAT_MAX_CENTROIDS];
  double magnitudes[STARCAT_MAX_CENTROIDS];
  starcat_workspace work;
  starcat_result result;
} starcat_memory;

/* List the neighbours of every star of an image, as starcat_list_neighbours does. */
int starcat_list_all_neighbours(const starcat_image *image, starcat_neighbours *table);

/* Identify the stars of a frame, near a prior attitude if q_prior is not null. The arrays are
 * doubles: x and y of each centroid, magnitudes and noises or null, four of a quaternion. Returns
 * the status, which is also in the answer. */
int starcat_identify_one(const starcat_search *search, uint32_t count, const void *pairs_px,
                         const void *magnitudes, const void *sigma_px, const void *q_prior,
                         double uncertainty_rad, starcat_memory *memory);

/* Identify the stars of frames `first` to `stop`: one answer per frame, one star per centroid. The
 * centroids of frame n have the indices starts[n] to starts[n + 1]. A star is a row of the
 * database, or a negative number of starcat.h; `star_ids` are the permanent numbers, int64_t, -1
 * without a star. */
void starcat_identify_many(const starcat_search *search, uint32_t first, uint32_t stop,
                           const int64_t *starts, const double *pairs_px, const double *magnitudes,
                           const double *sigma_px, starcat_frame_answer *answers, int32_t *stars,
                           void *star_ids, starcat_memory *memory);

#endif
