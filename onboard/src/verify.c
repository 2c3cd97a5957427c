/* Verification: whether an attitude explains a frame. Every proposal of every method comes here.
 * The same rules as the ground's starcat/matcher/verification.py.
 *
 *     try_attitude:
 *         fit: gather the stars of the field; up to four times, until the matches stay the same:
 *             project the stars on the detector
 *             match centroids and stars that are nearest to each other
 *             refine the attitude on them
 *         judge: bound the probability that chance matches as many as well  [chance.c];
 *             until it is certain, leave out the farthest star while that lowers it
 *         if its residuals are not those of noise, or much of the frame is
 *         unexplained: fit again with a shape of the frame  [shape.c]
 *             withhold it if its stars do not determine the boresight whatever the shape is
 *         keep it if it is better than the best one so far
 *         return whether the best one is certain, or the steps are used up
 *
 * SPDX-License-Identifier: MIT
 */
#include "internal.h"

#define STEPS_OF_TRY 32u   /* steps per attitude, besides its stars and centroids */
#define STEPS_OF_MATCH 16u /* steps per matched centroid for the fit and the bound */
#define STEPS_OF_SHAPE 64u /* to begin a fit with a shape, or a step of it, besides its centroids */
#define STEPS_OF_FACE 48u  /* of a face of the box of ranges in its bound */
#define STEPS_OF_CHECK 512u /* to check what the stars determine, besides its centroids */
#define PLAIN_SHARE (R(2.0) / R(3.0))
#define SHAPE_CHANCE R(1e-4)
#define SHAPE_STEPS 2u
#define LEAST_NOISE_PX R(1e-3) /* noise below which residuals show no shape */
#define DOUBLED_FOR_SCALE 1u   /* how often the first reach is doubled to fit a focal length */
#define DOUBLED_FOR_SHAPE 2u   /* the same to fit a shape */
#define FREE_TERMS 4u          /* with which the stars of an answer must determine the boresight */

/* Project the stars around the field on the detector; keep stars within a margin of it. */
void starcat_project_stars(const starcat_call *call, const real m[9], real margin_px) {
  starcat_workspace *w = call->work;
  const real x0 = call->camera.half_width, y0 = call->camera.half_height;
  const real most_x = x0 + margin_px, most_y = y0 + margin_px;
  uint32_t count = 0;
  for (uint32_t j = 0; j < call->own->n_near; j++) {
    real body[3], x, y;
    starcat_turn(m, w->near_icrs[j], body);
    if (starcat_find_pixel(&call->camera, body, &x, &y) != 0) {
      const real dx = x - x0, dy = y - y0;
      w->x_of[count] = x;
      w->y_of[count] = y;
      w->within[count] = (uint16_t)j;
      count += (uint32_t)((starcat_absolute(dx) <= most_x) && (starcat_absolute(dy) <= most_y));
    }
  }
  call->own->n_within = count;
}

/* Compare a star with the centroids within reach, whose squared reach is given too: find the
 * centroid nearest to it, and the centroids to which it is the nearest star so far. */
static void match_star(const starcat_call *call, uint32_t k, real reach_px, real reach) {
  starcat_workspace *w = call->work;
  const real x = w->x_of[k], y = w->y_of[k];
  const uint32_t stop = w->column[starcat_find_column(call, x + reach_px) + 1u];
  w->nearest[k] = UINT16_MAX;
  for (uint32_t n = w->column[starcat_find_column(call, x - reach_px)];
       (n < stop) && (n < STARCAT_MAX_CENTROIDS); n++) {
    const uint32_t i = starcat_limit_place(w->in_column[n], STARCAT_MAX_CENTROIDS);
    const real dx = call->x[i] - x, dy = call->y[i] - y;
    real square = dx * dx + dy * dy;
    const uint32_t deviation =
        square <= reach ? starcat_find_deviation(call, i, w->near_row[starcat_find_near(w, k)])
                        : STARCAT_INCOMPATIBLE;
    if (deviation < STARCAT_INCOMPATIBLE) {
      const real apart = call->noise_px * (real)deviation;
      square += apart * apart;
      if ((w->match[i] < 0) || (square < w->match_square[i])) {
        w->match_square[i] = square;
        w->match[i] = (int16_t)k;
      }
      if ((w->nearest[k] == UINT16_MAX) || (square < w->nearest_square[k]) ||
          ((square == w->nearest_square[k]) && (i < w->nearest[k]))) {
        w->nearest_square[k] = square;
        w->nearest[k] = (uint16_t)i;
      }
    }
  }
}

