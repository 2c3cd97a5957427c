/* How well an attitude is known: its covariance, the reduced chi-square, and weights.
 *
 * SPDX-License-Identifier: MIT
 */
#include <string.h>

#include "internal.h"
#include "traps.h"
#include "unit.h"

#define NOISE_PX 0.2
#define FRAMES 400u

static sky_frame truth;

static starcat_status identify(const unit_sky *sky, const starcat_real *sigma_px) {
  const starcat_frame frame = {truth.count, truth.x, truth.y, truth.magnitudes, sigma_px};
  return starcat_identify_frame(&sky->image, &sky->camera, &sky->options, &frame, &unit_work,
                                &unit_result);
}

/* The square of the error of an attitude in its covariance: 3 on average. */
static double deviation(void) {
  const starcat_real *c = unit_result.covariance_rad2;
  const starcat_real unit = (starcat_real)1e6; /* of a square milliradian */
  const starcat_real h[6] = {unit * c[0], unit * c[1], unit * c[2],
                             unit * c[4], unit * c[5], unit * c[8]};
  starcat_real e[3], x[3], inverse[6], turn[9];
  for (uint32_t k = 0; k < 9u; k++) {
    turn[k] = (starcat_real)0.0;
    for (uint32_t n = 0; n < 3u; n++) {
      turn[k] +=
          unit_result.matrix[3u * (k / 3u) + n] * (starcat_real)truth.matrix[3u * (k % 3u) + n];
    }
  }
  e[0] = turn[7];
  e[1] = turn[2];
  e[2] = turn[3];
  CHECK(starcat_solve_symmetric(h, e, x, inverse));
  return (double)(unit * starcat_dot(e, x));
}

/* Means over many frames whose centroids have noises that differ by up to eight times. */
static void check_means(unit_sky *sky, int is_weighted, double *square, double *chi_square) {
  uint64_t state = 51;
  uint32_t found = 0;
  *square = *chi_square = 0.0;
  for (uint32_t n = 0; n < FRAMES; n++) {
    starcat_real sigma_px[STARCAT_MAX_CENTROIDS];
    sky_look(&sky->image, &sky->camera, &state, is_weighted ? 0.0 : NOISE_PX, SKY_SPOTS, 0, &truth);
    for (uint32_t i = 0; i < truth.count; i++) {
      sigma_px[i] = (starcat_real)(0.05 * (double)(1u << i % 4u));
      if (is_weighted) {
        truth.x[i] += sigma_px[i] * (starcat_real)sky_normal(&state);
        truth.y[i] += sigma_px[i] * (starcat_real)sky_normal(&state);
      }
    }
    if (identify(sky, is_weighted ? sigma_px : NULL) == STARCAT_IDENTIFIED) {
      *square += deviation();
      *chi_square += (double)unit_result.reduced_chi_square;
      found++;
    }
  }
  CHECK(found > FRAMES * 9u / 10u);
  *square /= (double)found;
  *chi_square /= (double)found;
}

/* Noises that are not known, that cannot be, and the covariance of the residuals. */
static void check_unknown(unit_sky *sky) {
  uint64_t state = 52;
  starcat_real sigma_px[STARCAT_MAX_CENTROIDS], q[4];
  sky_look(&sky->image, &sky->camera, &state, NOISE_PX, SKY_SPOTS, 0, &truth);
  CHECK_IS(identify(sky, NULL), STARCAT_IDENTIFIED);
  CHECK(unit_result.reduced_chi_square == (starcat_real)0.0);
  CHECK(deviation() < 30.0);
  memcpy(q, unit_result.q_body_from_icrs, sizeof q);
  for (uint32_t i = 0; i < truth.count; i++) {
    sigma_px[i] = (starcat_real)(i % 2u == 0u ? NAN : INFINITY);
  }
  CHECK_IS(identify(sky, sigma_px), STARCAT_IDENTIFIED);
  CHECK(unit_result.reduced_chi_square == (starcat_real)0.0);
  for (uint32_t k = 0; k < 4u; k++) {
    const double apart = (double)(q[k] - unit_result.q_body_from_icrs[k]);
    CHECK((apart < 1e-5) && (apart > -1e-5));
  }
  sigma_px[0] = (starcat_real)0.1; /* one that is known leaves no degree of freedom */
  CHECK_IS(identify(sky, sigma_px), STARCAT_IDENTIFIED);
  CHECK(unit_result.reduced_chi_square == (starcat_real)0.0);
  sigma_px[1] = (starcat_real)0.0;
  CHECK_IS(identify(sky, sigma_px), STARCAT_E_OPTIONS);
}

