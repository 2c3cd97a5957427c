/* The camera: directions of pixels and back, with Brown's distortion as the ground has it, and the
 * columns of its detector.
 *
 * SPDX-License-Identifier: MIT
 */
#include "internal.h"

#define NEWTON_STEPS 50u
#define LEAST_SEEN (R(0.1) * STARCAT_LEAST_COSINE) /* cosine for a star next to the detector */

/* Square of the last step relative to the square of the distance, about the square of the error
 * left; square of the farthest place that the search can reach; largest step. Their powers must not
 * overflow. */
#ifdef STARCAT_SINGLE
#define SMALL_STEP R(1e-11)
#define FARTHEST R(400.0)
#define LARGEST_STEP R(100.0)
#else
#define SMALL_STEP R(1e-16)
#define FARTHEST R(1e24)
#define LARGEST_STEP R(1e12)
#endif

/* Apply the lens distortion to the direction x/z = u, y/z = v; result in focal lengths. */
static void apply_distortion(const starcat_camera *c, real u, real v, real *x, real *y) {
  const real s = u * u + v * v;
  const real factor =
      R(1.0) + s * (c->k1 + s * (c->k2 + s * c->k3)) + R(2.0) * (c->p2 * u + c->p1 * v);
  *x = u * factor + s * c->p2;
  *y = v * factor + s * c->p1;
}

/* The same; returns 0 at the fold and beyond. */
static int distort_point(const starcat_camera *c, real u, real v, real *x, real *y) {
  const real s = u * u + v * v;
  if (!(s < FARTHEST) || ((c->fold_radius > R(0.0)) && !(s < c->fold_radius * c->fold_radius))) {
    return 0;
  }
  apply_distortion(c, u, v, x, y);
  return 1;
}

/* Derivatives of the image of the direction x/z = u, y/z = v: dx/du, dx/dv, dy/du, dy/dv. */
static void differentiate_distortion(const starcat_camera *c, real u, real v, real slope[4]) {
  const real s = u * u + v * v;
  const real along = c->k1 + s * (R(2.0) * c->k2 + R(3.0) * s * c->k3);
  const real factor =
      R(1.0) + s * (c->k1 + s * (c->k2 + s * c->k3)) + R(2.0) * (c->p2 * u + c->p1 * v);
  const real du = R(2.0) * (u * along + c->p2), dv = R(2.0) * (v * along + c->p1);
  slope[0] = factor + u * du + R(2.0) * u * c->p2;
  slope[1] = u * dv + R(2.0) * v * c->p2;
  slope[2] = v * du + R(2.0) * u * c->p1;
  slope[3] = factor + v * dv + R(2.0) * v * c->p1;
}

/* The direction whose image is x, y: Newton's method in the plane, started at the image. Returns 0
 * if there is no such direction inside the fold, or if it is too far to be found. */
static int undistort_point(const starcat_camera *c, real x, real y, real *u, real *v) {
  *u = x;
  *v = y;
  for (uint32_t step = 0; step < NEWTON_STEPS; step++) {
    real there_x, there_y, slope[4];
    if (!(*u * *u + *v * *v < FARTHEST)) {
      return 0;
    }
    apply_distortion(c, *u, *v, &there_x, &there_y);
    differentiate_distortion(c, *u, *v, slope);
    const real miss_x = there_x - x, miss_y = there_y - y;
    const real determinant = slope[0] * slope[3] - slope[1] * slope[2];
    real step_u = slope[3] * miss_x - slope[1] * miss_y;
    real step_v = slope[0] * miss_y - slope[2] * miss_x;
    if (!(starcat_absolute(step_u) + starcat_absolute(step_v) <
          LARGEST_STEP * (starcat_absolute(determinant) - R(1e-12)))) {
      return 0;
    }
    step_u /= determinant;
    step_v /= determinant;
    *u -= step_u;
    *v -= step_v;
    const real size = *u * *u + *v * *v;
    const real fold = c->fold_radius * c->fold_radius;
    if ((fold > R(0.0)) && !(size < fold)) {
      /* The solution lies within the fold: continue from its edge. */
      const real scale = c->fold_radius / STARCAT_SQRT(size);
      *u *= scale;
      *v *= scale;
    } else if (step_u * step_u + step_v * step_v <= SMALL_STEP * size + R(1e-30)) {
      return 1;
    } else {
      /* the next step follows */
    }
  }
  return 0;
}

