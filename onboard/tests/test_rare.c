/* What ordinary frames reach seldom or never: the branches behind rare numbers.
 *
 * SPDX-License-Identifier: MIT
 */
#include <math.h>
#include <string.h>

#include "internal.h"
#include "unit.h"

static sky_frame truth;
static starcat_call call;

static starcat_status track(const unit_sky *sky, starcat_real uncertainty_rad) {
  const starcat_frame frame = unit_frame_of(&truth);
  return starcat_track_frame(&sky->image, &sky->camera, &sky->options, &frame,
                             truth.q_body_from_icrs, uncertainty_rad, &unit_work, &unit_result);
}

/* A frame that the sky identifies, its stars in the workspace, and the call that found them. */
static void begin(const unit_sky *sky, uint64_t seed, uint32_t n_spots, uint32_t n_false) {
  sky_look(&sky->image, &sky->camera, &seed, 0.2, n_spots, n_false, &truth);
  CHECK_IS(unit_identify(sky, &truth), STARCAT_IDENTIFIED);
  const starcat_frame frame = unit_frame_of(&truth);
  CHECK_IS(starcat_begin_call(&call, &sky->image, &sky->camera, &sky->options, &frame, &unit_work,
                              &unit_result),
           STARCAT_OK);
}

/* Directions that determine no attitude. */
static void check_degenerate(void) {
  const starcat_real zero[6] = {0}, v[3] = {1, 2, 3};
  starcat_real x[3], inverse[6], m[9] = {1, 0, 0, 0, 1, 0, 0, 0, 1};
  CHECK(!starcat_solve_symmetric(zero, v, x, inverse));
  starcat_refine_attitude(m, v, v, NULL, NULL, 0, 4);
  CHECK(m[0] == (starcat_real)1.0);
  begin(&unit_triangle, 4, SKY_SPOTS, 0);
  CHECK(starcat_try_attitude(&call, unit_result.matrix, (starcat_real)1.0));
  const uint32_t n = unit_work.best.n_matched;
  CHECK(starcat_log_chance(&call, (starcat_real)1.0, n, 0, NULL) < (starcat_real)0.0);
  for (uint32_t i = 0; i < call.own->count; i++) {
    unit_work.match[i] = -1;
  }
  CHECK(starcat_log_chance(&call, (starcat_real)1.0, n, 0, NULL) >= (starcat_real)0.0);
}

/* Two centroids in one direction, as no frame has them, proposed as triangles of stars; and sides
 * that lie on one great circle. */
static void check_coincident(void) {
  const starcat_real line[3] = {(starcat_real)0.0625, (starcat_real)0.125, (starcat_real)0.1875};
  starcat_real body[SKY_SPOTS][3];
  begin(&unit_triangle, 4, SKY_SPOTS, 0);
  memcpy(body, unit_work.body, sizeof body);
  for (uint32_t n = 0; n < SKY_SPOTS * SKY_SPOTS * SKY_SPOTS; n++) {
    const uint32_t t[3] = {n % SKY_SPOTS, n / SKY_SPOTS % SKY_SPOTS, n / SKY_SPOTS / SKY_SPOTS};
    if ((t[0] != t[1]) && (t[0] != t[2]) && (t[1] != t[2])) {
      const starcat_real sides[3] = {
          starcat_angle_of_chord(starcat_chord_square(body[t[1]], body[t[2]])),
          starcat_angle_of_chord(starcat_chord_square(body[t[0]], body[t[2]])),
          starcat_angle_of_chord(starcat_chord_square(body[t[0]], body[t[1]]))};
      memcpy(unit_work.body, body, sizeof body);
      call.own->steps_left = 1000000;
      memcpy(unit_work.body[t[1]], unit_work.body[t[0]], sizeof body[0]);
      CHECK_IS(starcat_look_up_triangle(&call, t, sides), 0);
      CHECK_IS(starcat_look_up_triangle(&call, t, line), 0);
    }
  }
  CHECK_IS(call.own->n_tried, 0);
}

