/* What ordinary frames reach seldom or never: the branches behind rare numbers.
 *
 * SPDX-License-Identifier: MIT
 */
#include <string.h>

#include "internal.h"
#include "unit.h"

static sky_frame truth;
static sc_call call;

static starcat_frame frame_of_truth(void) {
  const starcat_frame frame = {truth.count, truth.x, truth.y, truth.magnitudes};
  return frame;
}

static starcat_status identify(const unit_sky *sky) {
  const starcat_frame frame = frame_of_truth();
  return starcat_identify(&sky->image, &sky->camera, &sky->options, &frame, &unit_work,
                          &unit_result);
}

static starcat_status track(const unit_sky *sky, starcat_real uncertainty_rad) {
  const starcat_frame frame = frame_of_truth();
  return starcat_track(&sky->image, &sky->camera, &sky->options, &frame, truth.q_body_from_icrs,
                       uncertainty_rad, &unit_work, &unit_result);
}

/* A frame that the sky identifies, its stars in the workspace, and the call that found them. */
static void begin(const unit_sky *sky, uint64_t seed, uint32_t n_spots, uint32_t n_false) {
  sky_look(&sky->image, &sky->camera, &seed, 0.2, n_spots, n_false, &truth);
  CHECK_IS(identify(sky), STARCAT_IDENTIFIED);
  const starcat_frame frame = frame_of_truth();
  CHECK_IS(sc_begin(&call, &sky->image, &sky->camera, &sky->options, &frame, &unit_work,
                    &unit_result),
           STARCAT_IDENTIFIED);
}

static void matrix_of_truth(starcat_real m[9]) {
  for (uint32_t k = 0; k < 9u; k++) {
    m[k] = (starcat_real)truth.matrix[k];
  }
}

/* Directions that determine no attitude. */
static void check_degenerate(void) {
  const starcat_real zero[6] = {0}, v[3] = {1, 2, 3};
  starcat_real x[3], inverse[6], m[9] = {1, 0, 0, 0, 1, 0, 0, 0, 1};
  CHECK(!sc_solve(zero, v, x, inverse));
  sc_refine(m, v, v, NULL, 0, 4);
  CHECK(m[0] == (starcat_real)1.0);
  begin(&unit_triangle, 4, SKY_SPOTS, 0);
  CHECK(sc_try(&call, unit_result.matrix));
  const uint32_t n = unit_work.best.n_matched;
  CHECK(sc_log_chance(&call, (starcat_real)1.0, n) < (starcat_real)0.0);
  CHECK(sc_share(&call, unit_work.best.matrix, (starcat_real)0.0, n) > (starcat_real)0.5);
  for (uint32_t i = 0; i < unit_work.count; i++) {
    unit_work.match[i] = -1;
  }
  CHECK(sc_log_chance(&call, (starcat_real)1.0, n) >= (starcat_real)0.0);
  CHECK(sc_share(&call, unit_work.best.matrix, (starcat_real)0.0, n) <= (starcat_real)0.0);
}

/* Two centroids in one direction, as no frame has them, proposed as a triangle of stars. */
static void check_coincident(void) {
  starcat_real sides[3];
  const uint32_t triple[3] = {0, 1, 2};
  begin(&unit_triangle, 4, SKY_SPOTS, 0);
  sides[0] = sc_angle_of_chord(sc_chord_square(unit_work.body[1], unit_work.body[2]));
  sides[1] = sc_angle_of_chord(sc_chord_square(unit_work.body[0], unit_work.body[2]));
  sides[2] = sc_angle_of_chord(sc_chord_square(unit_work.body[0], unit_work.body[1]));
  for (uint32_t k = 0; k < 3u; k++) {
    unit_work.body[1][k] = unit_work.body[0][k];
  }
  CHECK_IS(sc_triangle(&call, triple, sides), 0);
  const uint32_t mirrored[3] = {1, 0, 2};
  const starcat_real mirrored_sides[3] = {sides[1], sides[0], sides[2]};
  CHECK_IS(sc_triangle(&call, mirrored, mirrored_sides), 0);
  for (uint32_t k = 0; k < 3u; k++) { /* all on one great circle */
    sides[k] = (starcat_real)(0.05 * (k + 1u));
  }
  CHECK_IS(sc_triangle(&call, triple, sides), 0);
  CHECK_IS(unit_work.n_tried, 0);
}

