/* The shape of a frame: the focal length that is used, scale, a lens, stretched and sheared rows, and a tilted detector. The same
 * functions as in the ground's starcat/matcher/shape.py, which defines the terms.
 *
 * SPDX-License-Identifier: MIT
 */
#include "internal.h"

#define ANGLES 3u
#define LARGEST_TERM R(0.5) /* a fit that reaches a larger term has run away */
#define LEAST_GROWTH R(1e-3)
#ifdef STARCAT_SINGLE
#define LEAST_DETERMINANT R(1e-4)
#else
#define LEAST_DETERMINANT R(1e-12)
#endif

#define HALF_RANGE R(0.10) /* largest term, of both signs, but the first: */
#define HALF_RANGE_OF_SCALE R(0.05)

/* Whether the terms of an answer are within their ranges; the scale can be outside, with a remark. */
int starcat_is_within_ranges(const starcat_call *call, const real terms[STARCAT_SHAPE_TERMS]) {
  int is_within = 1;
  for (uint32_t k = 0; k < STARCAT_SHAPE_TERMS; k++) {
    const real widest = k == 0u ? STARCAT_WIDER_RANGE : R(1.0);
    is_within = is_within && (starcat_absolute(terms[k]) <= widest * call->half_range[k]);
  }
  return is_within;
}

/* Square of the distance of a corner from the axis, in focal lengths. */
static real square_of_corner_rad(const starcat_call *call) {
  const real f = call->camera.given.focal_length_px;
  return call->camera.corner_square / (f * f);
}

/* By how much each unit of a term moves a place, pixels. */
static void find_basis(const starcat_call *call, real x_px, real y_px,
                       real basis[2][STARCAT_SHAPE_TERMS]) {
  const real x = x_px - call->camera.given.x0_px;
  const real y = y_px - call->camera.given.y0_px;
  const real square = call->camera.corner_square, corner_px = STARCAT_SQRT(square);
  const real radial = (x * x + y * y) / square - call->camera.mean_scale;
  const real factor[STARCAT_SHAPE_TERMS] = {R(1.0), radial,        R(0.0),
                                            R(0.0), x / corner_px, y / corner_px};
  for (uint32_t k = 0; k < STARCAT_SHAPE_TERMS; k++) {
    basis[0][k] = factor[k] * x;
    basis[1][k] = factor[k] * y;
  }
  basis[1][2] = y;
  basis[0][3] = y;
}

/* Set the largest terms. A stated error of the camera, as a share of the half diagonal, narrows them to
 * the terms that move no corner farther, the farthest from the axis most; a stated error of the focal
 * length is that of the scale. */
void starcat_set_ranges(starcat_call *call, real camera_error) {
  const starcat_camera *c = &call->camera.given;
  const real most_px = camera_error * STARCAT_SQRT(call->camera.corner_square);
  real basis[2][STARCAT_SHAPE_TERMS];
  find_basis(call, c->x0_px < call->camera.half_width ? c->width_px : R(0.0),
             c->y0_px < call->camera.half_height ? c->height_px : R(0.0), basis);
  for (uint32_t k = 0; k < STARCAT_SHAPE_TERMS; k++) {
    const real most = k == 0u ? HALF_RANGE_OF_SCALE : HALF_RANGE;
    const real moved = STARCAT_SQRT(basis[0][k] * basis[0][k] + basis[1][k] * basis[1][k]);
    call->half_range[k] = camera_error > R(0.0) ? starcat_smaller(most, most_px / moved) : most;
  }
  if (call->log_scales > R(0.0)) {
    call->half_range[0] = R(0.5) * call->log_scales;
  }
}

/* Undo a shape at a place. */
static void undo_shape(const starcat_call *call, const real terms[STARCAT_SHAPE_TERMS], real *x_px,
                       real *y_px) {
  real basis[2][STARCAT_SHAPE_TERMS];
  find_basis(call, *x_px, *y_px, basis);
  for (uint32_t k = 0; k < STARCAT_SHAPE_TERMS; k++) {
    *x_px -= basis[0][k] * terms[k];
    *y_px -= basis[1][k] * terms[k];
  }
}

/* How far beyond the given detector the places of a frame of a shape can lie, pixels: at most as far
 * as its corners, the middles of its sides and its middle. */