#ifndef STARCAT_SINGLE
/* Three stars of one pair list within a hundredth of an arcsecond, too near for an attitude. */
static void check_too_near(void) {
  static const int32_t steps[3][3] = {{0, 0, 0}, {140, 0, 0}, {0, 140, 0}};
  const uint32_t triple[3] = {0, 1, 2};
  uint32_t at, rows[4];
  starcat_real sides[3];
  unit_copy(&unit_pyramid);
  begin(&unit_scratch, 4, SKY_SPOTS, 0);
  memcpy(&at, unit_scratch.bytes + 256u + 4u, 4);
  starcat_read_rows(&unit_scratch.image, 0, 2, rows + 1);
  rows[0] = rows[1] == 0u ? rows[2] + 1u : rows[1] - 1u;
  const int32_t *place = unit_scratch.image.directions + 3u * (size_t)rows[0];
  for (uint32_t n = 0; n < 3u; n++) {
    const int32_t near[3] = {place[0] + steps[n][0], place[1] + steps[n][1], place[2]};
    memcpy(unit_scratch.bytes + at + 12u * (size_t)rows[n], near, 12);
    starcat_real *body = unit_work.body[n];
    starcat_read_star(&unit_scratch.image, rows[n], body);
    const starcat_real length = STARCAT_SQRT(starcat_dot(body, body));
    for (uint32_t k = 0; k < 3u; k++) {
      body[k] /= length;
    }
  }
  for (uint32_t n = 0; n < 3u; n++) {
    const uint32_t a = (n + 1u) % 3u, b = (n + 2u) % 3u;
    sides[n] = starcat_angle_of_chord(starcat_chord_square(unit_work.body[a], unit_work.body[b]));
    unit_work.separation_rad[a > b ? a * (a - 1u) / 2u + b : b * (b - 1u) / 2u + a] = sides[n];
  }
  unit_scratch.image.kvector_slope = (starcat_real)1e5; /* every side looks up the first pairs */
  call.tolerance_rad = (starcat_real)2e-8;
  CHECK_IS(starcat_look_up_pyramid(&call, triple, sides), 0);
  CHECK_IS(call.own->n_tried, 0);
}
#endif

/* A camera of 180 degrees minus a millionth of an arcsecond, too wide for a plane image; and a
 * camera whose stars, in opposite corners, are 178 degrees apart. */
static void check_half_sky(void) {
  unit_copy(&unit_pyramid);
  unit_scratch.camera.width_px = (starcat_real)1e6;
  unit_scratch.camera.height_px = (starcat_real)1e6;
  unit_scratch.camera.x0_px = (starcat_real)500000;
  unit_scratch.camera.y0_px = (starcat_real)500000;
  unit_scratch.camera.focal_length_px = (starcat_real)0.01;
  truth.count = 32;
  for (uint32_t n = 0; n < 32u; n++) {
    truth.x[n] = (starcat_real)(n % 2u == 0u ? n + 1u : 1000000u - n);
    truth.y[n] = truth.x[n];
    truth.magnitudes[n] = (starcat_real)n;
  }
  unit_scratch.options.max_steps = 100000;
  CHECK_IS(unit_identify(&unit_scratch, &truth), STARCAT_E_CAMERA);
  CHECK_IS(track(&unit_scratch, (starcat_real)0.01), STARCAT_E_CAMERA);
  unit_scratch.camera.focal_length_px = (starcat_real)10000.0;
  CHECK(unit_identify(&unit_scratch, &truth) != STARCAT_IDENTIFIED);
  CHECK_IS(track(&unit_scratch, (starcat_real)0.01), STARCAT_E_OPTIONS);
}

/* A repeated centroid of the same magnitude, at a distance too small to measure. */
static void check_repeated(void) {
  begin(&unit_pyramid, 4, SKY_SPOTS, 0);
  for (uint32_t k = 0; k < 4u; k++) {
    const uint32_t n = truth.count++;
    truth.x[n] = truth.x[k];
    truth.y[n] = truth.y[k];
    truth.magnitudes[n] = truth.magnitudes[k];
    truth.star[n] = -1;
  }
  CHECK_IS(unit_identify(&unit_pyramid, &truth), STARCAT_IDENTIFIED);
  CHECK_IS(unit_result.star[truth.count - 1u], STARCAT_DROPPED_DUPLICATE);
  for (uint32_t k = 0; k < 4u; k++) {
    truth.x[truth.count - 4u + k] *= (starcat_real)(1.0 + IF_SINGLE(1e-7, 1e-8));
  }
  CHECK_IS(unit_identify(&unit_pyramid, &truth), STARCAT_IDENTIFIED);
  CHECK_IS(track(&unit_pyramid, (starcat_real)0.01), STARCAT_IDENTIFIED);
  /* Only false spots, each twice: no pair of them is a pair of stars. */
  for (uint32_t k = 0; k < truth.count; k++) {
    truth.x[k] = (starcat_real)(40.0 + 37.0 * (k / 2u)) *
                 (starcat_real)(1.0 + IF_SINGLE(2e-7, 1e-8) * (k % 2u));
    truth.y[k] = (starcat_real)(3 + 7 * ((5 * (k / 2u)) % 64u));
  }
  CHECK(track(&unit_pyramid, (starcat_real)0.1) != STARCAT_IDENTIFIED);
}

