/* Chains: candidates of several frames that confirm each other. The same rules as in the ground's
 * starcat/matcher/chains.py, which explains them, but a session follows one chain.
 *
 * A second frame of the same stars is no second proof. Only spots that no earlier frame of the chain
 * has are counted: stars that came into the field, or were not detected before. The bound of a chain
 * is the expected number of tuples of attitudes, one per frame and each near the attitude before it,
 * whose squared residuals have as low a sum.
 *
 * SPDX-License-Identifier: MIT
 */
#include "internal.h"

#define SAME_SPOT R(2.0)    /* largest distance of spots that count as one, in reaches */
#define AROUND R(1.5)       /* radius around the boresight in which spots are compared, in radii */
#define MOST_COVERED R(0.5) /* of the frame by spots that are not new: no room for new ones */
#define LOG_HALF R(-0.69314718055994530942)
#define PI R(3.14159265358979323846)

/* Mark the usable centroids that no spot of a chain is near, in `before`. Returns the part of the
 * frame that the spots of the chain cover. */
static real mark_new(const starcat_call *call, const real m[9], real (*spots)[3],
                     uint32_t n_spots) {
  starcat_workspace *w = call->work;
  const starcat_optics *camera = &call->camera;
  const real reach_px = SAME_SPOT * call->reach_px;
  const real least = STARCAT_COS(AROUND * STARCAT_ATAN2(camera->sin_radius, camera->cos_radius));
  uint32_t n_there = 0;
  for (uint32_t i = 0; i < call->own->count; i++) {
    w->before[i] = 1;
  }
  for (uint32_t k = 0; k < n_spots; k++) {
    real body[3], x = STARCAT_LARGEST_PX, y = STARCAT_LARGEST_PX;
    starcat_turn(m, spots[k], body);
    if (body[2] > least) {
      n_there++;
      (void)starcat_find_pixel(camera, body, &x, &y);
      for (uint32_t i = 0; i < call->own->count; i++) {
        const real dx = w->x[i] - x, dy = w->y[i] - y;
        w->before[i] = (int16_t)(dx * dx + dy * dy <= reach_px * reach_px ? 0 : w->before[i]);
      }
    }
  }
  return (real)n_there * PI * reach_px * reach_px /
         (camera->given.width_px * camera->given.height_px);
}

/* Sum the new spots that have a star in the candidate: their normal equations and their squared
 * residuals. Returns their number. */
static uint32_t sum_new(const starcat_call *call, const real m[9], starcat_normal *n,
                        real *square_px) {
  const starcat_workspace *w = call->work;
  uint32_t matched = 0;
  for (uint32_t i = 0; i < call->own->count; i++) {
    if ((w->best.star[i] >= 0) && (w->before[i] != 0)) {
      real offset[2];
      const real apart =
          call->noise_px *
          (real)starcat_find_deviation(
              call, i, starcat_limit_place((uint32_t)w->best.star[i], call->image->n_stars));
      (void)starcat_find_offset(call, &w->best, m, i, offset);
      *square_px += offset[0] * offset[0] + offset[1] * offset[1] + apart * apart;
      starcat_add_normal(call, i, offset[0], offset[1], R(1.0), 0, n);
      matched++;
    }
  }
  return matched;
}

/* Logarithm of the ways to assign n new spots to stars. Only their magnitudes remain in the
 * workspace. Returns the number of new spots in `n_new`. */
static real log_ways_of_new(starcat_call *call, uint32_t n, uint32_t *n_new) {
  starcat_workspace *w = call->work;
  uint32_t kept = 0;
  for (uint32_t i = 0; i < call->own->count; i++) {
    if (w->before[i] != 0) {
      w->magnitude[kept] = w->magnitude[i];
      kept++;
    }
  }
  call->own->count = kept;
  *n_new = kept;
  starcat_count_ways(call, n);
  return w->log_ways[n];
}

/* Put the spots of the frame on the sky, after those of the chain. */
static void add_spots(const starcat_call *call, const real m[9], uint32_t count, real (*spots)[3]) {
  const starcat_workspace *w = call->work;
  for (uint32_t n = 0; n < 3u * count; n++) {
    const uint32_t i = n / 3u, k = n % 3u;
    spots[i][k] = m[k] * w->body[i][0] + m[3u + k] * w->body[i][1] + m[6u + k] * w->body[i][2];
  }
}

