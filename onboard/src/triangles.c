/* Search triangles of centroids in turn, and look up the triangles of stars that they can be.
 *
 *     search_triangles:
 *         if a frame without magnitudes has more than 32 centroids:
 *             take the triangles of each centroid and its neighbours
 *         else for round in (well shaped, poorly shaped if there are 12 centroids or fewer):
 *             with magnitudes: take triangles of the brightest centroids first
 *             else: take those with the longest sides first
 *         take, if it has the shape of this round: look it up, up to 5,000 times
 *
 *     look_up_triangle:
 *         compute area and circumradius of the triangle, and their errors
 *         for each block of 32 features of the image whose area fits:
 *             for each feature of the block whose circumradius fits:
 *                 for each order of its stars that keeps the handedness:
 *                     if all sides fit: try the attitude  [verify.c]
 *
 * SPDX-License-Identifier: MIT
 */
#include "internal.h"

#define BLOCK 32u
#define PART R(1.02)        /* largest over smallest area that are looked up together */
#define LEAST_PART R(1e-3)  /* smallest area that is looked up, over the largest */
#define STEPS_OF_SIDES 6u   /* steps of comparing the sides of one triangle */
#define STEPS_OF_SHAPED 32u /* of finding the shape that one triangle of stars needs */
#define EFFORT_OF_TRIANGLE 3u
#define EFFORT_OF_PYRAMID 9u
#define EFFORT_OF_SHAPED 50u
#define SIDE_CHANGE R(0.06) /* largest relative change of a side by a shape of the frame */
#define ROOT_OF_3 R(1.7320508075688772935)
#define HALF_TURN R(3.1415926535897932385)

/* Factors that widen a bound against rounding. */
#ifdef STARCAT_SINGLE
#define LEAST_CHORD R(1e-12) /* square of the longest chord of a triangle of stars */
#define BELOW R(0.99999)
#define ABOVE R(1.00001)
#else
#define LEAST_CHORD R(1e-28)
#define BELOW R(0.999999999)
#define ABOVE R(1.000000001)
#endif

/* Settings and state of a search of the triangles of one frame. */
typedef struct {
  starcat_look_up look_up;
  uint32_t count;
  real least_side_rad, least_poor_side_rad;
  int poor;        /* second round: triangles skipped in the first round */
  uint32_t done;   /* triangles looked up by the search before this one */
  uint32_t effort; /* of looking up a triangle */
} search;

static uint32_t pair_of(uint32_t i, uint32_t j) {
  return i < j ? j * (j - 1u) / 2u + i : i * (i - 1u) / 2u + j;
}

real starcat_measure_side(const starcat_call *call, uint32_t i, uint32_t j) {
  const starcat_workspace *w = call->work;
  return call->own->is_crowded != 0u
             ? starcat_angle_of_chord(starcat_chord_square(w->body[i], w->body[j]))
             : w->separation_rad[pair_of(i, j)];
}

/* Whether a triangle has no side shorter than `least` and no angle narrower than the angle with
 * this cosine (the thresholds of Li et al. 2015). */
static int is_well_shaped(const real sides[3], real least, real cosine) {
  real a = sides[0], b = sides[1], c = sides[2], swap;
  if (a > b) {
    swap = a;
    a = b;
    b = swap;
  }
  if (a > c) {
    swap = a;
    a = c;
    c = swap;
  }
  /* The law of cosines for the angle opposite the shortest side. */
  return (a > least) && (b * b + c * c - a * a < R(2.0) * cosine * b * c);
}

/* Look up a triangle if it belongs to this round. Returns 1 if the search can end. */
static int take_triangle(starcat_call *call, search *s, uint32_t i, uint32_t j, uint32_t k) {
  const uint32_t triple[3] = {i, j, k};
  const real sides[3] = {starcat_measure_side(call, j, k), starcat_measure_side(call, i, k),
                         starcat_measure_side(call, i, j)};
  const int good = is_well_shaped(sides, s->least_side_rad, STARCAT_COS_MIN_ANGLE);
  if (!starcat_spend_steps(call, 1)) {
    return 1;
  }
  if ((s->poor != 0) == (good != 0)) {
    return 0;
  }
  if ((s->poor != 0) && !is_well_shaped(sides, s->least_poor_side_rad, STARCAT_COS_LEAST_ANGLE)) {
    return 0;
  }
  if (s->done > 0u) {
    s->done--;
    return 0;
  }
  if ((call->own->n_looked_up >= STARCAT_MOST_TRIANGLES) ||
      !starcat_spend_effort(call, s->effort, 0)) {
    return 1;
  }
  call->own->n_looked_up++;
  return s->look_up(call, triple, sides);
}

