/* Frames: errors of the caller, centroids that are left out, and identified frames.
 *
 * SPDX-License-Identifier: MIT
 */
#include <string.h>

#include "unit.h"

#define NAN_REAL ((starcat_real)NAN)
#define PRIOR_RAD ((starcat_real)0.01)

static starcat_status identify(const unit_sky *sky, const starcat_frame *frame) {
  return starcat_identify_frame(&sky->image, &sky->camera, &sky->options, frame, &unit_work,
                                &unit_result);
}

static starcat_status track(const unit_sky *sky, const starcat_frame *frame,
                            const starcat_real q[4], starcat_real uncertainty_rad) {
  return starcat_track_frame(&sky->image, &sky->camera, &sky->options, frame, q, uncertainty_rad,
                             &unit_work, &unit_result);
}

static void check_nulls(const starcat_frame *frame, const starcat_real q[4]) {
  const unit_sky *s = &unit_scratch;
  starcat_frame without = *frame;
  CHECK_IS(starcat_identify_frame(NULL, &s->camera, &s->options, frame, &unit_work, &unit_result),
           STARCAT_E_NULL);
  CHECK_IS(starcat_identify_frame(&s->image, NULL, &s->options, frame, &unit_work, &unit_result),
           STARCAT_E_NULL);
  CHECK_IS(starcat_identify_frame(&s->image, &s->camera, NULL, frame, &unit_work, &unit_result),
           STARCAT_E_NULL);
  CHECK_IS(
      starcat_identify_frame(&s->image, &s->camera, &s->options, NULL, &unit_work, &unit_result),
      STARCAT_E_NULL);
  CHECK_IS(starcat_identify_frame(&s->image, &s->camera, &s->options, frame, NULL, &unit_result),
           STARCAT_E_NULL);
  CHECK_IS(starcat_identify_frame(&s->image, &s->camera, &s->options, frame, &unit_work, NULL),
           STARCAT_E_NULL);
  starcat_camera camera;
  CHECK_IS(starcat_get_camera(NULL, &camera), STARCAT_E_NULL);
  CHECK_IS(starcat_get_camera(&s->image, NULL), STARCAT_E_NULL);
  CHECK_IS(starcat_get_camera(&s->image, &camera), STARCAT_OK);
  CHECK_IS(starcat_set_default_options(NULL), STARCAT_E_NULL);
  CHECK_IS(track(s, NULL, q, PRIOR_RAD), STARCAT_E_NULL);
  CHECK_IS(track(s, frame, NULL, PRIOR_RAD), STARCAT_E_NULL);
  without.x_px = NULL;
  CHECK_IS(identify(s, &without), STARCAT_E_NULL);
  without = *frame;
  without.y_px = NULL;
  CHECK_IS(identify(s, &without), STARCAT_E_NULL);
  CHECK_IS(track(s, &without, q, PRIOR_RAD), STARCAT_E_NULL);
  without.x_px = NULL;
  without.count = 0;
  CHECK_IS(identify(s, &without), STARCAT_TOO_FEW_STARS);
}

/* An option set to a number, and set back. */
static starcat_status with_option(starcat_real *option, starcat_real value,
                                  const starcat_frame *frame, const starcat_real q[4]) {
  const starcat_real before = *option;
  *option = value;
  unit_result.n_matched = 9; /* of the frame before */
  const starcat_status status = identify(&unit_scratch, frame);
  CHECK_IS(unit_result.n_matched, 0);
  CHECK_IS(track(&unit_scratch, frame, q, PRIOR_RAD), status);
  *option = before;
  return status;
}