/* Add the candidate of a frame to a chain. The last call has left it in `work` and `candidate`. If
 * `error_rad` is above 0 it has to be as near to the attitude of the chain; else the chain is empty.
 * Spots are appended to `spots`. Returns 0, and changes nothing, if it adds no evidence, or if the
 * steps of the options are used up; `steps` are those taken. */
int starcat_extend_chain(const starcat_image *image, const starcat_camera *camera,
                         const starcat_options *options, const starcat_frame *frame,
                         starcat_workspace *work, const starcat_result *candidate, real error_rad,
                         real (*spots)[3], starcat_chain *chain, uint32_t *steps) {
  starcat_call call;
  starcat_result unused;
  starcat_normal n = {{{R(0.0)}}, {R(0.0)}};
  const real *m = candidate->matrix;
  real near[9], square_px = R(0.0);
  *steps = 0;
  if (starcat_begin_call(&call, image, camera, options, frame, work, &unused) != STARCAT_OK) {
    return 0;
  }
  starcat_make_matrix(chain->q, near);
  if (error_rad > R(0.0)) {
    starcat_search_near(&call, near, error_rad);
    if (starcat_is_allowed(&call, m) == 0) {
      return 0;
    }
  }
  const uint32_t count = call.own->count;
  (void)starcat_spend_steps(&call, count * (chain->n_spots + 1u));
  const real covered = mark_new(&call, m, spots, chain->n_spots);
  const uint32_t matched = sum_new(&call, m, &n, &square_px);
  call.own->n_near =
      starcat_gather_stars(&call, m + 6, call.camera.cos_radius, call.camera.sin_radius,
                           STARCAT_MAX_STARS, work->near_row, work->near_icrs);
  call.own->n_near = starcat_limit_place(call.own->n_near, STARCAT_MAX_STARS + 1u);
  starcat_project_stars(&call, m, call.reach_px);
  const int has_steps = starcat_spend_on_bound(&call);
  *steps = options->max_steps - call.own->steps_left;
  if (!has_steps || !(covered < MOST_COVERED) || (matched < 2u) || (matched > call.own->n_within) ||
      (starcat_factorise(n.gram, 3) == 0)) {
    return 0;
  }
  uint32_t n_new = 0;
  const real log_root = STARCAT_LOG(n.gram[0][0] * n.gram[1][1] * n.gram[2][2]);
  const real log_ways = log_ways_of_new(&call, matched, &n_new);
  chain->log_number += log_ways + call.log_attitudes + log_root -
                       (real)matched * (call.camera.log_area + STARCAT_LOG(R(1.0) - covered)) +
                       STARCAT_LOG((real)(n_new - 1u));
  chain->square_px += square_px;
  chain->left += 2u * matched - 3u;
  add_spots(&call, m, count, spots + chain->n_spots);
  chain->n_spots += count;
  for (uint32_t k = 0; k < 4u; k++) {
    chain->q[k] = candidate->q_body_from_icrs[k];
  }
  return 1;
}

/* Logarithm of the bound of a chain whose first frame was `frames` frames ago, at least one. Every
 * chain that ends with a frame has a share of the probability: 2^-frames, divided by the number of
 * choices of frames between. `rate` is that of magnitudes. */
real starcat_log_joint(const starcat_chain *chain, uint32_t frames, real rate) {
  return starcat_log_ball(chain->left, chain->square_px, rate) + chain->log_number -
         (real)(2u * frames - 1u) * LOG_HALF;
}

/* Make an answer of the candidate that the last call has left in the workspace. */
void starcat_confirm_candidate(const starcat_workspace *work, uint32_t count, real log_joint,
                               starcat_result *result) {
  result->n_matched = 0;
  for (uint32_t i = 0; i < starcat_limit_place(result->n_usable, STARCAT_MAX_CENTROIDS + 1u); i++) {
    result->star[starcat_limit_place(work->row[i], count)] = work->best.star[i];
    result->n_matched += work->best.star[i] >= 0 ? 1u : 0u;
  }
  result->log_chance = log_joint;
  result->reason = STARCAT_REASON_NONE;
}