/* Compute the separations of a centroid from all earlier ones. */
static void separate_centroid(starcat_call *call, uint32_t k) {
  starcat_workspace *w = call->work;
  for (uint32_t i = 0; i < k; i++) {
    w->separation_rad[pair_of(i, k)] =
        starcat_angle_of_chord(starcat_chord_square(w->body[i], w->body[k]));
  }
}

/* Take triangles by brightness: first the triangles whose faintest centroid is brightest. */
static int search_by_brightness(starcat_call *call, search *s) {
  for (uint32_t k = 0; k < s->count; k++) {
    if (s->poor == 0) {
      separate_centroid(call, k);
    }
    for (uint32_t j = 1; j < k; j++) {
      for (uint32_t i = 0; i < j; i++) {
        if (take_triangle(call, s, i, j, k) != 0) {
          return 1;
        }
      }
    }
  }
  return 0;
}

/* Whether pair a comes before pair b: the closer pair first, then the smaller index. */
static int is_closer(const starcat_workspace *w, uint16_t a, uint16_t b) {
  const real x = w->separation_rad[starcat_limit_place(a, STARCAT_MOST_PAIRS)];
  const real y = w->separation_rad[starcat_limit_place(b, STARCAT_MOST_PAIRS)];
  return (x < y) || (!(y < x) && (a < b));
}

/* Restore the order of the heap of pairs below an index. */
static void sift_heap(starcat_workspace *w, uint32_t top, uint32_t count) {
  const uint16_t moved = w->heap[top];
  uint32_t at = top, child = 2u * top + 1u;
  while (child < count) {
    if ((child + 1u < count) && is_closer(w, w->heap[child + 1u], w->heap[child])) {
      child++;
    }
    if (!is_closer(w, w->heap[child], moved)) {
      break;
    }
    w->heap[at] = w->heap[child];
    at = child;
    child = 2u * at + 1u;
  }
  w->heap[at] = moved;
}

/* Take all triangles whose longest side is a given pair. */
static int search_with_longest_side(starcat_call *call, search *s, uint16_t pair) {
  const starcat_workspace *w = call->work;
  uint32_t q = 1;
  while ((q + 1u) * q / 2u <= pair) {
    q++;
  }
  const uint32_t p = pair - q * (q - 1u) / 2u;
  for (uint32_t r = 0; r < s->count; r++) {
    if ((r != p) && (r != q) && is_closer(w, (uint16_t)pair_of(r, p), pair) &&
        is_closer(w, (uint16_t)pair_of(r, q), pair)) {
      const uint32_t i = r < p ? r : p, k = r > q ? r : q;
      if (take_triangle(call, s, i, p + q + r - i - k, k) != 0) {
        return 1;
      }
    }
  }
  return 0;
}

/* Take triangles by their longest side, the shortest first: most fields contain these completely.
 * The pairs are sorted only as far as necessary. */
static int search_by_longest_side(starcat_call *call, search *s) {
  starcat_workspace *w = call->work;
  const uint32_t pairs = s->count * (s->count - 1u) / 2u;
  uint32_t count = pairs;
  if (s->poor == 0) {
    for (uint32_t k = 1; k < s->count; k++) {
      separate_centroid(call, k);
    }
  }
  for (uint32_t n = 0; n < count; n++) {
    w->heap[n] = (uint16_t)n;
  }
  for (uint32_t n = count / 2u; n > 0u; n--) {
    sift_heap(w, n - 1u, count);
  }
  if (!starcat_spend_steps(call, 2u * count)) {
    return 1;
  }
  while (count > 0u) {
    const uint16_t closest = (uint16_t)starcat_limit_place(w->heap[0], pairs);
    count--;
    w->heap[0] = w->heap[count];
    sift_heap(w, 0, count);
    if (search_with_longest_side(call, s, closest) != 0) {
      return 1;
    }
  }
  return 0;
}

