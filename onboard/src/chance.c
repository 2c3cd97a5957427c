/* The probability that chance agrees as well, and how much of the frame an attitude explains.
 * The same formulas as the ground's starcat/matcher/chance.py and spread.py, where they are
 * derived.
 *
 * SPDX-License-Identifier: MIT
 */
#include "internal.h"

#ifdef STARCAT_SINGLE
#define LARGE R(1e24)
#define LEAST_SQUARE R(1e-12)
#else
#define LARGE R(1e200)
#define LEAST_SQUARE R(1e-30)
#endif

static real larger(real a, real b) { return a > b ? a : b; }

/* A product whose logarithm is taken when it gets too large or too small for a number. */
typedef struct {
  real product, logarithm;
} long_product;

static void times(long_product *p, real factor) {
  p->product *= factor;
  if ((p->product > LARGE) || (p->product < R(1.0) / LARGE)) {
    p->logarithm += STARCAT_LOG(p->product);
    p->product = R(1.0);
  }
}

static real logarithm_of(const long_product *p) { return p->logarithm + STARCAT_LOG(p->product); }

/* Logarithm of the elementary symmetric polynomial of degree n of `count` numbers, the largest of
 * which is `most`: a bound of the ways to choose n of them and a partner for each. */
static real log_symmetric(const uint16_t *numbers, uint32_t count, uint32_t n, uint16_t most) {
  real sums[STARCAT_MAX_CENTROIDS + 1];
  long_product p = {R(1.0), R(0.0)};
  sums[0] = R(1.0);
  for (uint32_t k = 1; k <= n; k++) {
    sums[k] = R(0.0);
  }
  for (uint32_t i = 0; i < count; i++) {
    const real share = (real)numbers[i] / (real)most;
    for (uint32_t k = n; k > 0u; k--) {
      sums[k] += share * sums[k - 1u];
    }
  }
  for (uint32_t k = 0; k < n; k++) {
    times(&p, (real)most);
  }
  times(&p, sums[n]);
  return logarithm_of(&p);
}

/* Logarithm of a bound of the ways to assign n of the centroids to n stars of like magnitude. */
static real log_compatible_ways(const sc_call *call, uint32_t n) {
  starcat_workspace *w = call->work;
  uint16_t of_centroid[STARCAT_MAX_CENTROIDS];
  uint16_t *of_star = w->nearest; /* free here */
  uint16_t most_stars = 1, most_centroids = 1;
  for (uint32_t j = 0; j < w->n_within; j++) {
    of_star[j] = 0;
  }
  for (uint32_t i = 0; i < w->count; i++) {
    of_centroid[i] = 0;
    for (uint32_t j = 0; j < w->n_within; j++) {
      if (sc_compatible(call, i, w->near_row[w->within[j]])) {
        of_centroid[i]++;
        of_star[j]++;
        most_centroids = of_star[j] > most_centroids ? of_star[j] : most_centroids;
      }
    }
    most_stars = of_centroid[i] > most_stars ? of_centroid[i] : most_stars;
  }
  const real a = log_symmetric(of_centroid, w->count, n, most_stars);
  const real b = log_symmetric(of_star, w->n_within, n, most_centroids);
  return a < b ? a : b;
}

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

/* Logarithm of the bound; 0 if it says nothing. */
real sc_log_chance(const sc_call *call, real square_px, uint32_t n_matched, uint32_t n_within) {
  const uint32_t n = n_matched, count = call->work->count;
  const uint32_t stars = n_within > n ? n_within : n;
  const real information = information_of_places(call);
  long_product ways = {R(1.0), R(0.0)}, rest = {R(1.0), R(0.0)};
  if (!(information > R(0.0))) {
    return R(0.0);
  }
  times(&rest, R(8.0) * SC_PI * SC_PI * STARCAT_SQRT(information));
  times(&rest, count > 4u ? (real)(count - 3u) : R(1.0));
  /* The volume of the unit ball in 2 n - 3 dimensions: of 1 it is 2, of k 2 pi / k that of k - 2. */
  times(&rest, R(2.0));
  for (uint32_t k = 0; k < n; k++) {
    times(&ways, (real)(count - k) * (real)(stars - k) / (real)(k + 1u));
    if (k >= 2u) {
      times(&rest, R(2.0) * SC_PI / (real)(2u * k - 1u));
    }
  }
  real log_ways = logarithm_of(&ways);
  if (call->mag_reach > R(0.0)) {
    const real compatible = log_compatible_ways(call, n);
    log_ways = compatible < log_ways ? compatible : log_ways;
  }
  const real log_ball = R(0.5) * (real)(2u * n - 3u) * STARCAT_LOG(larger(square_px, LEAST_SQUARE));
  const real expected = log_ways + logarithm_of(&rest) + R(3.0) * call->camera.log_focal +
                        log_ball - (real)n * call->camera.log_area;
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