int starcat_find_direction(const starcat_optics *camera, real x_px, real y_px, real body[3]) {
  const starcat_camera *c = &camera->given;
  const real x = (x_px - c->x0_px) / c->focal_length_px;
  const real y = (y_px - c->y0_px) / c->focal_length_px;
  real u = x, v = y;
  if (camera->distorted && !undistort_point(c, x, y, &u, &v)) {
    return 0;
  }
  const real scale = R(1.0) / STARCAT_SQRT(R(1.0) + u * u + v * v);
  body[0] = u * scale;
  body[1] = v * scale;
  body[2] = scale;
  return scale >= STARCAT_LEAST_COSINE;
}

int starcat_find_pixel(const starcat_optics *camera, const real body[3], real *x_px, real *y_px) {
  const starcat_camera *c = &camera->given;
  if (!(body[2] > LEAST_SEEN)) {
    return 0;
  }
  const real scale = R(1.0) / body[2];
  real x = body[0] * scale, y = body[1] * scale;
  if (camera->distorted && !distort_point(c, x, y, &x, &y)) {
    return 0;
  }
  *x_px = x * c->focal_length_px + c->x0_px;
  *y_px = y * c->focal_length_px + c->y0_px;
  return 1;
}

/* Rotation of a direction, radians, for one pixel of its image along x, and along y. */
void starcat_find_turns(const starcat_optics *camera, const real body[3], real turn[2][3]) {
  const real u = body[0] / body[2], v = body[1] / body[2];
  real s[4] = {R(1.0), R(0.0), R(0.0), R(1.0)};
  if (camera->distorted != 0) {
    differentiate_distortion(&camera->given, u, v, s);
  }
  /* b x db/du = z (b x e_x), likewise for v. At the fold of a lens the rotation is unbounded. */
  const real least = R(1e-6) * (s[0] * s[0] + s[1] * s[1] + s[2] * s[2] + s[3] * s[3]) + R(1e-12);
  const real determinant = starcat_larger(starcat_absolute(s[0] * s[3] - s[1] * s[2]), least);
  const real scale = body[2] / (camera->given.focal_length_px * determinant);
  const real of_u[3] = {R(0.0), body[2], -body[1]}, of_v[3] = {-body[2], R(0.0), body[0]};
  for (uint32_t k = 0; k < 3u; k++) {
    turn[0][k] = scale * (s[3] * of_u[k] - s[2] * of_v[k]);
    turn[1][k] = scale * (s[0] * of_v[k] - s[1] * of_u[k]);
  }
}

/* The largest of the lens's terms; 0 without distortion. */
static real largest_distortion(const starcat_camera *c) {
  return starcat_larger(
      starcat_larger(starcat_absolute(c->k1), starcat_absolute(c->k2)),
      starcat_larger(starcat_absolute(c->k3),
                     starcat_larger(starcat_absolute(c->p1), starcat_absolute(c->p2))));
}

static int is_possible(const starcat_camera *c) {
  if (!starcat_are_finite((const real *)(const void *)c, sizeof *c / sizeof(real))) {
    return 0;
  }
  const real most_px =
      starcat_larger(starcat_larger(c->width_px, c->height_px),
                     starcat_larger(starcat_absolute(c->x0_px), starcat_absolute(c->y0_px)));
  return (starcat_smaller(c->width_px, c->height_px) >= R(1.0)) &&
         (most_px <= STARCAT_LARGEST_PX) &&
         starcat_is_between(c->focal_length_px, R(1e-2), R(1e9)) &&
         (starcat_larger(largest_distortion(c), c->fold_radius) <= R(1e9)) &&
         (c->fold_radius >= R(0.0));
}