/* List the nearest centroids of a centroid, the nearest first. Returns their number. */
static uint32_t list_neighbours(starcat_call *call, uint32_t i, uint32_t count) {
  starcat_workspace *w = call->work;
  real square[STARCAT_NEIGHBOURS];
  uint32_t n = 0;
  for (uint32_t k = 0; k < count; k++) {
    const real apart = starcat_chord_square(w->body[i], w->body[k]);
    if ((k == i) || ((n == STARCAT_NEIGHBOURS) && !(apart < square[n - 1u]))) {
      continue;
    }
    uint32_t at = n < STARCAT_NEIGHBOURS ? n : n - 1u;
    n = at + 1u;
    while ((at > 0u) && (apart < square[at - 1u])) {
      square[at] = square[at - 1u];
      w->neighbour[i][at] = w->neighbour[i][at - 1u];
      at--;
    }
    square[at] = apart;
    w->neighbour[i][at] = (uint16_t)k;
  }
  return n;
}

/* Whether two centroids are neighbours of a third one, with ranks that come before the given ones:
 * then their triangle has been taken already. */
static int is_earlier(const starcat_workspace *w, uint32_t owner, uint32_t a, uint32_t b,
                      uint32_t first, uint32_t second, int is_before) {
  uint32_t low = STARCAT_NEIGHBOURS, high = STARCAT_NEIGHBOURS;
  for (uint32_t n = 0; n <= second; n++) {
    const uint32_t one = w->neighbour[owner][n];
    if ((one == a) || (one == b)) {
      high = low < STARCAT_NEIGHBOURS ? n : high;
      low = low < STARCAT_NEIGHBOURS ? low : n;
    }
  }
  if (high == STARCAT_NEIGHBOURS) {
    return 0;
  }
  return (high < second) || (low < first) || ((low == first) && (is_before != 0));
}

/* Take triangles of near centroids from everywhere in a crowded frame: every centroid with its two
 * nearest neighbours, then every centroid with the first and third nearest, with the second and
 * third, and so on. A database contains the triangles of the brightest stars of its fields; in one
 * part of a crowded frame most triangles share the same few stars. */
static int search_by_neighbours(starcat_call *call, search *s) {
  const starcat_workspace *w = call->work;
  uint32_t most = 0;
  for (uint32_t i = 0; i < s->count; i++) {
    most = list_neighbours(call, i, s->count);
    if (!starcat_spend_steps(call, s->count)) {
      return 1;
    }
  }
  for (uint32_t second = 1; second < most; second++) {
    for (uint32_t first = 0; first < second; first++) {
      for (uint32_t i = 0; i < s->count; i++) {
        const uint32_t a = starcat_limit_place(w->neighbour[i][first], s->count);
        const uint32_t b = starcat_limit_place(w->neighbour[i][second], s->count);
        const uint32_t low = a < b ? a : b, high = a < b ? b : a;
        if (!is_earlier(w, a, i, b, first, second, a < i) &&
            !is_earlier(w, b, i, a, first, second, b < i) &&
            (take_triangle(call, s, i < low ? i : low, i < low ? low : (i < high ? i : high),
                           i < high ? high : i) != 0)) {
          return 1;
        }
      }
    }
  }
  return 0;
}

static real find_least_side(const starcat_call *call) {
  return starcat_larger(STARCAT_MIN_SIDE_PX / call->focal_px, STARCAT_LEAST_SIDE);
}

void starcat_search_triangles(starcat_call *call, starcat_look_up look_up) {
  search s = {look_up,
              call->own->count,
              find_least_side(call),
              R(0.0),
              0,
              call->own->n_looked_up,
              look_up == starcat_look_up_triangle ? EFFORT_OF_TRIANGLE : EFFORT_OF_PYRAMID};
  s.least_poor_side_rad = starcat_larger(call->tolerance_rad, STARCAT_LEAST_SIDE);
  call->own->is_crowded = (s.count > STARCAT_MOST_CENTROIDS) && (call->own->has_magnitudes == 0u);
  if (call->own->is_crowded != 0u) {
    s.count = s.count < STARCAT_SPREAD_CENTROIDS ? s.count : STARCAT_SPREAD_CENTROIDS;
    (void)search_by_neighbours(call, &s);
    return;
  }
  if (s.count > STARCAT_MOST_CENTROIDS) {
    s.count = STARCAT_MOST_CENTROIDS;
  }
  const uint32_t rounds = s.count <= STARCAT_FEW_CENTROIDS ? 2u : 1u;
  for (uint32_t n = 0; n < rounds; n++) {
    s.poor = n > 0u;
    if ((call->own->has_magnitudes != 0u ? search_by_brightness(call, &s)
                                         : search_by_longest_side(call, &s)) != 0) {
      return;
    }
  }
}

