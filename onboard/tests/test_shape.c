/* Frames that have another shape than their camera: the terms that are found, frames whose stars do
 * not determine the attitude, and numbers that no frame has.
 *
 * SPDX-License-Identifier: MIT
 */
#include <string.h>

#include "internal.h"
#include "traps.h"
#include "unit.h"

#define TERMS 6u
#define CORNER_PX 362.03867196751236 /* of a detector of 512 by 512 pixels */

static sky_frame truth;
static starcat_call call;

/* By how much a shape moves a place that is counted from the axis, in pixels. */
static void move_place(const double terms[TERMS], double x, double y, double moved[2]) {
  const double mean = 7.0 / 15.0; /* of a square detector */
  const double radial = (x * x + y * y) / (CORNER_PX * CORNER_PX) - mean;
  const double factor = terms[0] + terms[1] * radial + (terms[4] * x + terms[5] * y) / CORNER_PX;
  moved[0] = factor * x + terms[3] * y;
  moved[1] = factor * y + terms[2] * y;
}

/* Give the frame a shape: its places less what the shape moves them by are those of the camera. */
static void give_shape(const double terms[TERMS]) {
  for (uint32_t k = 0; k < truth.count; k++) {
    const double x = (double)truth.x[k] - 256.0, y = (double)truth.y[k] - 256.0;
    double there[2] = {x, y};
    for (uint32_t n = 0; n < 60u; n++) {
      double moved[2];
      move_place(terms, there[0], there[1], moved);
      there[0] = x + moved[0];
      there[1] = y + moved[1];
    }
    truth.x[k] = (starcat_real)(256.0 + there[0]);
    truth.y[k] = (starcat_real)(256.0 + there[1]);
  }
}

/* The shapes of the tests: each term, a lens, a rolling shutter, and all together. */
static const double SHAPES[9][TERMS] = {{0.02, 0, 0, 0, 0, 0},
                                        {-0.03, 0, 0, 0, 0, 0},
                                        {0, 0.05, 0, 0, 0, 0},
                                        {0, 0, 0.03, 0, 0, 0},
                                        {0, 0, 0, -0.03, 0, 0},
                                        {0, 0, 0, 0, 0.03, 0},
                                        {0, 0, 0, 0, 0, -0.03},
                                        {0.01, -0.02, 0.02, 0.02, 0, 0},
                                        {-0.01, 0.02, -0.01, 0.01, 0.01, 0.01}};

/* Every term is found, with its sign and with the attitude, if noise is stated and if not. */
static void check_terms(void) {
  uint64_t state = 81;
  uint32_t found = 0;
  for (uint32_t n = 0; n < 90u; n++) {
    const double *terms = SHAPES[n % 9u];
    const double noise_px = n % 5u == 0u ? 0.001 : 0.1;
    starcat_real sigma_px[STARCAT_MAX_CENTROIDS];
    sky_look(&unit_crowded.image, &unit_crowded.camera, &state, noise_px, STARCAT_MAX_CENTROIDS, 4,
             &truth);
    give_shape(terms);
    for (uint32_t k = 0; k < truth.count; k++) {
      sigma_px[k] = (starcat_real)noise_px;
    }
    starcat_frame frame = unit_frame_of(&truth);
    frame.sigma_px = n % 2u == 0u ? NULL : sigma_px;
    if (starcat_identify_frame(&unit_crowded.image, &unit_crowded.camera, &unit_crowded.options,
                               &frame, &unit_work, &unit_result) != STARCAT_IDENTIFIED) {
      continue; /* the steps are used up */
    }
    found++;
    CHECK(unit_wrong_stars(&truth) <= 1u);
    CHECK(unit_error_rad(&truth) < 1e-4 + 1e-2 * noise_px);
    CHECK(unit_result.n_shape > 0u);
    const double left = 1.0 - terms[0];
    const double focal_px = (double)unit_result.focal_length_px;
    CHECK_NEAR(focal_px * left / (double)unit_crowded.camera.focal_length_px, 1.0, 2e-3);
    CHECK(unit_result.shape[0] == (starcat_real)0.0);
    for (uint32_t k = 1; k < TERMS; k++) {
      CHECK_NEAR(unit_result.shape[k], terms[k] / left, 5e-3);
    }
    CHECK(unit_result.covariance_rad2[0] > (starcat_real)0.0);
  }
  CHECK(found >= 78u);
}

