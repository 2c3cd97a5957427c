/* The frame: usable centroids in their own order, and what a call needs before it.
 *
 * SPDX-License-Identifier: MIT
 */
#include "internal.h"

#define WIDEST_FOV_ERROR R(0.5)
#define LEAST_CAMERA_ERROR R(1e-6) /* if it is stated */
#define MOST_CAMERA_ERROR R(0.1)
#define MOST_NOISE_MAG R(1e6)

starcat_status starcat_set_default_options(starcat_options *options) {
  if (options == NULL) {
    return STARCAT_E_NULL;
  }
  options->tolerance_px = R(2.0);
  options->noise_px = R(0.0);
  options->noise_mag = R(0.0);
  options->log_chance = STARCAT_LOG_CERTAIN;
  options->fov_error = R(0.0);
  options->camera_error = R(0.0);
  options->max_steps = 4000000u;
  return STARCAT_OK;
}

starcat_status starcat_check_options(const starcat_options *o) {
  if (!starcat_are_finite((const real *)(const void *)o, 6)) {
    return STARCAT_E_NOT_FINITE;
  }
  if ((o->noise_px < R(0.0)) ||
      !starcat_is_between(o->noise_mag, R(0.0), MOST_NOISE_MAG) ||
      !starcat_is_between(o->fov_error, R(0.0), WIDEST_FOV_ERROR) ||
      !starcat_is_between((o->camera_error != R(0.0)) ? o->camera_error : LEAST_CAMERA_ERROR,
                          LEAST_CAMERA_ERROR, MOST_CAMERA_ERROR) ||
      (o->max_steps == 0u) ||
      !starcat_is_between(o->noise_px > R(0.0) ? o->noise_px : o->tolerance_px, STARCAT_LEAST_PX,
                          STARCAT_LARGEST_PX)) {
    return STARCAT_E_OPTIONS;
  }
  return STARCAT_OK;
}

/* Whether a centroid comes before a sorted one: the brighter one first, centroids without magnitude
 * last; then the one nearer to the centre; then by x and y. */
static int comes_before(const starcat_call *call, real magnitude, real square, real x, real y,
                        uint32_t other) {
  const starcat_workspace *w = call->work;
  if (magnitude != w->magnitude[other]) {
    return magnitude < w->magnitude[other];
  }
  if (square != w->square[other]) {
    return square < w->square[other];
  }
  return (x != w->x[other]) ? (x < w->x[other]) : (y < w->y[other]);
}

/* Insert a centroid into the sorted centroids. */
static void insert_centroid(const starcat_call *call, uint32_t row, real magnitude, real x,
                            real y) {
  starcat_workspace *w = call->work;
  const real dx = x - call->camera.half_width, dy = y - call->camera.half_height;
  const real square = dx * dx + dy * dy;
  uint32_t at = call->own->count;
  while ((at > 0u) && comes_before(call, magnitude, square, x, y, at - 1u)) {
    w->row[at] = w->row[at - 1u];
    w->magnitude[at] = w->magnitude[at - 1u];
    w->square[at] = w->square[at - 1u];
    w->x[at] = w->x[at - 1u];
    w->y[at] = w->y[at - 1u];
    at--;
  }
  w->row[at] = row;
  w->magnitude[at] = magnitude;
  w->square[at] = square;
  w->x[at] = x;
  w->y[at] = y;
  call->own->count++;
}

/* Select the usable centroids; the others get the reason as their result. */
static void take_usable(const starcat_call *call, const starcat_frame *frame,
                        starcat_result *result) {
  const starcat_camera *camera = &call->camera.given;
  for (uint32_t i = 0; i < frame->count; i++) {
    const real *x = frame->x_px + i, *y = frame->y_px + i;
    result->star[i] = STARCAT_NO_STAR;
    if (!starcat_is_finite(x) || !starcat_is_finite(y)) {
      result->star[i] = STARCAT_DROPPED_NOT_FINITE;
    } else if ((*x < R(0.0)) || (*x >= camera->width_px) || (*y < R(0.0)) ||
               (*y >= camera->height_px)) {
      result->star[i] = STARCAT_DROPPED_OUT_OF_FRAME;
    } else {
      /* usable */
    }
  }
}

/* Drop centroids at exactly the position of an earlier one. */
static void drop_repeats(const starcat_call *call, starcat_result *result) {
  starcat_workspace *w = call->work;
  uint32_t kept = 0;
  for (uint32_t i = 0; i < call->own->count; i++) {
    uint32_t k = 0;
    while ((k < kept) && ((w->x[k] != w->x[i]) || (w->y[k] != w->y[i]))) {
      k++;
    }
    if (k < kept) {
      result->star[starcat_limit_place(w->row[i], call->own->given)] = STARCAT_DROPPED_DUPLICATE;
    } else {
      w->row[kept] = w->row[i];
      w->x[kept] = w->x[i];
      w->y[kept] = w->y[i];
      w->magnitude[kept] = w->magnitude[i];
      kept++;
    }
  }
  call->own->count = kept;
}