/* The rows of the features whose value is between two numbers, and a few others. */
void starcat_find_rows(const starcat_image *image, real low, real high, uint32_t *start,
                       uint32_t *stop) {
  const real end = (real)(image->n_kvector - 1u);
  const real first = (low - image->kvector_intercept) / image->kvector_slope - R(0.001);
  const real last = (high - image->kvector_intercept) / image->kvector_slope + R(1.001);
  *start = 0;
  if (first >= R(0.0)) {
    *start = image->kvector[first < end ? (uint32_t)first : image->n_kvector - 1u];
  }
  *stop = 0;
  if (last >= R(0.0)) {
    *stop = last < end ? image->kvector[(uint32_t)last] : image->n_features;
  }
  if (*stop > image->n_features) { /* a damaged image */
    *stop = image->n_features;
  }
}

/* Area and circumradius of a plane triangle, and their errors for given errors of its sides. */
static void compute_features(const real sides[3], const real error[3], real *area, real *area_error,
                             real *radius, real *radius_error) {
  const real a = sides[0], b = sides[1], c = sides[2];
  const real a2 = a * a, b2 = b * b, c2 = c * c;
  const real u = b2 + c2 - a2, v = a2 + c2 - b2, t = a2 + b2 - c2;
  const real square = a2 * u + b2 * v + c2 * t, sum = a2 + b2 + c2;
  const real least = starcat_larger(R(1e-30), R(1e-12) * sum * sum);
  *area = R(0.25) * STARCAT_SQRT(starcat_larger(square, least));
  const real scale = R(0.125) / *area;
  const real x = scale * a * u, y = scale * b * v, z = scale * c * t;
  real p = error[0] * x, q = error[1] * y, r = error[2] * z;
  *radius = starcat_larger(R(0.25) * a * b * c / *area, R(1e-18));
  *area_error = STARCAT_SQRT(p * p + q * q + r * r);
  p = error[0] * (R(1.0) / a - x / *area);
  q = error[1] * (R(1.0) / b - y / *area);
  r = error[2] * (R(1.0) / c - z / *area);
  *radius_error = *radius * STARCAT_SQRT(p * p + q * q + r * r);
}

/* What a triangle of stars has in common with an observed one: the sides, the shape with any allowed
 * scale, or what a shape of the frame leaves of the sides. */
typedef enum { SAME, SIMILAR, SHAPED } likeness;

/* An observed triangle in the form in which it is compared with triangles of stars. */
typedef struct {
  likeness as;
  uint32_t triple[3];
  real low[3], high[3];        /* squares of the chords that each side can have */
  real least[3], most[3];      /* bounds sorted by length, the shortest first */
  real sides[3], error, slack; /* error of the sides; of the scale */
  real area[2], second[2]; /* bounds of the area, and of the circumradius; with an unknown scale of
                            * the area over the squared circumradius */
  int is_right_handed;
} sought;

/* Put three numbers in order. */
static void sort_sides(real v[3]) {
  const real less = starcat_smaller(v[0], v[1]), more = starcat_larger(v[0], v[1]), other = v[2];
  v[0] = starcat_smaller(less, other);
  v[1] = starcat_larger(less, starcat_smaller(more, other));
  v[2] = starcat_larger(more, other);
}

/* Bound the chords if the scale is not known: the square of the longest, and the ratios of the
 * others to it. If sides fit in any order, they fit sorted by length with the largest of their
 * errors. A chord is shorter than its angle, and relatively shorter the longer it is. */