/* A tilt of a tenth of a pixel, with noise that is less and that nobody states, is found in a frame
 * that is explained without it. */
static void check_small(void) {
  static const double terms[TERMS] = {0, 0, 0, 0, 0.001, 0};
  uint64_t state = 83;
  for (uint32_t n = 0; n < 10u; n++) {
    sky_look(&unit_crowded.image, &unit_crowded.camera, &state, 0.002, 50, 0, &truth);
    give_shape(terms);
    CHECK_IS(unit_identify(&unit_crowded, &truth), STARCAT_IDENTIFIED);
    CHECK_IS(unit_wrong_stars(&truth), 0);
    CHECK_IS(unit_result.n_shape, 6);
    CHECK_NEAR(unit_result.shape[4], terms[4], 1e-4);
    CHECK(unit_error_rad(&truth) < 2e-5);
  }
}

/* A frame of the camera's own shape has no terms. */
static void check_none(void) {
  uint64_t state = 82;
  for (uint32_t n = 0; n < 20u; n++) {
    sky_look(&unit_crowded.image, &unit_crowded.camera, &state, 0.3, 40, 4, &truth);
    CHECK_IS(unit_identify(&unit_crowded, &truth), STARCAT_IDENTIFIED);
    CHECK_IS(unit_result.n_shape, 0);
    for (uint32_t k = 0; k < TERMS; k++) {
      CHECK(unit_result.shape[k] == (starcat_real)0.0);
    }
    CHECK(unit_result.focal_length_px == unit_crowded.camera.focal_length_px);
  }
}

/* Stars in a part of the frame and false spots elsewhere: the fewer stars there are, and the smaller
 * the part is, the fewer frames have an answer, and all answers are right. */
static void check_corners(void) {
  static const double edges[3] = {0.65, 0.4, 0.25};
  uint32_t found[3] = {0}, withheld = 0;
  for (uint32_t n = 0; n < 90u; n++) {
    uint64_t state = 300u + n;
    uint32_t count = 0;
    sky_look(&unit_crowded.image, &unit_crowded.camera, &state, 0.05, STARCAT_MAX_CENTROIDS, 0,
             &truth);
    for (uint32_t k = 0; k < truth.count; k++) {
      const double edge = 512.0 * edges[n % 3u];
      if (((double)truth.x[k] < edge) && ((double)truth.y[k] < edge)) {
        truth.x[count] = truth.x[k];
        truth.y[count] = truth.y[k];
        truth.magnitudes[count] = truth.magnitudes[k];
        truth.star[count++] = truth.star[k];
      }
    }
    truth.count = count;
    for (; (truth.count < 2u * count) && (truth.count < STARCAT_MAX_CENTROIDS); truth.count++) {
      truth.x[truth.count] = (starcat_real)(512.0 * sky_uniform(&state));
      truth.y[truth.count] = (starcat_real)(512.0 * sky_uniform(&state));
      truth.magnitudes[truth.count] = (starcat_real)(9.0 + (double)truth.count);
      truth.star[truth.count] = -1;
    }
    if (unit_identify(&unit_crowded, &truth) == STARCAT_IDENTIFIED) {
      CHECK(unit_error_rad(&truth) < 3e-3);
      found[n % 3u]++;
    }
    withheld += (uint32_t)(unit_result.reason == (uint32_t)STARCAT_REASON_SHARE);
  }
  CHECK((found[0] > found[1]) && (found[1] > found[2]));
  CHECK(withheld > 2u);
}

/* Terms that are larger than their ranges are no answer, and no answer is wrong. */
static void check_ranges(void) {
  uint64_t state = 84;
  uint32_t refused = 0;
  for (uint32_t n = 0; n < 40u; n++) {
    const double sign = n % 2u == 0u ? 1.0 : -1.0, size = 0.02 + 0.001 * (n / 2u);
    const double terms[TERMS] = {sign * size, 0, 0, 0, 0, 0};
    unit_scratch = unit_triangle;
    unit_scratch.options.fov_error = (starcat_real)0.01;
    sky_look(&unit_triangle.image, &unit_triangle.camera, &state, 0.1, SKY_SPOTS, 0, &truth);
    give_shape(terms);
    if (unit_identify(&unit_scratch, &truth) == STARCAT_IDENTIFIED) {
      CHECK(unit_error_rad(&truth) < 3e-3);
    }
    refused += (uint32_t)(unit_result.reason == (uint32_t)STARCAT_REASON_SCALE);
  }
  CHECK(refused > 3u);
}