/* Match each centroid with a star if they are mutually nearest and within reach. Returns the number
 * of matches. */
static uint32_t match_stars(const starcat_call *call, real reach_px) {
  starcat_workspace *w = call->work;
  uint32_t matched = 0;
  for (uint32_t i = 0; i < call->own->count; i++) {
    w->match[i] = -1;
  }
  for (uint32_t k = 0; k < call->own->n_within; k++) {
    match_star(call, k, reach_px, reach_px * reach_px);
  }
  for (uint32_t i = 0; i < call->own->count; i++) {
    if ((w->match[i] >= 0) && (w->nearest[starcat_find_match(w, i)] != i)) {
      w->match[i] = -1;
    }
    matched += (uint32_t)(w->match[i] >= 0);
  }
  return matched;
}

/* Store the matches; returns whether they equal the matches stored before. */
static int is_as_before(const starcat_call *call) {
  starcat_workspace *w = call->work;
  int same = 1;
  for (uint32_t i = 0; i < call->own->count; i++) {
    const int16_t star = (int16_t)(w->match[i] >= 0 ? w->within[starcat_find_match(w, i)] : -1);
    same &= w->before[i] == star;
    w->before[i] = star;
  }
  return same;
}

/* A symmetric matrix of four: xx, xy, xz, yy, yz, zz of the three angles; the terms of each angle
 * with the logarithm of the focal length; and the term of that logarithm. */
typedef struct {
  real angles[6];
  real with_scale[3];
  real scale;
} information;

/* Add the information that a direction gives about an attitude (Shuster and Oh 1981) and about the
 * focal length. */
static void add_information(information *h, const real b[3]) {
  const real square = b[2] * b[2];
  h->angles[0] += R(1.0) - b[0] * b[0];
  h->angles[1] -= b[0] * b[1];
  h->angles[2] -= b[0] * b[2];
  h->angles[3] += R(1.0) - b[1] * b[1];
  h->angles[4] -= b[1] * b[2];
  h->angles[5] += R(1.0) - square;
  h->with_scale[0] -= b[1] * b[2];
  h->with_scale[1] += b[0] * b[2];
  h->scale += square * (R(1.0) - square);
}

/* Refine the attitude on all matches, and also the focal length if its error can be above 0. This is
 * one step of Newton's method. */
static void refine_matched(starcat_call *call, real m[9]) {
  const starcat_workspace *w = call->work;
  uint16_t which[STARCAT_MAX_CENTROIDS], of[STARCAT_MAX_CENTROIDS];
  real body[STARCAT_MAX_CENTROIDS][3];
  uint32_t n = 0;
  for (uint32_t i = 0; i < call->own->count; i++) {
    if (w->match[i] >= 0) {
      which[n] = (uint16_t)starcat_find_near(w, starcat_find_match(w, i));
      of[n] = (uint16_t)i;
      n++;
    }
  }
  if (call->fov_error > R(0.0)) {
    information h = {{0}, {0}, R(0.0)};
    real turn[3] = {0}, shrink = R(0.0), along[3], unused[6], step = R(0.0);
    for (uint32_t i = 0; i < n; i++) {
      const real *b = call->body[of[i]];
      real a[3], left[3], moved[3];
      starcat_turn(m, w->near_icrs[which[i]], a);
      for (uint32_t k = 0; k < 3u; k++) {
        left[k] = b[k] - a[k];
      }
      starcat_cross(a, left, moved);
      for (uint32_t k = 0; k < 3u; k++) {
        turn[k] += moved[k];
      }
      shrink += b[2] * b[2] * starcat_dot(b, left) - b[2] * left[2];
      add_information(&h, b);
    }
    if (starcat_solve_symmetric(h.angles, h.with_scale, along, unused) != 0) {
      const real of_scale = h.scale - starcat_dot(h.with_scale, along);
      const real excess = shrink - starcat_dot(along, turn);
      if (starcat_absolute(excess) < of_scale) {
        step = excess / of_scale;
      } else if (of_scale > R(0.0)) { /* farther than a step is allowed */
        step = excess > R(0.0) ? R(1.0) : R(-1.0);
      } else {
        /* the centroids do not determine it */
      }
    }
    real focal = call->focal * starcat_exponential(step);
    const real shortest = R(1.0) - call->fov_error;
    focal = focal < shortest ? shortest : focal;
    (void)starcat_set_focal(call, focal * shortest > R(1.0) ? R(1.0) / shortest : focal);
  }
  for (uint32_t i = 0; i < n; i++) {
    body[i][0] = call->body[of[i]][0];
    body[i][1] = call->body[of[i]][1];
    body[i][2] = call->body[of[i]][2];
  }
  starcat_refine_attitude(m, &body[0][0], &w->near_icrs[0][0], which, NULL, n, 4);
}

