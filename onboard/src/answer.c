/* The answer: the attitude of the best agreement and how well it is known, or why there is none.
 *
 * SPDX-License-Identifier: MIT
 */
#include "internal.h"

/* Say why there is no answer, and how good the best agreement was. */
static void refuse(const starcat_call *call, starcat_result *result) {
  const starcat_workspace *w = call->work;
  result->best_n_matched = w->best.n_matched;
  result->best_log_chance = w->best.log_bound;
  result->best_share = w->best.share;
  if (w->steps_left == 0u) {
    result->reason = STARCAT_REASON_STEPS;
  } else if (w->n_tried == 0u) {
    result->reason = STARCAT_REASON_NO_CANDIDATE;
  } else {
    result->reason = w->best.withheld != 0u ? w->best.withheld : STARCAT_REASON_CHANCE;
  }
}

/* The noise of a centroid on each axis; 0 where it is not stated. */
static real noise_of(const real *sigma_px, real noise_px, uint32_t row) {
  if (sigma_px == NULL) {
    return noise_px;
  }
  return starcat_are_finite(sigma_px + row, 1) ? sigma_px[row] : R(0.0);
}

/* List the centroids of the best agreement that are stars, with directions of the image or others,
 * and their weights: one over the square of the noise, over the largest. */
static void take_stars(const starcat_image *image, const real *directions, const real *sigma_px,
                       starcat_workspace *w) {
  real(*body)[3] = w->best.focal == R(1.0) ? w->body : w->scaled;
  real least = R(0.0);
  uint32_t n = 0;
  for (uint32_t i = 0; i < w->count; i++) {
    const int32_t star = w->best.star[i];
    if (star >= 0) {
      real *icrs = w->seen_icrs[n];
      starcat_star(image, (uint32_t)star, icrs);
      for (uint32_t k = 0; k < 3u; k++) {
        w->seen_body[n][k] = body[i][k];
        icrs[k] = directions != NULL ? directions[3u * (size_t)star + k] : icrs[k];
      }
      const real noise = noise_of(sigma_px, R(0.0), w->row[i]);
      least = (noise > R(0.0)) && ((noise < least) || !(least > R(0.0))) ? noise : least;
      w->weight[n] = noise;
      w->seen[n] = (uint16_t)i;
      n++;
    }
  }
  w->n_seen = n;
  for (uint32_t i = 0; i < n; i++) {
    const real ratio = w->weight[i] > R(0.0) ? least / w->weight[i] : R(0.0);
    const real weight = ratio * ratio;
    w->weight[i] = weight > STARCAT_LEAST_WEIGHT ? weight : STARCAT_LEAST_WEIGHT;
    w->weight[i] = least > R(0.0) ? w->weight[i] : R(1.0);
  }
}

static void set_attitude(const real m[9], starcat_result *result) {
  starcat_quaternion(m, result->q_body_from_icrs);
  starcat_matrix(result->q_body_from_icrs, result->matrix);
}

/* Fit the attitude of the answer to the stars that are listed. */
static void fit_stars(const starcat_workspace *w, starcat_result *result) {
  real square = R(0.0);
  starcat_refine(result->matrix, &w->seen_body[0][0], &w->seen_icrs[0][0], NULL, w->weight,
                 w->n_seen, 4);
  set_attitude(result->matrix, result);
  for (uint32_t i = 0; i < w->n_seen; i++) {
    real turned[3];
    starcat_turn(result->matrix, w->seen_icrs[i], turned);
    square += starcat_chord_square(w->seen_body[i], turned);
  }
  result->residual_rad = STARCAT_SQRT(square / (real)w->n_seen);
}

#ifdef STARCAT_GROUND
/* Fit the attitude of an answer once more, with other directions than those of the image. */
void starcat_fit_answer(const starcat_image *image, const real *directions, const real *sigma_px,
                        starcat_workspace *work, starcat_result *result) {
  take_stars(image, directions, sigma_px, work);
  fit_stars(work, result);
}
#endif

/* Noise of centroids that is not stated: that of the residuals, of whose 2n numbers three went into
 * the attitude. Sums the squared residuals of stated noise, in it, and counts these centroids. */
