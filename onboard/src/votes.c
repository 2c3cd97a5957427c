/* Votes for the rotation of a frame about one of its centroids.
 *
 * If centroids are inaccurate, or if most of them are false, a triangle of centroids resembles
 * thousands of triangles of stars. The stars around the right star of a centroid agree on the
 * rotation of the frame about it; the stars around another star do not (compare Fu et al. 2025,
 * whose patterns are such rotations around a star).
 *
 *     search_votes:
 *         for each of the first centroids, the reference (as many as include a star almost always):
 *             list the centroids around it: separation, position angle, magnitude
 *             for each star that the reference may be by its magnitude:
 *                 for each neighbour of the star, and each centroid that the neighbour may be by
 *                 separation and magnitude: vote for the difference of their position angles
 *                 keep the star, if it is among those with the most votes in two adjacent bins
 *             for each star that was kept, the one with the most votes first:
 *                 fit the attitude to the pairs that voted for its bins, and try it  [verify.c]
 *
 * The same rules as the ground's starcat/matcher/methods/votes.py. Votes are counted for a group of
 * 64 stars at a time, whose neighbours are listed by separation: then the neighbours that a centroid
 * can be follow each other. The first count is quick, and counts each vote of a centroid; no star
 * has more votes than that. Only the few stars that could be kept are counted again, with one vote
 * per centroid in a bin.
 *
 * SPDX-License-Identifier: MIT
 */
#include "internal.h"

#define MISS_PROBABILITY R(1e-4) /* that a frame that can be identified has false references only */
#define FULL_SPHERE R(12.566370614359172)
#define RINGS 32u /* bins of separation; the neighbours of a group are listed by them */
#define PER_RING 1024u
#define MAX_KEPT 6u /* stars tried per reference */
#define MIN_VOTES 3u
#define MIN_LISTED_STARS \
  RINGS /* of a table of neighbours, so that `first` has room for the rings */
#define EXPECTED_AT_LEAST R(0.3) /* least expected votes of two bins by chance */
#define STEPS_OF_GROUP 256u      /* steps of a group, besides the votes */
#define STEPS_OF_RUN 32u         /* steps of finding the neighbours that a voter can be */
#define STEPS_OF_STAR 512u       /* steps of counting the votes for a star again */
#define PLACES_OF_STEP 8u        /* neighbours that are passed over then in one step */
#define MOST_IN_BIN 127u         /* two bins together have a byte; more votes are not counted */
#define LARGEST_WEIGHT R(1e6)
#if STARCAT_MAX_CENTROIDS > 32 /* STARCAT_MAX_VOTERS: the fit also includes the reference */
#define MOST_VOTES STARCAT_MAX_VOTERS
#else
#define MOST_VOTES (STARCAT_MAX_CENTROIDS - 1u)
#endif

/* Units of neighbours. Separations: the largest over APART. Position angles: 1/256 of a turn.
 * Magnitudes: 1/16, counted from BRIGHTEST. */
#define LAST_APART 32767u
#define APART ((real)LAST_APART)
#define PER_BIN (256u / STARCAT_BINS)
#define TURN_RAD R(6.283185307179586)
#define TURNS R(40.743665431525206) /* 256 / 2 pi */
#define PER_MAGNITUDE R(16.0)
#define BRIGHTEST R(-2.0)
#define FAINTEST R(14.0)
#define UNKNOWN 255u

#define MIN_RADIUS_RAD R(1e-4)
#define MAX_RADIUS_RAD R(1.57)

/* A centroid around the reference, in the units of neighbours. */
typedef struct {
  uint16_t centroid, nearest, depth; /* separation of its star: nearest to nearest + depth */
  uint8_t brightest, range, turn;    /* its brightness: brightest to brightest + range */
  real sine;                         /* sine of the separation */
} voter;

typedef struct {
  uint32_t reference, count;
  voter voters[STARCAT_MAX_VOTERS + 1u]; /* one more, for the voter that drops out */
} surroundings;

/* A star that the reference can be, and how far north it is, which decides between equal weights:
 * the ground has its stars in another order. */
typedef struct {
  uint32_t row, turn;
  int32_t north;
  real weight;
} leader;