/* Gather the stars around the field of an attitude. Returns 0 if there are too many, or if the
 * budget is used up. */
static int gather_field(const starcat_call *call, const real m[9], uint32_t free) {
  starcat_workspace *w = call->work;
  real c = call->camera.cos_radius, s = call->camera.sin_radius;
  if ((call->fov_error > R(0.0)) || (free > 0u)) {
    /* A corner is farther out than the margin on both axes: at most by the root of two. */
    const real radius_rad =
        (R(1.0) + STARCAT_FOCAL_MARGIN) *
        (STARCAT_ATAN2(s, c) + R(1.5) * call->margin_px / call->camera.given.focal_length_px);
    c = STARCAT_COS(radius_rad);
    s = STARCAT_SIN(radius_rad);
  }
  call->own->n_near =
      starcat_gather_stars(call, m + 6, c, s, STARCAT_MAX_STARS, w->near_row, w->near_icrs);
  return call->own->n_near <= STARCAT_MAX_STARS;
}

/* Refine an attitude, and the first `free` terms of a shape, on all matches. Returns 0 if the fit of
 * the shape runs away. */
static int refine_shape(starcat_call *call, real m[9], uint32_t free, real *terms) {
  starcat_normal n;
  starcat_step step;
  if (free == 0u) {
    refine_matched(call, m);
    return 1;
  }
  if (!starcat_spend_steps(call, STEPS_OF_SHAPE + STEPS_OF_MATCH * call->own->count)) {
    return 0;
  }
  starcat_sum_normal(call, free, &n);
  return (starcat_solve_normal(call, &n, terms, free, starcat_assume_noise(call), &step) != 0) &&
         (starcat_take_step(call, &step, free, m, terms) != 0);
}

/* Refine an attitude, and the first `free` terms of a shape, on all stars that match. The first reach
 * is doubled `doubled` times, and halved with each refinement. Returns the number of matches; 0 if
 * there are too many stars around the field, if the budget is used up, or if the fit of the shape
 * runs away. */
static uint32_t fit_matches(starcat_call *call, real m[9], uint32_t doubled, uint32_t free,
                            real *terms) {
  starcat_workspace *w = call->work;
  uint32_t matched = 0;
  if (!gather_field(call, m, free)) {
    return 0;
  }
  for (uint32_t i = 0; i < call->own->count; i++) {
    w->before[i] = -2;
  }
  for (uint32_t n = 0; n < doubled + STARCAT_REFINEMENTS; n++) {
    const int is_final = n >= doubled;
    const uint32_t factor = is_final ? 1u : 1u << (doubled - n);
    const real reach_px = (real)factor * call->reach_px;
    starcat_project_stars(call, m, reach_px + call->margin_px);
    if (!starcat_spend_steps(call,
                             call->own->n_near + call->own->count * (call->own->n_within + 1u))) {
      return 0;
    }
    matched = match_stars(call, reach_px);
    if (!starcat_spend_steps(call, STEPS_OF_MATCH * matched)) {
      return 0;
    }
    if ((matched < STARCAT_MIN_STARS) || (is_as_before(call) && is_final)) {
      break;
    }
    if (!refine_shape(call, m, free, terms)) {
      return 0;
    }
  }
  return matched;
}

