/* Pyramids (Mortari et al. 2004): pairs of stars as far apart as one side of an observed triangle,
 * each completed by stars at the predicted place of the third centroid. The verification tests the
 * fourth star.
 *
 * SPDX-License-Identifier: MIT
 */
#include "internal.h"

#define MOST_THIRD 8u
#define STEPS_OF_THIRD 16u /* steps of predicting a third star */
#define WORTH_MARKING 16u  /* pairs of the other sides per pair of the first; with more, no marks */
#define MARGIN R(1.001)    /* factor on an error, so that rounding does not make it too small */

/* An observed triangle; the side between its first two corners has the fewest pairs of stars. The
 * third corner is a linear combination of the first two and their cross product. */
typedef struct {
  uint32_t corner[3];
  uint32_t start, stop;
  int is_marked; /* whether possible stars of the first two corners are marked */
  real sum[3];
  real low[3], high[3]; /* squares of chords: first to second, first and second to third */
  real cos_reach, sin_reach;
} base;

/* Choose the side with the fewest pairs. Returns 0 if a side is longer than any pair. */
static int choose_side(const starcat_call *call, const uint32_t triple[3], const real sides[3],
                       real error, base *o) {
  const starcat_image *image = call->image;
  o->start = 0;
  o->stop = UINT32_MAX;
  for (uint32_t n = 0; n < 3u; n++) {
    o->corner[n] = triple[n];
  }
  for (uint32_t n = 0; n < 3u; n++) {
    uint32_t start, stop;
    if (sides[n] - error > image->longest_rad) {
      continue;
    }
    starcat_find_rows(image, sides[n] - error, sides[n] + error, &start, &stop);
    if (start > stop) {
      stop = start;
    }
    if (stop - start < o->stop - o->start) {
      o->start = start;
      o->stop = stop;
      o->corner[0] = triple[(n + 1u) % 3u];
      o->corner[1] = triple[(n + 2u) % 3u];
      o->corner[2] = triple[n];
    }
  }
  return o->stop != UINT32_MAX;
}

static void describe_base(const starcat_call *call, const real side[3], real error, base *o) {
  const starcat_workspace *w = call->work;
  real normal[3];
  const real *a = w->body[o->corner[0]], *b = w->body[o->corner[1]], *c = w->body[o->corner[2]];
  for (uint32_t n = 0; n < 3u; n++) {
    const real low = starcat_chord_of_angle(side[n] - error),
               high = starcat_chord_of_angle(side[n] + error);
    o->low[n] = low * low;
    o->high[n] = high * high;
  }
  starcat_cross(a, b, normal);
  const real square = starcat_dot(normal, normal), ab = starcat_dot(a, b);
  const real ac = starcat_dot(a, c), bc = starcat_dot(b, c);
  o->sum[0] = (ac - ab * bc) / square;
  o->sum[1] = (bc - ab * ac) / square;
  o->sum[2] = starcat_dot(normal, c) / square;
  /* An error of the first side rotates and shifts the third corner by a few times its own size, and
   * more if the other sides are longer. */
  const real longest = side[1] > side[2] ? side[1] : side[2];
  const real reach = error * (R(1.5) + R(1.5) * longest / side[0]);
  o->sin_reach = STARCAT_SIN(reach < R(0.5) ? reach : R(0.5));
  o->cos_reach = STARCAT_SQRT(R(1.0) - o->sin_reach * o->sin_reach);
}

static uint32_t has_mark(const uint32_t *marks, uint32_t row) {
  return marks[row / 32u % STARCAT_MARKS] >> (row % 32u) & 1u;
}

/* Mark every star that forms a pair with a marked star. The loop has no branch: a processor could
 * not predict it. */
static void mark_partners(const starcat_image *image, const uint32_t range[2],
                          const uint32_t *marks, uint32_t *partners) {
  uint32_t rows[3];
  for (uint32_t n = 0; n < STARCAT_MARKS; n++) {
    partners[n] = 0;
  }
  for (uint32_t pair = range[0]; pair < range[1]; pair++) {
    starcat_read_rows(image, pair, 2, rows);
    partners[rows[0] / 32u % STARCAT_MARKS] |= has_mark(marks, rows[1]) << (rows[0] % 32u);
    partners[rows[1] / 32u % STARCAT_MARKS] |= has_mark(marks, rows[0]) << (rows[1] % 32u);
  }
}

/* Mark the possible stars of the first two corners: stars in pairs that are as far apart as the two
 * corners are. Possible third stars are in pairs of the other sides with such stars; the first two
 * must be in pairs with such a third star. A side longer than all pairs excludes nothing. Stars
 * whose rows differ by a multiple of the marks share a mark. Returns 0 if the steps are used up. */