static void copy_vector(const real from[3], real to[3]) {
  to[0] = from[0];
  to[1] = from[1];
  to[2] = from[2];
}

/* Two directions at right angles to a direction and to each other; for a damaged direction without
 * length, two without length. */
static void make_axes(const real u[3], real axes[2][3]) {
  const int is_polar = u[2] * u[2] > R(0.5);
  axes[0][0] = is_polar ? u[2] : -u[1];
  axes[0][1] = is_polar ? R(0.0) : u[0];
  axes[0][2] = is_polar ? -u[0] : R(0.0);
  const real square = starcat_larger(starcat_dot(axes[0], axes[0]), STARCAT_LEAST_NUMBER);
  const real length = STARCAT_SQRT(square);
  for (uint32_t k = 0; k < 3u; k++) {
    axes[0][k] /= length;
  }
  starcat_cross(u, axes[0], axes[1]);
}

/* The position angle of a direction, from an axis of its centre. */
static real find_angle(real axes[2][3], const real v[3]) {
  return STARCAT_ATAN2(starcat_dot(axes[0], v), starcat_dot(axes[1], v));
}

/* Round to a unit from 0 to `last`; NaN becomes 0. */
static uint32_t round_units(real units, real last) {
  return (uint32_t)starcat_smaller(starcat_larger(units + R(0.5), R(0.0)), last);
}

static uint32_t find_turn(real angle_rad) {
  return round_units(TURNS * angle_rad + R(256.0), R(511.0)) & 255u;
}

/* A magnitude in the units of neighbours; bright and faint ones have the first and the last unit. */
static uint32_t find_magnitude(real magnitude) {
  const real held = starcat_smaller(starcat_larger(magnitude, BRIGHTEST), FAINTEST);
  return round_units(PER_MAGNITUDE * (held - BRIGHTEST), (real)(UNKNOWN - 1u));
}

/* A separation in the units of neighbours; separations beyond the radius have the last unit. */
static uint32_t find_apart(real apart_rad, real radius_rad) {
  return round_units(APART * apart_rad / radius_rad, APART);
}

static uint32_t gather_around(const starcat_call *call, const real centre[3], real radius_rad) {
  return starcat_gather_stars(call, centre, STARCAT_COS(radius_rad), STARCAT_SIN(radius_rad),
                              STARCAT_MAX_STARS, call->work->near_row, call->work->near_icrs);
}

/* Number of groups of stars; the last one can be smaller. */
static uint32_t number_of_groups(const starcat_image *image) {
  return (image->n_stars + STARCAT_GROUP - 1u) / STARCAT_GROUP;
}

/* Put neighbours in order of their places (Shell 1959). */
static void sort_neighbours(starcat_neighbour *list, uint32_t count) {
  for (uint32_t gap = count / 2u; gap > 0u; gap /= 2u) {
    for (uint32_t n = gap; n < count; n++) {
      const starcat_neighbour moved = list[n];
      uint32_t at = n;
      while ((at >= gap) && (moved.place < list[at - gap].place)) {
        list[at] = list[at - gap];
        at -= gap;
      }
      list[at] = moved;
    }
  }
}

/* The place of a neighbour in its ring: by separation, then by the star of the group. */
static uint16_t find_place(uint32_t apart, uint32_t star) {
  return (uint16_t)(apart % PER_RING * STARCAT_GROUP + star);
}

/* Count the neighbours of a star by rings if `next` is null, else list them: `next` has the index in
 * the table for the next neighbour of each ring. Returns 0 if there are too many. */