/* Noise that is not stated is taken from the residuals, widened by Student's t as tables give it
 * for 5 and for 13 degrees of freedom. */
static void check_widened(unit_sky *sky) {
  static const struct {
    uint32_t spots;
    double widening;
  } cases[] = {{4, 1.836}, {8, 1.214}};
  uint64_t state = 53;
  for (uint32_t n = 0; n < 2u; n++) {
    sky->options.noise_px = (starcat_real)NOISE_PX;
    do {
      sky_look(&sky->image, &sky->camera, &state, NOISE_PX, SKY_SPOTS, 0, &truth);
      truth.count = cases[n].spots;
    } while ((identify(sky, NULL) != STARCAT_IDENTIFIED) ||
             (unit_result.n_matched != cases[n].spots));
    const double stated = (double)unit_result.covariance_rad2[0];
    const double square = (double)unit_result.reduced_chi_square;
    sky->options.noise_px = (starcat_real)0.0;
    CHECK_IS(identify(sky, NULL), STARCAT_IDENTIFIED);
    CHECK_IS(unit_result.n_matched, cases[n].spots);
    const double ratio = (double)unit_result.covariance_rad2[0] / stated;
    const double expected = square * cases[n].widening * cases[n].widening;
    CHECK((ratio > 0.96 * expected) && (ratio < 1.04 * expected));
  }
}

/* Residuals that the stated noise does not explain are in the covariance: their excess as it is, not
 * divided by the number of stars. With the noise that they have, the covariance is that of the noise. */
static void check_excess(const unit_sky *sky) {
  static const double noises_px[2] = {0.7, 0.4};
  const double focal_px = (double)sky->camera.focal_length_px;
  uint64_t state = 54;
  uint32_t compared = 0;
  for (uint32_t n = 0; n < 40u; n++) {
    double covariance[2][9] = {{0}, {0}}, chi_square[2] = {0};
    uint32_t plain = 0;
    sky_look(&sky->image, &sky->camera, &state, noises_px[0], SKY_SPOTS, 0, &truth);
    for (uint32_t of = 0; of < 2u; of++) {
      starcat_real sigma_px[STARCAT_MAX_CENTROIDS];
      for (uint32_t i = 0; i < truth.count; i++) {
        sigma_px[i] = (starcat_real)noises_px[of];
      }
      plain += (uint32_t)((identify(sky, sigma_px) == STARCAT_IDENTIFIED) &&
                          (unit_result.n_shape == 0u));
      chi_square[of] = (double)unit_result.reduced_chi_square;
      for (uint32_t k = 0; k < 9u; k++) {
        covariance[of][k] = (double)unit_result.covariance_rad2[k];
      }
    }
    if (plain < 2u) {
      continue; /* a shape was fitted */
    }
    const double least = 1.0 + 3.0 * sqrt(2.0 / (2.0 * (double)unit_result.n_matched - 3.0));
    if ((chi_square[0] > least) || (chi_square[1] < least)) {
      continue; /* chance made the residuals large or small */
    }
    compared++;
    const double excess = noises_px[1] * noises_px[1] * (chi_square[1] - 1.0);
    for (uint32_t k = 0; k < 9u; k++) {
      const double added = k == 8u        ? 12.0 * excess / (2.0 * 512.0 * 512.0)
                           : k % 4u == 0u ? excess / (focal_px * focal_px)
                                          : 0.0;
      const double of_noise = covariance[0][k] * (0.4 * 0.4) / (0.7 * 0.7);
      CHECK_NEAR((covariance[1][k] - of_noise - added) / covariance[1][4u * (k / 4u)], 0.0,
                 IF_SINGLE(1e-3, 1e-9));
    }
  }
  CHECK(compared >= 20u);
}