/* The number of centroids, or of stars of the field if they are fewer. */
uint32_t starcat_count_fewer(const starcat_call *call) {
  return call->own->count < call->own->n_within ? call->own->count : call->own->n_within;
}

/* Take the steps of the bound of an agreement. Magnitudes cost most: every centroid is compared
 * with every star, and a polynomial is summed. Returns 0 if the budget is used up. */
static int spend_on_bound(const starcat_call *call) {
  const uint32_t most = starcat_count_fewer(call);
  uint32_t steps = STEPS_OF_MATCH * (call->own->count + call->own->n_within);
  if (call->noise_mag > R(0.0)) {
    steps += call->own->count * call->own->n_within + most * most;
  }
  return starcat_spend_steps(call, steps);
}

/* Take the steps of the same bound again, with the first `free` terms of a shape. */
static int spend_on_less(const starcat_call *call, uint32_t free) {
  return starcat_spend_steps(call, STEPS_OF_MATCH * (call->own->count + call->own->n_within) +
                                       (free > 0u ? STEPS_OF_FACE << free : 0u));
}

static void withhold_agreement(starcat_agreement *found, uint32_t reason) {
  found->withheld = reason;
  found->log_chance = R(0.0);
}

/* The match with the largest residual. */
static uint32_t find_farthest_match(const starcat_call *call) {
  const starcat_workspace *w = call->work;
  real most = R(-1.0);
  uint32_t farthest = 0;
  for (uint32_t i = 0; i < call->own->count; i++) {
    if ((w->match[i] >= 0) && (w->match_square[i] > most)) {
      most = w->match_square[i];
      farthest = i;
    }
  }
  return farthest;
}

/* Bound the probability that chance matches as well as the matches in the workspace. The bound counts
 * every choice of stars: until it is certain, the farthest match is left out while that lowers it. */
static void bound_matches(const starcat_call *call, uint32_t free,
                          const real terms[STARCAT_SHAPE_TERMS], starcat_agreement *found) {
  starcat_workspace *w = call->work;
  uint32_t n = found->n_matched, last = 0;
  int16_t star = w->match[last];
  int goes_on = 1;
  real square_px = R(0.0);
  if (call->noise_px > R(0.0)) {
    starcat_count_ways(call, starcat_count_fewer(call));
    starcat_share_ways(call, starcat_count_fewer(call));
  } else {
    starcat_count_ways(call, n);
  }
  for (uint32_t i = 0; i < call->own->count; i++) {
    square_px += w->match[i] >= 0 ? w->match_square[i] : R(0.0);
  }
  while (goes_on != 0) {
    const real log_bound = starcat_log_chance(call, square_px, n, free, terms);
    goes_on = 0;
    if (log_bound < found->log_bound) {
      found->n_matched = n;
      found->log_bound = log_bound;
      if ((log_bound > call->log_certain) && spend_on_less(call, free)) {
        last = find_farthest_match(call);
        star = w->match[last];
        w->match[last] = -1;
        square_px -= w->match_square[last];
        n--;
        goes_on = 1;
      }
    } else {
      w->match[last] = star;
    }
  }
}

