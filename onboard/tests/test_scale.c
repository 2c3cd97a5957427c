/* Focal lengths that are not known, and frames of another scale than the camera's.
 *
 * SPDX-License-Identifier: MIT
 */
#include "internal.h"
#include "unit.h"

static sky_frame truth;
static starcat_call call;

static starcat_status begin(const unit_sky *sky) {
  const starcat_frame frame = unit_frame_of(&truth);
  return starcat_begin_call(&call, &sky->image, &sky->camera, &sky->options, &frame, &unit_work,
                            &unit_result);
}

/* The focal length that was found, over the true one. */
static double found_scale(void) {
  return (double)unit_result.focal_length_px / (double)unit_triangle.camera.focal_length_px;
}

/* Focal lengths stated up to a quarter wrong are found, with a lens and without. */
static void check_found(void) {
  static const double noises[3] = {0.0, 0.1, 0.3}, errors[3] = {2e-4, 1e-3, 3e-3};
  uint64_t state = 71;
  uint32_t found[3] = {0};
  for (uint32_t n = 0; n < 90u; n++) {
    const uint32_t kind = n % 3u;
    unit_scratch = unit_triangle;
    unit_scratch.camera.k1 = (starcat_real)(n % 2u == 0u ? 0.0 : -0.1);
    sky_look(&unit_triangle.image, &unit_scratch.camera, &state, noises[kind], SKY_SPOTS,
             kind == 0u ? 0u : 2u, &truth);
    unit_scratch.camera.focal_length_px *=
        (starcat_real)(n < 9u ? 1.0 : 0.8 + 0.45 * sky_uniform(&state));
    unit_scratch.options.fov_error = (starcat_real)0.3;
    if (unit_identify(&unit_scratch, &truth) == STARCAT_IDENTIFIED) {
      CHECK_IS(unit_wrong_stars(&truth), 0);
      CHECK_NEAR(found_scale(), 1.0, errors[kind]);
      found[kind]++;
    }
  }
  CHECK((found[0] >= 29u) && (found[1] >= 29u) && (found[2] >= 27u));
}

/* A lens that shows nothing in a corner with a focal length that is a tenth smaller: that is not
 * tried, and what it can show is found. */
static void check_lens(void) {
  uint64_t state = 72;
  uint32_t found = 0;
  starcat_real x = 0, y = 0;
  for (uint32_t n = 0; n < 20u; n++) {
    unit_scratch = unit_triangle;
    unit_scratch.camera.k1 = (starcat_real)-0.2;
    unit_scratch.camera.fold_radius = (starcat_real)0.57;
    sky_look(&unit_triangle.image, &unit_scratch.camera, &state, 0.1, SKY_SPOTS, 0, &truth);
    unit_scratch.options.fov_error = (starcat_real)0.2;
    unit_scratch.camera.focal_length_px *= (starcat_real)(1.0 + 0.1 * sky_uniform(&state));
    found += (uint32_t)((unit_identify(&unit_scratch, &truth) == STARCAT_IDENTIFIED) &&
                        (unit_wrong_stars(&truth) == 0u));
  }
  CHECK(found >= 19u);
  CHECK_IS(begin(&unit_scratch), STARCAT_OK);
  (void)starcat_set_focal(&call, (starcat_real)1.05);
  CHECK(call.focal == (starcat_real)1.05);
  CHECK(call.body == unit_work.scaled);
  (void)starcat_set_focal(&call, (starcat_real)0.8);
  CHECK(call.focal == (starcat_real)1.0);
  CHECK(call.body == unit_work.body);
  CHECK(call.camera.given.focal_length_px == unit_scratch.camera.focal_length_px);
  CHECK(starcat_find_pixel(&call.camera, unit_work.body[0], &x, &y));
  CHECK_NEAR(x, unit_work.x[0], 1e-3);
  CHECK_NEAR(y, unit_work.y[0], 1e-3);
}

/* A false spot close to a star's spot is rarely taken for the star. */
static void check_beside(void) {
  uint64_t state = 73;
  uint32_t found = 0, wrong = 0;
  for (uint32_t n = 0; n < 40u; n++) {
    unit_scratch = unit_triangle;
    unit_scratch.options.fov_error = (starcat_real)0.05;
    sky_look(&unit_triangle.image, &unit_triangle.camera, &state, 0.1, SKY_SPOTS, 0, &truth);
    const uint32_t spot = truth.count++, beside = n % spot;
    const double angle = 6.28 * sky_uniform(&state), apart_px = 1.0 + 4.0 * sky_uniform(&state);
    truth.x[spot] = truth.x[beside] + (starcat_real)(apart_px * cos(angle));
    truth.y[spot] = truth.y[beside] + (starcat_real)(apart_px * sin(angle));
    truth.magnitudes[spot] = truth.magnitudes[beside];
    truth.star[spot] = -1;
    unit_scratch.camera.focal_length_px *= (starcat_real)(0.97 + 0.06 * sky_uniform(&state));
    if (unit_identify(&unit_scratch, &truth) == STARCAT_IDENTIFIED) {
      wrong += unit_wrong_stars(&truth);
      found++;
    }
    /* The steps can run out anywhere. */
    const uint32_t enough = unit_result.steps;
    for (uint32_t fewer = 1; (fewer < 1500u) && (fewer < enough); fewer += 60u) {
      unit_scratch.options.max_steps = enough - fewer;
      (void)unit_identify(&unit_scratch, &truth);
      CHECK_IS(unit_result.steps, enough - fewer);
    }
  }
  CHECK(found >= 36u);
  CHECK(wrong < 2u);
}