static void check_options(const starcat_frame *frame, const starcat_real q[4]) {
  starcat_options *o = &unit_scratch.options;
  starcat_real *const numbers[6] = {&o->tolerance_px, &o->noise_px, &o->noise_mag, &o->log_chance,
                                    &o->fov_error,    &o->camera_error};
  for (uint32_t n = 0; n < 6u; n++) {
    CHECK_IS(with_option(numbers[n], NAN_REAL, frame, q), STARCAT_E_NOT_FINITE);
    CHECK_IS(with_option(numbers[n], (starcat_real)INFINITY, frame, q), STARCAT_E_NOT_FINITE);
  }
  CHECK_IS(with_option(&o->tolerance_px, (starcat_real)0.0, frame, q), STARCAT_E_OPTIONS);
  CHECK_IS(with_option(&o->tolerance_px, (starcat_real)-1.0, frame, q), STARCAT_E_OPTIONS);
  CHECK_IS(with_option(&o->tolerance_px, (starcat_real)2e6, frame, q), STARCAT_E_OPTIONS);
  CHECK_IS(with_option(&o->noise_px, (starcat_real)1e-7, frame, q), STARCAT_E_OPTIONS);
  CHECK_IS(with_option(&o->noise_mag, (starcat_real)2e6, frame, q), STARCAT_E_OPTIONS);
  CHECK_IS(with_option(&o->noise_px, (starcat_real)-1.0, frame, q), STARCAT_E_OPTIONS);
  CHECK_IS(with_option(&o->noise_mag, (starcat_real)-1.0, frame, q), STARCAT_E_OPTIONS);
  CHECK_IS(with_option(&o->fov_error, (starcat_real)-0.1, frame, q), STARCAT_E_OPTIONS);
  CHECK_IS(with_option(&o->fov_error, (starcat_real)0.51, frame, q), STARCAT_E_OPTIONS);
  CHECK_IS(with_option(&o->camera_error, (starcat_real)-0.01, frame, q), STARCAT_E_OPTIONS);
  CHECK_IS(with_option(&o->camera_error, (starcat_real)0.11, frame, q), STARCAT_E_OPTIONS);
  CHECK_IS(with_option(&o->camera_error, (starcat_real)9e-7, frame, q), STARCAT_E_OPTIONS);
  o->max_steps = 0;
  CHECK_IS(identify(&unit_scratch, frame), STARCAT_E_OPTIONS);
  CHECK_IS(track(&unit_scratch, frame, q, PRIOR_RAD), STARCAT_E_OPTIONS);
  (void)starcat_set_default_options(o);
}

/* Every number of a camera out of its range, above and below. */
static void check_cameras(const starcat_frame *frame, const starcat_real q[4]) {
  starcat_camera *c = &unit_scratch.camera;
  static const double low[5] = {0.0, 0.0, 1e-3, -2e6, -2e6};
  static const double high[5] = {2e6, 2e6, 2e9, 2e6, 2e6};
  starcat_real *const numbers[11] = {&c->width_px, &c->height_px,  &c->focal_length_px,
                                     &c->x0_px,    &c->y0_px,      &c->k1,
                                     &c->k2,       &c->k3,         &c->p1,
                                     &c->p2,       &c->fold_radius};
  for (uint32_t n = 0; n < 11u; n++) {
    const starcat_real least = (starcat_real)(n < 5u ? low[n] : -2e9);
    const starcat_real most = (starcat_real)(n < 5u ? high[n] : 2e9);
    CHECK_IS(with_option(numbers[n], least, frame, q), STARCAT_E_CAMERA);
    CHECK_IS(with_option(numbers[n], most, frame, q), STARCAT_E_CAMERA);
    CHECK_IS(with_option(numbers[n], NAN_REAL, frame, q), STARCAT_E_CAMERA);
  }
  /* A lens that folds inside the detector: no direction is seen in its corners. */
  c->k1 = (starcat_real)-3.0;
  c->fold_radius = (starcat_real)(1.0 / 3.0);
  CHECK_IS(identify(&unit_scratch, frame), STARCAT_E_CAMERA);
  (void)starcat_get_camera(&unit_scratch.image, c);
}