static real find_margin(const starcat_call *call, const real terms[STARCAT_SHAPE_TERMS]) {
  const real x0 = call->camera.half_width, y0 = call->camera.half_height;
  real margin_px = R(0.0);
  for (uint32_t k = 0; k < 9u; k++) {
    real x = (real)(k % 3u) * x0, y = (real)(k / 3u) * y0;
    undo_shape(call, terms, &x, &y);
    margin_px = starcat_larger(margin_px, starcat_larger(starcat_absolute(x - x0) - x0,
                                                         starcat_absolute(y - y0) - y0));
  }
  return margin_px;
}

/* Prepare the camera and the directions of the centroids with a multiple of the given focal length.
 * Returns 0 if the lens would then form no image at a centroid. */
static int scale_camera(starcat_call *call, real focal) {
  starcat_workspace *w = call->work;
  starcat_camera given = call->camera.given;
  given.focal_length_px = focal * call->focal_px;
  int good = starcat_prepare_camera(&given, &call->camera) == STARCAT_OK;
  for (uint32_t i = 0; good && (i < call->own->count); i++) {
    good = starcat_find_direction(&call->camera, w->x[i], w->y[i], w->scaled[i]);
  }
  call->focal = focal;
  call->margin_px = R(0.0);
  call->body = focal == R(1.0) ? w->body : w->scaled;
  if (call->x != w->x) {
    call->x = w->x;
    call->y = w->y;
    starcat_list_columns(call);
  }
  return good;
}

/* Use another focal length from now on, a multiple of the given one. If the lens forms no image
 * with it, use the given one and return 0. */
int starcat_set_focal(starcat_call *call, real focal) {
  if ((focal == call->focal) || (scale_camera(call, focal) != 0)) {
    return 1;
  }
  (void)scale_camera(call, R(1.0));
  return 0;
}

/* Use the places that the given camera would show of a frame of some shape from now on, until
 * starcat_set_focal. Returns 0 if the lens forms no image at a place. */
int starcat_use_shape(starcat_call *call, const real terms[STARCAT_SHAPE_TERMS]) {
  starcat_workspace *w = call->work;
  int good = starcat_set_focal(call, R(1.0));
  for (uint32_t i = 0; i < call->own->count; i++) {
    w->at_x[i] = w->x[i];
    w->at_y[i] = w->y[i];
    undo_shape(call, terms, &w->at_x[i], &w->at_y[i]);
    good = good && starcat_find_direction(&call->camera, w->at_x[i], w->at_y[i], w->scaled[i]);
  }
  call->margin_px = find_margin(call, terms);
  call->x = w->at_x;
  call->y = w->at_y;
  call->body = w->scaled;
  call->focal = R(0.0); /* so that starcat_set_focal computes directions again */
  starcat_list_columns(call);
  return good;
}

/* Logarithm of the ratio of the areas around the matched centroids, before a shape was undone over
 * after. */
real starcat_log_growth(const starcat_call *call, const real terms[STARCAT_SHAPE_TERMS]) {
  const starcat_workspace *w = call->work;
  const real square = call->camera.corner_square, mean = call->camera.mean_scale;
  const real tilt_x = terms[4] / STARCAT_SQRT(square), tilt_y = terms[5] / STARCAT_SQRT(square);
  real growth = R(0.0);
  for (uint32_t i = 0; i < call->own->count; i++) {
    if (w->match[i] >= 0) {
      const real x = w->x[i] - call->camera.given.x0_px, y = w->y[i] - call->camera.given.y0_px;
      const real same = R(1.0) - terms[0] - terms[1] * ((x * x + y * y) / square - mean) -
                        tilt_x * x - tilt_y * y;
      const real bent = R(2.0) * terms[1] / square;
      const real xx = same - bent * x * x - tilt_x * x;
      const real yy = same - bent * y * y - tilt_y * y - terms[2];
      const real xy = -bent * x * y - terms[3] - tilt_y * x, yx = -bent * x * y - tilt_x * y;
      growth -= STARCAT_LOG(starcat_larger(xx * yy - xy * yx, LEAST_GROWTH));
    }
  }
  return growth;
}

