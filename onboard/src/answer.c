/* The answer: the attitude of the best agreement and how well it is known, or why there is none.
 *
 * SPDX-License-Identifier: MIT
 */
#include "internal.h"

#define FARTHEST_STAR R(1.5) /* in reaches: a star that agreed within one, after the last fit */

/* Fill in the reason for no answer, and the quality of the best agreement, whose attitude can be in
 * the result already. */
static starcat_status refuse_frame(const starcat_call *call, starcat_result *result) {
  const starcat_workspace *w = call->work;
  result->best_n_matched = w->best.n_matched;
  result->best_log_chance = w->best.log_bound;
  result->best_share = w->best.share;
  if (call->own->steps_left == 0u) {
    result->reason = STARCAT_REASON_STEPS;
  } else if (call->own->n_tried == 0u) {
    result->reason = STARCAT_REASON_NO_CANDIDATE;
  } else {
    result->reason = w->best.withheld != 0u ? w->best.withheld : STARCAT_REASON_CHANCE;
  }
  return call->own->steps_left == 0u ? STARCAT_E_BUDGET : STARCAT_NO_MATCH;
}

/* The stated noise of a usable centroid on each axis, or `otherwise` if each has its own; 0 if it is
 * not stated. */
static real find_stated(const starcat_call *call, uint32_t centroid, real otherwise) {
  const uint32_t place = call->work->row[starcat_limit_place(centroid, STARCAT_MAX_CENTROIDS)];
  const uint32_t row = starcat_limit_place(place, call->own->given);
  if (call->sigma_px == NULL) {
    return otherwise;
  }
  return starcat_are_finite(call->sigma_px + row, 1) ? call->sigma_px[row] : R(0.0);
}

real starcat_find_noise(const starcat_call *call, uint32_t centroid) {
  return find_stated(call, centroid, call->noise_px);
}

/* Stated noise of all centroids on each axis, else what the tolerance stands for. */
real starcat_assume_noise(const starcat_call *call) {
  return call->noise_px > R(0.0) ? call->noise_px
                                 : call->tolerance_px / STARCAT_SIGMAS_OF_TOLERANCE;
}

/* Noise of a centroid on each axis, its own if it is stated. */
real starcat_find_sigma(const starcat_call *call, uint32_t centroid) {
  const real stated = starcat_find_noise(call, centroid);
  return stated > R(0.0) ? stated : starcat_assume_noise(call);
}

/* List the identified centroids of the best agreement with their directions and weights: one over
 * the square of the noise, divided by the largest weight. Returns their number. */
static uint32_t take_stars(const starcat_call *call) {
  const starcat_image *image = call->image;
  starcat_workspace *w = call->work;
  const uint32_t count = call->own->count;
  real least = R(0.0);
  uint32_t n = 0;
  for (uint32_t i = 0; i < count; i++) {
    if (w->best.star[i] >= 0) {
      const uint32_t star = starcat_limit_place((uint32_t)w->best.star[i], image->n_stars);
      starcat_read_star(image, star, w->seen_icrs[n]);
      for (uint32_t k = 0; k < 3u; k++) {
        w->seen_body[n][k] = w->scaled[i][k];
      }
      const real noise = find_stated(call, i, R(0.0));
      least = (noise > R(0.0)) && ((noise < least) || !(least > R(0.0))) ? noise : least;
      w->weight[n] = noise;
      w->seen[n] = (uint16_t)i;
      n++;
    }
  }
  for (uint32_t i = 0; i < n; i++) {
    const real ratio = w->weight[i] > R(0.0) ? least / w->weight[i] : R(0.0);
    const real weight = ratio * ratio;
    w->weight[i] = weight > STARCAT_LEAST_WEIGHT ? weight : STARCAT_LEAST_WEIGHT;
    w->weight[i] = least > R(0.0) ? w->weight[i] : R(1.0);
  }
  return n;
}

/* Fit the attitude of the answer to the listed stars. */
static void fit_stars(const starcat_workspace *w, uint32_t count, starcat_result *result) {
  real square = R(0.0);
  /* The directions of an image are rounded, so that their attitude is not quite a rotation. */
  starcat_make_quaternion(w->best.matrix, result->q_body_from_icrs);
  starcat_make_matrix(result->q_body_from_icrs, result->matrix);
  starcat_refine_attitude(result->matrix, &w->seen_body[0][0], &w->seen_icrs[0][0], NULL, w->weight,
                          count, STARCAT_STEPS_FROM_AFAR);
  starcat_make_quaternion(result->matrix, result->q_body_from_icrs);
  starcat_make_matrix(result->q_body_from_icrs, result->matrix);
  for (uint32_t i = 0; i < count; i++) {
    real turned[3];
    starcat_turn(result->matrix, w->seen_icrs[i], turned);
    square += starcat_chord_square(w->seen_body[i], turned);
  }
  result->residual_rad = STARCAT_SQRT(square / (real)count);
}