static int list_around(const starcat_call *call, starcat_neighbours *table, uint32_t row,
                       uint32_t counts[RINGS], uint32_t *next) {
  const starcat_workspace *w = call->work;
  real centre[3], axes[2][3];
  starcat_read_star(call->image, row, centre);
  make_axes(centre, axes);
  call->own->steps_left = UINT32_MAX;
  const uint32_t count = gather_around(call, centre, table->radius_rad);
  for (uint32_t k = 0; (k < count) && (count <= STARCAT_MAX_STARS); k++) {
    const uint32_t other = starcat_limit_place(w->near_row[k], call->image->n_stars);
    const uint32_t apart = find_apart(
        starcat_angle_of_chord(starcat_chord_square(centre, w->near_icrs[k])), table->radius_rad);
    const uint32_t ring = apart / PER_RING;
    if (other == row) {
      continue;
    }
    if (next == NULL) {
      counts[ring]++;
    } else {
      const int16_t stored = call->image->magnitudes[other];
      starcat_neighbour *to =
          table->neighbour + starcat_limit_place(next[ring], table->capacity);
      to->place = find_place(apart, row % STARCAT_GROUP);
      to->turn = (uint8_t)find_turn(find_angle(axes, w->near_icrs[k]));
      to->magnitude =
          (uint8_t)(stored == INT16_MIN ? UNKNOWN : find_magnitude(R(0.001) * (real)stored));
      next[ring]++;
    }
  }
  return count <= STARCAT_MAX_STARS;
}

/* List the neighbours of a group of stars, after `total` others; count them only if they are too
 * many for the table. Returns 0 if a star has too many. */
static int list_group(const starcat_call *call, starcat_neighbours *table, uint32_t group,
                      uint32_t *total) {
  const uint32_t first = group * STARCAT_GROUP, left = call->image->n_stars - first;
  const uint32_t stop = left < STARCAT_GROUP ? first + left : first + STARCAT_GROUP;
  uint32_t counts[RINGS] = {0}, next[RINGS], begun = *total;
  for (uint32_t row = first; row < stop; row++) {
    if (!list_around(call, table, row, counts, NULL)) {
      return 0;
    }
  }
  for (uint32_t ring = 0; ring < RINGS; ring++) {
    next[ring] = *total;
    table->first[group * RINGS + ring] = *total;
    *total += counts[ring];
  }
  if (*total > table->capacity) {
    return 1;
  }
  for (uint32_t row = first; row < stop; row++) {
    (void)list_around(call, table, row, counts, next);
  }
  for (uint32_t ring = 0; ring < RINGS; ring++) {
    sort_neighbours(table->neighbour + begun, counts[ring]);
    begun += counts[ring];
  }
  return 1;
}

starcat_status starcat_list_neighbours(const starcat_image *image, starcat_workspace *work,
                                       starcat_neighbours *table) {
  starcat_call call;
  uint32_t total = 0;
  if ((image == NULL) || (work == NULL) || (table == NULL) || (table->first == NULL) ||
      ((table->neighbour == NULL) && (table->capacity > 0u))) {
    return STARCAT_E_NULL;
  }
  if (!starcat_is_finite(&table->radius_rad) ||
      !starcat_is_between(table->radius_rad, MIN_RADIUS_RAD, MAX_RADIUS_RAD)) {
    return STARCAT_E_OPTIONS;
  }
  call.image = image;
  call.work = work;
  call.own = &call.counters;
  table->n_stars = 0; /* so that an incomplete table is not used */
  table->first[image->n_stars] = 0;
  if (image->n_stars < MIN_LISTED_STARS) {
    return STARCAT_E_CAPACITY;
  }
  for (uint32_t group = 0; group < number_of_groups(image); group++) {
    if (!list_group(&call, table, group, &total)) {
      table->first[image->n_stars] = 0;
      return STARCAT_E_CAPACITY;
    }
  }
  /* The list of the last ring ends here; `first` has room for a ring for each star. */
  table->first[number_of_groups(image) * RINGS] = total;
  table->first[image->n_stars] = total;
  if (total > table->capacity) {
    return STARCAT_E_CAPACITY;
  }
  table->n_stars = image->n_stars;
  return STARCAT_OK;
}

