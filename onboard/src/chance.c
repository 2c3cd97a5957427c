/* The probability that chance agrees as well. The same formulas as in the ground's
 * starcat/matcher/chance.py, which derives them.
 *
 * SPDX-License-Identifier: MIT
 */
#include "internal.h"

#define LOG_PI R(1.1447298858494001741)
#define LOG_NOTHING R(-1e30)
#define LOG_SHARE_OF_PLAIN R(-0.10536051565782630)   /* of 0.9 */
#define LOG_SHARE_OF_SHAPE R(-3.6888794541139363057) /* of 0.1 over the number of other models */
#define FALL_OF_SHARE R(0.2) /* power of the factor from the limit with which shares fall */

/* Logarithm of the volume of the unit ball, by Gamma(k + 1/2) = (2 k)! sqrt(pi) / (4^k k!). */
static real log_unit_ball(uint32_t dimensions) {
  const uint32_t k = (dimensions + 1u) / 2u;
  if ((dimensions & 1u) == 0u) {
    return (real)k * LOG_PI - starcat_log_factorial(k);
  }
  return (real)(k - 1u) * LOG_PI - starcat_log_factorial(2u * k) + starcat_log_factorial(k) +
         (real)(2u * k) * R(0.69314718055994530942);
}

/* Logarithm of the volume of a ball, by the square of its radius. With a rate, the volume times
 * exp(-rate s) is at least that of the ball of the square less any s. */
real starcat_log_ball(uint32_t dimensions, real square_px, real rate) {
  const real half = R(0.5) * (real)dimensions;
  const real square = starcat_larger(square_px, STARCAT_LEAST_SQUARE);
  const real excess = rate * square / half;
  real log_volume = log_unit_ball(dimensions) + half * STARCAT_LOG(square);
  if (excess > R(1.0)) {
    log_volume += half * (excess - R(1.0) - STARCAT_LOG(excess));
  }
  return log_volume;
}

/* The rate by which squared residuals of magnitudes lower the number of ways; 0 if they are none. */
static real find_rate(real noise_px, real noise_mag) {
  return (noise_px > R(0.0)) && (noise_mag > R(0.0)) ? R(1.0) / (R(3.0) * noise_px * noise_px)
                                                     : R(0.0);
}

/* Logarithm of the expected number of chance agreements of n centroids, by the number of unknowns
 * in the fit, and the logarithm of the root of the determinant of their squared derivatives. */
static real log_expected(const starcat_call *call, uint32_t n, real square_px, real log_root,
                         uint32_t unknowns) {
  const real rate = find_rate(call->noise_px, call->noise_mag);
  return call->work->log_ways[n] + call->log_attitudes + log_root +
         starcat_log_ball(2u * n - unknowns, square_px, rate) - (real)n * call->camera.log_area;
}

/* Logarithm of the expected number of chance agreements of n centroids whose residuals are what noise
 * makes on average, and which are spread over the whole frame, by that of all ways and attitudes. */
static real log_typical(const starcat_call *call, uint32_t n, real log_all, uint32_t residuals,
                        real sigma_px) {
  const starcat_camera *c = &call->camera.given;
  const real square_of_frame = (c->width_px * c->width_px + c->height_px * c->height_px) / R(12.0);
  const real number = (real)n;
  return log_all + R(0.5) * STARCAT_LOG(number * number * number * square_of_frame) +
         R(2.0) * call->camera.log_focal +
         starcat_log_ball(2u * n - 3u, (real)(residuals - 3u) * sigma_px * sigma_px, R(0.0)) -
         number * call->camera.log_area;
}

/* Divide the ways to assign n centroids to stars, n up to `most`, by the share of the probability that n
 * has where the noise is stated: most have those whose agreements are typically as rare as the limit. */
void starcat_share_ways(const starcat_call *call, uint32_t most) {
  real *falls = call->work->sums[0], *log_ways = call->work->log_ways;
  const uint32_t residuals = call->noise_mag > R(0.0) ? 3u : 2u; /* of a star */
  real least = R(1e30), total = R(0.0);
  for (uint32_t n = STARCAT_MIN_STARS; n <= most; n++) {
    const real log_all = log_ways[n] + call->log_attitudes;
    falls[n] = FALL_OF_SHARE *
               starcat_absolute(log_typical(call, n, log_all, residuals * n, call->noise_px) -
                                STARCAT_LOG_CERTAIN);
    least = starcat_smaller(least, falls[n]);
  }
  for (uint32_t n = STARCAT_MIN_STARS; n <= most; n++) {
    falls[n] -= least;
    total += falls[n] < R(60.0) ? R(1.0) / starcat_exponential(falls[n]) : R(0.0);
  }
  for (uint32_t n = STARCAT_MIN_STARS; n <= most; n++) {
    log_ways[n] += falls[n] + STARCAT_LOG(total);
  }
}