static real residuals(const starcat_call *call, const real m[9], real *chi_square,
                      uint32_t *n_stated) {
  const starcat_workspace *w = call->work;
  real square = R(0.0);
  for (uint32_t n = 0; n < w->n_seen; n++) {
    const uint32_t i = w->seen[n];
    const real noise = noise_of(call->sigma_px, call->noise_px, w->row[i]);
    real body[3], x = w->x[i], y = w->y[i];
    starcat_turn(m, w->seen_icrs[n], body);
    (void)starcat_pixel(&call->camera, body, &x,
                        &y); /* it was within reach of its centroid before */
    const real dx = w->x[i] - x, dy = w->y[i] - y;
    square += dx * dx + dy * dy;
    if (noise > R(0.0)) {
      *chi_square += (dx / noise) * (dx / noise) + (dy / noise) * (dy / noise);
      (*n_stated)++;
    }
  }
  return STARCAT_SQRT(square /
                      (real)(2u * w->n_seen - 3u)); /* there are STARCAT_MIN_STARS at least */
}

/* Tell the covariance of the attitude, A^-1 sum(w^2 t t') A^-1 with the turns t that the noises of
 * centroids stand for, and the reduced chi-square. */
static void tell_errors(const starcat_call *call, starcat_result *result) {
  const starcat_workspace *w = call->work;
  real h[6] = {0}, s[3][3] = {{0}, {0}, {0}}, chi_square = R(0.0), unused[3], inverse[6];
  uint32_t n_stated = 0;
  const real unstated = residuals(call, result->matrix, &chi_square, &n_stated);
  const uint32_t unknowns = call->fov_error > R(0.0) ? 4u : 3u;
  if (2u * n_stated > unknowns) {
    result->reduced_chi_square = chi_square / (real)(2u * n_stated - unknowns);
  }
  for (uint32_t n = 0; n < w->n_seen; n++) {
    const real *b = w->seen_body[n], v = w->weight[n];
    const real noise = noise_of(call->sigma_px, call->noise_px, w->row[w->seen[n]]);
    const real scale = v * (noise > R(0.0) ? noise : unstated);
    real turn[2][3];
    h[0] += v * (R(1.0) - b[0] * b[0]);
    h[1] -= v * b[0] * b[1];
    h[2] -= v * b[0] * b[2];
    h[3] += v * (R(1.0) - b[1] * b[1]);
    h[4] -= v * b[1] * b[2];
    h[5] += v * (R(1.0) - b[2] * b[2]);
    starcat_turns_of_pixel(&call->camera, b, turn);
    for (uint32_t k = 0; k < 9u; k++) {
      const uint32_t i = k / 3u, j = k % 3u;
      s[i][j] += scale * scale * (turn[0][i] * turn[0][j] + turn[1][i] * turn[1][j]);
    }
  }
  if (!starcat_solve(h, s[0], unused, inverse)) {
    return; /* all stars are at one place */
  }
  const real p[3][3] = {{inverse[0], inverse[1], inverse[2]},
                        {inverse[1], inverse[3], inverse[4]},
                        {inverse[2], inverse[4], inverse[5]}};
  for (uint32_t k = 0; k < 9u; k++) {
    for (uint32_t i = 0; i < 3u; i++) {
      result->covariance_rad2[k] += p[k / 3u][i] * starcat_dot(s[i], p[k % 3u]);
    }
  }
}

starcat_status starcat_end(starcat_call *call, const starcat_options *options,
                           starcat_result *result) {
  starcat_workspace *w = call->work;
  result->steps = options->max_steps - w->steps_left;
  result->n_tried = w->n_tried;
  if ((w->best.n_matched < STARCAT_MIN_STARS) || !(w->best.log_chance <= call->log_limit)) {
    refuse(call, result);
    return w->steps_left == 0u ? STARCAT_E_BUDGET : STARCAT_NO_MATCH;
  }
  starcat_set_focal(call, w->best.focal);
  take_stars(call->image, NULL, call->sigma_px, w);
  set_attitude(w->best.matrix, result);
  result->residual_rad = w->best.residual_rad;
  if (call->sigma_px != NULL) {
    fit_stars(w, result);
  }
  tell_errors(call, result);
  result->log_chance = w->best.log_chance;
  result->n_matched = w->best.n_matched;
  result->focal_length_px = call->camera.given.focal_length_px;
  for (uint32_t i = 0; i < w->count; i++) {
    result->star[w->row[i]] = w->best.star[i];
  }
  return STARCAT_IDENTIFIED;
}
