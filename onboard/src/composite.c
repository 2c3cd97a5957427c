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
#define DROPPED 65535u                      /* number of frames that have a spot that is not kept */

/* Limits of the distances of the spots of a composite and a frame. */
typedef struct {
  real spot_square; /* of the places of a spot, if the turn is known */
  real move_square; /* of the places of a spot before and after the turn */
  real least_trace; /* of the matrix of the turn: 1 + 2 cos(angle) */
  real side;        /* difference of the distances of two spots */
  uint32_t n_old, n_new; /* spots from which turns are found */
} spot_limits;

/* Turn the first centroids to the camera frame of the composite, in `seen_icrs`. */
static void turn_centroids(const starcat_call *call, uint32_t count, const real m[9]) {
  for (uint32_t i = 0; i < count; i++) {
    starcat_turn(m, call->work->body[i], call->work->seen_icrs[i]);
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

/* Find the centroid of each spot, the nearest one; its weight is 0 without one. Returns whether they
 * are enough, and steps are left. */
static int match_spots(const starcat_call *call, const starcat_composite *c,
                       const spot_limits *most, const real m[9]) {
  starcat_workspace *w = call->work;
  const uint32_t count = call->own->count;
  uint32_t shared = 0;
  turn_centroids(call, count, m);
  for (uint32_t k = 0; k < c->n_spots; k++) {
    real nearest = most->spot_square;
    w->seen[k] = 0;
    w->weight[k] = R(0.0);
    for (uint32_t i = 0; i < count; i++) {
      const real apart = starcat_chord_square(w->seen_icrs[i], c->body[k]);
      if (apart < nearest) {
        nearest = apart;
        w->seen[k] = (uint16_t)i;
        w->weight[k] = R(1.0);
      }
    }
    shared += w->weight[k] > R(0.0) ? 1u : 0u;
  }
  return starcat_spend_steps(call, count * c->n_spots) && (shared >= LEAST_SHARED);
}

/* Move the spots to the camera frame of the new frame, at their mean places, and drop those that
 * were seen once, before the last frame, or are out of the field. Then add the other centroids. */
static void merge_spots(const starcat_call *call, starcat_composite *c, const real m[9]) {
  starcat_workspace *w = call->work;
  uint32_t kept = 0;
  for (uint32_t i = 0; i < call->own->count; i++) {
    w->before[i] = 0;
  }
  for (uint32_t k = 0; k < c->n_spots; k++) {
    const uint32_t i = starcat_limit_place(w->seen[k], STARCAT_MAX_CENTROIDS);
    uint32_t seen = c->seen[k];
    real mean[3] = {c->body[k][0], c->body[k][1], c->body[k][2]};
    c->magnitude[kept] = c->magnitude[k];
    if (w->weight[k] > R(0.0)) {
      seen += seen > 0u ? 1u : 2u;
      for (uint32_t n = 0; n < 3u; n++) {
        mean[n] += (w->seen_icrs[i][n] - mean[n]) / (real)seen;
      }
      c->magnitude[kept] = w->magnitude[i];
      w->before[i] = 1;
    } else if (seen < 2u) {
      seen = seen > 0u ? 0u : DROPPED;
    } else {
      /* seen by several frames */
    }
    const real scale = R(1.0) / STARCAT_SQRT(starcat_dot(mean, mean));
    for (uint32_t n = 0; n < 3u; n++) {
      c->body[kept][n] = scale * (m[n] * mean[0] + m[3u + n] * mean[1] + m[6u + n] * mean[2]);
    }
    c->seen[kept] = (uint16_t)seen;
    kept += (seen != DROPPED) && (c->body[kept][2] >= call->camera.cos_radius) ? 1u : 0u;
  }
  for (uint32_t i = 0; i < call->own->count; i++) {
    if ((w->before[i] == 0) && (kept < STARCAT_MAX_CENTROIDS)) {
      for (uint32_t n = 0; n < 3u; n++) {
        c->body[kept][n] = w->body[i][n];
      }
      c->magnitude[kept] = w->magnitude[i];
      c->seen[kept] = 1;
      kept++;
    }
  }
  c->n_spots = kept;
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