/* A call with the stars of a frame of the sky, of which the first `count` are matched. */
static void begin(const unit_sky *sky, uint32_t count) {
  uint64_t state = 85;
  sky_look(&sky->image, &sky->camera, &state, 0.1, SKY_SPOTS, 0, &truth);
  const starcat_frame frame = unit_frame_of(&truth);
  CHECK_IS(starcat_begin_call(&call, &sky->image, &sky->camera, &sky->options, &frame, &unit_work,
                              &unit_result),
           STARCAT_OK);
  for (uint32_t i = 0; i < call.own->count; i++) {
    unit_work.match[i] = (int16_t)(i < count ? (int32_t)i : -1);
    unit_work.x_of[i] = unit_work.x[i] + (starcat_real)0.5;
    unit_work.y_of[i] = unit_work.y[i];
    unit_work.match_square[i] = (starcat_real)0.25;
  }
  call.own->n_within = call.own->count;
}

/* A fit of none to three stars, and of stars that are all at one place; terms hold it if they are
 * free, as they have ranges. */
static void check_degenerate(void) {
  const starcat_real none[TERMS] = {0};
  starcat_normal n;
  starcat_step step;
  for (uint32_t free = 0; free <= TERMS; free += 2u) {
    for (uint32_t count = 0; count < 4u; count++) {
      begin(&unit_triangle, count);
      starcat_sum_normal(&call, free, &n);
      CHECK_IS(starcat_solve_normal(&call, &n, none, free, (starcat_real)1.0, &step), count >= 2u);
      CHECK((count >= 2u) || (starcat_log_chance(&call, 1, count, free, none) >= 0));
      if (count >= 2u) {
        CHECK_IS(step.free, free);
        CHECK(step.gain > (starcat_real)0.0);
        CHECK(starcat_corner_error(&call, &step) > (starcat_real)0.0);
        CHECK(starcat_find_influence(&call, 0, (starcat_real)0.5, 0, 1, &step) >= 0);
      }
    }
    begin(&unit_triangle, 4);
    for (uint32_t i = 0; i < call.own->count; i++) { /* all at one place */
      unit_work.x[i] = (starcat_real)300.0;
      unit_work.y[i] = (starcat_real)200.0;
      memcpy(unit_work.body[i], unit_work.body[0], sizeof unit_work.body[0]);
    }
    starcat_sum_normal(&call, free, &n);
    CHECK_IS(starcat_solve_normal(&call, &n, none, free, (starcat_real)1.0, &step), 0);
    CHECK(starcat_log_chance(&call, (starcat_real)1.0, 6, free, none) >= (starcat_real)0.0);
  }
  /* All in the row of the axis: the stretch moves none, and has no volume. */
  begin(&unit_triangle, 8);
  for (uint32_t i = 0; i < call.own->count; i++) {
    unit_work.y[i] = call.camera.given.y0_px;
  }
  const starcat_real four = starcat_log_chance(&call, (starcat_real)1.0, 8, 4, none);
  CHECK(four - four == (starcat_real)0.0);
}

/* The influence of a star on the corners is what the fit without it differs by. */
static void check_influence(void) {
  const starcat_real none[TERMS] = {0};
  starcat_normal n;
  starcat_step all, without;
  begin(&unit_triangle, 8);
  unit_work.x_of[3] += (starcat_real)4.0; /* its star is farther off than the others */
  starcat_sum_normal(&call, 0, &n);
  CHECK(starcat_solve_normal(&call, &n, none, 0, (starcat_real)1.0, &all));
  const double square =
      (double)starcat_find_influence(&call, 3, unit_work.x[3] - unit_work.x_of[3], 0, 1, &all);
  unit_work.match[3] = -1;
  starcat_sum_normal(&call, 0, &n);
  CHECK(starcat_solve_normal(&call, &n, none, 0, (starcat_real)1.0, &without));
  double turn[3];
  for (uint32_t k = 0; k < 3u; k++) {
    turn[k] = (double)(all.change[k] - without.change[k]);
  }
  const double corner = CORNER_PX / (double)call.camera.given.focal_length_px;
  const double expected =
      turn[0] * turn[0] + turn[1] * turn[1] + turn[2] * turn[2] * corner * corner;
  CHECK(expected > 0.0);
  CHECK_NEAR(square / expected, 1.0, IF_SINGLE(0.05, 1e-6));
}