/* Judge the fit in the workspace, with the first `free` terms of a shape. */
static void judge_fit(const starcat_call *call, const real m[9], uint32_t matched, uint32_t free,
                      const real terms[STARCAT_SHAPE_TERMS], starcat_agreement *found) {
  const starcat_workspace *w = call->work;
  real square_rad = R(0.0);
  for (uint32_t k = 0; k < 9u; k++) {
    found->matrix[k] = m[k];
  }
  for (uint32_t k = 0; k < STARCAT_SHAPE_TERMS; k++) {
    found->terms[k] = free > 0u ? terms[k] : R(0.0);
  }
  found->focal = free > 0u ? R(1.0) : call->focal;
  found->free = free;
  found->n_matched = matched;
  found->log_chance = R(0.0);
  found->log_bound = R(0.0);
  found->residual_rad = R(0.0);
  found->square_px = R(0.0);
  found->share = R(0.0);
  found->withheld = 0;
  if (matched < STARCAT_MIN_STARS) {
    return;
  }
  if (!spend_on_bound(call) ||
      ((free > 0u) && !starcat_spend_steps(call, STEPS_OF_FACE << free))) {
    found->n_matched = 0; /* as if nothing had matched */
    return;
  }
  bound_matches(call, free, terms, found);
  for (uint32_t i = 0; i < call->own->count; i++) {
    found->star[i] = STARCAT_NO_STAR;
    if (w->match[i] >= 0) {
      const uint32_t j = starcat_find_near(w, starcat_find_match(w, i));
      const real dx = call->x[i] - w->x_of[starcat_find_match(w, i)];
      const real dy = call->y[i] - w->y_of[starcat_find_match(w, i)];
      real body[3];
      starcat_turn(m, w->near_icrs[j], body);
      found->square_px += dx * dx + dy * dy;
      square_rad += starcat_chord_square(call->body[i], body);
      found->star[i] = (int32_t)w->near_row[j];
    }
  }
  found->residual_rad = STARCAT_SQRT(square_rad / (real)found->n_matched);
  found->share = starcat_smaller((real)found->n_matched / (real)starcat_count_fewer(call), R(1.0));
  found->log_chance = found->log_bound;
}

/* Whether agreement a is better than b; withheld agreements are compared by their bounds. */
static int is_better(const starcat_agreement *a, const starcat_agreement *b) {
  return (a->log_chance < b->log_chance) ||
         (!(b->log_chance < a->log_chance) && (a->log_bound < b->log_bound));
}

/* Whether an agreement is certain, with residuals of noise and most of the frame: then no shape is
 * tried. */
static int is_plain(const starcat_call *call, const starcat_agreement *found) {
  const real left = (real)(2u * found->n_matched - 3u - found->free),
             sigma = starcat_assume_noise(call);
  const real spread =
      call->noise_px > R(0.0) ? STARCAT_NOTABLE_DEVIATIONS * STARCAT_SQRT(R(2.0) * left) : R(0.0);
  return (found->log_bound <= call->log_certain) && (found->share >= PLAIN_SHARE) &&
         (found->square_px <= sigma * sigma * (left + spread));
}

/* Use the places of an agreement: a fitted focal length becomes the scale of its shape. */
static int use_agreement(starcat_call *call, const starcat_agreement *from,
                         real terms[STARCAT_SHAPE_TERMS]) {
  for (uint32_t k = 0; k < STARCAT_SHAPE_TERMS; k++) {
    terms[k] = from->terms[k];
  }
  if (from->free == 0u) {
    terms[0] = R(1.0) - R(1.0) / from->focal;
  }
  return starcat_use_shape(call, terms);
}

/* Fit nested models of the frame, each from where the previous one ended; keep the best one. */
static void try_shapes(starcat_call *call) {
  static const uint32_t MODELS[5] = {0, 1, 2, 4, 6};
  starcat_workspace *w = call->work;
  starcat_agreement *found = &w->found;
  const int is_scaled = call->fov_error > R(0.0);
  real m[9], terms[STARCAT_SHAPE_TERMS];
  w->start = *found;
  for (uint32_t k = 0; k < 5u; k++) {
    const uint32_t free = MODELS[k];
    if ((free < w->found.free) || (is_scaled && (free == 1u))) {
      continue; /* the search had more terms; or it is the first model */
    }
    int good = 1;
    if (!starcat_spend_steps(call, STEPS_OF_SHAPE + STEPS_OF_MATCH * call->own->count)) {
      return;
    }
    for (uint32_t i = 0; i < 9u; i++) {
      m[i] = w->start.matrix[i];
    }
    if (free == 0u) {
      (void)starcat_set_focal(call, w->start.focal);
    } else {
      good = use_agreement(call, &w->start, terms);
    }
    const uint32_t matched = good != 0 ? fit_matches(call, m, DOUBLED_FOR_SHAPE, free, terms) : 0u;
    if ((matched > 0u) || (free == 0u)) {
      judge_fit(call, m, matched, free, terms, &w->wider);
      if (w->wider.log_bound < R(0.0)) {
        w->start = w->wider;
      }
      if (is_better(&w->wider, found) != 0) {
        *found = w->wider;
      }
    }
  }
}

