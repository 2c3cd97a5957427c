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
#define NEXT_SHARE R(0.1)
#define LOG_NEXT_SHARE R(-2.3025850929940456840)

/* Logarithm of the volume of the unit ball, by Gamma(k + 1/2) = (2 k)! sqrt(pi) / (4^k k!). */
static real log_unit_ball(uint32_t dimensions) {
  const uint32_t k = (dimensions + 1u) / 2u;
  if ((dimensions & 1u) == 0u) {
    return (real)k * LOG_PI - starcat_log_factorial(k);
  }
  return (real)(k - 1u) * LOG_PI - starcat_log_factorial(2u * k) + starcat_log_factorial(k) +
         (real)(2u * k) * R(0.69314718055994530942);
}

/* Logarithm of the volume of a ball, by the square of its radius. */
real starcat_log_ball(uint32_t dimensions, real square) {
  return log_unit_ball(dimensions) +
         R(0.5) * (real)dimensions * STARCAT_LOG(starcat_larger(square, STARCAT_LEAST_SQUARE));
}

/* Logarithm of the expected number of chance agreements of n centroids, by the number of unknowns
 * in the fit, and the logarithm of the root of the determinant of their squared derivatives. */
static real log_expected(const starcat_call *call, uint32_t n, real square_px, real log_root,
                         uint32_t unknowns) {
  return starcat_log_ways(call, n) + call->log_attitudes + log_root +
         starcat_log_ball(2u * n - unknowns, square_px) - (real)n * call->camera.log_area;
}

/* Logarithm of the expected number of chance agreements of n centroids whose residuals are what noise
 * makes on average, and which are spread over the whole frame, by that of all ways and attitudes. */
static real log_typical(const starcat_call *call, uint32_t n, real log_all, real sigma_px) {
  const starcat_camera *c = &call->camera.given;
  const uint32_t left = 2u * n - 3u;
  const real square_of_frame = (c->width_px * c->width_px + c->height_px * c->height_px) / R(12.0);
  const real number = (real)n;
  return log_all + R(0.5) * STARCAT_LOG(number * number * number * square_of_frame) +
         R(2.0) * call->camera.log_focal + starcat_log_ball(left, (real)left * sigma_px * sigma_px) -
         number * call->camera.log_area;
}

/* Logarithm of the share of the probability that n of `most` stars are allotted where the noise
 * is stated: most to the number whose agreements are typically just certain, a tenth of it to the
 * next one, and so on. */
static real log_share(const starcat_call *call, uint32_t n, uint32_t most) {
  uint32_t typical = STARCAT_MIN_STARS;
  real total = R(0.0), share = R(1.0);
  while ((typical < most) &&
         (log_typical(call, typical, starcat_log_ways(call, typical) + call->log_attitudes,
                      call->noise_px) > STARCAT_LOG_CERTAIN)) {
    typical++;
  }
  for (uint32_t distance = 0; distance <= most - STARCAT_MIN_STARS; distance++) {
    total += share * (real)((uint32_t)(typical >= STARCAT_MIN_STARS + distance) +
                            (uint32_t)((distance > 0u) && (typical + distance <= most)));
    share *= NEXT_SHARE;
  }
  return (real)(n > typical ? n - typical : typical - n) * LOG_NEXT_SHARE - STARCAT_LOG(total);
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
 * the probability that its model has, after starcat_count_ways; 0 if the bound excludes nothing. If
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
  expected -= call->noise_px > R(0.0) ? log_share(call, n_matched, starcat_count_fewer(call))
                                      : -STARCAT_LOG((real)(call->own->count - 3u));
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
    if ((n >= STARCAT_MIN_STARS) && (log_typical(call, n, log_all, sigma_px) <= call->log_limit)) {
      return n;
    }
  }
  return most;
}