/* Terms that run away, places that are no numbers, and shapes that leave no image. */
static void check_numbers(void) {
  starcat_real terms[TERMS] = {0}, m[9];
  starcat_normal n;
  starcat_step step;
  begin(&unit_triangle, 6);
  unit_matrix_of(&truth, m);
  starcat_sum_normal(&call, TERMS, &n);
  CHECK(starcat_solve_normal(&call, &n, terms, TERMS, (starcat_real)1.0, &step));
  CHECK_IS(starcat_take_step(&call, &step, TERMS, m, terms), 1);
  CHECK(call.x == unit_work.at_x);
  CHECK(starcat_absolute(starcat_log_growth(&call, terms)) < (starcat_real)0.5);
  step.change[5] = (starcat_real)-0.7; /* the third term */
  CHECK_IS(starcat_take_step(&call, &step, TERMS, m, terms), 0);
  memset(terms, 0, sizeof terms);
  CHECK_IS(starcat_take_step(&call, &step, 2, m, terms), 1); /* it is not one of the first two */
  const starcat_real infinite = (starcat_real)NAN;
  traps_off();
  step.change[3] = infinite;
  CHECK_IS(starcat_take_step(&call, &step, TERMS, m, terms), 0);
  begin(&unit_triangle, 6);
  unit_work.x_of[2] = infinite;
  starcat_sum_normal(&call, 2, &n);
  memset(terms, 0, sizeof terms);
  step.gain = 0;
  if (starcat_solve_normal(&call, &n, terms, 2, (starcat_real)1.0, &step) != 0) {
    CHECK_IS(starcat_take_step(&call, &step, 2, m, terms), 0);
  }
  unit_work.body[1][0] = infinite;
  starcat_sum_normal(&call, 2, &n);
  CHECK_IS(starcat_solve_normal(&call, &n, terms, 2, (starcat_real)1.0, &step), 0);
  traps_on();
  begin(&unit_triangle, 6);
  terms[0] = (starcat_real)-1e7; /* every place is beside the axis by a right angle */
  CHECK_IS(starcat_use_shape(&call, terms), 0);
  terms[0] = (starcat_real)0.01;
  CHECK_IS(starcat_use_shape(&call, terms), 1);
  CHECK_IS(starcat_set_focal(&call, (starcat_real)1.0), 1); /* the places as given again */
  CHECK(call.x == unit_work.x);
}

/* With every number of steps a call ends within them, and its answer is right. */
static void check_budgets(void) {
  static const double terms[TERMS] = {0.01, -0.02, 0.02, 0.02, 0.01, 0};
  uint64_t state = 86;
  uint32_t found = 0, used_up = 0;
  unit_scratch = unit_crowded;
  sky_look(&unit_crowded.image, &unit_crowded.camera, &state, 0.1, 24, 2, &truth);
  give_shape(terms);
  CHECK_IS(unit_identify(&unit_scratch, &truth), STARCAT_IDENTIFIED);
  const uint32_t enough = unit_result.steps;
  for (uint32_t less = 0; less < enough; less += less < 2000u ? 7u : 97u) {
    unit_scratch.options.max_steps = enough - less + 1u;
    if (unit_identify(&unit_scratch, &truth) == STARCAT_IDENTIFIED) {
      CHECK(unit_error_rad(&truth) < 1e-3);
      found++;
    } else {
      CHECK_IS(unit_result.reason, STARCAT_REASON_STEPS);
      used_up++;
    }
    CHECK(unit_result.steps <= unit_scratch.options.max_steps);
  }
  CHECK((found > 0u) && (used_up > 100u));
}

/* Noises that differ so much that only some stars count: they determine no attitude, or the terms run
 * away, and there is no wrong answer. */