static void bound_shape(const starcat_call *call, sought *o) {
  const real shortest = R(1.0) - call->fov_error;
  real a[3] = {o->sides[0], o->sides[1], o->sides[2]};
  sort_sides(a);
  const real error = o->error + call->bend * a[2], narrowest = shortest - o->slack;
  const real angle = narrowest > R(0.01) ? (a[2] + error) / narrowest : HALF_TURN;
  const real widest = angle < HALF_TURN ? angle : HALF_TURN;
  const real least = starcat_chord_of_angle((a[2] - error) / (R(1.0) / shortest + o->slack));
  const real most = starcat_chord_of_angle(widest);
  for (uint32_t n = 0; n < 2u; n++) {
    const real low = a[n] > error ? (a[n] - error) / (a[2] + error) : R(0.0);
    const real high = a[2] > error ? widest / most * (a[n] + error) / (a[2] - error) : R(1.0);
    o->least[n] = BELOW * low * low;
    o->most[n] = ABOVE * high * high;
  }
  o->least[2] = starcat_larger(BELOW * least * least, LEAST_CHORD);
  o->most[2] = ABOVE * most * most;
}

static void observe_triangle(const starcat_call *call, const uint32_t triple[3],
                             const real sides[3], likeness as, sought *o) {
  const starcat_workspace *w = call->work;
  const real error = STARCAT_SIDE_TOLERANCE * call->tolerance_rad;
  real normal[3];
  o->as = as;
  for (uint32_t n = 0; n < 3u; n++) {
    const real most = error + (as == SHAPED ? SIDE_CHANGE * sides[n] : R(0.0));
    const real low = starcat_chord_of_angle(sides[n] - most),
               high = starcat_chord_of_angle(sides[n] + most);
    o->triple[n] = triple[n];
    o->low[n] = low * low;
    o->high[n] = high * high;
    o->least[n] = o->low[n];
    o->most[n] = o->high[n];
    o->sides[n] = sides[n];
  }
  o->error = error;
  o->slack = error / starcat_smaller(starcat_smaller(sides[0], sides[1]), sides[2]);
  sort_sides(o->least);
  sort_sides(o->most);
  if (as == SIMILAR) {
    bound_shape(call, o);
  }
  starcat_cross(w->body[triple[0]], w->body[triple[1]], normal);
  o->is_right_handed = starcat_dot(normal, w->body[triple[2]]) > R(0.0);
}

/* Whether the chords of stars can equal the observed chords in some order of the corners: most
 * cannot in any order. */
static int may_fit(const sought *o, const real chords[3], int has_scale) {
  real c[3] = {chords[0], chords[1], chords[2]};
  sort_sides(c);
  const real unit = has_scale ? c[2] : R(1.0);
  return starcat_is_between(c[2], o->least[2], o->most[2]) &&
         starcat_is_between(c[0], o->least[0] * unit, o->most[0] * unit) &&
         starcat_is_between(c[1], o->least[1] * unit, o->most[1] * unit);
}

/* Directions in a camera with a multiple of the focal length. */
static void scale_directions(real body[3][3], real focal) {
  for (uint32_t n = 0; n < 3u; n++) {
    real *b = body[n];
    b[2] *= focal;
    const real scale = R(1.0) / STARCAT_SQRT(starcat_dot(b, b));
    b[0] *= scale;
    b[1] *= scale;
    b[2] *= scale;
  }
}

static real circumference(real v[3][3]) {
  return starcat_chord_square(v[0], v[1]) + starcat_chord_square(v[1], v[2]) +
         starcat_chord_square(v[2], v[0]);
}

/* The focal length at which three centroids are as far apart as their stars; changes the directions
 * of the centroids to it. Two iterations, because an angle is not its tangent. */
static real fit_scale(const starcat_call *call, real body[3][3], real icrs[3][3]) {
  const real shortest = R(1.0) - call->fov_error, apart = circumference(icrs);
  real focal = R(1.0);
  for (uint32_t n = 0; n < 2u; n++) {
    const real before = focal;
    focal *= STARCAT_SQRT(circumference(body) / apart);
    focal = focal < shortest ? shortest : focal;
    focal = focal * shortest > R(1.0) ? R(1.0) / shortest : focal;
    scale_directions(body, focal / before);
  }
  return focal;
}

/* The scale, stretch and shear of the frame with which three centroids are as three stars at an
 * attitude: undone, they leave a turn of the camera, which QR decomposition separates. Returns 0 if
 * they are out of their ranges. */