/* Spots on a square lattice, whose sides are equal, and nothing known of their brightness. */
static void check_lattice(void) {
  truth.count = 25;
  for (uint32_t k = 0; k < 25u; k++) {
    truth.x[k] = (starcat_real)(56 + 100 * (k % 5u));
    truth.y[k] = (starcat_real)(56 + 100 * (k / 5u));
    truth.magnitudes[k] = (starcat_real)NAN;
  }
  CHECK_IS(unit_identify(&unit_triangle, &truth), STARCAT_NO_MATCH);
  CHECK_IS(unit_identify(&unit_pyramid, &truth), STARCAT_NO_MATCH);
}

/* Triangles of any size with an error of any size, where the scale is known to half of it; and two
 * spots at one place, that a star finds in either order. */
static void check_bounds_of_shapes(void) {
  static const double sizes[4][3] = {
      {0.02, 0.03, 0.04}, {0.3, 0.4, 0.5}, {1.4, 1.5, 1.6}, {0.002, 0.4, 0.401}};
  static const double errors[4] = {1e-4, 0.01, 0.15, 2.0};
  const uint32_t triple[3] = {0, 1, 2};
  begin(&unit_triangle, 4, SKY_SPOTS, 0);
  starcat_allow_scales(&call, (starcat_real)0.5);
  for (uint32_t n = 0; n < 16u; n++) {
    const double *size = sizes[n % 4u];
    const starcat_real sides[3] = {(starcat_real)size[0], (starcat_real)size[1],
                                   (starcat_real)size[2]};
    call.tolerance_rad = (starcat_real)errors[n / 4u];
    call.own->steps_left = 20000;
    const int has_ended = starcat_look_up_triangle(&call, triple, sides);
    CHECK((has_ended == 0) || (call.own->steps_left == 0u) ||
          (unit_work.best.log_chance <= call.log_certain));
  }
  for (uint32_t n = 0; n < 2u; n++) {
    starcat_real m[9];
    begin(&unit_triangle, 4, SKY_SPOTS, 0);
    unit_work.x[SKY_SPOTS - 1u] = unit_work.x[0];
    unit_work.y[SKY_SPOTS - 1u] = unit_work.y[0];
    starcat_list_columns(&call);
    for (uint32_t at = 0; (n > 0u) && (at < call.own->count); at++) {
      const uint16_t spot = unit_work.in_column[at];
      unit_work.in_column[at] = (uint16_t)(spot == 0u               ? SKY_SPOTS - 1u
                                           : spot == SKY_SPOTS - 1u ? 0u
                                                                    : spot);
    }
    call.own->steps_left = 1000000;
    unit_matrix_of(&truth, m);
    (void)starcat_try_attitude(&call, m, (starcat_real)1.0);
    CHECK(unit_work.found.star[0] >= 0);
    CHECK_IS(unit_work.found.star[SKY_SPOTS - 1u], -1);
  }
}

/* So many spots of unknown brightness that only near ones make triangles: stars on a crowded sky,
 * and a lattice; with any number of steps. */
static void check_spread(void) {
  unit_copy(&unit_crowded);
  for (uint32_t n = 0; n < 8u; n++) {
    uint64_t seed = n + 1u;
    sky_look(&unit_scratch.image, &unit_scratch.camera, &seed, 0.3, STARCAT_MAX_CENTROIDS,
             4u + n % 2u * 10u, &truth);
    if (n >= 6u) {
      for (uint32_t k = 0; k < truth.count; k++) {
        truth.x[k] = (starcat_real)(32 + 60 * (k % 8u));
        truth.y[k] = (starcat_real)(32 + (n == 6u ? 60u : 55u) * (k / 8u));
      }
    }
    const starcat_frame frame = {truth.count, truth.x, truth.y, NULL, NULL};
    for (uint32_t steps = 100; steps < 10000000u; steps *= 3u) {
      unit_scratch.options.max_steps = steps;
      const starcat_status status =
          starcat_identify_frame(&unit_scratch.image, &unit_scratch.camera, &unit_scratch.options,
                                 &frame, &unit_work, &unit_result);
      CHECK((status != STARCAT_IDENTIFIED) || ((n < 6u) && (unit_wrong_stars(&truth) <= 1u)));
    }
    CHECK_IS(unit_result.reason == (uint32_t)STARCAT_REASON_NONE, n < 6u);
  }
}