/* Logarithm of the sum of two numbers whose logarithms are given. */
static real log_of_sum(real a, real b) {
  const real most = starcat_larger(a, b), apart = most - starcat_smaller(a, b);
  return apart < R(20.0) ? most + STARCAT_LOG(R(1.0) + R(1.0) / starcat_exponential(apart)) : most;
}

/* Logarithm of the expected number for each set of the free terms, summed: the volumes of the
 * inside, faces, edges and corners of the box of their ranges; that of the scale is so many times
 * wider. A set that moves no place has no volume. Returns 0 if the matches determine no attitude. */
static real sum_faces(const starcat_call *call, const starcat_normal *n, real square_px,
                      uint32_t n_matched, uint32_t free, real wider) {
  real total = LOG_NOTHING;
  for (uint32_t set = 0; set < (1u << free); set++) {
    real a[STARCAT_UNKNOWNS][STARCAT_UNKNOWNS], log_root = R(0.0);
    uint32_t row[STARCAT_UNKNOWNS] = {0u, 1u, 2u}, count = 3;
    for (uint32_t k = 0; k < free; k++) {
      if ((set & (1u << k)) != 0u) {
        row[count] = 3u + k;
        log_root += STARCAT_LOG(R(2.0) * call->half_range[k] * (k == 0u ? wider : R(1.0)));
        count++;
      }
    }
    for (uint32_t i = 0; i < count; i++) {
      for (uint32_t j = 0; j <= i; j++) {
        a[i][j] = n->gram[row[i]][row[j]];
      }
    }
    if (starcat_factorise(a, count) != 0) {
      for (uint32_t i = 0; i < count; i++) {
        log_root += STARCAT_LOG(a[i][i]);
      }
      total = log_of_sum(total, log_expected(call, n_matched, square_px, log_root, count));
    } else if (set == 0u) {
      return R(0.0);
    } else {
      /* no volume */
    }
  }
  return total;
}

/* Logarithm of the bound of an agreement with the first `free` terms of a shape, over the share of
 * the probability that its model has, after starcat_count_ways and starcat_share_ways; 0 if the bound excludes nothing. If
 * the focal length is not known, the scale is free in any case. */
real starcat_log_chance(const starcat_call *call, real square_px, uint32_t n_matched, uint32_t free,
                        const real terms[STARCAT_SHAPE_TERMS]) {
  const uint32_t unknowns = (free == 0u) && (call->log_scales > R(0.0)) ? 1u : free;
  real wider = R(1.0), growth = R(0.0);
  starcat_normal n;
  if ((n_matched < STARCAT_MIN_STARS) || (2u * n_matched <= 3u + unknowns)) {
    return R(0.0);
  }
  if (free > 0u) {
    growth = starcat_log_growth(call, terms);
    if (starcat_absolute(terms[0]) > call->half_range[0]) {
      wider = STARCAT_WIDER_RANGE; /* with half of the probability */
      growth += STARCAT_LOG(STARCAT_WIDER_RANGE);
    }
  }
  starcat_sum_normal(call, unknowns, &n);
  real expected = sum_faces(call, &n, square_px, n_matched, unknowns, wider) + growth;
  if (!(call->noise_px > R(0.0))) {
    expected += STARCAT_LOG((real)(call->own->count - 3u));
  }
  expected -= free == 0u ? LOG_SHARE_OF_PLAIN : LOG_SHARE_OF_SHAPE;
  return expected < R(0.0) ? expected : R(0.0);
}

/* The smallest number of matches that is typically accepted, if as many stars are in a frame: their
 * residuals are what noise makes on average, and they are spread over the whole frame. If no number
 * is accepted, the largest possible one. */
uint32_t starcat_find_least_matches(const starcat_call *call, uint32_t stars, real sigma_px) {
  const uint32_t count = call->own->count, most = count < stars ? count : stars;
  real log_all = STARCAT_LOG_ALL_ATTITUDES;
  for (uint32_t n = 1; n < most; n++) {
    log_all += STARCAT_LOG((real)(count - n + 1u) * (real)(stars - n + 1u) / (real)n);
    if ((n >= STARCAT_MIN_STARS) && (log_typical(call, n, log_all, 2u * n, sigma_px) <= call->log_limit)) {
      return n;
    }
  }
  return most;
}
