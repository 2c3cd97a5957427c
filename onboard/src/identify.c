/* The two ways to find an attitude: lost in space, and from a prior attitude.
 *
 *     identify_frame:
 *         begin: order the usable centroids, brightest first
 *         for each triangle of centroids, until an attitude is certain or the steps are used up:
 *             for each feature of the image that it can be:  [triangles.c, pyramids.c]
 *                 try the attitude of this feature, and keep the best one  [verify.c]
 *         if none is certain: the same with triangles that a shape of the frame has changed
 *         end: fit the best attitude to its stars, or withhold it  [answer.c]
 *
 *     track_frame:
 *         begin as above; gather the stars that can be visible near the prior attitude
 *         for each of the first sixteen centroids a:
 *             for b in (the centroid farthest from a, the next one in order):
 *                 predict where the prior puts the stars
 *                 for each star near a, the nearest first:
 *                     find the star nearest to the predicted place of b
 *                     try the attitude of these two pairs, and stop if it is certain
 *         end as above
 *
 * SPDX-License-Identifier: MIT
 */
#include "internal.h"

#define WIDEST_PRIOR_RAD R(0.35)
#define WIDEST_TURN_RAD R(3.14159265358979)
#define LARGEST_QUATERNION R(1e6)
#define LEAST_OF_QUATERNION R(1e-12)
#define MOST_ANCHORS 16u
#define LOG_BALL R(1.4324119583011810) /* logarithm of 4 pi / 3 */
/* Largest effort of triangles, the same as in starcat/matcher/numpy_engine.py. */
#define EFFORT_BEFORE_VOTES 750u
#define EFFORT_AFTER_VOTES 1750u /* includes the effort before */
#define EFFORT_OF_CROWDED 60000u /* after votes, if these can miss the stars of the frame */
#define EFFORT_ON_SHAPES 4000u   /* of triangles in frames of another shape */
#define MIN_REFERENCES 12u       /* of votes; also if more than the largest number are needed */
#define MAX_REFERENCES 32u

/* Look up triangles up to an effort. Returns whether the effort ended the search. */
static int search_some(starcat_call *call, uint32_t most) {
  call->own->most_effort = most;
  starcat_search_triangles(call, call->image->method == STARCAT_TRIANGLE ? starcat_look_up_triangle
                                                                         : starcat_look_up_pyramid);
  return call->own->most_effort == 0u;
}

/* Look up triangles. If votes can be counted, look up only the first triangles, then count votes,
 * then look up more triangles: many of them if the votes need more references than they have.
 * Returns 0 if the votes need neighbours that the caller has not listed yet. */
static int search_sky(starcat_call *call) {
  const starcat_agreement *best = &call->work->best;
  if ((call->image->neighbours == NULL) || (call->fov_error > R(0.0))) {
    (void)search_some(call, UINT32_MAX);
    return 1;
  }
  const int has_more = search_some(call, EFFORT_BEFORE_VOTES);
  if (!(best->log_chance <= call->log_certain)) {
    if (call->image->neighbours->neighbour == NULL) {
      return 0;
    }
    const uint32_t needed = starcat_count_references(call);
    const int is_crowded = needed > MAX_REFERENCES;
    starcat_search_votes(call, is_crowded || (needed < MIN_REFERENCES) ? MIN_REFERENCES : needed);
    if (has_more && !(best->log_chance <= STARCAT_LOG_LIKELY)) {
      (void)search_some(call, is_crowded ? EFFORT_OF_CROWDED : EFFORT_AFTER_VOTES);
    }
  }
  return 1;
}

starcat_status starcat_identify_frame(const starcat_image *image, const starcat_camera *camera,
                                      const starcat_options *options, const starcat_frame *frame,
                                      starcat_workspace *work, starcat_result *result) {
  starcat_call call;
  const starcat_status status =
      starcat_begin_call(&call, image, camera, options, frame, work, result);
  if (status != STARCAT_OK) {
    return status;
  }
  if (search_sky(&call) == 0) {
    result->steps = options->max_steps - call.counters.steps_left;
    return STARCAT_INCOMPLETE;
  }
  if ((image->method == STARCAT_TRIANGLE) && !(work->best.log_chance <= STARCAT_LOG_LIKELY)) {
    starcat_search_shaped(&call, EFFORT_ON_SHAPES);
  }
  return starcat_end_call(&call, options, result);
}