/* What the caller accepts: much, a little more than is certain, and nothing. */
static void check_chances(void) {
  static const double chances[4] = {-6.9, -18.4, -30.0, -1000.0};
  unit_copy(&unit_triangle);
  for (uint32_t n = 0; n < 4u; n++) {
    uint64_t seed = 4;
    sky_look(&unit_scratch.image, &unit_scratch.camera, &seed, 0.2, SKY_SPOTS, 0, &truth);
    unit_scratch.options.log_chance = (starcat_real)chances[n];
    CHECK_IS(unit_identify(&unit_scratch, &truth), n < 3u ? STARCAT_IDENTIFIED : STARCAT_NO_MATCH);
  }
  /* And anything: what the workspace still holds of the frame before is no answer. */
  unit_scratch.options.log_chance = (starcat_real)-18.4;
  CHECK_IS(unit_identify(&unit_scratch, &truth), STARCAT_IDENTIFIED);
  unit_scratch.options.log_chance = (starcat_real)0.0;
  unit_scratch.options.tolerance_px = (starcat_real)1e5;
  unit_scratch.options.max_steps = 1;
  CHECK_IS(unit_identify(&unit_scratch, &truth), STARCAT_E_BUDGET);
}

/* Lenses that put nothing at a centroid, though all corners have a direction; and one whose fold
 * is so near that the search for a corner's direction never ends. */
static void check_lenses(void) {
  unit_copy(&unit_triangle);
  begin(&unit_scratch, 4, SKY_SPOTS, 0);
  truth.x[0] = (starcat_real)387.0;
  truth.y[0] = (starcat_real)487.0;
  unit_scratch.camera.k1 = (starcat_real)-8.0;
  unit_scratch.camera.k2 = (starcat_real)20.0;
  CHECK_IS(unit_identify(&unit_scratch, &truth), STARCAT_E_CAMERA);
  unit_scratch.camera.k1 = (starcat_real)-0.2;
  unit_scratch.camera.k2 = (starcat_real)0.0;
  unit_scratch.camera.fold_radius = (starcat_real)0.3;
  CHECK_IS(unit_identify(&unit_scratch, &truth), STARCAT_E_CAMERA);
  /* A bit of a centroid is flipped after its star was found. */
  begin(&unit_triangle, 4, SKY_SPOTS, 0);
  CHECK(starcat_try_attitude(&call, unit_result.matrix, (starcat_real)1.0));
  unit_work.x[2] = (starcat_real)1.1e7;
  CHECK_IS(starcat_end_call(&call, &unit_triangle.options, &unit_result), STARCAT_NO_MATCH);
  CHECK_IS(unit_result.n_matched, 0);
}

/* Frames of another scale than the camera's, larger and smaller ones, are identified with their
 * scale. */
static void check_scale(void) {
  for (int sign = -1; sign <= 1; sign += 2) {
    uint64_t seed = 4;
    for (uint32_t n = 0; n < 10u; n++) {
      sky_look(&unit_pyramid.image, &unit_pyramid.camera, &seed, 0.02, SKY_SPOTS, 0, &truth);
      const starcat_real scale = (starcat_real)(1.0 + sign * 0.008);
      for (uint32_t k = 0; k < truth.count; k++) {
        truth.x[k] = (starcat_real)256.0 + scale * (truth.x[k] - (starcat_real)256.0);
        truth.y[k] = (starcat_real)256.0 + scale * (truth.y[k] - (starcat_real)256.0);
      }
      CHECK_IS(unit_identify(&unit_pyramid, &truth), STARCAT_IDENTIFIED);
      CHECK_IS(unit_wrong_stars(&truth), 0);
      CHECK(unit_result.n_shape > 0u);
      CHECK_NEAR(unit_result.focal_length_px / unit_pyramid.camera.focal_length_px, scale, 1e-3);
      CHECK(unit_error_rad(&truth) < 3e-4);
    }
  }
}