/* Tolerances so wide that a side may be of any length: sides shorter than their error, and angles
 * larger than a half turn. */
static void check_wide(void) {
  uint64_t state = 74;
  uint32_t found = 0;
  for (uint32_t n = 0; n < 40u; n++) {
    static const double tolerances[4] = {20.0, 60.0, 120.0, 250.0};
    unit_scratch = unit_triangle;
    unit_scratch.options.fov_error = (starcat_real)(n % 8u < 4u ? 0.5 : 0.05);
    unit_scratch.options.tolerance_px = (starcat_real)tolerances[n % 4u];
    unit_scratch.options.max_steps = 300000;
    sky_look(&unit_triangle.image, &unit_triangle.camera, &state, 0.1, 4u + n / 5u, 0, &truth);
    if (unit_identify(&unit_scratch, &truth) == STARCAT_IDENTIFIED) {
      CHECK_IS(unit_wrong_stars(&truth), 0);
      found++;
    }
    CHECK(unit_result.steps <= unit_scratch.options.max_steps);
  }
  CHECK(found < 10u);
}

/* Directions so close to each other that rounding decides the focal length: it stays within its
 * error, and the bound on chance stays finite. */
static void check_near(void) {
  uint64_t state = 75;
  unit_scratch = unit_triangle;
  unit_scratch.options.fov_error = (starcat_real)0.3;
  for (uint32_t n = 0; n < 400u; n++) {
    starcat_real m[9];
    sky_look(&unit_triangle.image, &unit_triangle.camera, &state, 0.1, SKY_SPOTS, 0, &truth);
    unit_matrix_of(&truth, m);
    CHECK_IS(begin(&unit_scratch), STARCAT_OK);
    const double size = n == 0u ? 0.0 : IF_SINGLE(1e-4, 1e-8) * sky_uniform(&state);
    const double x = 0.3 * sky_uniform(&state), y = n == 0u ? 0.0 : 0.3 * sky_uniform(&state);
    for (uint32_t i = 0; i < call.own->count; i++) {
      const double u = (n == 0u ? 0.0 : x) + size * sky_normal(&state);
      const double v = y + size * sky_normal(&state), scale = 1.0 / sqrt(1.0 + u * u + v * v);
      unit_work.body[i][0] = (starcat_real)(scale * u);
      unit_work.body[i][1] = (starcat_real)(scale * v);
      unit_work.body[i][2] = (starcat_real)scale;
    }
    (void)starcat_try_attitude(&call, m, (starcat_real)1.0);
    const starcat_real bound = unit_work.best.log_bound, focal = unit_work.best.focal;
    CHECK(bound - bound == (starcat_real)0.0);
    CHECK((focal >= (starcat_real)0.6999) && (focal <= (starcat_real)1.4287));
  }
}

/* Frames of few stars at another scale than the camera's: they are identified if their stars
 * determine the attitude whatever the shape of the frame is. */
static void check_other_scales(void) {
  static const double scales[4] = {0.992, 0.996, 1.004, 1.008};
  uint64_t state = 76;
  for (uint32_t kind = 0; kind < 4u; kind++) {
    uint32_t found = 0;
    unit_scratch = unit_triangle;
    unit_scratch.camera.focal_length_px *= (starcat_real)scales[kind];
    for (uint32_t n = 0; n < 40u; n++) {
      sky_look(&unit_triangle.image, &unit_triangle.camera, &state, 0.4, 8u, 0, &truth);
      if (unit_identify(&unit_scratch, &truth) == STARCAT_IDENTIFIED) {
        CHECK_IS(unit_wrong_stars(&truth), 0);
        CHECK(unit_error_rad(&truth) < 3e-3);
        found++;
      }
    }
    CHECK(found >= 37u);
  }
}

/* True stars in one corner, spots elsewhere, and a wrong focal length: the answer is the first
 * attitude, not the wrong attitude with another focal length that is tried last. */
