/* The probability that chance agrees as well, and the share of the frame that an attitude
 * explains. The same formulas as in the ground's starcat/matcher/chance.py and spread.py, which
 * derive them.
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
#define LOG_ALL_ATTITUDES R(4.3689013133786361) /* log of 8 pi^2, the volume of all rotations */
#define LEAST_EXTENT R(1e-6)                    /* extent of stars on the detector, square pixels */
#define LOG_SHAPE_CHANCE R(-5.8091429903140281) /* of 3e-3 */
#define LEAST_BREADTH R(1e-4) /* least determinant of xx, xy, yy for a test of the shape */
#define NEXT_SHARE R(0.1)
#define LOG_NEXT_SHARE R(-2.3025850929940456840)

/* Sums over the matched centroids: of products of their stars' places x, y and their offsets. */
typedef struct {
  real xx, xy, yy, x_dx, y_dx, x_dy, y_dy, left;
} moments;

/* Motion of positions as the camera rotates, summed over the matched centroids: its determinant,
 * and the ratio of the determinant with the focal length as a fourth unknown to it. */
static real information_of_places(const starcat_call *call, real *of_scale) {
  const starcat_workspace *w = call->work;
  real h[6] = {0}, cross[3] = {0}, along = R(0.0), unused[6], share[3];
  for (uint32_t i = 0; i < call->own->count; i++) {
    if (w->match[i] >= 0) {
      const real *body = call->body[i];
      const real x = body[0] / body[2], y = body[1] / body[2];
      const real a = x * y, b = R(1.0) + x * x, c = R(1.0) + y * y;
      h[0] += a * a + c * c;
      h[1] -= a * (b + c);
      h[2] += a * y - c * x;
      h[3] += b * b + a * a;
      h[4] += a * x - b * y;
      h[5] += x * x + y * y;
      along += x * x + y * y;
      cross[0] += y * (b + y * y);
      cross[1] -= x * (b + y * y);
    }
  }
  *of_scale =
      starcat_solve_symmetric(h, cross, share, unused) ? along - starcat_dot(cross, share) : R(0.0);
  return h[0] * (h[3] * h[5] - h[4] * h[4]) + h[1] * (h[2] * h[4] - h[1] * h[5]) +
         h[2] * (h[1] * h[4] - h[2] * h[3]);
}

/* Logarithm of the volume of the unit ball in 2 n - 3 dimensions, where n is at least 2, by
 * Gamma(k + 1/2) = (2 k)! sqrt(pi) / (4^k k!) with k = n - 1; or in 2 n - 4 dimensions. */
static real log_unit_ball(uint32_t n, uint32_t unknowns) {
  const uint32_t k = n - 1u;
  if (unknowns > 3u) {
    return (real)(n - 2u) * LOG_PI - starcat_log_factorial(n - 2u);
  }
  return (real)(k - 1u) * LOG_PI - starcat_log_factorial(2u * k) + starcat_log_factorial(k) +
         (real)(2u * k) * R(0.69314718055994530942);
}

/* Logarithm of the expected number of chance agreements of n centroids, by the number of unknowns
 * in the fit: three angles, and the focal length. */
static real log_expected(const starcat_call *call, uint32_t n, real square_px, real log_information,
                         uint32_t unknowns) {
  return starcat_log_ways(call, n) + LOG_ALL_ATTITUDES + (real)unknowns * call->camera.log_focal +
         R(0.5) * log_information + log_unit_ball(n, unknowns) +
         R(0.5) * (real)(2u * n - unknowns) * STARCAT_LOG(starcat_larger(square_px, LEAST_SQUARE)) -
         (real)n * call->camera.log_area;
}

/* Logarithm of the share of the probability that n of `most` stars are allotted where the noise
 * is stated: most to the number whose agreements are typically just certain, a tenth of it to the
 * next one, and so on. */