/* Many spots on a crowded sky, tight and loose. */
static void check_crowded(void) {
  for (uint32_t n = 0; n < 24u; n++) {
    uint64_t seed = n + 1u;
    unit_copy(&unit_crowded);
    if (n % 3u == 1u) {
      unit_scratch.options.tolerance_px = (starcat_real)6.0;
    }
    if (n % 3u == 2u) {
      unit_scratch.options.noise_mag = (starcat_real)0.3;
    }
    sky_look(&unit_scratch.image, &unit_scratch.camera, &seed, 0.3, STARCAT_MAX_CENTROIDS,
             4u + n % 2u * 10u, &truth);
    if (n % 2u == 1u) { /* a second spot beside a true one */
      truth.x[0] = truth.x[1] + (starcat_real)1.0;
      truth.y[0] = truth.y[1];
      truth.magnitudes[0] = truth.magnitudes[1];
    }
    truth.magnitudes[2] = (starcat_real)NAN;
    const starcat_status identified = unit_identify(&unit_scratch, &truth);
    CHECK(n % 3u == 1u || identified == STARCAT_IDENTIFIED);
    CHECK(unit_result.steps <= unit_scratch.options.max_steps);
    const starcat_status tracked = track(&unit_scratch, (starcat_real)0.01);
    CHECK(n % 3u == 1u || tracked == STARCAT_IDENTIFIED);
  }
}

/* Pairs whose second star only is outside of the image. */
static void check_second_rows(void) {
  uint32_t offset;
  unit_copy(&unit_pyramid);
  memcpy(&offset, unit_scratch.bytes + 256u + 16u * 5u + 4u, 4);
  for (uint32_t n = 0; n < unit_scratch.image.n_features; n++) {
    memset(unit_scratch.bytes + offset + 8u * (size_t)n + 4u, 0xff, 4);
  }
  uint64_t seed = 4;
  sky_look(&unit_pyramid.image, &unit_pyramid.camera, &seed, 0.2, SKY_SPOTS, 0, &truth);
  CHECK_IS(unit_identify(&unit_scratch, &truth), STARCAT_NO_MATCH);
}

/* Numbers that a damaged image, or a tolerance as wide as the frame, lead to. */
static void check_wide(void) {
  uint32_t start = 7, stop = 7;
  uint64_t seed = 4;
  starcat_find_rows(&unit_triangle.image, (starcat_real)-9.0, (starcat_real)-8.0, &start, &stop);
  CHECK_IS(start, 0);
  CHECK_IS(stop, 0);
  starcat_find_rows(&unit_triangle.image, (starcat_real)8.0, (starcat_real)9.0, &start, &stop);
  CHECK_IS(start, unit_triangle.image.n_features);
  CHECK_IS(stop, unit_triangle.image.n_features);
  const unit_sky *skies[3] = {&unit_pyramid, &unit_triangle, &unit_crowded};
  for (uint32_t n = 0; n < 3u; n++) {
    unit_copy(skies[n]);
    unit_scratch.options.tolerance_px = (starcat_real)(n == 2u ? 20.0 : 250.0);
    unit_scratch.options.max_steps = 200000;
    sky_look(&unit_scratch.image, &unit_scratch.camera, &seed, 0.2, SKY_SPOTS, 0, &truth);
    CHECK((unit_identify(&unit_scratch, &truth) != STARCAT_IDENTIFIED) ||
          (unit_wrong_stars(&truth) == 0u));
    CHECK((track(&unit_scratch, (starcat_real)0.3) != STARCAT_IDENTIFIED) ||
          (unit_wrong_stars(&truth) == 0u));
  }
}

/* Frames of few and of many spots, and noises that make few, many or no number of stars certain. */
static void check_noises(void) {
  static const double noises[4] = {0.05, 0.3, 1.5, 6.0};
  uint32_t identified[4] = {0};
  unit_copy(&unit_pyramid);
  for (uint32_t n = 0; n < 36u; n++) {
    uint64_t seed = n + 50u;
    unit_scratch.options.noise_px = (starcat_real)noises[n % 4u];
    sky_look(&unit_scratch.image, &unit_scratch.camera, &seed, 0.05, 4u + n / 4u, n / 16u, &truth);
    if (unit_identify(&unit_scratch, &truth) == STARCAT_IDENTIFIED) {
      CHECK_IS(unit_wrong_stars(&truth), 0);
      identified[n % 4u]++;
    }
  }
  CHECK(identified[0] >= 6u);
  CHECK(identified[3] < identified[0]);
}

/* Logarithm of the ways to assign n centroids to stars, without magnitudes or with a noise of them. */
static double log_ways(uint32_t n, double noise_mag) {
  call.noise_mag = (starcat_real)noise_mag;
  starcat_count_ways(&call, n);
  return (double)unit_work.log_ways[n];
}

/* Put the magnitude of the first centroid, and those of the others, so many times the noise of 0.01 from
 * the magnitude of all stars. Returns the logarithm of the sum of the weights of the ways to assign
 * all centroids to stars. */