/* Stars at one place determine no attitude. */
static void check_one_place(const unit_sky *sky) {
  const starcat_frame frame = {truth.count, truth.x, truth.y, truth.magnitudes, NULL};
  static const starcat_real axis[2][3] = {{0, 0, 1}, {1, 0, 0}};
  starcat_real star[3], other[3], normal[3];
  starcat_call call;
  CHECK_IS(identify(sky, NULL), STARCAT_IDENTIFIED);
  const starcat_agreement best = unit_work.best;
  CHECK_IS(starcat_begin_call(&call, &sky->image, &sky->camera, &sky->options, &frame, &unit_work,
                              &unit_result),
           STARCAT_OK);
  unit_work.best = best;
  for (uint32_t i = 0; i < call.own->count; i++) {
    unit_work.x[i] = call.camera.half_width;
    unit_work.y[i] = call.camera.half_height;
    unit_work.best.star[i] = 0;
  }
  starcat_read_star(&sky->image, 0, star);
  starcat_read_star(&sky->image, 1, other);
  starcat_cross(star, other, normal);
  const starcat_real length = STARCAT_SQRT(starcat_dot(normal, normal));
  for (uint32_t k = 0; k < 3u; k++) {
    normal[k] /= length;
  }
  CHECK(starcat_fit_triad(axis[0], axis[1], star, normal, unit_work.best.matrix));
  CHECK_IS(starcat_end_call(&call, &sky->options, &unit_result), STARCAT_IDENTIFIED);
  CHECK(unit_result.covariance_rad2[0] == (starcat_real)0.0);
  unit_work.best.free = 2; /* nor with a shape, whose terms are 0 */
  memset(unit_work.best.terms, 0, sizeof unit_work.best.terms);
  memset(unit_result.covariance_rad2, 0, sizeof unit_result.covariance_rad2);
  CHECK_IS(starcat_end_call(&call, &sky->options, &unit_result), STARCAT_IDENTIFIED);
  CHECK(unit_result.covariance_rad2[0] == (starcat_real)0.0);
}

/* A shape that a flipped bit has changed; and six terms of four stars, which leave no degree of
 * freedom. */
static void check_changed_shape(const unit_sky *sky) {
  const starcat_frame frame = {truth.count, truth.x, truth.y, truth.magnitudes, NULL};
  starcat_call call;
  CHECK_IS(identify(sky, NULL), STARCAT_IDENTIFIED);
  starcat_agreement best = unit_work.best;
  uint32_t kept = 0;
  for (uint32_t n = 0; n < 2u; n++) {
    CHECK_IS(starcat_begin_call(&call, &sky->image, &sky->camera, &sky->options, &frame, &unit_work,
                                &unit_result),
             STARCAT_OK);
    best.free = STARCAT_SHAPE_TERMS;
    memset(best.terms, 0, sizeof best.terms);
    best.terms[0] = (starcat_real)(n == 0u ? -1e7 : 0.0);
    for (uint32_t k = 0; (n == 1u) && (k < truth.count); k++) {
      kept += best.star[k] >= 0 ? 1u : 0u;
      best.star[k] = kept > STARCAT_MIN_STARS ? STARCAT_NO_STAR : best.star[k];
    }
    unit_work.best = best;
    CHECK_IS(starcat_end_call(&call, &sky->options, &unit_result),
             n == 0u ? STARCAT_NO_MATCH : STARCAT_IDENTIFIED);
  }
  CHECK(unit_result.covariance_rad2[0] > (starcat_real)0.0);
  CHECK_IS(starcat_begin_call(&call, &sky->image, &sky->camera, &sky->options, &frame, &unit_work,
                              &unit_result),
           STARCAT_OK);
  unit_work.best = best;
  unit_work.best.free = 0x40000000u; /* more terms than there are: none */
  CHECK_IS(starcat_end_call(&call, &sky->options, &unit_result), STARCAT_IDENTIFIED);
  CHECK_IS(unit_result.n_shape, 0);
}

/* An agreement that a flipped bit has changed since it was verified: its attitude, its bound or its
 * stars. */
static void check_changed(const unit_sky *sky) {
  static const starcat_real other = (starcat_real)-1.0;
  const starcat_frame frame = {truth.count, truth.x, truth.y, truth.magnitudes, NULL};
  starcat_call call;
  CHECK_IS(identify(sky, NULL), STARCAT_IDENTIFIED);
  const starcat_agreement best = unit_work.best;
  for (uint32_t n = 0; n < 7u; n++) {
    CHECK_IS(starcat_begin_call(&call, &sky->image, &sky->camera, &sky->options, &frame, &unit_work,
                                &unit_result),
             STARCAT_OK);
    unit_work.best = best;
    unit_work.best.log_chance -= (starcat_real)(n == 6u ? 1.0 : 0.0); /* less than its bound */
    for (uint32_t k = 0; k < 6u; k++) {                               /* turned by a half */
      unit_work.best.matrix[k] *= n == 1u ? other : (starcat_real)1.0;
    }
    unit_work.best.log_bound = n == 2u ? (starcat_real)0.0 : best.log_bound;
    for (uint32_t k = 0; k < STARCAT_MAX_CENTROIDS; k++) {
      unit_work.best.star[k] = n == 3u ? -1 : best.star[k];
      unit_work.best.star[k] ^= (n == 4u) && (best.star[k] >= 0) ? 0x40000000 : 0;
    }
    for (uint32_t k = 6; k < 9u; k++) { /* all that was before the camera is behind it */
      unit_work.best.matrix[k] *= n == 5u ? other : (starcat_real)1.0;
    }
    CHECK_IS(starcat_end_call(&call, &sky->options, &unit_result),
             n == 0u ? STARCAT_IDENTIFIED : STARCAT_NO_MATCH);
    CHECK((unit_result.n_matched > 0u) == (n == 0u));
  }
}