/* A prior attitude, and how far stars can be from their predicted places. */
typedef struct {
  real matrix[9];
  real cos_radius, sin_radius; /* cap that contains every possible frame */
  real shift_px;               /* largest shift of one star */
  real turn;                   /* of two stars relative to each other, over their distance */
  int is_stale;                /* whether a verification has overwritten the workspace */
} prior;

static starcat_status set_prior(const starcat_call *call, const real q[4], real uncertainty_rad,
                                prior *p) {
  const starcat_optics *camera = &call->camera;
  real unit[4], square = R(0.0);
  if (!starcat_are_finite(q, 4) || !starcat_are_finite(&uncertainty_rad, 1)) {
    return STARCAT_E_NOT_FINITE;
  }
  for (uint32_t n = 0; n < 4u; n++) {
    if (starcat_absolute(q[n]) > LARGEST_QUATERNION) {
      return STARCAT_E_OPTIONS;
    }
    square += q[n] * q[n];
  }
  if (!(square > LEAST_OF_QUATERNION) || !(uncertainty_rad > R(0.0)) ||
      (uncertainty_rad > WIDEST_PRIOR_RAD)) {
    return STARCAT_E_OPTIONS;
  }
  for (uint32_t n = 0; n < 4u; n++) {
    unit[n] = q[n] / STARCAT_SQRT(square);
  }
  starcat_make_matrix(unit, p->matrix);
  const real c = STARCAT_COS(uncertainty_rad), s = STARCAT_SIN(uncertainty_rad);
  p->cos_radius = camera->cos_radius * c - camera->sin_radius * s;
  p->sin_radius = camera->sin_radius * c + camera->cos_radius * s;
  if (!(p->cos_radius > STARCAT_LEAST_COSINE)) {
    return STARCAT_E_OPTIONS;
  }
  const real stretch = R(1.0) / (p->cos_radius * p->cos_radius);
  p->shift_px = uncertainty_rad * stretch * camera->given.focal_length_px + call->reach_px;
  p->turn = R(2.0) * uncertainty_rad * stretch;
  p->is_stale = 1;
  return STARCAT_OK;
}

/* The largest angle that noise can make of a turn by an angle. */
real starcat_widen_turn(const starcat_call *call, real turn_rad) {
  const starcat_camera *camera = &call->camera.given;
  const real noise_rad =
      R(2.0) * call->tolerance_px / starcat_smaller(camera->width_px, camera->height_px);
  return starcat_smaller(turn_rad + noise_rad, WIDEST_TURN_RAD);
}

/* Search only attitudes within the uncertainty of a prior, and the turn that noise can add. */
static void search_near(starcat_call *call, const real m[9], real uncertainty_rad) {
  const real turn = starcat_widen_turn(call, uncertainty_rad);
  const real half = STARCAT_SIN(R(0.5) * turn);
  call->near = m;
  call->near_square = R(8.0) * half * half;
  call->log_attitudes =
      starcat_smaller(LOG_BALL + R(3.0) * STARCAT_LOG(turn), STARCAT_LOG_ALL_ATTITUDES);
}

/* Predict the positions of the stars around the prior's frame. Returns 0 if they are too many, or
 * the budget is used up. */
static int predict_stars(const starcat_call *call, prior *p) {
  starcat_workspace *w = call->work;
  if (p->is_stale != 0) {
    call->own->n_near = starcat_gather_stars(call, p->matrix + 6, p->cos_radius, p->sin_radius,
                                             STARCAT_MAX_STARS, w->near_row, w->near_icrs);
    if ((call->own->n_near > STARCAT_MAX_STARS) || !starcat_spend_steps(call, call->own->n_near)) {
      return 0;
    }
    starcat_project_stars(call, p->matrix, p->shift_px);
    p->is_stale = 0;
  }
  return 1;
}

static real square_from(const starcat_workspace *w, uint32_t star, real x, real y) {
  const real dx = w->x_of[star] - x, dy = w->y_of[star] - y;
  return dx * dx + dy * dy;
}

/* The next star farther from a centroid's prediction than `past`; -1 if none is in reach. */
static int32_t find_next_star(const starcat_call *call, const prior *p, uint32_t centroid,
                              real *past) {
  const starcat_workspace *w = call->work;
  real least = p->shift_px * p->shift_px;
  int32_t found = -1;
  for (uint32_t k = 0; k < call->own->n_within; k++) {
    const real square = square_from(w, k, w->x[centroid], w->y[centroid]);
    if ((square > *past) && (square <= least) &&
        starcat_is_compatible(call, centroid, w->near_row[starcat_find_near(w, k)])) {
      least = square;
      found = (int32_t)k;
    }
  }
  *past = least;
  return found;
}