/* List the centroids around the reference, the nearest first. */
static void list_voters(const starcat_call *call, uint32_t reference, surroundings *s) {
  const starcat_workspace *w = call->work;
  const real error = STARCAT_SIDE_TOLERANCE * call->tolerance_rad;
  const real radius_rad = call->image->neighbours->radius_rad;
  real axes[2][3], apart[STARCAT_MAX_VOTERS + 1u];
  make_axes(w->body[reference], axes);
  s->reference = reference;
  s->count = 0;
  for (uint32_t i = 0; i < call->own->count; i++) {
    const real own = starcat_angle_of_chord(starcat_chord_square(w->body[reference], w->body[i]));
    /* A centroid that is too near has no position angle. */
    if ((own >= R(2.0) * error) && (own - error <= radius_rad)) {
      uint32_t at = s->count;
      while ((at > 0u) && (own < apart[at - 1u])) {
        apart[at] = apart[at - 1u];
        s->voters[at] = s->voters[at - 1u];
        at--;
      }
      voter *v = s->voters + at;
      apart[at] = own;
      v->centroid = (uint16_t)i;
      v->nearest = (uint16_t)find_apart(own - error, radius_rad);
      v->depth = (uint16_t)(find_apart(own + error, radius_rad) - v->nearest);
      v->turn = (uint8_t)find_turn(find_angle(axes, w->body[i]));
      v->sine = STARCAT_SIN(own);
      v->brightest = 0;
      v->range = UNKNOWN - 1u;
      if ((call->noise_mag > R(0.0)) && (w->magnitude[i] < STARCAT_UNKNOWN_MAGNITUDE)) {
        const real reach = STARCAT_MAG_DEVIATIONS * call->noise_mag;
        v->brightest = (uint8_t)find_magnitude(w->magnitude[i] - reach);
        v->range = (uint8_t)(find_magnitude(w->magnitude[i] + reach) - v->brightest);
      }
      s->count += (uint32_t)(s->count < STARCAT_MAX_VOTERS);
    }
  }
}

static uint32_t count_bits(uint32_t bits) {
  const uint32_t pairs = bits - (bits >> 1 & 0x55555555u);
  const uint32_t fours = (pairs & 0x33333333u) + (pairs >> 2 & 0x33333333u);
  return (((fours + (fours >> 4)) & 0x0f0f0f0fu) * 0x01010101u) >> 24;
}

/* The neighbours of a group that a voter can be by separation: they follow each other. */
typedef struct {
  uint32_t start, stop;
} run;

/* Index of the first neighbour of a group at a separation, or farther. */
static uint32_t find_first(const starcat_neighbours *table, uint32_t group, uint32_t apart) {
  if (apart > LAST_APART) {
    const uint32_t end = table->first[((size_t)group + 1u) * RINGS];
    return end < table->capacity ? end : table->capacity;
  }
  const uint32_t *first = table->first + (size_t)group * RINGS + apart / PER_RING;
  const uint32_t least = find_place(apart, 0);
  const uint32_t stop = first[1] < table->capacity ? first[1] : table->capacity;
  uint32_t at = first[0] < stop ? first[0] : stop, left = stop - at;
  while (left > 0u) { /* skip half of the places that are left if they are below: no branch */
    const uint32_t half = (left + 1u) / 2u;
    at += half * (uint32_t)(table->neighbour[at + half - 1u].place < least);
    left -= half;
  }
  return at;
}

/* Find the neighbours of a group that each voter can be, and their number for all voters together.
 * Returns 0 if the budget is used up. */
static int find_runs(const starcat_call *call, const surroundings *s, uint32_t group,
                     run runs[STARCAT_MAX_VOTERS], uint32_t *places) {
  const starcat_neighbours *table = call->image->neighbours;
  *places = 0;
  for (uint32_t n = 0; n < s->count; n++) {
    const voter *v = s->voters + n;
    runs[n].start = find_first(table, group, v->nearest);
    runs[n].stop = find_first(table, group, (uint32_t)v->nearest + v->depth + 1u);
    *places += runs[n].stop > runs[n].start ? runs[n].stop - runs[n].start : 0u;
  }
  return starcat_spend_steps(call, STEPS_OF_GROUP + STEPS_OF_RUN * s->count + *places);
}

static uint32_t find_bin(const starcat_neighbour *b, const voter *v) {
  return (((uint32_t)b->turn - v->turn) & 255u) / PER_BIN;
}

static uint32_t is_like(const starcat_neighbour *b, const voter *v) {
  return (uint32_t)((uint32_t)b->magnitude - v->brightest <= v->range) |
         (uint32_t)(b->magnitude == UNKNOWN);
}

