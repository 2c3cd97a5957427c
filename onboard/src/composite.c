/* Composites: the spots of successive frames without an answer, put together. The same rules as
 * in the ground's starcat/matcher/composite.py, which explains them.
 *
 * The turn of the camera from one frame to the next is found from their spots alone, so the bound of
 * a composite is that of a frame with these spots. The spots are in the camera frame of the last
 * frame; one that was seen again has the mean of its places.
 *
 * SPDX-License-Identifier: MIT
 */
#include "internal.h"

#define SAME_SPOT R(1.4142135623730950488) /* largest distance of two places, in tolerances */
#define MOST_SEEDS 24u                      /* spots of each from which turns are found */
#define LEAST_SHARED 3u                     /* spots that two frames share; two give the turn */
#define MOST_SEEN 1000u                     /* frames in the mean of the places of a spot */

/* Limits of the distances of the spots of a composite and a frame. */
typedef struct {
  real spot_square; /* of the places of a spot, if the turn is known */
  real move_square; /* of the places of a spot before and after the turn */
  real least_trace; /* of the matrix of the turn: 1 + 2 cos(angle) */
  real side;        /* difference of the distances of two spots */
  uint32_t n_old, n_new; /* spots from which turns are found */
} spot_limits;

/* Turn the first centroids to the camera frame of the composite, in `seen_icrs`. None of them is a
 * spot yet, in `before`. */
static void turn_centroids(const starcat_call *call, uint32_t count, const real m[9]) {
  for (uint32_t i = 0; i < count; i++) {
    starcat_turn(m, call->work->body[i], call->work->seen_icrs[i]);
    call->work->before[i] = 0;
  }
}

/* Keep the turn of two spots if it puts the first spots and centroids nearer to each other. */
static void try_turn(const starcat_call *call, const starcat_composite *c, const spot_limits *most,
                     const real m[9], real *least, real best[9]) {
  const starcat_workspace *w = call->work;
  real sum = R(0.0);
  if (!(m[0] + m[4] + m[8] >= most->least_trace)) {
    return;
  }
  turn_centroids(call, most->n_new, m);
  for (uint32_t k = 0; k < most->n_old; k++) {
    real nearest = most->spot_square;
    for (uint32_t i = 0; i < most->n_new; i++) {
      nearest = starcat_smaller(nearest, starcat_chord_square(w->seen_icrs[i], c->body[k]));
    }
    sum += nearest;
  }
  if (sum < *least) {
    *least = sum;
    for (uint32_t n = 0; n < 9u; n++) {
      best[n] = m[n];
    }
  }
}

/* Try the turns that put a centroid on a spot, and any other one on a later spot. Returns 0 if the
 * steps are used up. */
static int try_spot(const starcat_call *call, const starcat_composite *c, const spot_limits *most,
                    uint32_t spot, const real *centroid, real *least, real best[9]) {
  const starcat_workspace *w = call->work;
  const uint32_t end = most->n_old * most->n_new;
  uint32_t n = (spot + 1u) * most->n_new;
  int has_steps = starcat_spend_steps(call, end - n);
  for (; (has_steps != 0) && (n < end); n++) {
    const real *a = c->body[spot], *b = c->body[n / most->n_new], *other = w->body[n % most->n_new];
    const real before = STARCAT_SQRT(starcat_chord_square(a, b));
    const real after = STARCAT_SQRT(starcat_chord_square(centroid, other));
    real m[9];
    if ((starcat_absolute(after - before) <= most->side) &&
        (starcat_chord_square(b, other) <= most->move_square) &&
        starcat_fit_triad(a, b, centroid, other, m)) {
      has_steps = starcat_spend_steps(call, end);
      try_turn(call, c, most, m, least, best);
    }
  }
  return has_steps;
}

/* Find the turn of two spots that puts the most spots on each other. Returns whether there is one
 * before the steps are used up. */
static int find_likeliest_turn(const starcat_call *call, const starcat_composite *c,
                               const spot_limits *most, real best[9]) {
  const starcat_workspace *w = call->work;
  const uint32_t end = most->n_old * most->n_new;
  const real none = (real)most->n_old * most->spot_square;
  real least = none;
  int has_steps = starcat_spend_steps(call, end);
  for (uint32_t n = 0; (has_steps != 0) && (n < end); n++) {
    const uint32_t spot = n / most->n_new;
    const real *centroid = w->body[n % most->n_new];
    if (starcat_chord_square(c->body[spot], centroid) <= most->move_square) {
      has_steps = try_spot(call, c, most, spot, centroid, &least, best);
    }
  }
  return (has_steps != 0) && (least < none);
}

/* Find the centroid of each spot, the nearest one; its weight is 0 without one. Returns whether the
 * centroids are enough, and steps are left. */
static int match_spots(const starcat_call *call, const starcat_composite *c,
                       const spot_limits *most, const real m[9]) {
  starcat_workspace *w = call->work;
  const uint32_t count = call->own->count;
  uint32_t shared = 0;
  turn_centroids(call, count, m);
  for (uint32_t k = 0; k < c->n_spots; k++) {
    real nearest = most->spot_square;
    uint32_t row = count;
    for (uint32_t i = 0; i < count; i++) {
      const real apart = starcat_chord_square(w->seen_icrs[i], c->body[k]);
      if (apart < nearest) {
        nearest = apart;
        row = i;
      }
    }
    w->seen[k] = 0;
    w->weight[k] = R(0.0);
    if (row < count) {
      w->seen[k] = (uint16_t)row;
      w->weight[k] = R(1.0);
      shared += w->before[row] == 0 ? 1u : 0u;
      w->before[row] = 1;
    }
  }
  return starcat_spend_steps(call, count * c->n_spots) && (shared >= LEAST_SHARED);
}

