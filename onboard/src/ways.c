/* The number of ways to assign centroids to stars, which stated magnitudes reduce. The same bounds
 * as in the ground's starcat/matcher/chance.py, which derives them.
 *
 * SPDX-License-Identifier: MIT
 */
#include "internal.h"

#define LEAST R(-1e30) /* logarithm of zero ways */
#define SMALL 16u
/* Largest count of numbers up to 1 whose polynomials cannot overflow: they are below exp(count). */
#ifdef STARCAT_SINGLE
#define MOST_OF_SUM 80u
#else
#define MOST_OF_SUM 700u
#endif
#define FAR_MAGNITUDE R(1e30) /* for stars of unknown magnitude, which are counted separately */

/* Compute the elementary symmetric polynomials of `count` numbers up to degree `most`, in units of
 * the largest one, or of a multiple. From the third bound on the numbers n stand for (n!)^(1/n). */
static void sum_polynomials(starcat_workspace *w, uint32_t bound, const uint16_t *numbers,
                            uint32_t count, uint32_t most) {
  const int is_tight = bound >= 2u;
  real *sums = w->sums[bound];
  uint32_t unit = 1;
  uint32_t top = 1;
  real shares[SMALL] = {0};
  for (uint32_t i = 0; i < count; i++) {
    top = numbers[i] > top ? numbers[i] : top;
  }
  while (count / unit > MOST_OF_SUM) { /* too many numbers: the sums would overflow */
    unit *= 2u;
  }
  const real largest =
      (real)unit *
      (is_tight ? starcat_exponential(starcat_log_factorial(top) / (real)top) : (real)top);
  w->log_largest[bound] = STARCAT_LOG(largest);
  w->n_some[bound] = 0;
  sums[0] = R(1.0);
  for (uint32_t k = 1; k <= most; k++) {
    sums[k] = R(0.0);
  }
  for (uint32_t i = 0; i < count; i++) {
    const uint32_t own = numbers[i], place = own < SMALL ? own : 0u;
    if (own == 0u) {
      continue;
    }
    w->n_some[bound]++;
    real share = shares[place];
    if ((place == 0u) || !(share > R(0.0))) { /* else it was computed before: many are equal */
      share = (is_tight ? starcat_exponential(starcat_log_factorial(own) / (real)own) : (real)own) /
              largest;
      shares[place] = share;
    }
    for (uint32_t k = i < most ? i + 1u : most; k > 0u; k--) { /* all beyond are 0 */
      sums[k] += share * sums[k - 1u];
    }
  }
}

/* Term that Bregman's theorem adds to the logarithm for n, with `others` on the other side. */
static real log_filled(uint32_t others, uint32_t n) {
  return (real)(others - n) / (real)others * starcat_log_factorial(others) -
         starcat_log_factorial(others - n);
}

/* Logarithm of the bound of the ways to assign n of the centroids to n stars, after
 * starcat_count_ways. */
real starcat_log_ways(const starcat_call *call, uint32_t n) {
  const starcat_workspace *w = call->work;
  real least = w->log_ways[n];
  for (uint32_t bound = 0; (bound < 4u) && (call->mag_reach > R(0.0)); bound++) {
    real logarithm = LEAST;
    if (n <= w->n_some[bound]) { /* else there is no way; the sum of a way can round to 0 */
      logarithm = STARCAT_LOG(starcat_larger(w->sums[bound][n], STARCAT_LEAST_NUMBER)) +
                  (real)n * w->log_largest[bound];
      if (bound >= 2u) {
        logarithm += log_filled(bound == 2u ? call->own->n_within : call->own->count, n);
      }
    }
    least = logarithm < least ? logarithm : least;
  }
  return least;
}

/* Count the stars that each centroid can be, and the centroids that each star can be. `nearest` and
 * `nearest_square` are no longer needed at this point and are used as memory. */
static void count_compatible(const starcat_call *call) {
  starcat_workspace *w = call->work;
  const real reach = call->mag_reach;
  uint16_t unknown = 0;
  for (uint32_t j = 0; j < call->own->n_within; j++) {
    const int16_t stored = call->image->magnitudes[starcat_limit_place(
        w->near_row[starcat_find_near(w, j)], call->image->n_stars)];
    const int is_known = stored != INT16_MIN;
    w->nearest_square[j] = is_known ? R(0.001) * (real)stored : FAR_MAGNITUDE;
    w->nearest[j] = is_known ? 0u : (uint16_t)call->own->count;
    unknown = (uint16_t)(unknown + (is_known ? 0u : 1u));
  }
  for (uint32_t i = 0; i < call->own->count; i++) {
    const real observed = w->magnitude[i];
    const int is_known = observed < STARCAT_UNKNOWN_MAGNITUDE;
    uint16_t some = unknown;
    for (uint32_t j = 0; j < call->own->n_within; j++) {
      const real apart = observed - w->nearest_square[j];
      const uint16_t fits = (uint16_t)((apart <= reach) & (-apart <= reach));
      some = (uint16_t)(some + fits);
      w->nearest[j] = (uint16_t)(w->nearest[j] + fits);
    }
    for (uint32_t j = 0; !is_known && (j < call->own->n_within); j++) {
      w->nearest[j] = (uint16_t)(w->nearest[j] + (w->nearest_square[j] < FAR_MAGNITUDE ? 1u : 0u));
    }
    w->compatible[i] = is_known ? some : (uint16_t)call->own->n_within;
  }
}

/* Prepare starcat_log_ways for every n up to `most`: the number of all ways and, with magnitudes,
 * four bounds of the ways with similar magnitudes, from the centroids and from the stars. */
void starcat_count_ways(const starcat_call *call, uint32_t most) {
  starcat_workspace *w = call->work;
  const uint32_t stars = call->own->n_within;
  w->log_ways[0] = R(0.0);
  for (uint32_t n = 1; n <= most; n++) {
    w->log_ways[n] = w->log_ways[n - 1u] + STARCAT_LOG((real)(call->own->count - n + 1u) *
                                                       (real)(stars - n + 1u) / (real)n);
  }
  if (call->mag_reach > R(0.0)) {
    count_compatible(call);
    sum_polynomials(w, 0, w->compatible, call->own->count, most);
    sum_polynomials(w, 1, w->nearest, stars, most);
    sum_polynomials(w, 2, w->compatible, call->own->count, most);
    sum_polynomials(w, 3, w->nearest, stars, most);
  }
}