/* A flipped bit that doubles or halves a number of the attitude, or changes its sign: the stars give
 * the attitude back, or there is no answer. */
static void check_flipped_attitudes(const unit_sky *sky) {
  static const double factors[3] = {2.0, 0.5, -1.0};
  starcat_call call;
  uint32_t answers = 0;
  for (uint64_t look = 0; look < 400u; look++) {
    uint64_t state = 900u + look;
    sky_look(&sky->image, &sky->camera, &state, 0.2, SKY_SPOTS, 0, &truth);
    const starcat_frame frame = {truth.count, truth.x, truth.y, truth.magnitudes, NULL};
    if (identify(sky, NULL) != STARCAT_IDENTIFIED) {
      continue;
    }
    const starcat_agreement best = unit_work.best;
    const starcat_result right = unit_result;
    for (uint32_t n = 0; n < 27u; n++) {
      CHECK_IS(starcat_begin_call(&call, &sky->image, &sky->camera, &sky->options, &frame,
                                  &unit_work, &unit_result),
               STARCAT_OK);
      unit_work.best = best;
      unit_work.best.matrix[n / 3u] *= (starcat_real)factors[n % 3u];
      if (starcat_end_call(&call, &sky->options, &unit_result) == STARCAT_IDENTIFIED) {
        for (uint32_t k = 0; k < 4u; k++) {
          CHECK(fabs((double)(unit_result.q_body_from_icrs[k] - right.q_body_from_icrs[k])) < 1e-5);
        }
        answers++;
      }
    }
  }
  CHECK(answers > 300u);
}

/* Damaged indexes in the workspace never address memory outside of it. */
static void check_places(const unit_sky *sky) {
  const starcat_real terms[STARCAT_SHAPE_TERMS] = {0};
  const starcat_frame frame = {truth.count, truth.x, truth.y, truth.magnitudes, NULL};
  starcat_call call;
  starcat_real m[9];
  CHECK_IS(identify(sky, NULL), STARCAT_IDENTIFIED);
  memcpy(m, unit_result.matrix, sizeof m);
  CHECK_IS(starcat_begin_call(&call, &sky->image, &sky->camera, &sky->options, &frame, &unit_work,
                              &unit_result),
           STARCAT_OK);
  traps_off(); /* the numbers make no sense, and may be none */
  memset(unit_work.in_column, 0xff, sizeof unit_work.in_column);
  for (uint32_t n = 1; n <= STARCAT_COLUMNS; n++) {
    unit_work.column[n] = n % 2u == 0u ? 0u : UINT16_MAX;
  }
  (void)starcat_try_attitude(&call, m, (starcat_real)1.0);
  memset(unit_work.row, 0x7f, sizeof unit_work.row);
  memset(unit_work.within, 0x7f, sizeof unit_work.within);
  memset(unit_work.near_row, 0x7f, sizeof unit_work.near_row);
  memset(unit_work.match, 0x7f, sizeof unit_work.match);
  starcat_count_ways(&call, 4);
  (void)starcat_log_chance(&call, (starcat_real)1.0, 6, STARCAT_SHAPE_TERMS, terms);
  (void)starcat_end_call(&call, &sky->options, &unit_result);
  traps_on();
}

void test_answer(void) {
  double square, chi_square;
  unit_sky *sky = &unit_scratch;
  unit_copy(&unit_triangle);
  check_unknown(sky);
  check_widened(sky);
  check_changed(sky);
  check_flipped_attitudes(sky);
  check_changed_shape(sky);
  check_places(sky);
  check_one_place(sky);
  check_excess(sky);
  for (int is_weighted = 0; is_weighted < 2; is_weighted++) {
    sky->options.noise_px = (starcat_real)(is_weighted ? 0.0 : NOISE_PX);
    check_means(sky, is_weighted, &square, &chi_square);
    CHECK((square > 2.6) && (square < 3.4));
    CHECK((chi_square > 0.95) && (chi_square < 1.05));
  }
  sky->options.noise_px = (starcat_real)0.0;
  sky->camera.k1 = (starcat_real)-0.3; /* the lens is in the covariance too */
  check_means(sky, 1, &square, &chi_square);
  CHECK((square > 2.6) && (square < 3.4));
  sky->camera.k1 = (starcat_real)0.0;
}