/* Offset of a centroid from its star in an agreement, with the places that are in use. Returns the
 * squared chord between both directions. */
static real find_offset(const starcat_call *call, const starcat_agreement *found, const real m[9],
                         uint32_t centroid, real offset[2]) {
  real icrs[3], body[3], x = STARCAT_LARGEST_PX, y = STARCAT_LARGEST_PX;
  starcat_read_star(call->image,
                    starcat_limit_place((uint32_t)found->star[centroid], call->image->n_stars),
                    icrs);
  starcat_turn(m, icrs, body);
  (void)starcat_find_pixel(&call->camera, body, &x, &y);
  offset[0] = call->x[centroid] - x;
  offset[1] = call->y[centroid] - y;
  return starcat_chord_square(call->body[centroid], body);
}

/* Squared residuals of the stars of an agreement, and whether the noise of each is stated. */
typedef struct {
  real px, rad;        /* square pixels, square radians */
  real chi, least_chi; /* in units of the noise; of the smallest noise of a real frame */
  int is_stated;
} squares;

/* One over the square of the noise of a centroid, stated or what the tolerance stands for. */
static real find_weight(const starcat_call *call, uint32_t centroid) {
  const real sigma = starcat_find_sigma(call, centroid);
  return R(1.0) / (sigma * sigma);
}

/* Add the stars of an agreement to normal equations, with the places that are in use and in units
 * of their noise. */
static void sum_stars(const starcat_call *call, const starcat_agreement *found, const real m[9],
                      starcat_normal *n, squares *s) {
  const starcat_normal none = {{{R(0.0)}}, {R(0.0)}};
  *n = none;
  s->px = R(0.0);
  s->rad = R(0.0);
  s->chi = R(0.0);
  s->least_chi = R(1e30);
  s->is_stated = 1;
  for (uint32_t i = 0; i < call->own->count; i++) {
    if (found->star[i] >= 0) {
      real offset[2];
      const real weight = find_weight(call, i);
      s->rad += find_offset(call, found, m, i, offset);
      const real square = offset[0] * offset[0] + offset[1] * offset[1];
      s->px += square;
      s->chi += weight * square;
      s->least_chi = starcat_smaller(s->least_chi, weight * LEAST_NOISE_PX * LEAST_NOISE_PX);
      s->is_stated = s->is_stated && (starcat_find_noise(call, i) > R(0.0));
      starcat_add_normal(call, i, offset[0], offset[1], weight, STARCAT_SHAPE_TERMS, n);
    }
  }
  s->least_chi *= (real)found->n_matched;
}

/* Whether the stars of an agreement determine the corners of the frame to one tolerance with the
 * terms of a step, and no single star does. */
static int determines_frame(const starcat_call *call, const starcat_agreement *found,
                            const squares *s, starcat_step *step) {
  const uint32_t unknowns = 3u + step->free;
  const uint32_t left = 2u * found->n_matched > unknowns ? 2u * found->n_matched - unknowns : 1u;
  const real most = STARCAT_REACH * call->tolerance_rad;
  const real factor =
      s->is_stated != 0 ? R(1.0) : starcat_larger(R(0.5), STARCAT_SQRT(s->chi / (real)left));
  real influence = R(0.0);
  for (uint32_t i = 0; i < call->own->count; i++) {
    if (found->star[i] >= 0) {
      real offset[2];
      (void)find_offset(call, found, found->matrix, i, offset);
      influence = starcat_larger(influence, starcat_find_influence(call, i, offset[0], offset[1],
                                                                   find_weight(call, i), step));
    }
  }
  return (starcat_corner_error(call, step) * factor <= most) && (influence <= most * most);
}