/* Derivatives of the place of a centroid by the angles and the first `free` terms. */
static void find_rows(const starcat_call *call, uint32_t centroid, uint32_t free,
                      real row[2][STARCAT_UNKNOWNS]) {
  const real *body = call->body[centroid];
  const real f = call->camera.given.focal_length_px;
  const real x = body[0] / body[2], y = body[1] / body[2];
  real basis[2][STARCAT_SHAPE_TERMS];
  row[0][0] = -f * x * y;
  row[0][1] = f * (R(1.0) + x * x);
  row[0][2] = -f * y;
  row[1][0] = -f * (R(1.0) + y * y);
  row[1][1] = f * x * y;
  row[1][2] = f * x;
  if (free > 0u) {
    find_basis(call, call->work->x[centroid], call->work->y[centroid], basis);
  }
  for (uint32_t k = 0; k < free; k++) {
    row[0][ANGLES + k] = basis[0][k];
    row[1][ANGLES + k] = basis[1][k];
  }
}

/* Add a centroid, whose star has the offset dx, dy from it, to the normal equations of an attitude
 * and the first `free` terms. */
void starcat_add_normal(const starcat_call *call, uint32_t centroid, real dx, real dy, real weight,
                        uint32_t free, starcat_normal *n) {
  real row[2][STARCAT_UNKNOWNS];
  find_rows(call, centroid, free, row);
  for (uint32_t i = 0; i < ANGLES + free; i++) {
    n->right[i] += weight * (row[0][i] * dx + row[1][i] * dy);
    for (uint32_t j = 0; j <= i; j++) {
      n->gram[i][j] += weight * (row[0][i] * row[0][j] + row[1][i] * row[1][j]);
    }
  }
}

/* Normal equations of the matches in the workspace. */
void starcat_sum_normal(const starcat_call *call, uint32_t free, starcat_normal *n) {
  const starcat_workspace *w = call->work;
  const starcat_normal none = {{{R(0.0)}}, {R(0.0)}};
  *n = none;
  for (uint32_t i = 0; i < call->own->count; i++) {
    if (w->match[i] >= 0) {
      const uint32_t k = starcat_find_match(w, i);
      starcat_add_normal(call, i, call->x[i] - w->x_of[k], call->y[i] - w->y_of[k], R(1.0), free,
                         n);
    }
  }
}

/* Cholesky's factor of the first `count` rows of a symmetric matrix, in place; returns 0 if it is
 * singular. A row that all earlier rows explain, except for rounding, makes it singular. */
int starcat_factorise(real a[STARCAT_UNKNOWNS][STARCAT_UNKNOWNS], uint32_t count) {
  for (uint32_t i = 0; i < count; i++) {
    const real least = STARCAT_LEAST_PIVOT * a[i][i];
    for (uint32_t j = 0; j <= i; j++) {
      real sum = a[i][j];
      for (uint32_t k = 0; k < j; k++) {
        sum -= a[i][k] * a[j][k];
      }
      if (i == j) {
        if (!(sum > least)) {
          return 0;
        }
        a[i][i] = STARCAT_SQRT(sum);
      } else {
        a[i][j] = sum / a[j][j];
      }
    }
  }
  return 1;
}

/* Solve L L' x = b. */
static void substitute(real l[STARCAT_UNKNOWNS][STARCAT_UNKNOWNS], uint32_t count,
                       real x[STARCAT_UNKNOWNS]) {
  for (uint32_t i = 0; i < count; i++) {
    for (uint32_t k = 0; k < i; k++) {
      x[i] -= l[i][k] * x[k];
    }
    x[i] /= l[i][i];
  }
  for (uint32_t i = count; i > 0u; i--) {
    for (uint32_t k = i; k < count; k++) {
      x[i - 1u] -= l[k][i - 1u] * x[k];
    }
    x[i - 1u] /= l[i - 1u][i - 1u];
  }
}

/* Solve a fit of an attitude and the first `free` terms, whose priors have the standard deviations
 * of their ranges: the step, by how much it lowers the squares, and the covariance of the angles
 * for noise of one pixel. Returns 0 if the matches determine none. */