static real log_share(const starcat_call *call, uint32_t n, uint32_t most) {
  const starcat_camera *c = &call->camera.given;
  const real log_spread = STARCAT_LOG((c->width_px * c->width_px + c->height_px * c->height_px) /
                                      (R(12.0) * c->focal_length_px * c->focal_length_px));
  const real square_px = call->noise_px * call->noise_px;
  uint32_t typical = STARCAT_MIN_STARS;
  real total = R(0.0), share = R(1.0);
  while ((typical < most) &&
         (log_expected(call, typical, (real)(2u * typical - 3u) * square_px,
                       R(3.0) * STARCAT_LOG((real)typical) + log_spread, 3) > LOG_NEARLY_CERTAIN)) {
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

/* Logarithm of the bound; 0 if the bound excludes nothing. */
real starcat_log_chance(const starcat_call *call, real square_px, uint32_t n_matched) {
  const uint32_t fewer =
      call->own->count < call->own->n_within ? call->own->count : call->own->n_within;
  const int is_stated = call->noise_px > R(0.0);
  real of_scale;
  const real information = information_of_places(call, &of_scale);
  if (!(information > R(0.0))) {
    return R(0.0);
  }
  starcat_count_ways(call, is_stated ? fewer : n_matched);
  real expected = log_expected(call, n_matched, square_px, STARCAT_LOG(information), 3);
  if ((call->log_scales > R(0.0)) && (of_scale > R(0.0))) {
    expected = log_of_sum(
        expected,
        STARCAT_LOG(call->log_scales) +
            log_expected(call, n_matched, square_px,
                         STARCAT_LOG(starcat_larger(information * of_scale, STARCAT_LEAST_NUMBER)),
                         4));
  }
  expected -=
      is_stated ? log_share(call, n_matched, fewer) : -STARCAT_LOG((real)(call->own->count - 3u));
  return expected < R(0.0) ? expected : R(0.0);
}

/* Add the information that a direction gives about an attitude (Shuster and Oh 1981) and about the
 * focal length. */
void starcat_add_information(starcat_information *h, const real b[3]) {
  const real square = b[2] * b[2];
  h->angles[0] += R(1.0) - b[0] * b[0];
  h->angles[1] -= b[0] * b[1];
  h->angles[2] -= b[0] * b[2];
  h->angles[3] += R(1.0) - b[1] * b[1];
  h->angles[4] -= b[1] * b[2];
  h->angles[5] += R(1.0) - square;
  h->with_scale[0] -= b[1] * b[2];
  h->with_scale[1] += b[0] * b[2];
  h->scale += square * (R(1.0) - square);
}

/* Trace of the product of two matrices. */
static real trace(const starcat_information *a, const starcat_information *b) {
  const real *c = a->angles, *h = b->angles;
  return c[0] * h[0] + c[3] * h[3] + c[5] * h[5] +
         R(2.0) *
             (c[1] * h[1] + c[2] * h[2] + c[4] * h[4] + starcat_dot(a->with_scale, b->with_scale)) +
         a->scale * b->scale;
}

/* Error of the worst corner, in units of the error of a direction along one axis. */
static real corner_deviation(const starcat_information *covariance, const starcat_optics *camera) {
  real worst = R(0.0);
  for (uint32_t n = 0; n < 4u; n++) {
    starcat_information h = {{0}, {0}, R(0.0)};
    starcat_add_information(&h, camera->corner[n]);
    worst = starcat_larger(worst, trace(covariance, &h));
  }
  return STARCAT_SQRT(worst);
}

/* The covariance without the focal length. Returns 0 if it determines no attitude. */
static int invert_angles(const starcat_information *matched, starcat_information *covariance) {
  const starcat_information none = {{0}, {0}, R(0.0)};
  real unused[3];
  *covariance = none;
  return starcat_solve_symmetric(matched->angles, matched->with_scale, unused, covariance->angles);
}

/* Weigh an agreement: the share of the frame that it explains, 0 if it determines no attitude; and
 * whether its stars determine the whole frame, even if the focal length is not trusted. */
void starcat_weigh_agreement(const starcat_call *call, const real m[9], real tolerance_rad,
                             starcat_agreement *found) {
  const starcat_workspace *w = call->work;
  const real n = (real)found->n_matched;
  starcat_information matched = {{0}, {0}, R(0.0)}, centroids = matched, stars = matched;
  starcat_information own, with_scale;
  const int has_scale = call->fov_error > R(0.0);
  for (uint32_t i = 0; i < call->own->count; i++) {
    starcat_add_information(&centroids, call->body[i]);
    if (w->match[i] >= 0) {
      starcat_add_information(&matched, call->body[i]);
    }
  }
  const int is_whole = starcat_invert_information(&matched, &with_scale);
  real corner = R(0.0);
  found->is_firm = 0;
  if (is_whole != 0) {
    corner = found->residual_rad * STARCAT_SQRT(n / (R(2.0) * n - R(4.0))) *
             corner_deviation(&with_scale, &call->camera);
    found->is_firm = corner <= (has_scale ? R(2.0) : R(1.0)) * STARCAT_SURE_CORNER * tolerance_rad;
  }
  if (found->n_matched >= call->own->n_within) {
    return;
  }
  found->share = R(0.0);
  if (has_scale ? !is_whole : !invert_angles(&matched, &own)) {
    return;
  }
  for (uint32_t j = 0; j < call->own->n_within; j++) {
    real body[3];
    starcat_turn(m, w->near_icrs[starcat_find_near(w, j)], body);
    starcat_add_information(&stars, body);
  }
  const starcat_information *covariance = has_scale ? &with_scale : &own;
  const real unknowns = has_scale ? R(4.0) : R(3.0);
  const real of_centroids = unknowns / trace(covariance, &centroids);
  found->share = unknowns / trace(covariance, &stars);
  if (of_centroids > found->share) {
    if (!has_scale) {
      corner = found->residual_rad * STARCAT_SQRT(n / (R(2.0) * n - R(3.0))) *
               corner_deviation(covariance, &call->camera);
    }
    if (!(corner > call->tolerance_rad)) {
      found->share = of_centroids;
    }
  }
}

/* Add a matched centroid to the moments of the frame's shape: the position of its star, from the
 * mean position, and its offset from the star, from the mean offset. */
static void add_moments(moments *of, real x, real y, real dx, real dy) {
  of->xx += x * x;
  of->xy += x * y;
  of->yy += y * y;
  of->x_dx += x * dx;
  of->y_dx += y * dx;
  of->x_dy += x * dy;
  of->y_dy += y * dy;
  of->left += dx * dx + dy * dy;
}

/* Whether the offsets show another shape: pixels that are not square, or axes that are not at right
 * angles. A linear map must move the corners by two tolerances, without its rotation and scale, and
 * must leave smaller residuals than noise would with a probability of 3e-3. */
static int has_other_shape(const moments *of, real n, real corner_px, real tolerance_px) {
  const real extent = of->xx + of->yy;
  const real determinant = of->xx * of->yy - of->xy * of->xy;
  if (!(determinant > LEAST_BREADTH * extent * extent)) {
    return 0;
  }
  const real a = (of->yy * of->x_dx - of->xy * of->y_dx) / determinant;
  const real b = (of->xx * of->y_dx - of->xy * of->x_dx) / determinant;
  const real c = (of->yy * of->x_dy - of->xy * of->y_dy) / determinant;
  const real d = (of->xx * of->y_dy - of->xy * of->x_dy) / determinant;
  const real bent = corner_px * corner_px * ((a - d) * (a - d) + (b + c) * (b + c));
  if (!(bent > R(16.0) * tolerance_px * tolerance_px)) {
    return 0;
  }
  const real scale = of->x_dx + of->y_dy, turn = of->x_dy - of->y_dx;
  const real of_similar = of->left - (scale * scale + turn * turn) / extent;
  const real of_linear = of->left - (a * of->x_dx + b * of->y_dx + c * of->x_dy + d * of->y_dy);
  const real ratio = starcat_larger(of_linear / of_similar, STARCAT_LEAST_WEIGHT);
  return (n - R(3.0)) * STARCAT_LOG(ratio) < LOG_SHAPE_CHANCE;
}

/* Whether the scale of the frame differs from its stars, which means a wrong focal length; or its
 * shape, which is tested if the stars explain only a part of the frame. */
int starcat_is_deformed(const starcat_call *call, uint32_t n_matched, real tolerance_px,
                        int is_partial) {
  const starcat_workspace *w = call->work;
  const real n = (real)n_matched;
  real mean_x = R(0.0), mean_y = R(0.0), off_x = R(0.0), off_y = R(0.0);
  moments of = {0};
  for (uint32_t i = 0; i < call->own->count; i++) {
    if (w->match[i] >= 0) {
      const uint32_t j = starcat_find_match(w, i);
      mean_x += w->x_of[j] / n;
      mean_y += w->y_of[j] / n;
      off_x += (w->x[i] - w->x_of[j]) / n;
      off_y += (w->y[i] - w->y_of[j]) / n;
    }
  }
  for (uint32_t i = 0; i < call->own->count; i++) {
    if (w->match[i] >= 0) {
      const uint32_t j = starcat_find_match(w, i);
      add_moments(&of, w->x_of[j] - mean_x, w->y_of[j] - mean_y, w->x[i] - w->x_of[j] - off_x,
                  w->y[i] - w->y_of[j] - off_y);
    }
  }
  const real extent = starcat_larger(of.xx + of.yy, LEAST_EXTENT);
  const real excess = (of.x_dx + of.y_dy) / extent;
  const real corner_px = STARCAT_SQRT(call->camera.half_width * call->camera.half_width +
                                      call->camera.half_height * call->camera.half_height);
  const real moved = excess < R(0.0) ? -excess * corner_px : excess * corner_px;
  const real variance = (of.left - excess * excess * extent) / (R(2.0) * n - R(4.0)) / extent;
  if ((moved > tolerance_px) &&
      (excess * excess > STARCAT_SCALE_DEVIATIONS * STARCAT_SCALE_DEVIATIONS * variance)) {
    return 1;
  }
  return (is_partial != 0) && (has_other_shape(&of, n, corner_px, tolerance_px) != 0);
}