/* Squared residuals. */
typedef struct {
  real px;     /* square pixels */
  real stated; /* those of stated noise, in units of it */
  real all;    /* in units of the noise, stated or what the tolerance stands for */
  uint32_t n_stated, n_far; /* stars with a stated noise, and farther than any that agreed */
} residual_sums;

static void sum_residuals(const starcat_call *call, const real m[9], uint32_t n_seen, real left,
                          residual_sums *s) {
  const starcat_workspace *w = call->work;
  for (uint32_t n = 0; n < n_seen; n++) {
    const uint32_t i = starcat_limit_place(w->seen[n], STARCAT_MAX_CENTROIDS);
    const real noise = starcat_find_noise(call, i);
    real body[3], x = STARCAT_LARGEST_PX, y = STARCAT_LARGEST_PX;
    starcat_turn(m, w->seen_icrs[n], body);
    (void)starcat_find_pixel(&call->camera, body, &x, &y);
    const real dx = call->x[i] - x, dy = call->y[i] - y;
    const real square = dx * dx + dy * dy, sigma = left * starcat_find_sigma(call, i);
    s->px += square;
    s->n_far += square <= FARTHEST_STAR * FARTHEST_STAR * call->reach_px * call->reach_px ? 0u : 1u;
    s->all += square / (sigma * sigma);
    if (noise > R(0.0)) {
      s->stated += square / (noise * noise);
      s->n_stated++;
    }
  }
}

/* Add the errors of places that noise does not explain to the covariance. If the frame has a shape
 * that is in no model, its residuals are larger than the noise. Neighbours are off alike then, and
 * the attitude is off as much as they are, however many there are. */
static void tell_errors_of_model(const starcat_call *call, const residual_sums *s, uint32_t n_free,
                                 real left, starcat_result *result) {
  const starcat_camera *c = &call->camera.given;
  const real ratio = s->all / (real)n_free;
  if (ratio > R(1.0) + STARCAT_NOTABLE_DEVIATIONS * STARCAT_SQRT(R(2.0) / (real)n_free)) {
    const real excess = s->px / (real)n_free * (R(1.0) - R(1.0) / ratio);
    const real turn = excess / (c->focal_length_px * c->focal_length_px);
    result->covariance_rad2[0] += turn;
    result->covariance_rad2[4] += turn;
    result->covariance_rad2[8] += R(12.0) * excess / (left * left) /
                                  (c->width_px * c->width_px + c->height_px * c->height_px);
  }
}

/* Noise of centroids without stated noise, from residuals with `n_free` degrees of freedom, at
 * least four. It is widened so that three times it covers as much as three standard deviations, by
 * the quantile of Student's t (Abramowitz and Stegun 1964, 26.7.5), as in pose.py. */
static real find_unstated(real square, uint32_t n_free) {
  const real free = (real)n_free;
  return STARCAT_SQRT(square / free) *
         (R(1.0) + (R(2.5) + (R(5.75) + R(10.0625) / free) / free) / free);
}

/* The covariance of the attitude if a shape was fitted with it: the inverse of the information of
 * both, with the ranges of the terms as their priors. */
static void tell_errors_of_shape(const starcat_call *call, uint32_t n_seen, real unstated,
                                 real left, starcat_result *result) {
  const starcat_workspace *w = call->work;
  starcat_normal n = {{{R(0.0)}}, {R(0.0)}};
  starcat_step step;
  const uint32_t free = starcat_count_terms(&w->best); /* a flipped bit does not lead out of n */
  for (uint32_t k = 0; k < n_seen; k++) {
    const real stated = starcat_find_noise(call, w->seen[k]) * left;
    const real noise = stated > R(0.0) ? stated : unstated;
    starcat_add_normal(call, starcat_limit_place(w->seen[k], STARCAT_MAX_CENTROIDS), R(0.0), R(0.0),
                       R(1.0) / starcat_larger(noise * noise, STARCAT_LEAST_SQUARE), free, &n);
  }
  if (starcat_solve_normal(call, &n, w->best.terms, free, R(1.0), &step) != 0) {
    for (uint32_t k = 0; k < 9u; k++) {
      result->covariance_rad2[k] += step.covariance[k / 3u][k % 3u];
    }
  }
}

/* Compute the covariance of the attitude, A^-1 sum(w^2 t t') A^-1 with the rotations t that the
 * noise of each centroid causes, and the reduced chi-square. Returns 0 if a star is much farther from
 * where the attitude puts it than the reach: it agreed within the reach, so that a bit must have
 * flipped since. */