/* The centroid farthest from `from`: the two determine the attitude best. */
static uint32_t find_farthest(const starcat_call *call, uint32_t from) {
  const starcat_workspace *w = call->work;
  uint32_t best = from;
  real most = R(0.0);
  for (uint32_t i = 0; i < call->own->count; i++) {
    const real dx = w->x[i] - w->x[from], dy = w->y[i] - w->y[from];
    if (dx * dx + dy * dy > most) {
      most = dx * dx + dy * dy;
      best = i;
    }
  }
  return best;
}

/* Take centroid a as `star`, predict centroid b, and verify the attitude with the star nearest to
 * that prediction. Returns 1 if the search can end. */
static int try_pair(starcat_call *call, prior *p, uint32_t a, uint32_t star, uint32_t b) {
  starcat_workspace *w = call->work;
  const real error = STARCAT_SIDE_TOLERANCE * call->tolerance_rad;
  const real apart = starcat_angle_of_chord(starcat_chord_square(w->body[a], w->body[b]));
  const real low = starcat_chord_of_angle(apart - error),
             high = starcat_chord_of_angle(apart + error);
  const real dx = w->x[b] - w->x[a], dy = w->y[b] - w->y[a];
  const real slack = R(2.0) * call->reach_px + p->turn * STARCAT_SQRT(dx * dx + dy * dy);
  const real *first = w->near_icrs[starcat_find_near(w, star)];
  real least = slack * slack, m[9];
  int32_t partner = -1;
  for (uint32_t k = 0; k < call->own->n_within; k++) {
    const real square = square_from(w, k, w->x_of[star] + dx, w->y_of[star] + dy);
    if ((square <= least) && starcat_is_compatible(call, b, w->near_row[starcat_find_near(w, k)])) {
      const real chord = starcat_chord_square(first, w->near_icrs[starcat_find_near(w, k)]);
      if ((chord >= low * low) && (chord <= high * high)) {
        least = square;
        partner = (int32_t)k;
      }
    }
  }
  if (!starcat_spend_steps(call, call->own->n_within + 1u)) {
    return 1;
  }
  if (partner < 0) {
    return 0;
  }
  if (!starcat_fit_triad(w->body[a], w->body[b], first,
                         w->near_icrs[starcat_find_near(w, (uint32_t)partner)], m)) {
    return 0;
  }
  p->is_stale = 1;
  return starcat_try_attitude(call, m, R(1.0));
}

/* Try the stars that one centroid can be, the nearest first, together with one other centroid.
 * Returns 1 if the search can end. */
static int try_anchor(starcat_call *call, prior *p, uint32_t a, uint32_t b) {
  real past = R(-1.0);
  int32_t star = 0;
  while (star >= 0) { /* each star is farther than the last, so this ends */
    if (!predict_stars(call, p) || !starcat_spend_steps(call, call->own->n_within + 1u)) {
      return 1;
    }
    star = find_next_star(call, p, a, &past);
    if ((star >= 0) && try_pair(call, p, a, (uint32_t)star, b)) {
      return 1;
    }
  }
  return 0;
}

starcat_status starcat_track_frame(const starcat_image *image, const starcat_camera *camera,
                                   const starcat_options *options, const starcat_frame *frame,
                                   const starcat_real q_prior[4], starcat_real uncertainty_rad,
                                   starcat_workspace *work, starcat_result *result) {
  starcat_call call;
  prior p;
  if (q_prior == NULL) {
    return STARCAT_E_NULL;
  }
  starcat_status status = starcat_begin_call(&call, image, camera, options, frame, work, result);
  if (status == STARCAT_OK) {
    status = set_prior(&call, q_prior, uncertainty_rad, &p);
  }
  if (status != STARCAT_OK) {
    return status;
  }
  search_near(&call, p.matrix, uncertainty_rad);
  if (!predict_stars(&call, &p) && (call.counters.steps_left > 0u)) {
    result->steps = options->max_steps - call.counters.steps_left;
    return STARCAT_E_CAPACITY; /* the prior is too wide for this many stars */
  }
  for (uint32_t a = 0; (a < call.counters.count) && (a < MOST_ANCHORS); a++) {
    const uint32_t b = find_farthest(&call, a);
    /* The farthest one can be a false spot; then use the next one in order. */
    if (try_anchor(&call, &p, a, b) || try_anchor(&call, &p, a, (a + 1u) % call.counters.count)) {
      break;
    }
  }
  return starcat_end_call(&call, options, result);
}
