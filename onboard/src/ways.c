/* The number of ways to assign centroids to stars, which stated magnitudes make smaller. The same
 * bounds as the ground's starcat/matcher/ways.py, where they are derived.
 *
 * SPDX-License-Identifier: MIT
 */
#include "internal.h"

#define LEAST R(-1e30) /* logarithm of no way at all */

/* Logarithm of a factorial, from 16 on by Stirling's series. */
real sc_log_factorial(uint32_t n) {
  static const real table[16] = {
      R(0.0),                  R(0.0),                  R(0.69314718055994530942),
      R(1.7917594692280550008), R(3.1780538303479456197), R(4.7874917427820459943),
      R(6.5792512120101009951), R(8.5251613610654143002), R(10.604602902745250228),
      R(12.801827480081469611), R(15.104412573075515295), R(17.502307845873885839),
      R(19.987214495661886150), R(22.552163853123422886), R(25.191221182738681500),
      R(27.899271383840891566)};
  if (n < 16u) {
    return table[n];
  }
  const real x = (real)n, inverse = R(1.0) / x, square = inverse * inverse;
  return (x + R(0.5)) * STARCAT_LOG(x) - x + R(0.91893853320467274178) +
         inverse * (R(1.0 / 12.0) - square * (R(1.0 / 360.0) - square * R(1.0 / 1260.0)));
}

/* Exponential of a number from 0 to 20, without another function of libm. */
static real exponential(real x) {
  const real y = x * R(1.0 / 256.0);
  real power = R(1.0) + y * (R(1.0) + y * (R(0.5) + y * (R(1.0 / 6.0) +
                                                        y * (R(1.0 / 24.0) + y * R(1.0 / 120.0)))));
  for (uint32_t n = 0; n < 8u; n++) {
    power *= power;
  }
  return power;
}

/* Lower `bounds` to the elementary symmetric polynomials of `count` numbers; in logarithms, up to
 * degree `most`. With `others` above 0 the numbers n stand for (n!)^(1/n), and what Bregman's
 * theorem adds is added. */
static void lower(const uint16_t *numbers, uint32_t count, uint32_t most, uint32_t others,
                  real *sums, real *bounds) {
  const real whole = others > 0u ? sc_log_factorial(others) : R(0.0);
  uint32_t top = 1;
  for (uint32_t i = 0; i < count; i++) {
    top = numbers[i] > top ? numbers[i] : top;
  }
  const real largest = others > 0u ? exponential(sc_log_factorial(top) / (real)top) : (real)top;
  sums[0] = R(1.0);
  for (uint32_t k = 1; k <= most; k++) {
    sums[k] = R(0.0);
  }
  for (uint32_t i = 0; i < count; i++) {
    const real own = (real)numbers[i];
    real share = R(1.0);
    if (numbers[i] == 0u) {
      continue;
    }
    if (numbers[i] != top) {
      share = (others > 0u ? exponential(sc_log_factorial(numbers[i]) / own) : own) / largest;
    }
    for (uint32_t k = most; k > 0u; k--) {
      sums[k] += share * sums[k - 1u];
    }
  }
  const real log_largest = STARCAT_LOG(largest);
  for (uint32_t n = 1; n <= most; n++) {
    real bound = LEAST;
    if (sums[n] > R(0.0)) {
      bound = STARCAT_LOG(sums[n]) + (real)n * log_largest;
      if (others > 0u) {
        bound += (real)(others - n) / (real)others * whole - sc_log_factorial(others - n);
      }
    }
    if (bound < bounds[n]) {
      bounds[n] = bound;
    }
  }
}

/* Count the stars that each centroid may be, and the centroids that each star may be. */
static void count_compatible(const sc_call *call) {
  starcat_workspace *w = call->work;
  for (uint32_t j = 0; j < w->n_within; j++) {
    w->nearest[j] = 0;
  }
  for (uint32_t i = 0; i < w->count; i++) {
    w->compatible[i] = 0;
    for (uint32_t j = 0; j < w->n_within; j++) {
      if (sc_compatible(call, i, w->near_row[w->within[j]]) != 0) {
        w->compatible[i]++;
        w->nearest[j]++; /* not needed any more, so that it can count */
      }
    }
  }
}

/* Bound the ways to assign n of the centroids to n stars, for every n up to `most`: logarithms in
 * the workspace. */
void sc_count_ways(const sc_call *call, uint32_t most) {
  starcat_workspace *w = call->work;
  const uint32_t stars = w->n_within;
  w->log_ways[0] = R(0.0);
  for (uint32_t n = 1; n <= most; n++) {
    w->log_ways[n] = w->log_ways[n - 1u] + STARCAT_LOG((real)(w->count - n + 1u) *
                                                       (real)(stars - n + 1u) / (real)n);
  }
  if (call->mag_reach > R(0.0)) {
    count_compatible(call);
    lower(w->compatible, w->count, most, 0, w->sums, w->log_ways);
    lower(w->nearest, stars, most, 0, w->sums, w->log_ways);
    lower(w->compatible, w->count, most, stars, w->sums, w->log_ways);
    lower(w->nearest, stars, most, w->count, w->sums, w->log_ways);
  }
}
