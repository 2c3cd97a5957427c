/* Votes for the rotation of a frame about one of its centroids.
 *
 * If centroids are inaccurate, or if most of them are false, a triangle of centroids resembles
 * thousands of triangles of stars. The stars around the right star of a centroid agree on the
 * rotation of the frame about it; the stars around another star do not (compare Fu et al. 2025,
 * whose patterns are such rotations around a star).
 *
 *     search_votes:
 *         for each of the first centroids, the reference:
 *             list the centroids around it: separation, position angle, magnitude
 *             for each star that the reference may be by its magnitude:
 *                 for each neighbour of the star, and each centroid that the neighbour may be by
 *                 separation and magnitude: vote for the difference of their position angles
 *                 keep the star, if it is among those with the most votes in two adjacent bins
 *             for each star that was kept, the one with the most votes first:
 *                 fit the attitude to the pairs that voted for its bins, and try it  [verify.c]
 *
 * The same rules as the ground's starcat/matcher/methods/votes.py.
 *
 * SPDX-License-Identifier: MIT
 */
#include "internal.h"

#define MAX_REFERENCES 12u
#define RINGS 128u /* bins of separation; each lists the centroids that its stars can be */
#define BINS 64u
#define MAX_KEPT 6u /* stars tried per reference */
#define MIN_VOTES 3u
#define EXPECTED_AT_LEAST R(0.3) /* least expected votes of two bins by chance */
#define STEPS_OF_STAR 32u        /* steps of counting the votes for a star */
#if STARCAT_MAX_CENTROIDS > 32   /* STARCAT_MAX_VOTERS: the fit also includes the reference */
#define MOST_VOTES STARCAT_MAX_VOTERS
#else
#define MOST_VOTES (STARCAT_MAX_CENTROIDS - 1u)
#endif

/* Units of neighbours. Separations: the largest over APART. Position angles: 1/256 of a turn.
 * Magnitudes: 1/16, counted from BRIGHTEST. */
#define APART R(65535.0)
#define PER_RING 512u
#define PER_BIN (256u / BINS)
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
  uint32_t most;                         /* voters of one ring */
  voter voters[STARCAT_MAX_VOTERS + 1u]; /* one more, for the voter that drops out */
  uint8_t first[RINGS], stop[RINGS];     /* voters that a star of each ring can be */
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
  for (uint32_t row = 0; row < image->n_stars; row++) {
    real centre[3], axes[2][3];
    starcat_read_star(image, row, centre);
    make_axes(centre, axes);
    call.own->steps_left = UINT32_MAX;
    const uint32_t count = gather_around(&call, centre, table->radius_rad);
    if (count > STARCAT_MAX_STARS) {
      return STARCAT_E_CAPACITY;
    }
    table->first[row] = total;
    for (uint32_t k = 0; k < count; k++) {
      const uint32_t other = starcat_limit_place(work->near_row[k], image->n_stars);
      if ((other != row) && (total < table->capacity)) {
        const int16_t stored = image->magnitudes[other];
        starcat_neighbour *to = table->neighbour + total;
        to->apart = (uint16_t)find_apart(
            starcat_angle_of_chord(starcat_chord_square(centre, work->near_icrs[k])),
            table->radius_rad);
        to->turn = (uint8_t)find_turn(find_angle(axes, work->near_icrs[k]));
        to->magnitude =
            (uint8_t)(stored == INT16_MIN ? UNKNOWN : find_magnitude(R(0.001) * (real)stored));
      }
      total += (uint32_t)(other != row);
    }
  }
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
  uint32_t first = 0, stop = 0;
  s->reference = reference;
  s->count = 0;
  s->most = 0;
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
      if ((call->mag_reach > R(0.0)) && (w->magnitude[i] < STARCAT_UNKNOWN_MAGNITUDE)) {
        v->brightest = (uint8_t)find_magnitude(w->magnitude[i] - call->mag_reach);
        v->range = (uint8_t)(find_magnitude(w->magnitude[i] + call->mag_reach) - v->brightest);
      }
      s->count += (uint32_t)(s->count < STARCAT_MAX_VOTERS);
    }
  }
  for (uint32_t ring = 0; ring < RINGS; ring++) {
    const uint32_t nearest = ring * PER_RING, farthest = nearest + PER_RING - 1u;
    while ((first < s->count) &&
           ((uint32_t)s->voters[first].nearest + s->voters[first].depth < nearest)) {
      first++;
    }
    while ((stop < s->count) && (s->voters[stop].nearest <= farthest)) {
      stop++;
    }
    s->first[ring] = (uint8_t)first;
    s->stop[ring] = (uint8_t)stop;
    s->most = s->most < stop - first ? stop - first : s->most;
  }
}