static int find_linear_shape(starcat_call *call, const uint32_t t[3], const real *icrs,
                             const real m[9], real terms[STARCAT_SHAPE_TERMS]) {
  const starcat_workspace *w = call->work;
  const real x1 = w->x[t[1]] - w->x[t[0]], y1 = w->y[t[1]] - w->y[t[0]];
  const real x2 = w->x[t[2]] - w->x[t[0]], y2 = w->y[t[2]] - w->y[t[0]];
  const real area = x1 * y2 - x2 * y1;
  real place[3][2], x[2], y[2];
  (void)starcat_set_focal(call, R(1.0));
  for (uint32_t n = 0; n < 3u; n++) {
    real body[3];
    starcat_turn(m, icrs + 3u * n, body);
    if (!starcat_find_pixel(&call->camera, body, &place[n][0], &place[n][1])) {
      return 0;
    }
  }
  /* Columns of the linear map from the sides of the centroids to those of the stars, by Cramer's
   * rule. */
  for (uint32_t k = 0; k < 2u; k++) {
    const real side1 = place[1][k] - place[0][k], side2 = place[2][k] - place[0][k];
    x[k] = (side1 * y2 - side2 * y1) / area;
    y[k] = (side2 * x1 - side1 * x2) / area;
  }
  const real along_x = STARCAT_SQRT(x[0] * x[0] + x[1] * x[1]);
  terms[0] = R(1.0) - along_x;
  terms[1] = R(0.0);
  terms[2] = along_x - (x[0] * y[1] - y[0] * x[1]) / along_x;
  terms[3] = -(x[0] * y[0] + x[1] * y[1]) / along_x;
  terms[4] = R(0.0);
  terms[5] = R(0.0);
  return starcat_is_within_ranges(call, terms);
}

/* Try a triangle of stars in one order of its corners. Returns 1 if the search can end. */
static int try_order(starcat_call *call, const sought *o, const uint32_t rows[3], real stars[3][3],
                     const uint8_t order[3]) {
  const starcat_workspace *w = call->work;
  const int is_shaped = o->as == SHAPED;
  real m[9], body[3][3], icrs[3][3], focal = R(1.0), terms[STARCAT_SHAPE_TERMS];
  for (uint32_t n = 0; n < 3u; n++) {
    if (is_shaped && !starcat_is_compatible(call, o->triple[n], rows[order[n]])) {
      return 0;
    }
    for (uint32_t k = 0; k < 3u; k++) {
      body[n][k] = w->body[o->triple[n]][k];
      icrs[n][k] = stars[order[n]][k];
    }
  }
  if (o->as == SIMILAR) {
    focal = fit_scale(call, body, icrs);
  }
  if (!starcat_fit_triad(body[0], body[1], icrs[0], icrs[1], m)) {
    return 0;
  }
  starcat_refine_attitude(m, &body[0][0], &icrs[0][0], NULL, NULL, 3, 2);
  if (is_shaped != 0) {
    if (!starcat_spend_steps(call, STEPS_OF_SHAPED)) {
      return 1;
    }
    if (!find_linear_shape(call, o->triple, &icrs[0][0], m, terms)) {
      return 0;
    }
  }
  if (!starcat_spend_effort(call, 0, call->own->count)) {
    return 1;
  }
  return is_shaped ? starcat_try_shape(call, m, o->triple, &icrs[0][0], terms)
                   : starcat_try_attitude(call, m, focal);
}

/* Whether the sides of stars, in an order of the corners, equal the observed sides at an allowed
 * scale: the scale of least squares. */
static int is_similar(const starcat_call *call, const sought *o, const real apart[3],
                      const uint8_t order[3]) {
  const real u = apart[order[0]], v = apart[order[1]], t = apart[order[2]];
  const real scale =
      (o->sides[0] * u + o->sides[1] * v + o->sides[2] * t) / (u * u + v * v + t * t);
  const real shortest = R(1.0) - call->fov_error;
  if (!starcat_is_between(scale, shortest - o->slack, R(1.0) / shortest + o->slack)) {
    return 0;
  }
  for (uint32_t n = 0; n < 3u; n++) {
    const real miss = apart[order[n]] * scale - o->sides[n];
    const real most = o->error + call->bend * o->sides[n];
    if (!starcat_is_between(miss, -most, most)) {
      return 0;
    }
  }
  return 1;
}

