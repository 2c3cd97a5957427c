/* The probability that chance agrees as well, and how much of the frame an attitude explains.
 * The same formulas as the ground's starcat/matcher/chance.py and spread.py, where they are
 * derived.
 *
 * SPDX-License-Identifier: MIT
 */
#include "internal.h"

#ifdef STARCAT_SINGLE
#define LEAST_SQUARE R(1e-12)
#else
#define LEAST_SQUARE R(1e-30)
#endif
#define LOG_NEARLY_CERTAIN R(-16.118095650958319) /* of 1e-7 */
#define LOG_PI R(1.1447298858494001741)
#define LOG_ALL_ATTITUDES R(4.3689013133786361) /* of 8 pi^2, the volume of the rotations */
#define NEXT_SHARE R(0.1)
#define LOG_NEXT_SHARE R(-2.3025850929940456840)

static real larger(real a, real b) { return a > b ? a : b; }

/* How places move as the camera turns, summed over the matched centroids: the determinant. */
static real information_of_places(const sc_call *call) {
  const starcat_workspace *w = call->work;
  real h[6] = {0};
  for (uint32_t i = 0; i < w->count; i++) {
    if (w->match[i] >= 0) {
      const real x = w->body[i][0] / w->body[i][2], y = w->body[i][1] / w->body[i][2];
      const real a = x * y, b = R(1.0) + x * x, c = R(1.0) + y * y;
      h[0] += a * a + c * c;
      h[1] -= a * (b + c);
      h[2] += a * y - c * x;
      h[3] += b * b + a * a;
      h[4] += a * x - b * y;
      h[5] += x * x + y * y;
    }
  }
  return h[0] * (h[3] * h[5] - h[4] * h[4]) + h[1] * (h[2] * h[4] - h[1] * h[5]) +
         h[2] * (h[1] * h[4] - h[2] * h[3]);
}

/* Logarithm of the volume of the unit ball in 2 n - 3 dimensions, where n is at least 2: by
 * Gamma(k + 1/2) = (2 k)! sqrt(pi) / (4^k k!) with k = n - 1. */
static real log_unit_ball(uint32_t n) {
  const uint32_t k = n - 1u;
  return (real)(k - 1u) * LOG_PI - sc_log_factorial(2u * k) + sc_log_factorial(k) +
         (real)(2u * k) * R(0.69314718055994530942);
}

/* Logarithm of the expected number of agreements of n centroids. */
static real log_expected(const sc_call *call, uint32_t n, real square_px, real log_information) {
  return sc_log_ways(call, n) + LOG_ALL_ATTITUDES + R(3.0) * call->camera.log_focal +
         R(0.5) * log_information + log_unit_ball(n) +
         R(0.5) * (real)(2u * n - 3u) * STARCAT_LOG(larger(square_px, LEAST_SQUARE)) -
         (real)n * call->camera.log_area;
}

/* Logarithm of the share of the probability that n of `most` stars are allotted where the noise
 * is stated: most to the number whose agreements are typically just certain, a tenth of it to the
 * next one, and so on. */
static real log_share(const sc_call *call, uint32_t n, uint32_t most) {
  const starcat_camera *c = &call->camera.given;
  const real log_spread = STARCAT_LOG((c->width_px * c->width_px + c->height_px * c->height_px) /
                                      (R(12.0) * c->focal_length_px * c->focal_length_px));
  const real square_px = call->noise_px * call->noise_px;
  uint32_t typical = SC_MIN_STARS;
  real total = R(0.0), share = R(1.0);
  while ((typical < most) &&
         (log_expected(call, typical, (real)(2u * typical - 3u) * square_px,
                       R(3.0) * STARCAT_LOG((real)typical) + log_spread) > LOG_NEARLY_CERTAIN)) {
    typical++;
  }
  for (uint32_t distance = 0; distance <= most - SC_MIN_STARS; distance++) {
    total += share * (real)((uint32_t)(typical >= SC_MIN_STARS + distance) +
                            (uint32_t)((distance > 0u) && (typical + distance <= most)));
    share *= NEXT_SHARE;
  }
  return (real)(n > typical ? n - typical : typical - n) * LOG_NEXT_SHARE - STARCAT_LOG(total);
}

/* Logarithm of the bound; 0 if it says nothing. */
real sc_log_chance(const sc_call *call, real square_px, uint32_t n_matched) {
  const starcat_workspace *w = call->work;
  const uint32_t fewer = w->count < w->n_within ? w->count : w->n_within;
  const int is_stated = call->noise_px > R(0.0);
  const real information = information_of_places(call);
  if (!(information > R(0.0))) {
    return R(0.0);
  }
  sc_count_ways(call, is_stated ? fewer : n_matched);
  const real expected = log_expected(call, n_matched, square_px, STARCAT_LOG(information)) -
                        (is_stated ? log_share(call, n_matched, fewer)
                                   : -STARCAT_LOG((real)(w->count - 3u)));
  return expected < R(0.0) ? expected : R(0.0);
}