static void check_priors(const starcat_frame *frame, const starcat_real q[4]) {
  for (uint32_t n = 0; n < 4u; n++) {
    starcat_real bad[4] = {q[0], q[1], q[2], q[3]};
    bad[n] = NAN_REAL;
    CHECK_IS(track(&unit_scratch, frame, bad, PRIOR_RAD), STARCAT_E_NOT_FINITE);
  }
  const starcat_real zero[4] = {0};
  CHECK_IS(track(&unit_scratch, frame, zero, PRIOR_RAD), STARCAT_E_OPTIONS);
  const starcat_real large[4] = {0, 0, 0, (starcat_real)2e6};
  CHECK_IS(track(&unit_scratch, frame, large, PRIOR_RAD), STARCAT_E_OPTIONS);
  CHECK_IS(track(&unit_scratch, frame, q, NAN_REAL), STARCAT_E_NOT_FINITE);
  CHECK_IS(track(&unit_scratch, frame, q, (starcat_real)0.0), STARCAT_E_OPTIONS);
  CHECK_IS(track(&unit_scratch, frame, q, (starcat_real)-0.1), STARCAT_E_OPTIONS);
  CHECK_IS(track(&unit_scratch, frame, q, (starcat_real)0.36), STARCAT_E_OPTIONS);
  /* A camera of 160 degrees and a prior of 20: stars behind the camera would have to be sought. */
  unit_scratch.camera.focal_length_px = (starcat_real)64.0;
  CHECK_IS(track(&unit_scratch, frame, q, (starcat_real)0.34), STARCAT_E_OPTIONS);
  (void)starcat_get_camera(&unit_scratch.image, &unit_scratch.camera);
}

void test_errors(void) {
  uint64_t state = 3;
  sky_frame truth;
  unit_copy(&unit_triangle);
  sky_look(&unit_triangle.image, &unit_triangle.camera, &state, 0.2, SKY_SPOTS, 0, &truth);
  starcat_frame frame = unit_frame_of(&truth);
  check_nulls(&frame, truth.q_body_from_icrs);
  check_options(&frame, truth.q_body_from_icrs);
  check_cameras(&frame, truth.q_body_from_icrs);
  check_priors(&frame, truth.q_body_from_icrs);
  frame.count = STARCAT_MAX_CENTROIDS + 1u;
  CHECK_IS(identify(&unit_scratch, &frame), STARCAT_E_TOO_MANY_CENTROIDS);
  CHECK_IS(track(&unit_scratch, &frame, truth.q_body_from_icrs, PRIOR_RAD),
           STARCAT_E_TOO_MANY_CENTROIDS);
  for (frame.count = 0; frame.count < 4u; frame.count++) {
    CHECK_IS(identify(&unit_scratch, &frame), STARCAT_TOO_FEW_STARS);
    CHECK_IS(track(&unit_scratch, &frame, truth.q_body_from_icrs, PRIOR_RAD),
             STARCAT_TOO_FEW_STARS);
  }
}

/* Centroids that cannot be used get their reason, and the others are identified as without them.
 */
void test_dropped(void) {
  uint64_t state = 4;
  sky_frame truth;
  starcat_real x[STARCAT_MAX_CENTROIDS], y[STARCAT_MAX_CENTROIDS];
  starcat_real magnitudes[STARCAT_MAX_CENTROIDS];
  sky_look(&unit_triangle.image, &unit_triangle.camera, &state, 0.2, SKY_SPOTS, 0, &truth);
  const starcat_frame clean = unit_frame_of(&truth),
                      dirty = {truth.count + 6u, x, y, magnitudes, NULL};
  const uint32_t n = truth.count;
  memcpy(x, truth.x, sizeof truth.x);
  memcpy(y, truth.y, sizeof truth.y);
  memcpy(magnitudes, truth.magnitudes, sizeof truth.magnitudes);
  for (uint32_t i = n; i < n + 6u; i++) {
    x[i] = (starcat_real)50.0;
    y[i] = (starcat_real)60.0;
    magnitudes[i] = (starcat_real)9.0;
  }
  x[n] = NAN_REAL;
  y[n + 1u] = (starcat_real)INFINITY;
  x[n + 2u] = (starcat_real)-0.5;
  y[n + 3u] = (starcat_real)512.5;
  x[n + 4u] = x[2];
  y[n + 4u] = y[2];
  magnitudes[n + 5u] = NAN_REAL;
  CHECK_IS(identify(&unit_triangle, &clean), STARCAT_IDENTIFIED);
  const starcat_result expected = unit_result;
  CHECK_IS(identify(&unit_triangle, &dirty), STARCAT_IDENTIFIED);
  CHECK(memcmp(unit_result.star, expected.star, n * sizeof expected.star[0]) == 0);
  CHECK_IS(unit_result.star[n], STARCAT_DROPPED_NOT_FINITE);
  CHECK_IS(unit_result.star[n + 1u], STARCAT_DROPPED_NOT_FINITE);
  CHECK_IS(unit_result.star[n + 2u], STARCAT_DROPPED_OUT_OF_FRAME);
  CHECK_IS(unit_result.star[n + 3u], STARCAT_DROPPED_OUT_OF_FRAME);
  CHECK_IS(unit_result.star[n + 4u], STARCAT_DROPPED_DUPLICATE);
  CHECK_IS(unit_result.star[n + 5u], STARCAT_NO_STAR);
  x[n + 2u] = (starcat_real)512.5;
  y[n + 3u] = (starcat_real)-0.5;
  y[n + 4u] = (starcat_real)61.0; /* the same column alone is not a repeat */
  for (uint32_t i = 0; i < dirty.count; i++) {
    magnitudes[i] = NAN_REAL; /* as if none were given */
  }
  CHECK_IS(identify(&unit_triangle, &dirty), STARCAT_IDENTIFIED);
  CHECK_IS(unit_result.star[n + 2u], STARCAT_DROPPED_OUT_OF_FRAME);
  CHECK_IS(unit_result.star[n + 3u], STARCAT_DROPPED_OUT_OF_FRAME);
  CHECK_IS(unit_result.star[n + 4u], STARCAT_NO_STAR);
  const starcat_result unknown = unit_result;
  for (uint32_t i = 0; i < dirty.count; i++) {
    magnitudes[i] = (starcat_real)3e38; /* as a composite has them */
  }
  CHECK_IS(identify(&unit_triangle, &dirty), STARCAT_IDENTIFIED);
  CHECK(memcmp(&unit_result, &unknown, sizeof unknown) == 0);
}

