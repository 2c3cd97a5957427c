/* One frame or many in one call, so that Python has little overhead per call, and other threads run
 * meanwhile. Not part of the flight library.
 *
 * SPDX-License-Identifier: MIT
 */
#include <math.h>
#include <stdlib.h>
#include <string.h>
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

/* Magnitudes far from any star's are unknown magnitudes, as in starcat/matcher/observation.py. */
static const double LARGEST_MAG = 100.0;

static const double ARCSEC = 206264.80624709636; /* arcseconds per radian */

/* Convert a result of the library into the record that Python reads. */
static void tell_answer(const starcat_result *result, starcat_frame_answer *answer) {
  answer->n_usable = (int32_t)result->n_usable;
  answer->reason = (int32_t)result->reason;
  if (result->reason != STARCAT_REASON_NONE) {
    answer->n_matched = (int32_t)result->best_n_matched;
    answer->chance = exp(result->best_log_chance);
    answer->share = result->best_share;
    return;
  }
  answer->n_matched = (int32_t)result->n_matched;
  answer->chance = exp(result->log_chance);
  answer->focal_length_px = result->focal_length_px;
  answer->residual_arcsec = ARCSEC * result->residual_rad;
  const int is_stated = result->reduced_chi_square > 0.0;
  answer->reduced_chi_square = is_stated ? result->reduced_chi_square : (double)NAN;
  const int is_determined = result->covariance_rad2[0] > 0.0;
  for (uint32_t k = 0; k < 9u; k++) {
    const double rad2 = is_determined ? result->covariance_rad2[k] : (double)NAN;
    answer->covariance_arcsec2[k / 3u][k % 3u] = ARCSEC * ARCSEC * rad2;
  }
  memcpy(answer->shape, result->shape, sizeof answer->shape);
  answer->n_shape = (int64_t)result->n_shape;
  memcpy(answer->matrix, result->matrix, sizeof answer->matrix);
  memcpy(answer->q_body_from_icrs, result->q_body_from_icrs, sizeof answer->q_body_from_icrs);
}

static int identify_copied(const starcat_search *search, uint32_t count, const double *pairs_px,
                           const double *magnitudes, const double *sigma_px, const double *q_prior,
                           double uncertainty_rad, starcat_frame_answer *answer, int32_t *star,
                           void *star_ids, starcat_memory *memory) {
  const starcat_frame frame = {count, memory->x_px, memory->y_px,
                               magnitudes == NULL ? NULL : memory->magnitudes, sigma_px};
  starcat_result *result = &memory->result;
  memset(answer, 0, sizeof *answer);
  if (count > STARCAT_MAX_CENTROIDS) {
    answer->status = STARCAT_E_TOO_MANY_CENTROIDS;
    return answer->status;
  }
  for (size_t i = 0; i < count; i++) {
    memory->x_px[i] = pairs_px[2u * i];
    memory->y_px[i] = pairs_px[2u * i + 1u];
  }
  for (size_t i = 0; (magnitudes != NULL) && (i < count); i++) {
    const int is_known = (magnitudes[i] >= -LARGEST_MAG) && (magnitudes[i] <= LARGEST_MAG);
    memory->magnitudes[i] = is_known ? magnitudes[i] : (double)NAN;
  }
  const double begun_s = now_s();
  const starcat_status status =
      q_prior == NULL ? starcat_identify_frame(search->image, search->camera, search->options,
                                               &frame, &memory->work, result)
                      : starcat_track_frame(search->image, search->camera, search->options, &frame,
                                            q_prior, uncertainty_rad, &memory->work, result);
  answer->seconds = now_s() - begun_s;
  answer->status = (int32_t)status;
  answer->steps = (int64_t)result->steps;
  const int has_stars = (status >= 0) || (status == STARCAT_E_BUDGET);
  for (uint32_t i = 0; i < count; i++) {
    const int32_t row = has_stars ? result->star[i] : STARCAT_NO_STAR;
    star[i] = row < 0 ? row : search->rows[row];
    const int64_t id = row < 0 ? -1 : search->image->star_ids[row];
    memcpy((char *)star_ids + sizeof id * i, &id, sizeof id);
  }
  if (has_stars) {
    tell_answer(result, answer);
  }
  return answer->status;
}

int starcat_list_all_neighbours(const starcat_image *image, starcat_neighbours *table) {
  starcat_workspace *work = malloc(sizeof *work);
  const int status =
      work == NULL ? STARCAT_E_CAPACITY : starcat_list_neighbours(image, work, table);
  free(work);
  return status;
}

int starcat_identify_one(const starcat_search *search, uint32_t count, const void *pairs_px,
                         const void *magnitudes, const void *sigma_px, const void *q_prior,
                         double uncertainty_rad, starcat_memory *memory) {
  return identify_copied(search, count, pairs_px, magnitudes, sigma_px, q_prior, uncertainty_rad,
                         &memory->answer, memory->stars + 2u * count, memory->stars, memory);
}

void starcat_identify_many(const starcat_search *search, uint32_t first, uint32_t stop,
                           const int64_t *starts, const double *pairs_px, const double *magnitudes,
                           const double *sigma_px, starcat_frame_answer *answers, int32_t *stars,
                           void *star_ids, starcat_memory *memory) {
  for (uint32_t n = first; n < stop; n++) {
    const int64_t start = starts[n];
    (void)identify_copied(search, (uint32_t)(starts[n + 1u] - start), pairs_px + 2 * start,
                          magnitudes == NULL ? NULL : magnitudes + start,
                          sigma_px == NULL ? NULL : sigma_px + start, NULL, 0.0, answers + n,
                          stars + start, (char *)star_ids + sizeof(int64_t) * (size_t)start,
                          memory);
  }
}