/* Turn a direction in the camera frame of the composite to that of the new frame. */
static void turn_back(const real m[9], const real v[3], real turned[3]) {
  const real scale = R(1.0) / STARCAT_SQRT(starcat_dot(v, v));
  for (uint32_t n = 0; n < 3u; n++) {
    turned[n] = scale * (m[n] * v[0] + m[3u + n] * v[1] + m[6u + n] * v[2]);
  }
}

static void copy_spot(starcat_composite *c, uint32_t k, const real body[3], real magnitude,
                      uint32_t seen) {
  for (uint32_t n = 0; n < 3u; n++) {
    c->body[k][n] = body[n];
  }
  c->magnitude[k] = magnitude;
  c->seen[k] = (uint16_t)seen;
}

/* Make the composite of the centroids in their order, at the mean places of the spots that they
 * are, and then of the spots that are kept. One that is not seen again is dropped if it was seen
 * once, before the last frame, or is out of the field, or has no room. */
static void merge_spots(const starcat_call *call, starcat_composite *c, const real m[9]) {
  starcat_workspace *w = call->work;
  const uint32_t count = call->own->count;
  uint32_t kept = 0;
  for (uint32_t i = 0; i < count; i++) {
    w->before[i] = 1;
  }
  for (uint32_t k = 0; k < c->n_spots; k++) {
    const uint32_t i = starcat_limit_place(w->seen[k], STARCAT_MAX_CENTROIDS);
    const uint32_t seen = c->seen[k];
    if (!(w->weight[k] > R(0.0))) {
      real turned[3];
      turn_back(m, c->body[k], turned);
      copy_spot(c, kept, turned, c->magnitude[k], seen > 1u ? seen : 0u);
      kept += (seen > 0u) && (turned[2] >= call->camera.cos_radius) ? 1u : 0u;
    } else if (w->before[i] == 1) {
      real mean[3] = {c->body[k][0], c->body[k][1], c->body[k][2]};
      w->before[i] = (int16_t)(seen == 0u ? 2u : (seen < MOST_SEEN ? seen + 1u : MOST_SEEN));
      for (uint32_t n = 0; n < 3u; n++) {
        mean[n] += (w->seen_icrs[i][n] - mean[n]) / (real)w->before[i];
      }
      turn_back(m, mean, w->body[i]);
    } else {
      /* the centroid is a spot already */
    }
  }
  kept = kept < (STARCAT_MAX_CENTROIDS - count) ? kept : (STARCAT_MAX_CENTROIDS - count);
  c->n_spots = count + kept;
  for (uint32_t k = kept; k > 0u; k--) {
    copy_spot(c, count + k - 1u, c->body[k - 1u], c->magnitude[k - 1u], c->seen[k - 1u]);
  }
  for (uint32_t i = 0; i < count; i++) {
    copy_spot(c, i, w->body[i], w->magnitude[i], (uint32_t)w->before[i]);
  }
}

/* Add a frame to a composite, after a turn of the camera by at most `turn_rad`. Returns whether the
 * turn is found; else the composite is that of the frame alone. `x_px` and `y_px` are the places of
 * the spots in the frame. `steps` are those taken. A frame that is refused by
 * starcat_identify_frame changes nothing. */
int starcat_join_frame(const starcat_image *image, const starcat_camera *camera,
                       const starcat_options *options, const starcat_frame *frame,
                       starcat_workspace *work, real turn_rad, starcat_composite *c, real *x_px,
                       real *y_px, uint32_t *steps) {
  starcat_call call;
  starcat_result unused;
  real turn[9];
  *steps = 0;
  if (starcat_begin_call(&call, image, camera, options, frame, work, &unused) != STARCAT_OK) {
    return 0;
  }
  const real turn_most_rad = starcat_widen_turn(&call, turn_rad);
  const real spot_rad = SAME_SPOT * call.tolerance_rad, move_rad = turn_most_rad + spot_rad;
  const spot_limits most = {spot_rad * spot_rad,
                            move_rad * move_rad,
                            R(1.0) + R(2.0) * STARCAT_COS(turn_most_rad),
                            STARCAT_SIDE_TOLERANCE * spot_rad,
                            c->n_spots < MOST_SEEDS ? c->n_spots : MOST_SEEDS,
                            call.own->count < MOST_SEEDS ? call.own->count : MOST_SEEDS};
  int is_joined = find_likeliest_turn(&call, c, &most, turn) && match_spots(&call, c, &most, turn);
  if (is_joined != 0) {
    starcat_refine_attitude(turn, c->body[0], work->body[0], work->seen, work->weight, c->n_spots,
                            STARCAT_REFINEMENTS);
    is_joined = match_spots(&call, c, &most, turn);
  }
  *steps = options->max_steps - call.own->steps_left;
  c->n_spots = is_joined != 0 ? c->n_spots : 0u;
  merge_spots(&call, c, turn);
  for (uint32_t k = 0; k < c->n_spots; k++) {
    x_px[k] = R(-1.0);
    y_px[k] = R(-1.0);
    (void)starcat_find_pixel(&call.camera, c->body[k], x_px + k, y_px + k);
  }
  return is_joined;
}