/* How often noise lowers the squares from a gain of `own` terms to one of `all` six, or more:
 * Fisher's F, or chi-square if the noise is stated. */
static real chance_of_shape(const starcat_agreement *found, const squares *s, real own, real all) {
  const real gain = starcat_larger(all - own, R(0.0));
  real power = R(0.5) * gain, sum = R(1.0) + power * (R(1.0) + R(0.5) * power);
  if (s->is_stated == 0) {
    if (2u * found->n_matched <= STARCAT_UNKNOWNS) {
      return R(1.0);
    }
    const real half = R(0.5) * (real)(2u * found->n_matched - STARCAT_UNKNOWNS);
    const real gone = gain / starcat_larger(s->chi - own, s->least_chi);
    if (!(gone < R(1.0))) {
      return R(0.0);
    }
    power = -half * STARCAT_LOG(R(1.0) - gone);
    sum = R(1.0) + half * gone * (R(1.0) + R(0.5) * (half + R(1.0)) * gone);
  }
  return power < R(60.0) ? sum / starcat_exponential(power) : R(0.0);
}

/* Fit the whole shape to the stars of an agreement, whose places are in use, from a first step. */
static void fit_shape_of_stars(starcat_call *call, starcat_agreement *found, starcat_step *step,
                               real terms[STARCAT_SHAPE_TERMS]) {
  starcat_normal n;
  squares s;
  real m[9];
  int good = 1;
  for (uint32_t k = 0; k < 9u; k++) {
    m[k] = found->matrix[k];
  }
  for (uint32_t k = 0; good && (k < SHAPE_STEPS); k++) {
    good = starcat_take_step(call, step, STARCAT_SHAPE_TERMS, m, terms);
    if (good != 0) {
      sum_stars(call, found, m, &n, &s);
      good = starcat_solve_normal(call, &n, terms, STARCAT_SHAPE_TERMS, R(1.0), step);
    }
  }
  if (good != 0) {
    for (uint32_t k = 0; k < 9u; k++) {
      found->matrix[k] = m[k];
    }
    for (uint32_t k = 0; k < STARCAT_SHAPE_TERMS; k++) {
      found->terms[k] = terms[k];
    }
    found->free = STARCAT_SHAPE_TERMS;
    found->focal = R(1.0);
    found->square_px = s.px;
    found->residual_rad = STARCAT_SQRT(s.rad / (real)found->n_matched);
  }
}

/* If the residuals of an agreement show a shape, fit the attitude with it. Returns 0 if it is not
 * plain, and its stars do not determine the boresight with the terms of a shape free within their
 * ranges. */
static int is_determined(starcat_call *call, starcat_agreement *found, int plain) {
  starcat_normal n;
  starcat_step step;
  squares s;
  real terms[STARCAT_SHAPE_TERMS];
  if (!starcat_spend_steps(call, STEPS_OF_CHECK + 4u * STEPS_OF_MATCH * call->own->count) ||
      !use_agreement(call, found, terms)) {
    return 0;
  }
  sum_stars(call, found, found->matrix, &n, &s);
  const uint32_t own =
      (found->free == 0u) && (call->fov_error > R(0.0)) ? 1u : starcat_count_terms(found);
  /* The attitude was fitted without the noise of each centroid, which alone lowers the squares. */
  const real gain =
      starcat_solve_normal(call, &n, terms, own, R(1.0), &step) != 0 ? step.gain : R(0.0);
  if ((found->free < STARCAT_SHAPE_TERMS) &&
      (starcat_solve_normal(call, &n, terms, STARCAT_SHAPE_TERMS, R(1.0), &step) != 0) &&
      (chance_of_shape(found, &s, gain, step.gain) < SHAPE_CHANCE)) {
    fit_shape_of_stars(call, found, &step, terms);
    (void)use_agreement(call, found, terms); /* its places were in use */
    sum_stars(call, found, found->matrix, &n, &s);
  }
  const uint32_t free =
      (plain != 0) || (found->free > FREE_TERMS) ? starcat_count_terms(found) : FREE_TERMS;
  return (starcat_solve_normal(call, &n, terms, free, R(1.0), &step) != 0) &&
         (determines_frame(call, found, &s, &step) != 0);
}