/* Add the information that a direction gives about an attitude (Shuster and Oh 1981). */
static void inform(real h[6], const real b[3]) {
  h[0] += R(1.0) - b[0] * b[0];
  h[1] -= b[0] * b[1];
  h[2] -= b[0] * b[2];
  h[3] += R(1.0) - b[1] * b[1];
  h[4] -= b[1] * b[2];
  h[5] += R(1.0) - b[2] * b[2];
}

/* Three over the trace of the product of two symmetric matrices. */
static real share_of(const real c[6], const real h[6]) {
  return R(3.0) / (c[0] * h[0] + c[3] * h[3] + c[5] * h[5] +
                   R(2.0) * (c[1] * h[1] + c[2] * h[2] + c[4] * h[4]));
}

/* Error of the worst corner, in units of the error of a direction along one axis. */
static real corner_deviation(const real c[6], const sc_camera *camera) {
  real worst = R(0.0);
  for (uint32_t n = 0; n < 4u; n++) {
    const real *b = camera->corner[n];
    const real along = c[0] * b[0] * b[0] + c[3] * b[1] * b[1] + c[5] * b[2] * b[2] +
                       R(2.0) * (c[1] * b[0] * b[1] + c[2] * b[0] * b[2] + c[4] * b[1] * b[2]);
    worst = larger(worst, c[0] + c[3] + c[5] - along);
  }
  return STARCAT_SQRT(worst);
}

/* Share of the frame that an attitude explains, by weight; 0 if it determines no attitude. */
real sc_share(const sc_call *call, const real m[9], real residual_rad, uint32_t n_matched) {
  const starcat_workspace *w = call->work;
  real matched[6] = {0}, centroids[6] = {0}, stars[6] = {0}, covariance[6], unused[3];
  for (uint32_t i = 0; i < w->count; i++) {
    inform(centroids, w->body[i]);
    if (w->match[i] >= 0) {
      inform(matched, w->body[i]);
    }
  }
  for (uint32_t j = 0; j < w->n_within; j++) {
    real body[3];
    sc_turn(m, w->near_icrs[w->within[j]], body);
    inform(stars, body);
  }
  if (!sc_solve(matched, call->camera.corner[0], unused, covariance)) {
    return R(0.0);
  }
  const real of_stars = share_of(covariance, stars);
  const real of_centroids = share_of(covariance, centroids);
  if (of_centroids <= of_stars) {
    return of_stars;
  }
  /* Three of the 2 n components went into the attitude. */
  const real deviation =
      residual_rad * STARCAT_SQRT((real)n_matched / (real)(2u * n_matched - 3u));
  const real corner = deviation * corner_deviation(covariance, &call->camera);
  return corner > call->tolerance_rad ? of_stars : of_centroids;
}

/* Whether the frame differs in scale from the stars that it matches: a wrong focal length. */
int sc_is_scaled(const sc_call *call, uint32_t n_matched) {
  const starcat_workspace *w = call->work;
  const real n = (real)n_matched;
  real mean_x = R(0.0), mean_y = R(0.0), off_x = R(0.0), off_y = R(0.0);
  real extent = R(0.0), product = R(0.0), left = R(0.0);
  for (uint32_t i = 0; i < w->count; i++) {
    if (w->match[i] >= 0) {
      const uint32_t j = (uint32_t)w->match[i];
      mean_x += w->x_of[j] / n;
      mean_y += w->y_of[j] / n;
      off_x += (w->x[i] - w->x_of[j]) / n;
      off_y += (w->y[i] - w->y_of[j]) / n;
    }
  }
  for (uint32_t i = 0; i < w->count; i++) {
    if (w->match[i] >= 0) {
      const uint32_t j = (uint32_t)w->match[i];
      const real x = w->x_of[j] - mean_x, y = w->y_of[j] - mean_y;
      extent += x * x + y * y;
      product += x * (w->x[i] - w->x_of[j]) + y * (w->y[i] - w->y_of[j]);
    }
  }
  const real excess = product / extent;
  const real corner_px =
      STARCAT_SQRT(call->camera.half_width * call->camera.half_width +
                   call->camera.half_height * call->camera.half_height);
  const real moved = excess < R(0.0) ? -excess * corner_px : excess * corner_px;
  if (!(moved > call->tolerance_px)) {
    return 0;
  }
  for (uint32_t i = 0; i < w->count; i++) {
    if (w->match[i] >= 0) {
      const uint32_t j = (uint32_t)w->match[i];
      const real x = w->x[i] - w->x_of[j] - off_x - excess * (w->x_of[j] - mean_x);
      const real y = w->y[i] - w->y_of[j] - off_y - excess * (w->y_of[j] - mean_y);
      left += x * x + y * y;
    }
  }
  const real variance = left / (R(2.0) * n - R(4.0)) / extent;
  return excess * excess > SC_SCALE_DEVIATIONS * SC_SCALE_DEVIATIONS * variance;
}
