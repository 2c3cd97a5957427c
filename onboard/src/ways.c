/* The number of ways to assign centroids to stars, which stated magnitudes reduce. The same bound
 * as in the ground's starcat/matcher/chance.py, which derives it.
 *
 * SPDX-License-Identifier: MIT
 */
#include "internal.h"

#define NO_WAYS R(-1e30) /* logarithm of zero ways */
/* Polynomials of numbers up to 1 are below exp(count of the numbers), which must not overflow. */
#ifdef STARCAT_SINGLE
#define MOST_OF_SUM 80u
#else
#define MOST_OF_SUM 700u
#endif
#define UNIT (1u + (STARCAT_MAX_CENTROIDS - 1u) / MOST_OF_SUM)

/* Logarithm of a sum of products of n numbers in a unit. */
static real log_scaled(real sum, uint32_t n, real unit) {
  return STARCAT_LOG(starcat_larger(sum, STARCAT_LEAST_NUMBER)) + (real)n * STARCAT_LOG(unit);
}

/* (n!)^(1/n); 0 for 0. */
static real root_of_factorial(uint32_t n) {
  return n > 0u ? starcat_exponential(starcat_log_factorial(n) / (real)n) : R(0.0);
}

/* By how many whole deviations the magnitudes of a centroid and a star differ. Without a stated noise
 * of places, which is their unit, it is 0, or STARCAT_INCOMPATIBLE. */
uint32_t starcat_find_deviation(const starcat_call *call, uint32_t centroid, uint32_t row) {
  const real observed = call->work->magnitude[centroid];
  const int16_t stored = call->image->magnitudes[starcat_limit_place(row, call->image->n_stars)];
  if (!(call->noise_mag > R(0.0)) || (stored == INT16_MIN) ||
      !(observed < STARCAT_UNKNOWN_MAGNITUDE)) {
    return 0;
  }
  const real apart = starcat_absolute(observed - R(0.001) * (real)stored);
  if (!(apart <= STARCAT_MAG_DEVIATIONS * call->noise_mag)) {
    return STARCAT_INCOMPATIBLE;
  }
  return call->noise_px > R(0.0) ? (uint32_t)(apart / call->noise_mag) : 0u;
}

/* Whether the magnitudes of a centroid and a star are compatible. */
int starcat_is_compatible(const starcat_call *call, uint32_t centroid, uint32_t row) {
  return starcat_find_deviation(call, centroid, row) < STARCAT_INCOMPATIBLE;
}

/* The sums of the weights exp(-d^2 / 3) of the partners that a centroid or a star can have, d whole
 * deviations apart: as they are, and in the terms of Bregman's theorem, of those that are d apart at
 * most, times what the weight falls from d to d + 1. */
static void weigh_partners(const starcat_call *call, uint32_t one, int is_star, uint32_t partners,
                           real sums[2]) {
  static const real FALL[STARCAT_INCOMPATIBLE] = {R(0.28346868942621073), R(0.45293417245806250),
                                                  R(0.21381006974786282), R(0.049787068367863943)};
  const starcat_workspace *w = call->work;
  uint32_t number[STARCAT_INCOMPATIBLE + 1u] = {0}, count = 0;
  for (uint32_t k = 0; k < partners; k++) {
    const uint32_t star = w->near_row[starcat_find_near(w, is_star != 0 ? one : k)];
    number[starcat_find_deviation(call, is_star != 0 ? k : one, star)]++;
  }
  sums[0] = R(0.0);
  sums[1] = R(0.0);
  for (uint32_t d = 0; d < STARCAT_INCOMPATIBLE; d++) {
    count += number[d];
    sums[0] += FALL[d] * (real)count;
    sums[1] += FALL[d] * root_of_factorial(count);
  }
}

/* Find the logarithms of the sums of the weights of the ways to assign 1 to `most` centroids to
 * stars: the less of two bounds. Centroids or stars, whichever are fewer, are the numbers of elementary
 * symmetric polynomials, in units of the largest possible number, or of a multiple. */
static void weigh_ways(const starcat_call *call, uint32_t most) {
  starcat_workspace *w = call->work;
  const uint32_t centroids = call->own->count, stars = call->own->n_within;
  const int is_star = stars < centroids;
  const uint32_t fewer = is_star != 0 ? stars : centroids;
  const uint32_t others = is_star != 0 ? centroids : stars;
  const real log_all = starcat_log_factorial(others);
  const real unit[2] = {(real)UNIT * (real)others, (real)UNIT * root_of_factorial(others)};
  uint32_t some = 0;
  for (uint32_t n = 0; n <= most; n++) {
    w->sums[0][n] = n > 0u ? R(0.0) : R(1.0);
    w->sums[1][n] = w->sums[0][n];
  }
  for (uint32_t i = 0; i < fewer; i++) {
    real sums[2];
    weigh_partners(call, i, is_star, others, sums);
    some += sums[0] > R(0.0) ? 1u : 0u;
    for (uint32_t n = i < most ? i + 1u : most; n > 0u; n--) { /* all beyond are 0 */
      w->sums[0][n] += sums[0] / unit[0] * w->sums[0][n - 1u];
      w->sums[1][n] += sums[1] / unit[1] * w->sums[1][n - 1u];
    }
  }
  for (uint32_t n = 1; n <= most; n++) { /* the sum of a way can round to 0 */
    const real filled = (real)(others - n) / (real)others * log_all - starcat_log_factorial(others - n);
    w->log_ways[n] =
        n > some
            ? NO_WAYS
            : starcat_smaller(log_scaled(w->sums[0][n], n, unit[0]),
                              log_scaled(w->sums[1][n], n, unit[1]) + filled);
  }
}

/* Find the logarithms of the numbers of ways to assign 1 to `most` centroids to stars; with magnitudes
 * bounds of the sums of their weights. */
void starcat_count_ways(const starcat_call *call, uint32_t most) {
  starcat_workspace *w = call->work;
  w->log_ways[0] = R(0.0);
  if (call->noise_mag > R(0.0)) {
    weigh_ways(call, most);
    return;
  }
  for (uint32_t n = 1; n <= most; n++) {
    w->log_ways[n] =
        w->log_ways[n - 1u] + STARCAT_LOG((real)(call->own->count - n + 1u) *
                                          (real)(call->own->n_within - n + 1u) / (real)n);
  }
}