/* The same centroid again, of the same magnitude, and beside itself by less than can be told. */
static void check_repeated(void) {
  begin(&unit_pyramid, 4, SKY_SPOTS, 0);
  for (uint32_t k = 0; k < 4u; k++) {
    const uint32_t n = truth.count++;
    truth.x[n] = truth.x[k];
    truth.y[n] = truth.y[k];
    truth.magnitudes[n] = truth.magnitudes[k];
    truth.star[n] = -1;
  }
  CHECK_IS(identify(&unit_pyramid), STARCAT_IDENTIFIED);
  CHECK_IS(unit_result.star[truth.count - 1u], STARCAT_DROPPED_DUPLICATE);
  for (uint32_t k = 0; k < 4u; k++) {
    truth.x[truth.count - 4u + k] *= (starcat_real)(1.0 + IF_SINGLE(1e-7, 1e-8));
  }
  CHECK_IS(identify(&unit_pyramid), STARCAT_IDENTIFIED);
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
  CHECK_IS(identify(&unit_triangle), STARCAT_NO_MATCH);
  CHECK_IS(identify(&unit_pyramid), STARCAT_NO_MATCH);
}

/* What the caller accepts: much, a little more than is certain, and nothing. */
static void check_chances(void) {
  static const double chances[4] = {-6.9, -18.4, -30.0, -1000.0};
  unit_copy(&unit_triangle);
  for (uint32_t n = 0; n < 4u; n++) {
    uint64_t seed = 4;
    sky_look(&unit_scratch.image, &unit_scratch.camera, &seed, 0.2, SKY_SPOTS, 0, &truth);
    unit_scratch.options.log_chance = (starcat_real)chances[n];
    CHECK_IS(identify(&unit_scratch), n < 3u ? STARCAT_IDENTIFIED : STARCAT_NO_MATCH);
  }
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
  CHECK_IS(identify(&unit_scratch), STARCAT_E_CAMERA);
  unit_scratch.camera.k1 = (starcat_real)-0.2;
  unit_scratch.camera.k2 = (starcat_real)0.0;
  unit_scratch.camera.fold_radius = (starcat_real)0.3;
  CHECK_IS(identify(&unit_scratch), STARCAT_E_CAMERA);
}

/* Frames of another scale than the camera's are refused, larger and smaller ones, although every
 * star is within reach. */
static void check_scale(void) {
  for (int sign = -1; sign <= 1; sign += 2) {
    uint64_t seed = 4;
    uint32_t identified = 0;
    for (uint32_t n = 0; n < 10u; n++) {
      sky_look(&unit_pyramid.image, &unit_pyramid.camera, &seed, 0.02, SKY_SPOTS, 0, &truth);
      for (uint32_t k = 0; k < truth.count; k++) {
        const starcat_real scale = (starcat_real)(1.0 + sign * 0.008);
        truth.x[k] = (starcat_real)256.0 + scale * (truth.x[k] - (starcat_real)256.0);
        truth.y[k] = (starcat_real)256.0 + scale * (truth.y[k] - (starcat_real)256.0);
      }
      identified += (uint32_t)(identify(&unit_pyramid) == STARCAT_IDENTIFIED);
    }
    CHECK_IS(identified, 0);
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
    const starcat_status identified = identify(&unit_scratch);
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
  CHECK_IS(identify(&unit_scratch), STARCAT_NO_MATCH);
}

/* A few true stars in one corner and many spots elsewhere: an attitude that explains too little. */
static void check_clusters(void) {
  uint32_t identified = 0;
  for (uint32_t n = 0; n < 40u; n++) {
    uint64_t seed = n + 100u;
    unit_copy(&unit_crowded);
    starcat_real m[9];
    sky_look(&unit_crowded.image, &unit_crowded.camera, &seed, 0.1, STARCAT_MAX_CENTROIDS, 0,
             &truth);
    const starcat_real half = (starcat_real)(150.0 + 4.0 * n);
    for (uint32_t k = 0; k < truth.count; k++) {
      if ((truth.x[k] > half) || (truth.y[k] > half)) {
        truth.x[k] = (starcat_real)(512.0 * sky_uniform(&seed));
        truth.y[k] = (starcat_real)(512.0 * sky_uniform(&seed));
      } else {
        truth.x[k] += (starcat_real)(n % 4u) * (truth.x[k] > half - (starcat_real)20.0);
      }
    }
    const starcat_frame frame = frame_of_truth();
    CHECK_IS(sc_begin(&call, &unit_scratch.image, &unit_scratch.camera, &unit_scratch.options,
                      &frame, &unit_work, &unit_result),
             STARCAT_IDENTIFIED);
    matrix_of_truth(m);
    identified += (uint32_t)sc_try(&call, m);
    (void)sc_share(&call, m, (starcat_real)0.1, 6);
  }
  CHECK(identified < 40u);
}

void test_rare(void) {
  check_degenerate();
  check_coincident();
  check_repeated();
  check_lattice();
  check_chances();
  check_lenses();
  check_scale();
  check_crowded();
  check_second_rows();
  check_clusters();
}