/* Whether the chords of stars, in an order of the corners, equal the observed chords. */
static int is_same(const sought *o, const real chords[3], const uint8_t order[3]) {
  int fits = 1;
  for (uint32_t n = 0; n < 3u; n++) {
    fits = fits && starcat_is_between(chords[order[n]], o->low[n], o->high[n]);
  }
  return fits;
}

/* Whether area and circumradius, or area and shape, of stars are as observed: the rows of the image
 * that are looked up include a few others. */
static int has_features(const sought *o, const real sides[3], int has_scale) {
  static const real none[3] = {R(0.0), R(0.0), R(0.0)};
  real area, radius, unused[2];
  compute_features(sides, none, &area, unused, &radius, unused + 1);
  return starcat_is_between(area, o->area[0], o->area[1]) &&
         starcat_is_between(has_scale ? area / (radius * radius) : radius, o->second[0],
                            o->second[1]);
}

/* Compare one triangle of stars with the observed one. Returns 1 if the search can end. */
static int compare_feature(starcat_call *call, const sought *o, uint32_t feature) {
  static const uint8_t orders[6][3] = {{0, 1, 2}, {0, 2, 1}, {1, 0, 2},
                                       {1, 2, 0}, {2, 0, 1}, {2, 1, 0}};
  uint32_t rows[3];
  real stars[3][3], normal[3], chords[3];
  starcat_read_rows(call->image, feature, 3, rows);
  for (uint32_t n = 0; n < 3u; n++) {
    if (rows[n] >= call->image->n_stars) { /* a damaged image */
      return 0;
    }
    starcat_read_star(call->image, rows[n], stars[n]);
  }
  chords[0] = starcat_chord_square(stars[1], stars[2]);
  chords[1] = starcat_chord_square(stars[0], stars[2]);
  chords[2] = starcat_chord_square(stars[0], stars[1]);
  const int has_scale = o->as == SIMILAR;
  if (!may_fit(o, chords, has_scale)) {
    return 0;
  }
  const real sides[3] = {starcat_angle_of_chord(chords[0]), starcat_angle_of_chord(chords[1]),
                         starcat_angle_of_chord(chords[2])};
  if (!has_features(o, sides, has_scale)) {
    return 0;
  }
  starcat_cross(stars[0], stars[1], normal);
  const int is_right_handed = starcat_dot(normal, stars[2]) > R(0.0);
  for (uint32_t k = 0; k < 6u; k++) {
    const uint8_t *order = orders[k];
    const int fits = has_scale ? is_similar(call, o, sides, order) : is_same(o, chords, order);
    /* The first, fourth and fifth orders keep the handedness. */
    const int is_even = (k == 0u) || (k == 3u) || (k == 4u);
    if (fits && ((is_even == is_right_handed) == o->is_right_handed) &&
        (try_order(call, o, rows, stars, order) != 0)) {
      return 1;
    }
  }
  return 0;
}

static uint16_t quantise_radius(real radius, real quantum) {
  const real scaled = radius / quantum;
  if (!(scaled > R(0.0))) {
    return 0;
  }
  return scaled < R(65535.0) ? (uint16_t)scaled : (uint16_t)STARCAT_RADIUS_OVERFLOW;
}

/* Whether any radius of a block is in a range; written so that compilers vectorize it. */
static int has_radius(const uint16_t *radii, uint16_t low, uint16_t width) {
  uint16_t found = 0;
  for (uint32_t n = 0; n < BLOCK; n++) {
    found |= (uint16_t)((uint16_t)(radii[n] - low) <= width);
  }
  return found != 0u;
}

/* Compare the triangles of stars of some areas and circumradii. Returns 1 if the search can end. */
static int look_up_features(starcat_call *call, const sought *o, const real area[2],
                            const real radius[2]) {
  const starcat_image *image = call->image;
  const real quantum = image->radius_quantum_rad;
  const uint16_t low = quantise_radius(radius[0] - quantum, quantum);
  const uint16_t width = (uint16_t)(quantise_radius(radius[1] + R(2.0) * quantum, quantum) - low);
  uint32_t start, stop;
  starcat_find_rows(image, area[0], area[1], &start, &stop);
  for (uint32_t row = start; row < stop; row += BLOCK) {
    const uint32_t count = stop - row < BLOCK ? stop - row : BLOCK;
    if (!starcat_spend_steps(call, count)) {
      return 1;
    }
    if ((count < BLOCK) || has_radius(image->radii + row, low, width)) {
      for (uint32_t n = 0; n < count; n++) {
        if (((uint16_t)(image->radii[row + n] - low) <= width) &&
            (!starcat_spend_steps(call, STEPS_OF_SIDES) || compare_feature(call, o, row + n))) {
          return 1;
        }
      }
    }
  }
  return 0;
}