starcat_status starcat_prepare_camera(const starcat_camera *given, starcat_optics *camera) {
  real widest = R(1.0);
  if (!is_possible(given)) {
    return STARCAT_E_CAMERA;
  }
  camera->given = *given;
  camera->half_width = R(0.5) * given->width_px;
  camera->half_height = R(0.5) * given->height_px;
  camera->distorted = largest_distortion(given) > R(0.0);
  for (uint32_t n = 0; n < 4u; n++) {
    const real x = (n & 1u) != 0u ? given->width_px : R(0.0);
    const real y = (n & 2u) != 0u ? given->height_px : R(0.0);
    if (!starcat_find_direction(camera, x, y, camera->corner[n])) {
      return STARCAT_E_CAMERA;
    }
    if (camera->corner[n][2] < widest) {
      widest = camera->corner[n][2];
    }
  }
  camera->cos_radius = widest;
  camera->sin_radius = STARCAT_SQRT(R(1.0) - widest * widest);
  const real a = camera->half_width * camera->half_width;
  const real b = camera->half_height * camera->half_height;
  camera->corner_square = a + b;
  camera->mean_scale = R(0.6) - (R(8.0) / R(15.0)) * a * b / ((a + b) * (a + b));
  camera->log_area = STARCAT_LOG(given->width_px * given->height_px);
  camera->log_focal = STARCAT_LOG(given->focal_length_px);
  return STARCAT_OK;
}

/* From now on fit the focal length too, if its error can be above 0. */
void starcat_allow_scales(starcat_call *call, real fov_error) {
  const starcat_optics *camera = &call->camera;
  call->fov_error = fov_error;
  call->log_scales = R(0.0);
  call->bend = R(0.0);
  if (fov_error > R(0.0)) {
    const real radius_rad = STARCAT_ATAN2(camera->sin_radius, camera->cos_radius);
    call->log_scales = R(-2.0) * STARCAT_LOG(R(1.0) - fov_error);
    call->bend = STARCAT_CURVATURE * fov_error * radius_rad * radius_rad;
  }
}

starcat_status starcat_get_camera(const starcat_image *image, starcat_camera *camera) {
  if ((image == NULL) || (camera == NULL)) {
    return STARCAT_E_NULL;
  }
  camera->width_px = image->width_px;
  camera->height_px = image->height_px;
  camera->focal_length_px = image->focal_length_px;
  camera->x0_px = R(0.5) * image->width_px;
  camera->y0_px = R(0.5) * image->height_px;
  camera->k1 = R(0.0);
  camera->k2 = R(0.0);
  camera->k3 = R(0.0);
  camera->p1 = R(0.0);
  camera->p2 = R(0.0);
  camera->fold_radius = R(0.0);
  return STARCAT_OK;
}

/* List the usable centroids by column of the detector. */
void starcat_list_columns(starcat_call *call) {
  starcat_workspace *w = call->work;
  call->columns_per_px = (real)STARCAT_COLUMNS / call->camera.given.width_px;
  for (uint32_t n = 0; n <= STARCAT_COLUMNS; n++) {
    w->column[n] = 0;
  }
  for (uint32_t i = 0; i < call->own->count; i++) {
    w->column[starcat_find_column(call, call->x[i])]++;
  }
  for (uint32_t n = 1; n <= STARCAT_COLUMNS; n++) { /* end of each column */
    w->column[n] = (uint16_t)(w->column[n] + w->column[n - 1u]);
  }
  for (uint32_t i = call->own->count; i > 0u; i--) { /* begin of each column */
    const uint32_t n = starcat_find_column(call, call->x[i - 1u]);
    w->column[n]--;
    w->in_column[starcat_limit_place(w->column[n], STARCAT_MAX_CENTROIDS)] = (uint16_t)(i - 1u);
  }
}