/* Count the centroids that have the wrong star, and check the attitude. */
static uint32_t wrong_stars(const sky_frame *truth) {
  const uint32_t wrong = unit_wrong_stars(truth);
  double off = 0.0;
  for (uint32_t k = 0; k < 9u; k++) {
    off = fmax(off, fabs((double)unit_result.matrix[k] - truth->matrix[k]));
  }
  for (uint32_t k = 0; k < 4u; k++) {
    off = fmax(off,
               fabs((double)unit_result.q_body_from_icrs[k] - (double)truth->q_body_from_icrs[k]));
  }
  CHECK(off < 0.02);
  return wrong;
}

/* Identify frames of a sky, lost in space and tracked; count what is identified. */
static void look_around(const unit_sky *sky, int with_magnitudes, uint32_t n_false,
                        uint32_t found[2]) {
  uint64_t state = 11;
  sky_frame truth;
  found[0] = 0;
  found[1] = 0;
  for (uint32_t n = 0; n < 60u; n++) {
    sky_look(&unit_triangle.image, &sky->camera, &state, 0.2, SKY_SPOTS, n_false, &truth);
    starcat_frame frame = unit_frame_of(&truth);
    if (!with_magnitudes) {
      frame.magnitudes = NULL;
    }
    starcat_status status = identify(sky, &frame);
    if (status == STARCAT_IDENTIFIED) {
      CHECK_IS(wrong_stars(&truth), 0);
      CHECK(unit_result.log_chance <= sky->options.log_chance);
      CHECK((unit_result.n_matched >= 4u) && (unit_result.n_matched <= frame.count));
      CHECK(unit_result.residual_rad < (starcat_real)0.003);
      found[0]++;
    } else {
      CHECK(status > 0);
    }
    status = track(sky, &frame, truth.q_body_from_icrs, PRIOR_RAD);
    if (status == STARCAT_IDENTIFIED) {
      CHECK_IS(wrong_stars(&truth), 0);
      found[1]++;
    } else {
      CHECK(status > 0);
    }
  }
}