static void check_noises(void) {
  uint32_t withheld = 0;
  for (uint32_t n = 0; n < 120u; n++) {
    uint64_t state = 500u + n;
    starcat_real sigma_px[STARCAT_MAX_CENTROIDS], m[9];
    sky_look(&unit_crowded.image, &unit_crowded.camera, &state, 1.0, STARCAT_MAX_CENTROIDS, 0,
             &truth);
    for (uint32_t k = 0; k < truth.count; k++) {
      const double x = (double)(truth.x[k] - truth.x[0]), y = (double)(truth.y[k] - truth.y[0]);
      const double most = n % 4u == 0u ? 1.0 : 20.0 + 40.0 * (n % 4u);
      sigma_px[k] = (starcat_real)(x * x + y * y <= most * most ? 1e-5 : n % 8u < 4u ? 1e5 : 3.0);
    }
    const starcat_frame frame = {truth.count, truth.x, truth.y, truth.magnitudes, sigma_px};
    CHECK_IS(starcat_begin_call(&call, &unit_crowded.image, &unit_crowded.camera,
                                &unit_crowded.options, &frame, &unit_work, &unit_result),
             STARCAT_OK);
    unit_matrix_of(&truth, m);
    (void)starcat_try_attitude(&call, m, (starcat_real)1.0);
    withheld += (uint32_t)(unit_work.best.withheld != 0u);
    if (starcat_end_call(&call, &unit_crowded.options, &unit_result) == STARCAT_IDENTIFIED) {
      CHECK(unit_error_rad(&truth) < 0.02);
    }
  }
  CHECK(withheld > 20u);
}

/* A lens whose fold is near the corners: a shape that moves a spot beyond it is not tried. */
static void check_folds(void) {
  uint64_t state = 88;
  uint32_t found = 0;
  for (uint32_t n = 0; n < 60u; n++) {
    const double size = 0.002 * (double)(n / 2u);
    const double terms[TERMS] = {
        n % 2u == 0u ? -size : size, 0, n % 3u == 0u ? 0.0 : -size, 0, 0, 0};
    unit_scratch = unit_triangle;
    unit_scratch.camera.k1 = (starcat_real)-0.2;
    unit_scratch.camera.fold_radius = (starcat_real)0.57;
    sky_look(&unit_triangle.image, &unit_scratch.camera, &state, 0.05, SKY_SPOTS, 0, &truth);
    give_shape(terms);
    truth.x[truth.count] = (starcat_real)1.0; /* a false spot in a corner */
    truth.y[truth.count] = (starcat_real)1.0;
    truth.magnitudes[truth.count] = (starcat_real)20.0;
    truth.star[truth.count++] = -1;
    if (unit_identify(&unit_scratch, &truth) == STARCAT_IDENTIFIED) {
      CHECK_IS(unit_wrong_stars(&truth), 0);
      CHECK(unit_error_rad(&truth) < 5e-3);
      found++;
    }
  }
  CHECK(found > 10u);
}

/* Four stars whose noise is stated, and residuals that only a shape explains. */
static void check_four_stars(void) {
  uint32_t tried = 0;
  for (uint32_t n = 0; n < 40u; n++) {
    uint64_t state = 900u + n;
    starcat_real m[9];
    unit_scratch = unit_triangle;
    unit_scratch.options.noise_px = (starcat_real)0.1;
    sky_look(&unit_triangle.image, &unit_triangle.camera, &state, 0.15 + 0.01 * n, 4, 0, &truth);
    const starcat_frame frame = unit_frame_of(&truth);
    CHECK_IS(starcat_begin_call(&call, &unit_scratch.image, &unit_scratch.camera,
                                &unit_scratch.options, &frame, &unit_work, &unit_result),
             STARCAT_OK);
    unit_matrix_of(&truth, m);
    (void)starcat_try_attitude(&call, m, (starcat_real)1.0);
    tried += (uint32_t)(unit_work.best.n_matched == 4u);
    CHECK(!(unit_work.best.log_chance < (starcat_real)-20.0) || (unit_work.best.free == 0u));
  }
  CHECK(tried > 10u);
}

/* Search a frame by triangles that a shape has changed, up to an effort. Returns the number of
 * attitudes that were tried. */
static uint32_t search_shaped(const unit_sky *sky, uint32_t most) {
  const starcat_frame frame = unit_frame_of(&truth);
  if (starcat_begin_call(&call, &sky->image, &sky->camera, &sky->options, &frame, &unit_work,
                         &unit_result) != STARCAT_OK) {
    return 0; /* the shape moved all but three stars out of the frame */
  }
  starcat_search_shaped(&call, most);
  CHECK(50u * call.own->n_looked_up <= most);
  return call.own->n_tried;
}