int starcat_solve_normal(const starcat_call *call, const starcat_normal *n,
                         const real terms[STARCAT_SHAPE_TERMS], uint32_t free, real sigma_px,
                         starcat_step *step) {
  const uint32_t count = ANGLES + free;
  starcat_normal copy = *n;
  step->free = free;
  for (uint32_t k = 0; k < free; k++) {
    const real ratio = sigma_px / call->half_range[k];
    copy.gram[ANGLES + k][ANGLES + k] += ratio * ratio;
    copy.right[ANGLES + k] -= ratio * ratio * terms[k];
  }
  if (!starcat_factorise(copy.gram, count)) {
    return 0;
  }
  for (uint32_t k = 0; k < STARCAT_UNKNOWNS; k++) {
    step->change[k] = k < count ? copy.right[k] : R(0.0);
  }
  substitute(copy.gram, count, step->change);
  step->gain = R(0.0);
  for (uint32_t k = 0; k < count; k++) {
    step->gain += step->change[k] * copy.right[k];
  }
  for (uint32_t k = 0; k < ANGLES; k++) {
    real column[STARCAT_UNKNOWNS] = {R(0.0)};
    column[k] = R(1.0);
    substitute(copy.gram, count, column);
    for (uint32_t j = 0; j < ANGLES; j++) {
      step->covariance[j][k] = column[j];
    }
  }
  for (uint32_t i = 0; i < count; i++) {
    for (uint32_t j = 0; j <= i; j++) {
      step->factor[i][j] = copy.gram[i][j];
    }
  }
  return 1;
}

/* Square of the turn of the corners if a centroid, whose star has the offset dx, dy from it, is
 * left out of the fit that a step leads to. */
real starcat_find_influence(const starcat_call *call, uint32_t centroid, real dx, real dy,
                            real weight, starcat_step *step) {
  const uint32_t count = ANGLES + step->free;
  real row[2][STARCAT_UNKNOWNS], moved[2][STARCAT_UNKNOWNS];
  real kept[3] = {R(1.0), R(0.0), R(1.0)}, left[2] = {dx, dy};
  find_rows(call, centroid, step->free, row);
  for (uint32_t axis = 0; axis < 2u; axis++) {
    for (uint32_t k = 0; k < count; k++) {
      moved[axis][k] = weight * row[axis][k];
      left[axis] -= row[axis][k] * step->change[k];
    }
    substitute(step->factor, count, moved[axis]);
  }
  for (uint32_t k = 0; k < count; k++) {
    kept[0] -= row[0][k] * moved[0][k];
    kept[1] -= row[0][k] * moved[1][k];
    kept[2] -= row[1][k] * moved[1][k];
  }
  const real determinant = starcat_larger(kept[0] * kept[2] - kept[1] * kept[1], LEAST_DETERMINANT);
  const real back[2] = {(kept[2] * left[0] - kept[1] * left[1]) / determinant,
                        (kept[0] * left[1] - kept[1] * left[0]) / determinant};
  const real x = moved[0][0] * back[0] + moved[1][0] * back[1];
  const real y = moved[0][1] * back[0] + moved[1][1] * back[1];
  const real z = moved[0][2] * back[0] + moved[1][2] * back[1];
  return x * x + y * y + z * z * square_of_corner_rad(call);
}

/* Take the step of a fit. Returns 0 if the fit runs away. */
int starcat_take_step(starcat_call *call, const starcat_step *step, uint32_t free, real m[9],
                      real terms[STARCAT_SHAPE_TERMS]) {
  for (uint32_t k = 0; k < free; k++) {
    terms[k] += step->change[ANGLES + k];
    if (!(starcat_absolute(terms[k]) <= LARGEST_TERM)) {
      return 0;
    }
  }
  starcat_turn_matrix(m, step->change);
  return starcat_use_shape(call, terms);
}

/* Standard error of an attitude at the corners, for noise of one pixel: that of the boresight on its
 * worst axis, with that of the roll at the distance of a corner. */
real starcat_corner_error(const starcat_call *call, const starcat_step *step) {
  const real a = step->covariance[0][0], b = step->covariance[0][1], d = step->covariance[1][1];
  const real half = R(0.5) * (a - d);
  const real largest = R(0.5) * (a + d) + STARCAT_SQRT(half * half + b * b);
  return STARCAT_SQRT(
      starcat_larger(largest + step->covariance[2][2] * square_of_corner_rad(call), R(0.0)));
}