static void check_corners(void) {
  static const starcat_real other[9] = {1, 0, 0, 0, 1, 0, 0, 0, 1};
  static const double scales[4] = {1.0, 0.985, 1.015, 1.03};
  uint32_t found = 0, wrong = 0;
  uint64_t state = 77;
  unit_scratch = unit_crowded;
  unit_scratch.options.fov_error = (starcat_real)0.05;
  for (uint32_t n = 0; n < 120u; n++) {
    starcat_real m[9];
    sky_look(&unit_crowded.image, &unit_crowded.camera, &state, 0.1, STARCAT_MAX_CENTROIDS, 0,
             &truth);
    const starcat_real edge = (starcat_real)(140 + 40 * (n / 4u % 6u));
    for (uint32_t k = 0; k < truth.count; k++) {
      if ((truth.x[k] > edge) || (truth.y[k] > edge)) {
        truth.x[k] = (starcat_real)(512.0 * sky_uniform(&state));
        truth.y[k] = (starcat_real)(512.0 * sky_uniform(&state));
        truth.star[k] = -1;
      }
    }
    unit_scratch.camera.focal_length_px =
        unit_crowded.camera.focal_length_px * (starcat_real)scales[n % 4u];
    unit_matrix_of(&truth, m);
    CHECK_IS(begin(&unit_scratch), STARCAT_OK);
    (void)starcat_try_attitude(&call, m, (starcat_real)1.0);
    (void)starcat_try_attitude(&call, other, (starcat_real)0.96);
    if (starcat_end_call(&call, &unit_scratch.options, &unit_result) == STARCAT_IDENTIFIED) {
      for (uint32_t k = 0; k < truth.count; k++) {
        wrong += (uint32_t)((unit_result.star[k] >= 0) && (truth.star[k] >= 0) &&
                            (unit_result.star[k] != truth.star[k]));
      }
      found++;
      CHECK_NEAR(found_scale(), 1.0, 0.02);
    }
  }
  CHECK(found > 60u);
  CHECK(wrong < 4u);
}

/* Pixels that are not square: most frames are identified, and no boresight is farther off than such
 * pixels move it. */
static void check_shapes(void) {
  static const double stretches[4] = {0.95, 0.98, 1.02, 1.05};
  const unit_sky *skies[2] = {&unit_triangle, &unit_crowded};
  uint64_t state = 79;
  uint32_t found = 0;
  for (uint32_t n = 0; n < 160u; n++) {
    const unit_sky *sky = skies[n % 2u];
    unit_scratch = *sky;
    unit_scratch.options.fov_error = (starcat_real)(n % 3u == 0u ? 0.0 : 0.05);
    unit_scratch.options.noise_mag = (starcat_real)(n % 5u == 0u ? 0.3 : 0.0);
    sky_look(&sky->image, &sky->camera, &state, 0.3, STARCAT_MAX_CENTROIDS, 2u, &truth);
    for (uint32_t k = 0; k < truth.count; k++) {
      const double middle = 0.5 * (double)sky->camera.width_px;
      const double stretch = stretches[(n / 2u) % 4u];
      truth.x[k] = (starcat_real)(middle + stretch * ((double)truth.x[k] - middle));
    }
    if (unit_identify(&unit_scratch, &truth) == STARCAT_IDENTIFIED) {
      CHECK(unit_error_rad(&truth) < 3e-3);
      found++;
    }
  }
  CHECK(found >= 120u);
}

/* Whatever the budget, a call takes no more of it, and what it finds is right. */
static void check_budgets(void) {
  uint64_t state = 78;
  uint32_t found = 0, used_up = 0;
  unit_scratch = unit_triangle;
  unit_scratch.camera.focal_length_px *= (starcat_real)1.04;
  unit_scratch.options.fov_error = (starcat_real)0.1;
  sky_look(&unit_triangle.image, &unit_triangle.camera, &state, 0.1, SKY_SPOTS, 2, &truth);
  for (uint32_t steps = 1; steps < 400000u; steps += 1u + steps / 20u) {
    unit_scratch.options.max_steps = steps;
    const starcat_status status = unit_identify(&unit_scratch, &truth);
    CHECK((unit_result.steps > 0u) && (unit_result.steps <= steps));
    if (status == STARCAT_IDENTIFIED) {
      CHECK_IS(unit_wrong_stars(&truth), 0);
      CHECK_NEAR(found_scale(), 1.0, 2e-3);
      found++;
    } else {
      CHECK_IS(status, STARCAT_E_BUDGET);
      CHECK_IS(unit_result.reason, STARCAT_REASON_STEPS);
      used_up++;
    }
  }
  CHECK((found > 0u) && (used_up > 0u));
}

void test_scale(void) {
  unit_copy(&unit_triangle);
  check_found();
  check_lens();
  check_beside();
  check_wide();
  check_near();
  check_other_scales();
  check_corners();
  check_shapes();
  check_budgets();
}