static int tell_errors(const starcat_call *call, uint32_t n_seen, starcat_result *result) {
  const starcat_workspace *w = call->work;
  real h[6] = {0}, s[3][3] = {{0}, {0}, {0}}, unused[3], inverse[6];
  residual_sums squared = {R(0.0), R(0.0), R(0.0), 0, 0};
  /* Noise is stated in pixels of the frame; its scale is undone in the places. */
  const real left = w->best.free > 0u ? R(1.0) - w->best.terms[0] : R(1.0);
  sum_residuals(call, result->matrix, n_seen, left, &squared);
  uint32_t unknowns = call->fov_error > R(0.0) ? 4u : 3u;
  unknowns = w->best.free > 0u ? 3u + w->best.free : unknowns;
  const uint32_t n_free = 2u * n_seen > unknowns ? 2u * n_seen - unknowns : 1u;
  const real unstated = find_unstated(squared.px, n_free);
  if (squared.n_far > 0u) {
    return 0;
  }
  if (2u * squared.n_stated > unknowns) {
    result->reduced_chi_square = squared.stated / (real)(2u * squared.n_stated - unknowns);
  }
  tell_errors_of_model(call, &squared, n_free, left, result);
  if (w->best.free > 0u) {
    tell_errors_of_shape(call, n_seen, unstated, left, result);
    return 1;
  }
  for (uint32_t n = 0; n < n_seen; n++) {
    const real *b = w->seen_body[n], v = w->weight[n];
    const real noise = starcat_find_noise(call, w->seen[n]);
    const real scale = v * (noise > R(0.0) ? noise : unstated);
    real turn[2][3];
    h[0] += v * (R(1.0) - b[0] * b[0]);
    h[1] -= v * b[0] * b[1];
    h[2] -= v * b[0] * b[2];
    h[3] += v * (R(1.0) - b[1] * b[1]);
    h[4] -= v * b[1] * b[2];
    h[5] += v * (R(1.0) - b[2] * b[2]);
    starcat_find_turns(&call->camera, b, turn);
    for (uint32_t k = 0; k < 9u; k++) {
      const uint32_t i = k / 3u, j = k % 3u;
      s[i][j] += scale * scale * (turn[0][i] * turn[0][j] + turn[1][i] * turn[1][j]);
    }
  }
  if (!starcat_solve_symmetric(h, s[0], unused, inverse)) {
    return 1; /* all stars are at one place */
  }
  const real p[3][3] = {{inverse[0], inverse[1], inverse[2]},
                        {inverse[1], inverse[3], inverse[4]},
                        {inverse[2], inverse[4], inverse[5]}};
  for (uint32_t k = 0; k < 9u; k++) {
    for (uint32_t i = 0; i < 3u; i++) {
      result->covariance_rad2[k] += p[k / 3u][i] * starcat_dot(s[i], p[k % 3u]);
    }
  }
  return 1;
}

/* Write the attitude of the best agreement with its errors. Returns the number of its stars; 0 if it
 * has none, or if it is not better than chance. */
static uint32_t tell_attitude(starcat_call *call, starcat_result *result) {
  const starcat_workspace *w = call->work;
  if ((w->best.n_matched < STARCAT_MIN_STARS) || !(w->best.log_bound < R(0.0)) ||
      !(w->best.log_bound <= w->best.log_chance)) {
    return 0;
  }
  call->focal = R(0.0); /* so that the directions are computed again */
  if (!starcat_set_focal(call, w->best.focal) ||
      ((w->best.free > 0u) && !starcat_use_shape(call, w->best.terms))) {
    return 0; /* a flipped bit moved a centroid out of view */
  }
  const uint32_t n_seen = take_stars(call);
  if (n_seen < STARCAT_MIN_STARS) {
    return 0;
  }
  fit_stars(w, n_seen, result);
  if (!tell_errors(call, n_seen, result)) {
    return 0;
  }
  result->log_chance = w->best.log_bound;
  /* The scale of a shape is that of the focal length. */
  const real left = R(1.0) - w->best.terms[0];
  result->focal_length_px = call->camera.given.focal_length_px / left;
  result->n_shape = starcat_count_terms(&w->best);
  for (uint32_t k = 1; k < STARCAT_SHAPE_TERMS; k++) {
    result->shape[k] = w->best.terms[k] / left;
  }
  return n_seen;
}

starcat_status starcat_end_call(starcat_call *call, const starcat_options *options,
                                starcat_result *result) {
  const starcat_workspace *w = call->work;
  result->steps = options->max_steps - call->own->steps_left;
  result->n_tried = call->own->n_tried;
  const uint32_t n_seen = tell_attitude(call, result);
  if ((n_seen == 0u) || (w->best.withheld != 0u) || !(result->log_chance <= call->log_limit)) {
    return refuse_frame(call, result);
  }
  result->n_matched = n_seen;
  for (uint32_t i = 0; i < call->own->count; i++) {
    result->star[starcat_limit_place(w->row[i], call->own->given)] = w->best.star[i];
  }
  return STARCAT_IDENTIFIED;
}