/* Count the votes for each star of a group by bins, each vote of a centroid. */
static void count_group(const starcat_call *call, const surroundings *s,
                        const run runs[STARCAT_MAX_VOTERS]) {
  uint8_t(*votes)[STARCAT_BINS] = call->work->votes;
  for (uint32_t k = 0; k < STARCAT_GROUP; k++) {
    for (uint32_t bin = 0; bin < STARCAT_BINS; bin++) {
      votes[k][bin] = 0;
    }
  }
  for (uint32_t n = 0; n < s->count; n++) {
    const voter *v = s->voters + n;
    for (uint32_t k = runs[n].start; k < runs[n].stop; k++) {
      const starcat_neighbour *b = call->image->neighbours->neighbour + k;
      uint8_t *to = &votes[b->place % STARCAT_GROUP][find_bin(b, v)];
      *to = (uint8_t)(*to + (is_like(b, v) & (uint32_t)(*to < MOST_IN_BIN)));
    }
  }
}

/* The evidence of votes, of which chance gives each bin its share. */
static real weigh_votes(uint32_t most, uint32_t total) {
  const real expected = R(2.0) / (real)STARCAT_BINS * (real)total + EXPECTED_AT_LEAST;
  return (most >= MIN_VOTES) && ((real)most > expected)
             ? (real)most * (STARCAT_LOG((real)most / expected) - R(1.0)) + expected
             : R(0.0);
}

/* The smallest number of votes, without any other, that has at least a weight. */
static uint8_t find_enough(real least) {
  uint32_t most = MIN_VOTES;
  for (uint32_t step = STARCAT_BINS; step > 0u; step /= 2u) {
    const uint32_t next = most + step;
    most = weigh_votes(next - 1u, next - 1u) < least ? next : most;
  }
  return (uint8_t)most;
}

/* The largest weight that the votes for a star can have; 0 if not even the best bins have enough of
 * them. Written so that compilers vectorize it. */
static real bound_weight(const uint8_t votes[STARCAT_BINS], uint8_t enough) {
  uint8_t most = (uint8_t)(votes[STARCAT_BINS - 1u] + votes[0]);
  uint32_t total = 0;
  for (uint32_t k = 0; k < STARCAT_BINS - 1u; k++) {
    const uint8_t both = (uint8_t)(votes[k] + votes[k + 1u]);
    most = most < both ? both : most;
  }
  if (most < enough) {
    return R(0.0);
  }
  for (uint32_t k = 0; k < STARCAT_BINS; k++) {
    total += votes[k];
  }
  return most < MOST_IN_BIN ? weigh_votes(most, total) : LARGEST_WEIGHT;
}

/* Count the centroids that vote for a star. */
static void count_votes(const starcat_call *call, const surroundings *s,
                        const run runs[STARCAT_MAX_VOTERS], leader *star) {
  uint32_t voted[STARCAT_BINS] = {0}, total = 0, most = 0; /* a bit for each centroid */
  for (uint32_t n = 0; n < s->count; n++) {
    const voter *v = s->voters + n;
    for (uint32_t k = runs[n].start; k < runs[n].stop; k++) {
      const starcat_neighbour *b = call->image->neighbours->neighbour + k;
      if (((b->place ^ star->row) % STARCAT_GROUP == 0u) && (is_like(b, v) != 0u)) {
        voted[find_bin(b, v)] |= (uint32_t)1 << n;
        total++;
      }
    }
  }
  for (uint32_t k = 0; k < STARCAT_BINS; k++) {
    const uint32_t both = count_bits(voted[k] | voted[(k + 1u) % STARCAT_BINS]);
    if (both > most) {
      most = both;
      star->turn = PER_BIN * k;
    }
  }
  star->weight = weigh_votes(most, total);
}

/* A pair of a centroid and a star that voted: the rotation of the frame by it, and its error. */
typedef struct {
  uint16_t voter, near;
  real turn_rad, error_rad;
} vote;

/* Reduce an angle of up to two turns in either direction to half a turn in either direction. */
static real within_turn(real angle_rad) {
  const real turns = (real)round_units(angle_rad / TURN_RAD + R(2.0), R(4.0)) - R(2.0);
  return angle_rad - TURN_RAD * turns;
}