static void set_limits(starcat_call *call, const starcat_options *options) {
  call->tolerance_px = options->noise_px > R(0.0) ? STARCAT_SIGMAS_OF_TOLERANCE * options->noise_px
                                                  : options->tolerance_px;
  call->noise_px = options->noise_px;
  call->focal = R(1.0);
  call->focal_px = call->camera.given.focal_length_px;
  starcat_allow_scales(call, options->fov_error);
  starcat_set_ranges(call, options->camera_error);
  call->tolerance_rad = call->tolerance_px / call->camera.given.focal_length_px;
  call->reach_px = STARCAT_REACH * call->tolerance_px;
  call->noise_mag = call->own->has_magnitudes != 0u ? options->noise_mag : R(0.0);
  call->log_limit = options->log_chance;
  /* A higher limit accepts more, but ends no search earlier. */
  call->log_certain = starcat_smaller(options->log_chance, STARCAT_LOG_CERTAIN);
}

starcat_status starcat_begin_call(starcat_call *call, const starcat_image *image,
                                  const starcat_camera *camera, const starcat_options *options,
                                  const starcat_frame *frame, starcat_workspace *work,
                                  starcat_result *result) {
  if ((image == NULL) || (camera == NULL) || (options == NULL) || (frame == NULL) ||
      (work == NULL) || (result == NULL)) {
    return STARCAT_E_NULL;
  }
  result->n_matched = 0;
  result->steps = 0;
  result->n_tried = 0;
  result->log_chance = R(0.0);
  result->reason = STARCAT_REASON_NONE;
  result->n_usable = 0;
  result->best_n_matched = 0;
  result->best_log_chance = R(0.0);
  result->best_share = R(0.0);
  result->reduced_chi_square = R(0.0);
  result->n_shape = 0;
  for (uint32_t k = 0; k < STARCAT_SHAPE_TERMS; k++) {
    result->shape[k] = R(0.0);
  }
  for (uint32_t k = 0; k < 9u; k++) {
    result->covariance_rad2[k] = R(0.0);
  }
  if ((frame->count > 0u) && ((frame->x_px == NULL) || (frame->y_px == NULL))) {
    return STARCAT_E_NULL;
  }
  if (frame->count > STARCAT_MAX_CENTROIDS) {
    return STARCAT_E_TOO_MANY_CENTROIDS;
  }
  starcat_status status = starcat_check_options(options);
  if (status == STARCAT_OK) {
    status = starcat_prepare_camera(camera, &call->camera);
  }
  if (status != STARCAT_OK) {
    return status;
  }
  call->image = image;
  call->work = work;
  call->own = &call->counters;
  call->own->given = frame->count;
  call->own->count = 0;
  call->own->n_tried = 0;
  call->own->n_looked_up = 0;
  call->own->effort = 0;
  call->own->most_effort = UINT32_MAX;
  call->own->steps_left = options->max_steps;
  work->best.log_chance = R(0.0);
  work->best.log_bound = R(0.0);
  work->best.n_matched = 0;
  work->best.withheld = 0;
  work->best.share = R(0.0);
  work->best.free = 0;
  call->body = work->body;
  call->x = work->x;
  call->y = work->y;
  call->margin_px = R(0.0);
  call->sigma_px = frame->sigma_px;
  call->near = NULL;
  call->near_square = R(0.0);
  call->log_attitudes = STARCAT_LOG_ALL_ATTITUDES;
  call->own->has_magnitudes = 0;
  take_usable(call, frame, result);
  for (uint32_t i = 0; i < frame->count; i++) {
    if ((frame->sigma_px != NULL) && starcat_is_finite(frame->sigma_px + i) &&
        !starcat_is_between(frame->sigma_px[i], STARCAT_LEAST_PX, STARCAT_LARGEST_PX)) {
      return STARCAT_E_OPTIONS;
    }
    if (result->star[i] == STARCAT_NO_STAR) {
      /* A composite has numbers for unknown magnitudes, too. */
      const int is_known = (frame->magnitudes != NULL) &&
                           starcat_is_finite(frame->magnitudes + i) &&
                           (frame->magnitudes[i] < STARCAT_UNKNOWN_MAGNITUDE);
      call->own->has_magnitudes |= is_known != 0 ? 1u : 0u;
      insert_centroid(call, i, is_known != 0 ? frame->magnitudes[i] : STARCAT_UNKNOWN_MAGNITUDE,
                      frame->x_px[i], frame->y_px[i]);
    }
  }
  drop_repeats(call, result);
  starcat_list_columns(call);
  for (uint32_t i = 0; i < call->own->count; i++) {
    if (!starcat_find_direction(&call->camera, work->x[i], work->y[i], work->body[i])) {
      return STARCAT_E_CAMERA;
    }
  }
  set_limits(call, options);
  result->n_usable = call->own->count;
  if (call->own->count < STARCAT_MIN_STARS) {
    result->reason = STARCAT_REASON_TOO_FEW_STARS;
    return STARCAT_TOO_FEW_STARS;
  }
  return STARCAT_OK;
}
