/* Attitudes against known rotations, and cameras there and back.
 *
 * SPDX-License-Identifier: MIT
 */
#include "internal.h"
#include "unit.h"

static const double tight = IF_SINGLE(3e-6, 2e-14);

static void make_pairs(const double m[9], uint32_t count, uint64_t *state, double noise,
                       starcat_real (*body)[3], starcat_real (*icrs)[3]) {
  for (uint32_t i = 0; i < count; i++) {
    double v[3], b[3], length = 0.0, turned = 0.0;
    for (int k = 0; k < 3; k++) {
      v[k] = sky_normal(state);
      length += v[k] * v[k];
    }
    for (int k = 0; k < 3; k++) {
      icrs[i][k] = (starcat_real)(v[k] /= sqrt(length));
      b[k] = noise * sky_normal(state);
    }
    for (int k = 0; k < 3; k++) {
      b[k] += m[3 * k] * v[0] + m[3 * k + 1] * v[1] + m[3 * k + 2] * v[2];
      turned += b[k] * b[k];
    }
    for (int k = 0; k < 3; k++) {
      body[i][k] = (starcat_real)(b[k] / sqrt(turned));
    }
  }
}

/* Half turns put each component of the quaternion in turn at the largest place. */
static void check_known_rotations(void) {
  static const starcat_real icrs[3][3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
  static const starcat_real bodies[4][3][3] = {{{1, 0, 0}, {0, -1, 0}, {0, 0, -1}},
                                               {{-1, 0, 0}, {0, 1, 0}, {0, 0, -1}},
                                               {{-1, 0, 0}, {0, -1, 0}, {0, 0, 1}},
                                               {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}};
  for (uint32_t n = 0; n < 4u; n++) {
    starcat_real q[4];
    CHECK_IS(starcat_fit_attitude(bodies[n], icrs, 3, q), STARCAT_OK);
    for (uint32_t k = 0; k < 4u; k++) {
      CHECK_NEAR(fabs((double)q[k]), k == n ? 1.0 : 0.0, tight);
    }
  }
  /* A quarter turn about z: x of the sky is seen at -y of the camera. */
  static const starcat_real quarter[2][3] = {{0, -1, 0}, {1, 0, 0}};
  starcat_real q[4];
  CHECK_IS(starcat_fit_attitude(quarter, icrs, 2, q), STARCAT_OK);
  CHECK_NEAR(q[2], sqrt(0.5), tight);
  CHECK_NEAR(q[3], sqrt(0.5), tight);
}

/* The example at the head of starcat.h, which the pages of the documentation have too. */
static void check_worked_example(void) {
  static const double q_body_from_icrs[4] = {-0.781300520, 0.137764362, 0.208208671, 0.572048623};
  static const double v_icrs[3] = {-0.187455223, 0.939217529, -0.287629922};
  static const double v_camera[3] = {-0.003626651, 0.036746347, 0.999318044};
  static const double pixel[2] = {628.38680, 597.66855};
  starcat_camera given = {0};
  starcat_optics camera;
  starcat_real q[4], m[9], back[4], v[3], seen[3], x = 0, y = 0;
  for (int k = 0; k < 4; k++) {
    q[k] = (starcat_real)q_body_from_icrs[k];
  }
  starcat_make_matrix(q, m);
  starcat_make_quaternion(m, back);
  for (int k = 0; k < 4; k++) {
    CHECK_NEAR(back[k], q_body_from_icrs[k], IF_SINGLE(1e-6, 2e-9));
  }
  for (int k = 0; k < 3; k++) {
    v[k] = (starcat_real)v_icrs[k];
  }
  for (int k = 0; k < 3; k++) {
    seen[k] = starcat_dot(m + 3 * k, v);
    CHECK_NEAR(seen[k], v_camera[k], IF_SINGLE(1e-6, 3e-9));
  }
  given.width_px = (starcat_real)1280.0;
  given.height_px = (starcat_real)960.0;
  given.focal_length_px = (starcat_real)3200.0;
  given.x0_px = (starcat_real)640.0;
  given.y0_px = (starcat_real)480.0;
  CHECK_IS(starcat_prepare_camera(&given, &camera), STARCAT_OK);
  CHECK(starcat_find_pixel(&camera, seen, &x, &y));
  CHECK_NEAR(x, pixel[0], IF_SINGLE(5e-3, 2e-5));
  CHECK_NEAR(y, pixel[1], IF_SINGLE(5e-3, 2e-5));
}

static starcat_status solve(starcat_real (*body)[3], starcat_real (*icrs)[3], uint32_t count,
                            starcat_real *q) {
  return starcat_fit_attitude((const starcat_real(*)[3])body, (const starcat_real(*)[3])icrs, count,
                              q);
}

void test_attitude(void) {
  starcat_real body[12][3], icrs[12][3], q[4];
  uint64_t state = 41;
  check_known_rotations();
  check_worked_example();
  for (uint32_t n = 0; n < 200u; n++) {
    double m[9], truth[4], off = 0.0;
    const uint32_t count = 2u + n % 10u;
    sky_rotation(&state, m, truth);
    make_pairs(m, count, &state, n % 2u == 0u ? 0.0 : 1e-3, body, icrs);
    CHECK_IS(solve(body, icrs, count, q), STARCAT_OK);
    for (uint32_t k = 0; k < 4u; k++) {
      off = fmax(off, fabs((double)q[k] - truth[k]));
    }
    CHECK((double)q[3] >= 0.0);
    if (count > 2u) { /* two directions may be nearly the same */
      CHECK(off < (n % 2u == 0u ? 100.0 * tight : 0.03));
    }
  }
  for (uint32_t k = 0; k < 3u; k++) { /* numbers that no direction has */
    const starcat_real sound[2] = {body[1][k], icrs[2][k]};
    body[1][k] = (starcat_real)-2.1;
    CHECK_IS(solve(body, icrs, 4, q), STARCAT_E_NOT_FINITE);
    body[1][k] = sound[0];
    icrs[2][k] = (starcat_real)INFINITY;
    CHECK_IS(solve(body, icrs, 4, q), STARCAT_E_NOT_FINITE);
    icrs[2][k] = sound[1];
  }
  body[1][1] = (starcat_real)NAN;
  CHECK_IS(solve(body, icrs, 4, q), STARCAT_E_NOT_FINITE);
  CHECK_IS(solve(body, icrs, 1, q), STARCAT_TOO_FEW_STARS);
  CHECK_IS(solve(body, icrs, 0, q), STARCAT_TOO_FEW_STARS);
  CHECK_IS(solve(NULL, icrs, 4, q), STARCAT_E_NULL);
  CHECK_IS(solve(body, NULL, 4, q), STARCAT_E_NULL);
  CHECK_IS(solve(body, icrs, 4, NULL), STARCAT_E_NULL);
  for (uint32_t k = 0; k < 3u; k++) { /* the same direction twice, in the sky and in the camera */
    body[1][k] = body[0][k];
  }
  CHECK_IS(solve(body, icrs, 2, q), STARCAT_TOO_FEW_STARS);
  make_pairs((const double[9]){1, 0, 0, 0, 1, 0, 0, 0, 1}, 2, &state, 0.0, body, icrs);
  for (uint32_t k = 0; k < 3u; k++) {
    icrs[1][k] = icrs[0][k];
  }
  CHECK_IS(solve(body, icrs, 2, q), STARCAT_TOO_FEW_STARS);
}

/* Pixels to directions and back over the whole detector. */
static void check_round_trip(const starcat_camera *given) {
  starcat_optics camera;
  double worst = 0.0;
  CHECK_IS(starcat_prepare_camera(given, &camera), STARCAT_OK);
  for (uint32_t n = 0; n < 33u * 33u; n++) {
    const starcat_real x = given->width_px * (starcat_real)(n % 33u) / (starcat_real)32.0;
    const starcat_real y = given->height_px * (starcat_real)(n / 33u) / (starcat_real)32.0;
    starcat_real body[3], back_x = 0, back_y = 0;
    CHECK(starcat_find_direction(&camera, x, y, body));
    CHECK_NEAR(starcat_dot(body, body), 1.0, tight);
    CHECK(body[2] >= camera.cos_radius);
    CHECK(starcat_find_pixel(&camera, body, &back_x, &back_y));
    worst = fmax(worst, hypot((double)(back_x - x), (double)(back_y - y)));
  }
  CHECK(worst < IF_SINGLE(2e-3, 1e-9));
}

void test_camera(void) {
  starcat_camera given = unit_triangle.camera;
  starcat_optics camera;
  starcat_real x = 0, y = 0, body[3] = {0, 0, 1};
  check_round_trip(&given);
  given.k1 = (starcat_real)-0.2;
  given.k2 = (starcat_real)0.05;
  given.k3 = (starcat_real)-0.01;
  given.p1 = (starcat_real)0.003;
  given.p2 = (starcat_real)-0.002;
  given.x0_px = (starcat_real)240.0;
  given.y0_px = (starcat_real)270.0;
  check_round_trip(&given);
  given.fold_radius = (starcat_real)0.9;
  check_round_trip(&given);
  CHECK_IS(starcat_prepare_camera(&given, &camera), STARCAT_OK);
  /* Nothing is seen behind the camera, beside it, or beyond the fold of its lens. */
  CHECK(starcat_find_pixel(&camera, body, &x, &y));
  CHECK_NEAR(x, 240.0, 1e-3);
  CHECK_NEAR(y, 270.0, 1e-3);
  body[2] = (starcat_real)-1.0;
  CHECK(!starcat_find_pixel(&camera, body, &x, &y));
  body[2] = (starcat_real)0.0;
  CHECK(!starcat_find_pixel(&camera, body, &x, &y));
  body[0] = (starcat_real)0.8;
  body[2] = (starcat_real)0.6;
  CHECK(!starcat_find_pixel(&camera, body, &x, &y));
  /* Without a fold single precision ends at an angle of 87 degrees from the axis. */
  given.fold_radius = (starcat_real)0.0;
  CHECK_IS(starcat_prepare_camera(&given, &camera), STARCAT_OK);
  body[2] = (starcat_real)0.02;
  CHECK_IS(starcat_find_pixel(&camera, body, &x, &y), IF_SINGLE(0, 1));
}

/* Chords and angles against libm, where the series ends and beyond. */
void test_kernels(void) {
  for (uint32_t n = 1; n <= 310u; n++) {
    const double angle = 0.01 * n, chord = 2.0 * sin(0.5 * angle);
    CHECK_NEAR(starcat_angle_of_chord((starcat_real)(chord * chord)), angle,
               angle * IF_SINGLE(3e-5, 1e-11));
    CHECK_NEAR(starcat_chord_of_angle((starcat_real)angle), chord, chord * IF_SINGLE(1e-6, 1e-14));
  }
  CHECK_NEAR(starcat_angle_of_chord((starcat_real)4.5), 3.14159265358979, 1e-6);
  CHECK_NEAR(starcat_chord_of_angle((starcat_real)-1.0), 0.0, 0.0);
}