static int mark_corners(const starcat_call *call, base *o, const real side[3], real error) {
  const starcat_image *image = call->image;
  starcat_workspace *w = call->work;
  uint32_t range[3][2] = {{o->start, o->stop}, {0, 0}, {0, 0}}, count = 0;
  for (uint32_t n = 1; n < 3u; n++) {
    const real low = side[n] - MARGIN * error, high = side[n] + MARGIN * error;
    if (high <= image->longest_rad) {
      starcat_find_rows(image, low, high, range[n], range[n] + 1);
      count += range[n][1] > range[n][0] ? range[n][1] - range[n][0] : 0u;
    }
  }
  o->is_marked = (range[1][1] + range[2][1] != 0u) && (count / WORTH_MARKING <= o->stop - o->start);
  if (o->is_marked == 0) {
    return 1;
  }
  if (!starcat_spend_steps(call, 2u * count + o->stop - o->start + 4u * STARCAT_MARKS)) {
    return 0; /* before the work: all pairs of the image can be in range */
  }
  for (uint32_t n = 0; n < STARCAT_MARKS; n++) {
    w->corner[0][n] = UINT32_MAX;
    w->corner[1][n] = UINT32_MAX;
    w->third[n] = UINT32_MAX;
  }
  mark_partners(image, range[0], w->third, w->either);
  for (uint32_t n = 0; n < 4u; n++) {
    const uint32_t own = n % 2u;
    if (range[own + 1u][1] != 0u) {
      mark_partners(image, range[own + 1u], n < 2u ? w->either : w->third, w->corner[own]);
    }
    for (uint32_t k = 0; (n < 2u) && (k < STARCAT_MARKS); k++) {
      w->third[k] &= w->corner[own][k];
    }
  }
  return 1;
}

/* Complete a pair with a third star. Returns 1 if the search can end. */
static int complete_pyramid(starcat_call *call, const base *o, const real first[3],
                            const real second[3]) {
  const starcat_workspace *w = call->work;
  uint32_t rows[MOST_THIRD];
  real normal[3], third[3], found[MOST_THIRD][3], body[3][3], m[9];
  if (!starcat_spend_steps(call, STEPS_OF_THIRD)) {
    return 1;
  }
  starcat_cross(first, second, normal);
  for (uint32_t k = 0; k < 3u; k++) {
    third[k] = o->sum[0] * first[k] + o->sum[1] * second[k] + o->sum[2] * normal[k];
    for (uint32_t n = 0; n < 3u; n++) {
      body[n][k] = w->body[o->corner[n]][k];
    }
  }
  const real scale = R(1.0) / STARCAT_SQRT(starcat_larger(starcat_dot(third, third), R(1e-6)));
  for (uint32_t k = 0; k < 3u; k++) {
    third[k] *= scale;
  }
  uint32_t count =
      starcat_gather_stars(call, third, o->cos_reach, o->sin_reach, MOST_THIRD, rows, found);
  if (call->own->steps_left == 0u) {
    return 1;
  }
  if (count > MOST_THIRD) {
    count = MOST_THIRD;
  }
  for (uint32_t n = 0; n < count; n++) {
    const real icrs[3][3] = {{first[0], first[1], first[2]},
                             {second[0], second[1], second[2]},
                             {found[n][0], found[n][1], found[n][2]}};
    if (starcat_is_between(starcat_chord_square(first, found[n]), o->low[1], o->high[1]) &&
        starcat_is_between(starcat_chord_square(second, found[n]), o->low[2], o->high[2]) &&
        starcat_fit_triad(body[0], body[1], icrs[0], icrs[1], m)) {
      starcat_refine_attitude(m, &body[0][0], &icrs[0][0], NULL, NULL, 3, 2);
      if (!starcat_spend_effort(call, 0, call->own->count) ||
          (starcat_try_attitude(call, m, R(1.0)) != 0)) {
        return 1;
      }
    }
  }
  return 0;
}

/* Complete a pair with a third star in both possible orders of its stars. Returns 1 if the search
 * can end. */
static int try_stars(starcat_call *call, const base *o, const uint32_t rows[2]) {
  const starcat_workspace *w = call->work;
  uint32_t may[2] = {1, 1};
  real star[2][3];
  for (uint32_t n = 0; (o->is_marked != 0) && (n < 2u); n++) {
    may[n] = has_mark(w->corner[0], rows[n]) & has_mark(w->corner[1], rows[1u - n]);
  }
  if ((may[0] | may[1]) == 0u) {
    return 0;
  }
  starcat_read_star(call->image, rows[0], star[0]);
  starcat_read_star(call->image, rows[1], star[1]);
  if (!starcat_is_between(starcat_chord_square(star[0], star[1]), o->low[0], o->high[0])) {
    return 0;
  }
  for (uint32_t n = 0; n < 2u; n++) {
    if ((may[n] != 0u) && complete_pyramid(call, o, star[n], star[1u - n])) {
      return 1;
    }
  }
  return 0;
}

int starcat_look_up_pyramid(starcat_call *call, const uint32_t triple[3], const real sides[3]) {
  const starcat_image *image = call->image;
  const real error = STARCAT_SIDE_TOLERANCE * call->tolerance_rad;
  base o;
  if (!choose_side(call, triple, sides, error, &o)) {
    return 0;
  }
  const real side[3] = {starcat_measure_side(call, o.corner[0], o.corner[1]),
                        starcat_measure_side(call, o.corner[0], o.corner[2]),
                        starcat_measure_side(call, o.corner[1], o.corner[2])};
  describe_base(call, side, error, &o);
  if (!mark_corners(call, &o, side, error)) {
    return 1;
  }
  for (uint32_t pair = o.start; pair < o.stop; pair++) {
    uint32_t rows[3];
    if (!starcat_spend_steps(call, 1)) {
      return 1;
    }
    starcat_read_rows(image, pair, 2, rows);
    if ((rows[0] < image->n_stars) && (rows[1] < image->n_stars) && /* else the image is damaged */
        try_stars(call, &o, rows)) {
      return 1;
    }
  }
  return 0;
}