static double log_apart(double first, double others) {
  for (uint32_t i = 0; i < call.own->count; i++) {
    unit_work.magnitude[i] = (starcat_real)(5.0 + 0.01 * (i == 0u ? first : others));
  }
  return log_ways(call.own->count, 0.01);
}

/* If all centroids and stars are alike, the bound of the ways is their number, whether centroids or stars
 * are fewer. */
static void check_ways(void) {
  begin(&unit_triangle, 4, SKY_SPOTS, 0);
  CHECK(starcat_try_attitude(&call, unit_result.matrix, (starcat_real)1.0));
  CHECK_NEAR(log_ways(5, 100.0), log_ways(5, 0.0), 1e-4);
  /* Of many stars. */
  const uint32_t stars = call.own->n_within, count = call.own->count;
  for (uint32_t j = stars; j < 180u; j++) {
    unit_work.within[j] = unit_work.within[j - stars];
  }
  call.own->n_within = 180;
  CHECK_NEAR(log_ways(count, 100.0), log_ways(count, 0.0), 1e-3);
  call.own->n_within = 5; /* of few */
  CHECK_NEAR(log_ways(5, 100.0), log_ways(5, 0.0), 1e-4);
  call.own->n_within = stars;
}

/* With a rate of magnitudes a ball is above the volumes that their squares leave for the places, and is
 * the ball itself where its square is not above the typical one. */
static void check_ball(void) {
  for (uint32_t n = 1; n < 40u; n++) {
    const double square = 0.5 * n, rate = 1.0 / 3.0, half = 2.5;
    const double volume = (double)starcat_log_ball(5, (starcat_real)square, 0);
    const double bound = (double)starcat_log_ball(5, (starcat_real)square, (starcat_real)rate);
    double most = volume;
    for (double s = 0.0; s < square; s += 0.01) {
      const double left = volume + half * log1p(-s / square) + rate * s;
      most = left > most ? left : most;
    }
    CHECK_NEAR(bound, most, 1e-4);
  }
}

/* A way counts by how many whole deviations its magnitudes are apart, if the noise of places is stated.
 * Centroids that no star resembles have none. */
static void check_weights(void) {
  unit_sky *sky = &unit_scratch;
  static int16_t magnitude[4096];
  unit_copy(&unit_triangle);
  CHECK(sky->image.n_stars <= 4096u);
  for (uint32_t j = 0; j < 4096u; j++) {
    magnitude[j] = 5000;
  }
  sky->image.magnitudes = magnitude;
  sky->options.noise_px = (starcat_real)0.2;
  begin(sky, 4, SKY_SPOTS, 0);
  CHECK(starcat_try_attitude(&call, unit_result.matrix, (starcat_real)1.0));
  const double none = log_apart(0.5, 0.5), count = (double)call.own->count;
  for (uint32_t d = 1; d < STARCAT_INCOMPATIBLE; d++) {
    const double apart = (double)d + 0.25;
    CHECK_NEAR(log_apart(apart, apart), none - count * d * d / 3.0, 1e-3);
    CHECK_NEAR(log_apart(-apart, 0.0), none - d * d / 3.0, 1e-3);
  }
  CHECK(log_apart(0.5, 4.0) < -1e29);
  call.noise_px = (starcat_real)0.0;
  CHECK_NEAR(log_apart(3.25, -1.25), none, 1e-3);
}

/* A prior that reaches beyond the fold of the lens, where nothing is visible; and a prior so wide
 * that only brightness distinguishes the stars. */
static void check_priors(void) {
  uint64_t seed = 4;
  unit_copy(&unit_pyramid);
  unit_scratch.camera.k1 = (starcat_real)-0.2;
  unit_scratch.camera.fold_radius = (starcat_real)0.6;
  sky_look(&unit_scratch.image, &unit_scratch.camera, &seed, 0.1, SKY_SPOTS, 0, &truth);
  CHECK_IS(track(&unit_scratch, (starcat_real)0.2), STARCAT_IDENTIFIED);
  unit_copy(&unit_crowded);
  CHECK_IS(track(&unit_scratch, (starcat_real)0.35), STARCAT_E_CAPACITY);
  unit_scratch.options.max_steps = 10;
  CHECK_IS(track(&unit_scratch, (starcat_real)0.35), STARCAT_E_BUDGET);
  (void)starcat_set_default_options(&unit_scratch.options);
  unit_scratch.options.noise_mag = (starcat_real)0.1;
  for (uint32_t n = 0; n < 10u; n++) {
    sky_look(&unit_scratch.image, &unit_scratch.camera, &seed, 0.1, 30, 0, &truth);
    truth.q_body_from_icrs[n % 3u] += (starcat_real)0.015;
    CHECK_IS(track(&unit_scratch, (starcat_real)0.05), STARCAT_IDENTIFIED);
    CHECK_IS(unit_wrong_stars(&truth), 0);
  }
}