void test_identify(void) {
  uint32_t found[2];
  const unit_sky *skies[2] = {&unit_triangle, &unit_pyramid};
  for (uint32_t n = 0; n < 2u; n++) {
    for (int with_magnitudes = 0; with_magnitudes < 2; with_magnitudes++) {
      unit_copy(skies[n]);
      look_around(&unit_scratch, with_magnitudes, 0, found);
      CHECK(found[0] >= 50u && found[1] >= 50u);
      look_around(&unit_scratch, with_magnitudes, 2, found);
      CHECK(found[0] >= 40u && found[1] >= 40u);
      unit_scratch.options.noise_mag = (starcat_real)0.3;
      unit_scratch.options.noise_px = (starcat_real)0.3;
      look_around(&unit_scratch, with_magnitudes, 2, found);
      CHECK(found[0] >= 40u && found[1] >= 40u);
      /* A lens, as the ground has it. */
      unit_scratch.camera.k1 = (starcat_real)-0.1;
      unit_scratch.camera.k2 = (starcat_real)0.02;
      unit_scratch.camera.k3 = (starcat_real)-0.003;
      unit_scratch.camera.p1 = (starcat_real)0.001;
      unit_scratch.camera.p2 = (starcat_real)-0.002;
      unit_scratch.camera.fold_radius = (starcat_real)1.8;
      look_around(&unit_scratch, with_magnitudes, 0, found);
      CHECK(found[0] >= 50u && found[1] >= 50u);
    }
  }
}

/* A prior that is off in every direction, one that is wrong, and one that is not a unit. */
void test_track(void) {
  uint64_t state = 21;
  uint32_t found = 0, refused = 0;
  sky_frame truth;
  for (uint32_t n = 0; n < 40u; n++) {
    starcat_real q[4], wrong[4];
    sky_look(&unit_pyramid.image, &unit_pyramid.camera, &state, 0.2, SKY_SPOTS, 2, &truth);
    const starcat_frame frame = unit_frame_of(&truth);
    for (uint32_t k = 0; k < 4u; k++) {
      const double turn = n % 4u == k ? 0.008 : 0.0;
      q[k] = (starcat_real)(3.0 * ((double)truth.q_body_from_icrs[k] + turn));
      wrong[k] = truth.q_body_from_icrs[(k + 1u) % 4u];
    }
    if (track(&unit_pyramid, &frame, q, (starcat_real)0.02) == STARCAT_IDENTIFIED) {
      CHECK_IS(wrong_stars(&truth), 0);
      found++;
    }
    refused += (uint32_t)(track(&unit_pyramid, &frame, wrong, PRIOR_RAD) == STARCAT_NO_MATCH);
  }
  CHECK(found >= 35u);
  CHECK_IS(refused, 40);
}

/* Whatever the budget, a call returns, never takes more, and the answer does not depend on what is
 * left over. Without a budget of an answer it says that the budget was used up. */
static void check_budgets(unit_sky *sky, const sky_frame *truth, int is_tracked, int has_mag) {
  starcat_frame frame = unit_frame_of(truth);
  uint32_t enough = 0, used_up = 0;
  if (!has_mag) {
    frame.magnitudes = NULL;
  }
  for (uint32_t steps = 1; steps < 400000u; steps += 1u + steps / 60u) {
    sky->options.max_steps = steps;
    const starcat_status status =
        is_tracked ? track(sky, &frame, truth->q_body_from_icrs, (starcat_real)0.03)
                   : identify(sky, &frame);
    CHECK((unit_result.steps <= steps) && (unit_result.steps > 0u));
    if (status == STARCAT_IDENTIFIED) {
      CHECK_IS(wrong_stars(truth), 0);
      enough = enough == 0u ? unit_result.steps : enough;
      CHECK((unit_result.steps == enough) || (unit_result.steps == steps));
    } else {
      CHECK((status == STARCAT_NO_MATCH) || (status == STARCAT_E_BUDGET));
      CHECK_IS(unit_result.n_matched, 0);
      CHECK((status == STARCAT_NO_MATCH) || (unit_result.steps == steps));
      used_up += (uint32_t)(status == STARCAT_E_BUDGET);
    }
  }
  CHECK((enough > 0u) && (used_up > 0u));
}

void test_budget(void) {
  uint64_t state = 31;
  sky_frame truth;
  const unit_sky *skies[2] = {&unit_triangle, &unit_pyramid};
  sky_look(&unit_triangle.image, &unit_triangle.camera, &state, 0.2, SKY_SPOTS, 2, &truth);
  for (uint32_t n = 0; n < 8u; n++) {
    unit_copy(skies[n % 2u]);
    check_budgets(&unit_scratch, &truth, (n & 2u) != 0u, (n & 4u) != 0u);
  }
  (void)starcat_set_default_options(&unit_scratch.options);
  CHECK_IS(unit_scratch.options.max_steps, 4000000);
}
