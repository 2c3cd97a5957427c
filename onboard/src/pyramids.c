/* Pyramids (Mortari et al. 2004): pairs of stars as far apart as one side of an observed triangle
 * are, each completed by the stars where the third centroid would be; the fourth star is the
 * verification's.
 *
 * SPDX-License-Identifier: MIT
 */
#include "internal.h"

#define MOST_THIRD 8u

/* An observed triangle, its corners put in an order such that the side between the first two has
 * the fewest pairs of stars. The third is a sum of the first two and of their cross product. */
typedef struct {
  uint32_t corner[3];
  uint32_t start, stop;
  real sum[3];
  real low[3], high[3]; /* squares of chords: first to second, first and second to third */
  real cos_reach, sin_reach;
} base;

/* Choose the side with the fewest pairs. Returns 0 if a side is longer than any pair. */
static int choose_side(const sc_call *call, const uint32_t triple[3], const real sides[3],
                       real error, base *o) {
  const starcat_image *image = call->image;
  o->start = 0;
  o->stop = UINT32_MAX;
  for (uint32_t n = 0; n < 3u; n++) {
    uint32_t start, stop;
    if (sides[n] - error > image->longest_rad) {
      continue;
    }
    sc_rows_between(image, sides[n] - error, sides[n] + error, &start, &stop);
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

static int choose_base(const sc_call *call, const uint32_t triple[3], const real sides[3],
                       base *o) {
  const starcat_workspace *w = call->work;
  const real error = SC_SIDE_TOLERANCE * call->tolerance_rad;
  real normal[3];
  if (!choose_side(call, triple, sides, error, o)) {
    return 0;
  }
  const real *a = w->body[o->corner[0]], *b = w->body[o->corner[1]], *c = w->body[o->corner[2]];
  const real side[3] = {sc_side(call, o->corner[0], o->corner[1]),
                        sc_side(call, o->corner[0], o->corner[2]),
                        sc_side(call, o->corner[1], o->corner[2])};
  for (uint32_t n = 0; n < 3u; n++) {
    const real low = sc_chord_of_angle(side[n] - error), high = sc_chord_of_angle(side[n] + error);
    o->low[n] = low * low;
    o->high[n] = high * high;
  }
  sc_cross(a, b, normal);
  const real square = sc_dot(normal, normal), ab = sc_dot(a, b);
  const real ac = sc_dot(a, c), bc = sc_dot(b, c);
  o->sum[0] = (ac - ab * bc) / square;
  o->sum[1] = (bc - ab * ac) / square;
  o->sum[2] = sc_dot(normal, c) / square;
  /* An error of the first side turns and shifts the third corner by a few of its own size, the
   * more the longer the other sides are. */
  const real longest = side[1] > side[2] ? side[1] : side[2];
  const real reach = error * (R(1.5) + R(1.5) * longest / side[0]);
  o->sin_reach = STARCAT_SIN(reach < R(0.5) ? reach : R(0.5));
  o->cos_reach = STARCAT_SQRT(R(1.0) - o->sin_reach * o->sin_reach);
  return 1;
}

/* Complete a pair by a third star. Returns 1 if the search can end. */
static int complete(sc_call *call, const base *o, const real first[3], const real second[3]) {
  const starcat_workspace *w = call->work;
  uint32_t rows[MOST_THIRD];
  real normal[3], third[3], found[MOST_THIRD][3], body[3][3], m[9];
  sc_cross(first, second, normal);
  for (uint32_t k = 0; k < 3u; k++) {
    third[k] = o->sum[0] * first[k] + o->sum[1] * second[k] + o->sum[2] * normal[k];
    for (uint32_t n = 0; n < 3u; n++) {
      body[n][k] = w->body[o->corner[n]][k];
    }
  }
  const real scale = R(1.0) / STARCAT_SQRT(sc_dot(third, third));
  for (uint32_t k = 0; k < 3u; k++) {
    third[k] *= scale;
  }
  uint32_t count = sc_gather(call, third, o->cos_reach, o->sin_reach, MOST_THIRD, rows, found);
  if (w->steps_left == 0u) {
    return 1;
  }
  if (count > MOST_THIRD) {
    count = MOST_THIRD;
  }
  for (uint32_t n = 0; n < count; n++) {
    const real icrs[3][3] = {{first[0], first[1], first[2]},
                             {second[0], second[1], second[2]},
                             {found[n][0], found[n][1], found[n][2]}};
    if (sc_is_between(sc_chord_square(first, found[n]), o->low[1], o->high[1]) &&
        sc_is_between(sc_chord_square(second, found[n]), o->low[2], o->high[2]) &&
        sc_triad(body[0], body[1], icrs[0], icrs[1], m)) {
      sc_refine(m, &body[0][0], &icrs[0][0], NULL, NULL, 3, 1);
      if (sc_try(call, m, R(1.0)) != 0) {
        return 1;
      }
    }
  }
  return 0;
}

int sc_pyramid(sc_call *call, const uint32_t triple[3], const real sides[3]) {
  const starcat_image *image = call->image;
  base o;
  if (!choose_base(call, triple, sides, &o)) {
    return 0;
  }
  for (uint32_t pair = o.start; pair < o.stop; pair++) {
    uint32_t rows[3];
    real first[3], second[3];
    if (!sc_spend(call->work, 1)) {
      return 1;
    }
    sc_rows_of(image, pair, 2, rows);
    if ((rows[0] >= image->n_stars) || (rows[1] >= image->n_stars)) { /* a damaged image */
      continue;
    }
    sc_star(image, rows[0], first);
    sc_star(image, rows[1], second);
    if (sc_is_between(sc_chord_square(first, second), o.low[0], o.high[0]) &&
        (complete(call, &o, first, second) || complete(call, &o, second, first))) {
      return 1;
    }
  }
  return 0;
}