static int is_listed(const uint32_t *rows, uint32_t count, uint32_t row) {
  int found = 0;
  for (uint32_t n = 0; n < count; n++) {
    found |= rows[n] == row;
  }
  return found;
}

/* Gather a cap and compare it with all stars of the sky. */
static void check_cap(const double centre[3], double cosine, double sine, uint32_t most) {
  static uint32_t rows[SKY_MOST_STARS];
  static starcat_real icrs[SKY_MOST_STARS][3];
  const starcat_real c[3] = {(starcat_real)centre[0], (starcat_real)centre[1],
                             (starcat_real)centre[2]};
  const starcat_real cos_r = (starcat_real)cosine;
  const starcat_real margin = (starcat_real)IF_SINGLE(7e-7, 2e-9);
  uint32_t within = 0, beside = 0, missing = 0;
  call.own->steps_left = 1000000;
  const uint32_t count =
      starcat_gather_stars(&call, c, cos_r, (starcat_real)sine, most, rows, icrs);
  for (uint32_t row = 0; row < call.image->n_stars; row++) {
    starcat_real star[3];
    starcat_read_star(call.image, row, star);
    const starcat_real nearness = starcat_dot(star, c);
    beside += (uint32_t)((nearness >= cos_r - margin) && (nearness < cos_r));
    if (nearness >= cos_r) {
      within++;
      missing += (uint32_t)!is_listed(rows, count <= most ? count : most, row);
    }
  }
  CHECK(count >= (within <= most ? within : most + 1u));
  CHECK(count <= (within + beside <= most ? within + beside : most + 1u));
  CHECK((count > most) || (missing == 0u));
}

/* However narrow the cap, the star in its centre is in it, although rounding has left the star's
 * vector a little shorter than 1. */
static void check_narrow_caps(void) {
  uint32_t missing = 0;
  for (uint32_t row = 0; row < call.image->n_stars; row++) {
    starcat_real centre[3], icrs[8][3];
    uint32_t rows[8];
    starcat_read_star(call.image, row, centre);
    const starcat_real length = STARCAT_SQRT(starcat_dot(centre, centre));
    for (uint32_t k = 0; k < 3u; k++) {
      centre[k] /= length;
    }
    call.own->steps_left = 1000000;
    const uint32_t count = starcat_gather_stars(&call, centre, (starcat_real)(1.0 - 5e-13),
                                                (starcat_real)1e-6, 8, rows, icrs);
    missing += (uint32_t)!is_listed(rows, count, row);
  }
  CHECK_IS(missing, 0);
}

/* Caps everywhere, over the poles and over right ascension 0 too. */
static void check_caps(void) {
  uint64_t state = 77;
  const double pole[3] = {0.0, 0.0, 1.0}, south[3] = {0.0, 0.0, -1.0}, seam[3] = {1.0, 0.0, 0.0};
  begin(&unit_crowded, 4, 20, 0);
  for (uint32_t n = 0; n < 400u; n++) {
    double centre[3], square = 0.0;
    for (uint32_t k = 0; k < 3u; k++) {
      centre[k] = sky_normal(&state);
      square += centre[k] * centre[k];
    }
    for (uint32_t k = 0; k < 3u; k++) {
      centre[k] /= sqrt(square);
    }
    const double radius = 0.001 + 0.7 * sky_uniform(&state);
    check_cap(centre, cos(radius), sin(radius), n % 4u == 0u ? n % 7u : SKY_MOST_STARS - 1u);
  }
  for (uint32_t n = 0; n < 20u; n++) {
    const double c = cos(0.03 * (n + 1u)), s = sin(0.03 * (n + 1u));
    check_cap(pole, c, s, 1500);
    check_cap(south, c, s, 1500);
    check_cap(seam, c, s, n % 2u == 0u ? n / 2u : 1500u);
  }
  check_narrow_caps();
  /* Rounding alone makes a cap touch a pole that its centre is too far from. */
  const double edge[3] = {0.1, 0.0, 0.99498};
  check_cap(edge, 0.99499, 0.1000001, 1500);
}

/* A focal length stated up to 3 % wrong is found with the attitude. If only an error of 1 % is
 * allowed most frames have no answer, and no answer is wrong. */