/* List the pairs that voted for a star. Returns their number; 0 if the budget is used up. */
static uint32_t list_votes(const starcat_call *call, const surroundings *s, const leader *star,
                           const real centre[3], vote *votes) {
  starcat_workspace *w = call->work;
  const real radius_rad = call->image->neighbours->radius_rad;
  const real error = STARCAT_SIDE_TOLERANCE * call->tolerance_rad;
  const real middle = ((real)(star->turn + PER_BIN) - R(0.5)) / TURNS;
  real axes[2][3], own[2][3];
  uint32_t count = 0;
  const uint32_t n_near = gather_around(call, centre, radius_rad);
  if ((n_near > STARCAT_MAX_STARS) || !starcat_spend_steps(call, n_near * (s->count + 1u))) {
    return 0;
  }
  make_axes(centre, axes);
  make_axes(w->body[s->reference], own);
  for (uint32_t k = 0; k < n_near; k++) {
    const real chord = starcat_chord_square(centre, w->near_icrs[k]);
    const uint32_t apart = find_apart(starcat_angle_of_chord(chord), radius_rad);
    const real angle = find_angle(axes, w->near_icrs[k]);
    const uint32_t turn = find_turn(angle);
    for (uint32_t n = 0; (n < s->count) && (count < MOST_VOTES); n++) {
      const voter *v = s->voters + n;
      if ((apart - v->nearest <= v->depth) &&
          (((turn - v->turn - star->turn) & 255u) < 2u * PER_BIN) &&
          starcat_is_compatible(call, v->centroid, w->near_row[k])) {
        votes[count].voter = v->centroid;
        votes[count].near = (uint16_t)k;
        votes[count].turn_rad = within_turn(angle - find_angle(own, w->body[v->centroid]) - middle);
        votes[count].error_rad = error / v->sine;
        count++;
      }
    }
  }
  return count;
}

/* Whether a vote is preferred to another vote that as many votes agree with. */
static int is_first_vote(const vote *a, const vote *b) {
  return a->voter != b->voter ? a->voter < b->voter
                              : starcat_absolute(a->turn_rad) < starcat_absolute(b->turn_rad);
}

/* Fit the attitude to the largest set of pairs that voted for a star and agree with one of them,
 * and try it. Returns 1 if the search can end. */
static int try_star(starcat_call *call, const surroundings *s, const leader *star) {
  starcat_workspace *w = call->work;
  vote votes[MOST_VOTES];
  real centre[3], m[9];
  uint32_t best = 0, most = 0, n_pairs = 0;
  starcat_read_star(call->image, star->row, centre);
  const uint32_t count = list_votes(call, s, star, centre, votes);
  for (uint32_t k = 0; k < count; k++) {
    uint32_t agreeing = 0;
    for (uint32_t n = 0; n < count; n++) {
      agreeing +=
          (uint32_t)(starcat_absolute(votes[n].turn_rad - votes[k].turn_rad) <= votes[n].error_rad);
    }
    if ((agreeing > most) || ((agreeing == most) && is_first_vote(votes + k, votes + best))) {
      most = agreeing;
      best = k;
    }
  }
  if ((most == 0u) || !starcat_fit_triad(w->body[s->reference], w->body[votes[best].voter], centre,
                                         w->near_icrs[votes[best].near], m)) {
    return call->own->steps_left == 0u;
  }
  for (uint32_t n = 0; n < count; n++) {
    if (starcat_absolute(votes[n].turn_rad - votes[best].turn_rad) <= votes[n].error_rad) {
      copy_vector(w->body[votes[n].voter], w->seen_body[n_pairs]);
      copy_vector(w->near_icrs[votes[n].near], w->seen_icrs[n_pairs]);
      n_pairs++;
    }
  }
  copy_vector(w->body[s->reference], w->seen_body[n_pairs]);
  copy_vector(centre, w->seen_icrs[n_pairs]);
  starcat_refine_attitude(m, &w->seen_body[0][0], &w->seen_icrs[0][0], NULL, NULL, n_pairs + 1u, 2);
  return starcat_try_attitude(call, m, R(1.0));
}