/* Look up the triangles of stars similar to an observed one: area over squared circumradius is
 * equal, so that the area determines the circumradius. Returns 1 if the search can end. */
static int look_up_similar(starcat_call *call, sought *o, real area, real area_error, real radius) {
  const real shortest = R(1.0) - call->fov_error, error = o->error;
  const real a = o->sides[0], b = o->sides[1], c = o->sides[2];
  const real shape = area / (radius * radius);
  const real scale = R(0.375) / (area * area);
  const real x = scale * a * (b * b + c * c - a * a) - R(2.0) / a;
  const real y = scale * b * (a * a + c * c - b * b) - R(2.0) / b;
  const real z = scale * c * (a * a + b * b - c * c) - R(2.0) / c;
  const real shape_error =
      shape * (error * STARCAT_SQRT(x * x + y * y + z * z) + R(3.0) * o->slack * o->slack);
  const real thinnest = shape - shape_error;
  const real end = (area + area_error) / (shortest * shortest);
  real part[2], radii[2];
  part[0] = (area - area_error) * shortest * shortest;
  o->area[0] = part[0];
  o->area[1] = end;
  o->second[0] = thinnest;
  o->second[1] = shape + shape_error;
  part[0] = part[0] > LEAST_PART * end ? part[0] : LEAST_PART * end;
  while (part[0] < end) {
    part[1] = part[0] * PART;
    part[1] = part[1] < end ? part[1] : end;
    radii[0] = STARCAT_SQRT(part[0] / (shape + shape_error));
    radii[1] = thinnest > R(0.0) ? STARCAT_SQRT(part[1] / thinnest) : R(1e3);
    if (!starcat_spend_steps(call, 1) || (look_up_features(call, o, part, radii) != 0)) {
      return 1;
    }
    part[0] = part[1];
  }
  return 0;
}

/* Look up the triangles of stars with the area and circumradius of an observed one. */
static int look_up_as(starcat_call *call, const uint32_t triple[3], const real sides[3],
                      likeness as) {
  real error[3], area, area_error, radius, radius_error;
  sought o;
  observe_triangle(call, triple, sides, as, &o);
  for (uint32_t n = 0; n < 3u; n++) {
    /* A shape changes the three sides together: their errors add up. */
    error[n] = as == SHAPED ? ROOT_OF_3 * (o.error + SIDE_CHANGE * sides[n]) : o.error;
  }
  compute_features(sides, error, &area, &area_error, &radius, &radius_error);
  if (as == SIMILAR) {
    return look_up_similar(call, &o, area, area_error, radius);
  }
  o.area[0] = area - area_error;
  o.area[1] = area + area_error;
  o.second[0] = radius - radius_error;
  o.second[1] = radius + radius_error;
  return look_up_features(call, &o, o.area, o.second);
}

int starcat_look_up_triangle(starcat_call *call, const uint32_t triple[3], const real sides[3]) {
  return look_up_as(call, triple, sides, call->fov_error > R(0.0) ? SIMILAR : SAME);
}

/* Look up the triangles of stars that a shape of the frame turns into an observed one. */
static int look_up_shaped(starcat_call *call, const uint32_t triple[3], const real sides[3]) {
  return look_up_as(call, triple, sides, SHAPED);
}

/* Search a frame of another shape, up to an effort: the most compact triangles first, because the
 * stars have the fewest triangles of their size. */
void starcat_search_shaped(starcat_call *call, uint32_t most) {
  search s = {look_up_shaped,  call->own->count, find_least_side(call), R(0.0), 0, 0,
              EFFORT_OF_SHAPED};
  if (s.count > STARCAT_MOST_CENTROIDS) {
    s.count = STARCAT_MOST_CENTROIDS;
  }
  call->own->is_crowded = 0;
  call->own->n_looked_up = 0;
  call->own->effort = 0;
  call->own->most_effort = most;
  (void)search_by_longest_side(call, &s);
}