static void check_focal_length(void) {
  uint64_t seed = 9;
  uint32_t found = 0;
  for (uint32_t n = 0; n < 12u; n++) {
    const starcat_real scale = (starcat_real)(n % 2u == 0u ? 1.03 : 0.975);
    sky_look(&unit_triangle.image, &unit_triangle.camera, &seed, 0.05, SKY_SPOTS, 0, &truth);
    unit_scratch = unit_triangle;
    unit_scratch.camera.focal_length_px *= scale;
    unit_scratch.options.fov_error = (starcat_real)0.01;
    if (unit_identify(&unit_scratch, &truth) == STARCAT_IDENTIFIED) {
      CHECK_IS(unit_wrong_stars(&truth), 0);
      CHECK(unit_error_rad(&truth) < 2e-3);

      found++;
    } else {
      CHECK(unit_result.reason != (uint32_t)STARCAT_REASON_NONE);
    }
    CHECK_IS(unit_result.n_usable, truth.count);
    unit_scratch.options.fov_error = (starcat_real)0.05;
    CHECK_IS(unit_identify(&unit_scratch, &truth), STARCAT_IDENTIFIED);
    CHECK_IS(unit_wrong_stars(&truth), 0);
    const starcat_real ratio = unit_result.focal_length_px / unit_triangle.camera.focal_length_px;
    CHECK((ratio > (starcat_real)0.998) && (ratio < (starcat_real)1.002));
  }
  CHECK(found <= 2u);
  unit_scratch.options.fov_error = (starcat_real)0.6;
  CHECK_IS(unit_identify(&unit_scratch, &truth), STARCAT_E_OPTIONS);
}

/* True stars in one corner, spots elsewhere, and an attitude that is turned: what it explains is
 * too little, or is found only within wider reaches. */
static void check_clusters(void) {
  uint32_t certain = 0, wrong = 0;
  for (uint32_t n = 0; n < 240u; n++) {
    uint64_t seed = n + 100u;
    starcat_real m[9];
    sky_look(&unit_crowded.image, &unit_crowded.camera, &seed, 0.1, STARCAT_MAX_CENTROIDS, 0,
             &truth);
    const starcat_real edge = (starcat_real)(150 + 40 * (n % 10u));
    for (uint32_t k = 0; k < truth.count; k++) {
      if ((truth.x[k] > edge) || (truth.y[k] > edge)) {
        truth.x[k] = (starcat_real)(512.0 * sky_uniform(&seed));
        truth.y[k] = (starcat_real)(512.0 * sky_uniform(&seed));
        truth.star[k] = -1;
      }
    }
    const starcat_frame frame = unit_frame_of(&truth);
    CHECK_IS(starcat_begin_call(&call, &unit_crowded.image, &unit_crowded.camera,
                                &unit_crowded.options, &frame, &unit_work, &unit_result),
             STARCAT_OK);
    unit_matrix_of(&truth, m);
    for (uint32_t k = 0; k < 3u; k++) { /* turned by up to five reaches about y, and about z */
      const starcat_real turn = (starcat_real)(0.0025 * (n / 10u % 8u));
      const starcat_real roll = (starcat_real)(0.01 * (n / 80u));
      const starcat_real x = m[k], y = m[3u + k], z = m[6u + k];
      m[k] = x + turn * z + roll * y;
      m[3u + k] = y - roll * x;
      m[6u + k] = z - turn * x;
    }
    certain += (uint32_t)starcat_try_attitude(&call, m, (starcat_real)1.0);
    for (uint32_t k = 0; (unit_work.best.log_chance < (starcat_real)0.0) && (k < call.own->count);
         k++) {
      const int32_t star = unit_work.best.star[k];
      wrong += (uint32_t)((star >= 0) && (truth.star[unit_work.row[k]] >= 0) &&
                          (star != truth.star[unit_work.row[k]]));
    }
  }
  CHECK((certain > 40u) && (certain < 240u));
  CHECK(wrong < 4u);
}

void test_rare(void) {
  check_degenerate();
  check_coincident();
  check_half_sky();
#ifndef STARCAT_SINGLE
  check_too_near();
#endif
  check_repeated();
  check_lattice();
  check_chances();
  check_lenses();
  check_scale();
  check_crowded();
  check_second_rows();
  check_wide();
  check_noises();
  check_ways();
  check_ball();
  check_weights();
  check_priors();
  check_caps();
  check_focal_length();
  check_spread();
  check_bounds_of_shapes();
  check_clusters();
}