static uint32_t count_bits(uint32_t bits) {
  const uint32_t pairs = bits - (bits >> 1 & 0x55555555u);
  const uint32_t fours = (pairs & 0x33333333u) + (pairs >> 2 & 0x33333333u);
  return (((fours + (fours >> 4)) & 0x0f0f0f0fu) * 0x01010101u) >> 24;
}

/* Count the centroids that vote for a star. Returns 0 if the budget is used up. */
static int count_votes(const starcat_call *call, const surroundings *s, leader *star) {
  const starcat_neighbours *table = call->image->neighbours;
  const uint32_t first = table->first[star->row], stop = table->first[star->row + 1u];
  const int is_sound = (stop <= table->capacity) && (stop - first < STARCAT_MAX_STARS);
  const uint32_t count = is_sound ? stop - first : 0u;
  uint32_t voted[BINS] = {0}, total = 0, most = 0; /* a bit for each centroid */
  uint8_t votes[BINS] = {0};
  if (!starcat_spend_steps(call, STEPS_OF_STAR + count * (1u + s->most / 2u))) {
    return 0;
  }
  for (uint32_t k = 0; k < count; k++) {
    const starcat_neighbour b = table->neighbour[first + k];
    const uint32_t ring = b.apart / PER_RING, end = s->stop[ring];
    for (uint32_t n = s->first[ring]; n < end; n++) {
      const voter *v = s->voters + n;
      const uint32_t is_near = (uint32_t)((uint32_t)b.apart - v->nearest <= v->depth);
      const uint32_t is_like = (uint32_t)((uint32_t)b.magnitude - v->brightest <= v->range) |
                               (uint32_t)(b.magnitude == UNKNOWN);
      const uint32_t bin = ((b.turn - v->turn) & 255u) / PER_BIN, may = is_near & is_like;
      votes[bin] = (uint8_t)(votes[bin] + (may & ~(voted[bin] >> n)));
      voted[bin] |= may << n;
      total += may;
    }
  }
  for (uint32_t k = 0; k < BINS; k++) {
    const uint32_t next = (k + 1u) % BINS;
    if ((uint32_t)votes[k] + votes[next] > most) {
      const uint32_t both = count_bits(voted[k] | voted[next]);
      if (both > most) {
        most = both;
        star->turn = PER_BIN * k;
      }
    }
  }
  /* Expected by chance: each bin has its share of all votes. */
  const real expected = R(2.0) / (real)BINS * (real)total + EXPECTED_AT_LEAST;
  star->weight = R(0.0);
  if ((most >= MIN_VOTES) && ((real)most > expected)) {
    star->weight = (real)most * (STARCAT_LOG((real)most / expected) - R(1.0)) + expected;
  }
  return 1;
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

/* Search with the table of the image, which must not be null. */
void starcat_search_votes(starcat_call *call) {
  const starcat_neighbours *table = call->image->neighbours;
  surroundings s;
  leader kept[MAX_KEPT + 1u], star = {0, 0, 0, R(0.0)};
  if (table->n_stars != call->image->n_stars) {
    return;
  }
  for (uint32_t r = 0; (r < call->own->count) && (r < MAX_REFERENCES); r++) {
    uint32_t count = 0;
    if (call->work->best.log_chance <= STARCAT_LOG_LIKELY) {
      return; /* the attitude is likely, and no other search makes it certain */
    }
    list_voters(call, r, &s);
    if (!starcat_spend_steps(call, call->image->n_stars + RINGS * s.count)) {
      return;
    }
    for (uint32_t row = 0; row < call->image->n_stars; row++) {
      star.row = row;
      if (starcat_is_compatible(call, r, row) != 0) {
        if (!count_votes(call, &s, &star)) {
          return;
        }
        if (star.weight > R(0.0)) {
          star.north = call->image->directions[3u * (size_t)row + 2u];
          count = keep_star(kept, count, &star);
        }
      }
    }
    for (uint32_t n = 0; n < count; n++) {
      if (try_star(call, &s, kept + n) != 0) {
        return;
      }
    }
  }
}