/* Whether a star has more votes than another star, or as many and is farther south. */
static int is_heavier(const leader *a, const leader *b) {
  return (a->weight > b->weight) || (!(a->weight < b->weight) && (a->north < b->north));
}

/* Insert a star among the stars with the most votes. Returns their number. */
static uint32_t keep_star(leader *kept, uint32_t count, const leader *star) {
  uint32_t at = count;
  while ((at > 0u) && (is_heavier(star, kept + at - 1u) != 0)) {
    kept[at] = kept[at - 1u];
    at--;
  }
  kept[at] = *star;
  return count < MAX_KEPT ? count + 1u : count;
}

/* Keep the stars of a group with the most votes. Returns 0 if the budget is used up. */
static int keep_group(const starcat_call *call, const surroundings *s, uint32_t group, leader *kept,
                      uint32_t *count) {
  const uint32_t first = group * STARCAT_GROUP, left = call->image->n_stars - first;
  run runs[STARCAT_MAX_VOTERS];
  uint32_t places;
  if (!find_runs(call, s, group, runs, &places)) {
    return 0;
  }
  count_group(call, s, runs);
  real least = *count < MAX_KEPT ? R(0.0) : kept[MAX_KEPT - 1u].weight;
  uint8_t enough = find_enough(least);
  for (uint32_t k = 0; (k < STARCAT_GROUP) && (k < left); k++) {
    leader star = {first + k, 0, 0, R(0.0)};
    const real most = bound_weight(call->work->votes[k], enough);
    if ((most > R(0.0)) && !(most < least) &&
        (starcat_is_compatible(call, s->reference, star.row) != 0)) {
      if (!starcat_spend_steps(call, STEPS_OF_STAR + places / PLACES_OF_STEP)) {
        return 0;
      }
      count_votes(call, s, runs, &star);
      if (star.weight > R(0.0)) {
        star.north = call->image->directions[3u * (size_t)star.row + 2u];
        *count = keep_star(kept, *count, &star);
        least = *count < MAX_KEPT ? R(0.0) : kept[MAX_KEPT - 1u].weight;
        enough = find_enough(least);
      }
    }
  }
  return 1;
}

/* The number of references that include a star, except with the probability of a miss, if a frame has
 * as few stars as can typically be accepted: its first centroids are stars as often as any. */
uint32_t starcat_count_references(const starcat_call *call) {
  const starcat_camera *c = &call->camera.given;
  const real area = c->width_px * c->height_px / (call->focal_px * call->focal_px);
  const uint32_t stars =
      (uint32_t)((real)call->image->n_stars * starcat_smaller(area / FULL_SPHERE, R(1.0)) + R(0.5));
  const real sigma_px =
      call->noise_px > R(0.0) ? call->noise_px : call->tolerance_px / STARCAT_SIGMAS_OF_TOLERANCE;
  const uint32_t least = starcat_find_least_matches(call, stars, sigma_px);
  const uint32_t count = call->own->count, others = count > least ? count - least : 0u;
  real miss = R(1.0);
  uint32_t needed = 0;
  while ((needed < count) && (miss > MISS_PROBABILITY)) {
    miss *= needed < others ? (real)(others - needed) / (real)(count - needed) : R(0.0);
    needed++;
  }
  return needed;
}

/* Search with the table of the image, which must not be null. */
void starcat_search_votes(starcat_call *call, uint32_t references) {
  const starcat_neighbours *table = call->image->neighbours;
  surroundings s;
  leader kept[MAX_KEPT + 1u];
  if (table->n_stars != call->image->n_stars) {
    return;
  }
  for (uint32_t r = 0; (r < call->own->count) && (r < references); r++) {
    uint32_t count = 0;
    if (call->work->best.log_chance <= STARCAT_LOG_LIKELY) {
      return; /* the attitude is likely, and no other search makes it certain */
    }
    list_voters(call, r, &s);
    for (uint32_t group = 0; group < number_of_groups(call->image); group++) {
      if (!keep_group(call, &s, group, kept, &count)) {
        return;
      }
    }
    for (uint32_t n = 0; n < count; n++) {
      if (try_star(call, &s, kept + n) != 0) {
        return;
      }
    }
  }
}