/* A stated error of the camera narrows the ranges to terms that move no corner farther. */
static void check_camera_error(void) {
  static const double errors[4] = {0.0, 0.004, 0.004, 0.1};
  unit_scratch = unit_triangle;
  starcat_camera *c = &unit_scratch.camera;
  const double half[2] = {0.5 * (double)c->width_px, 0.5 * (double)c->height_px};
  const double corner = sqrt(half[0] * half[0] + half[1] * half[1]);
  uint64_t state = 91;
  sky_look(&unit_triangle.image, &unit_triangle.camera, &state, 0.0, SKY_SPOTS, 0, &truth);
  for (uint32_t n = 0; n < 4u; n++) {
    unit_scratch.options.camera_error = (starcat_real)errors[n];
    if (n == 3u) { /* another corner is the farthest */
      c->x0_px -= (starcat_real)10.0;
      c->y0_px -= (starcat_real)10.0;
    }
    unit_scratch.options.fov_error = (starcat_real)(n == 2u ? 0.02 : 0.0);
    const starcat_frame frame = unit_frame_of(&truth);
    CHECK_IS(starcat_begin_call(&call, &unit_scratch.image, &unit_scratch.camera,
                                &unit_scratch.options, &frame, &unit_work, &unit_result),
             STARCAT_OK);
    CHECK_NEAR(call.half_range[0], n == 2u ? -log1p(-0.02) : n == 1u ? 0.004 : 0.05, 1e-6);
    const int is_narrow = (n == 1u) || (n == 2u);
    const double mean = (double)call.camera.mean_scale;
    CHECK_NEAR(call.half_range[1], is_narrow ? 0.004 / (1.0 - mean) : 0.1, 1e-6);
    CHECK_NEAR(call.half_range[2], is_narrow ? 0.004 * corner / half[1] : 0.1, 1e-6);
    CHECK_NEAR(call.half_range[3], is_narrow ? 0.004 * corner / half[1] : 0.1, 1e-6);
    CHECK_NEAR(call.half_range[4], is_narrow ? 0.004 * corner / half[0] : 0.1, 1e-6);
    CHECK_NEAR(call.half_range[5], is_narrow ? 0.004 * corner / half[1] : 0.1, 1e-6);
  }
}

/* Stretches and shears of 4 to 8 %, with either sign: three stars give them and the attitude, even
 * with a focal length that can be off. A shape that is out of the ranges is not tried. */
static void check_shaped(void) {
  uint64_t state = 90;
  uint32_t found = 0, tried_far = 0;
  for (uint32_t n = 0; n < 40u; n++) {
    const double size = (n % 2u == 0u ? 1.0 : -1.0) * (0.04 + 0.001 * n);
    const double terms[TERMS] = {0, 0, n % 4u < 2u ? size : 0.0, n % 4u < 2u ? 0.0 : size, 0, 0};
    const double far[TERMS] = {0, 0, 4.0 * size, 0, 0, 0};
    unit_scratch = unit_triangle;
    unit_scratch.options.fov_error = (starcat_real)(n % 8u < 4u ? 0.0 : 0.02);
    sky_look(&unit_triangle.image, &unit_triangle.camera, &state, 0.0, SKY_SPOTS, 0, &truth);
    const sky_frame plain = truth;
    give_shape(terms);
    CHECK_IS(search_shaped(&unit_scratch, 0), 0);
    CHECK_IS(call.own->n_looked_up, 0);
    if ((search_shaped(&unit_scratch, 4000) > 0u) &&
        (starcat_end_call(&call, &unit_scratch.options, &unit_result) == STARCAT_IDENTIFIED)) {
      found++;
      CHECK_IS(unit_wrong_stars(&truth), 0);
      CHECK(unit_error_rad(&truth) < 1e-3);
      CHECK_NEAR(unit_result.shape[2], terms[2], 1e-3);
      CHECK_NEAR(unit_result.shape[3], terms[3], 1e-3);
    }
    truth = plain;
    give_shape(far);
    tried_far += search_shaped(&unit_scratch, 4000);
    CHECK(!(unit_work.best.log_chance < (starcat_real)-20.0));
  }
  CHECK(found >= 34u);
  CHECK(tried_far < 8u);
}