/* Withhold an agreement if its stars do not determine the boresight, or if the terms of its shape
 * are out of their ranges. */
static void check_agreement(starcat_call *call, starcat_agreement *found, int plain) {
  if (!is_determined(call, found, plain)) {
    withhold_agreement(found, STARCAT_REASON_SHARE);
  } else if (!starcat_is_within_ranges(call, found->terms)) {
    withhold_agreement(found, STARCAT_REASON_SCALE);
  } else {
    /* an answer, if chance is unlikely enough */
  }
}

/* Whether an attitude is within the error of the prior, if there is one. */
static int is_allowed(const starcat_call *call, const real m[9]) {
  real square = R(0.0);
  for (uint32_t k = 0; (k < 9u) && (call->near != NULL); k++) {
    const real apart = m[k] - call->near[k];
    square += apart * apart;
  }
  return square <= call->near_square;
}

/* Compare the agreement in the workspace with a shape unless it excludes nothing, and keep it if it is
 * better than the best one so far. Returns whether the search ends: the answer is certain, or the steps are
 * used up. */
static int settle_agreement(starcat_call *call) {
  starcat_workspace *w = call->work;
  starcat_agreement *found = &w->found;
  if (found->log_bound < R(0.0)) {
    const int plain = is_plain(call, found);
    if (plain == 0) {
      try_shapes(call);
    }
    check_agreement(call, found, plain);
  }
  if (is_allowed(call, found->matrix) &&
      ((w->best.n_matched == 0u) || is_better(found, &w->best))) {
    w->best = *found;
  }
  return (w->best.log_chance <= call->log_certain) || (call->own->steps_left == 0u);
}

/* Try three stars as the three centroids of a triangle, in a frame of a shape; refines the attitude.
 * Returns whether the search ends. */
int starcat_try_shape(starcat_call *call, real m[9], const uint32_t triple[3], const real *icrs,
                      real terms[STARCAT_SHAPE_TERMS]) {
  real body[9];
  if (!starcat_spend_steps(call,
                           STEPS_OF_TRY + STEPS_OF_SHAPE + STEPS_OF_MATCH * call->own->count)) {
    return 1;
  }
  if (!starcat_use_shape(call, terms)) {
    return 0;
  }
  for (uint32_t k = 0; k < 9u; k++) {
    body[k] = call->body[triple[k / 3u]][k % 3u];
  }
  starcat_refine_attitude(m, body, icrs, NULL, NULL, 3, 2);
  judge_fit(call, m, fit_matches(call, m, DOUBLED_FOR_SHAPE, FREE_TERMS, terms), FREE_TERMS, terms,
            &call->work->found);
  if (!(call->work->found.log_bound < R(0.0))) {
    return 0;
  }
  call->own->n_tried++;
  return settle_agreement(call);
}

/* Try an attitude with a multiple of the given focal length. Returns whether the search ends: the
 * answer is certain, or the steps are used up. */
int starcat_try_attitude(starcat_call *call, const real m[9], real focal) {
  uint32_t doubled = 0;
  real attitude[9];
  for (uint32_t k = 0; k < 9u; k++) {
    attitude[k] = m[k];
  }
  call->own->n_tried++;
  if (!starcat_spend_steps(call, STEPS_OF_TRY)) {
    return 1;
  }
  if (call->fov_error > R(0.0)) {
    doubled = DOUBLED_FOR_SCALE;
  }
  (void)starcat_set_focal(call, focal);
  judge_fit(call, attitude, fit_matches(call, attitude, doubled, 0, NULL), 0, NULL,
            &call->work->found);
  return settle_agreement(call);
}