/* Stars that the lens would not show where three centroids put them are not tried. */
static void check_unseen(void) {
  const double terms[TERMS] = {0, 0, 0.06, 0, 0, 0};
  uint64_t state = 92;
  sky_look(&unit_triangle.image, &unit_triangle.camera, &state, 0.0, SKY_SPOTS, 0, &truth);
  give_shape(terms);
  const starcat_frame frame = unit_frame_of(&truth);
  for (uint32_t n = 0; n < 2u; n++) {
    CHECK_IS(starcat_begin_call(&call, &unit_triangle.image, &unit_triangle.camera,
                                &unit_triangle.options, &frame, &unit_work, &unit_result),
             STARCAT_OK);
    call.camera.distorted = (int)n;
    call.camera.given.fold_radius = (starcat_real)1e-3;
    starcat_search_shaped(&call, 4000);
    CHECK(call.own->n_looked_up > 0u);
    CHECK((call.own->n_tried > 0u) == (n == 0u));
  }
}

/* Stars of other magnitudes than their centroids are not tried, if the noise of magnitudes is known;
 * and a search ends where its effort or its steps end. */
static void check_limits_of_shaped(void) {
  const double terms[TERMS] = {0, 0, 0.06, 0, 0, 0};
  uint64_t state = 91;
  uint32_t tried = 0, compatible = 0;
  for (uint32_t n = 0; n < 8u; n++) {
    unit_scratch = unit_triangle;
    unit_scratch.options.noise_mag = (starcat_real)0.1;
    sky_look(&unit_triangle.image, &unit_triangle.camera, &state, 0.0, SKY_SPOTS, 0, &truth);
    give_shape(terms);
    compatible += search_shaped(&unit_scratch, 4000);
    CHECK(unit_work.best.log_chance < (starcat_real)-20.0);
    for (uint32_t k = 0; k < truth.count; k++) {
      truth.magnitudes[k] += (starcat_real)5.0;
    }
    CHECK_IS(search_shaped(&unit_scratch, 4000), 0);
    unit_scratch.options.noise_mag = (starcat_real)0.0;
    (void)search_shaped(&unit_scratch, 4000);
    const uint32_t enough = unit_scratch.options.max_steps - call.own->steps_left;
    for (uint32_t less = 0; less < enough; less += 1u + less / 8u) {
      unit_scratch.options.max_steps = enough - less;
      tried += search_shaped(&unit_scratch, 4000);
      CHECK((call.own->steps_left == 0u) || (less == 0u));
    }
    unit_scratch.options.max_steps = unit_triangle.options.max_steps;
    for (uint32_t most = 50; most < 200u; most++) {
      tried += search_shaped(&unit_scratch, most);
    }
  }
  CHECK((tried > 0u) && (compatible > 7u));
}

/* Bits of the call that are flipped while it tries an attitude: the tolerance is no number, or the
 * camera is lost; no shape is fitted. */
static void check_flipped(void) {
  const double terms[TERMS] = {0.01, 0, 0.02, 0, 0, 0};
  for (uint32_t n = 0; n < 3u; n++) {
    uint64_t state = 89;
    starcat_real m[9];
    sky_look(&unit_crowded.image, &unit_crowded.camera, &state, 0.1, 40, 0, &truth);
    give_shape(terms);
    const starcat_frame frame = unit_frame_of(&truth);
    CHECK_IS(starcat_begin_call(&call, &unit_crowded.image, &unit_crowded.camera,
                                &unit_crowded.options, &frame, &unit_work, &unit_result),
             STARCAT_OK);
    unit_matrix_of(&truth, m);
    traps_off();
    call.tolerance_px = (starcat_real)(n == 1u ? NAN : 2.0);
    call.focal_px = n == 2u ? (starcat_real)NAN : call.focal_px;
    (void)starcat_try_attitude(&call, m, (starcat_real)1.0);
    CHECK((unit_work.best.log_chance < (starcat_real)-20.0) == (n == 0u));
    (void)feclearexcept(TRAPS);
    traps_on();
  }
}

void test_shape(void) {
  check_terms();
  check_small();
  check_none();
  check_flipped();
  check_corners();
  check_ranges();
  check_degenerate();
  check_influence();
  check_numbers();
  check_budgets();
  check_noises();
  check_camera_error();
  check_shaped();
  check_unseen();
  check_limits_of_shaped();
  check_folds();
  check_four_stars();
}
