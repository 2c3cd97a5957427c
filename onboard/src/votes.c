/* Votes for how a frame is turned about one of its centroids.
 *
 * Where centroids are far from their places, or most of them are false, a triangle of centroids is
 * like thousands of triangles of stars. The stars around the right star of a centroid agree on how
 * the frame is turned about it; the stars around another star agree on nothing (compare Fu et al.
 * 2025, whose patterns are such turns around a star).
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
#define RINGS 128u /* of separations; a ring tells which centroids a star of it may be */
#define BINS 64u
#define MAX_KEPT 6u /* stars of one reference that are tried */
#define MIN_VOTES 3u
#define EXPECTED_AT_LEAST R(0.3) /* votes of two bins by chance, where there are few */
#define STEPS_OF_STAR 32u        /* of counting the votes for a star */

/* The units of neighbours: of separations, the largest one over this; of position angles, a turn
 * over 256; of magnitudes, a sixteenth from the brightest one on. */
#define APART R(65535.0)
#define PER_RING 512u
#define PER_BIN (256u / BINS)
#define TURNS R(40.743665431525206) /* 256 / 2 pi */
#define PER_MAGNITUDE R(16.0)
#define BRIGHTEST R(-2.0)
#define UNKNOWN 255u

#define MIN_RADIUS_RAD R(1e-4)
#define MAX_RADIUS_RAD R(1.57)

/* A centroid around the reference, in the units of neighbours. */
typedef struct {
  uint16_t centroid, nearest, farthest;
  uint8_t brightest, faintest, turn;
  real sine; /* of the separation */
} voter;

typedef struct {
  uint32_t reference, count;
  uint32_t most; /* voters of one ring */
  voter voters[STARCAT_MAX_VOTERS];
  uint8_t first[RINGS], stop[RINGS]; /* the voters that a star of a ring may be */
} surroundings;

/* A star that the reference may be. */
typedef struct {
  uint32_t row, turn;
  real weight;
} leader;

static void copy_vector(const real from[3], real to[3]) {
  to[0] = from[0];
  to[1] = from[1];
  to[2] = from[2];
}

/* Two directions at right angles to a direction and to each other. */
static void make_axes(const real u[3], real axes[2][3]) {
  const int is_polar = u[2] * u[2] > R(0.5);
  const real pole[3] = {R(0.0), is_polar ? R(1.0) : R(0.0), is_polar ? R(0.0) : R(1.0)};
  starcat_cross(pole, u, axes[0]);
  const real scale = R(1.0) / STARCAT_SQRT(starcat_dot(axes[0], axes[0]));
  for (uint32_t k = 0; k < 3u; k++) {
    axes[0][k] *= scale;
  }
  starcat_cross(u, axes[0], axes[1]);
}

static uint32_t find_turn(real axes[2][3], const real v[3]) {
  const real turn = STARCAT_ATAN2(starcat_dot(axes[0], v), starcat_dot(axes[1], v));
  return (uint32_t)(TURNS * turn + R(256.5)) & 255u;
}

/* A magnitude in the units of neighbours; bright and faint ones have the first and the last unit. */
static uint32_t find_magnitude(real magnitude) {
  const real units = PER_MAGNITUDE * (magnitude - BRIGHTEST) + R(0.5);
  if (!(units > R(0.0))) {
    return 0;
  }
  return units < (real)UNKNOWN ? (uint32_t)units : UNKNOWN - 1u;
}

/* A separation in the units of neighbours, from 0 to one more than the largest. */
static uint32_t find_apart(real apart_rad, real radius_rad) {
  const real units = APART * apart_rad / radius_rad + R(0.5);
  if (!(units > R(0.0))) {
    return 0;
  }
  return units < APART ? (uint32_t)units : (uint32_t)APART;
}

starcat_status starcat_list_neighbours(const starcat_image *image, starcat_workspace *work,
                                       starcat_neighbours *table) {
  starcat_call call;
  uint32_t total = 0;
  if ((image == NULL) || (work == NULL) || (table == NULL) || (table->first == NULL)) {
    return STARCAT_E_NULL;
  }
  if (!starcat_are_finite(&table->radius_rad, 1) ||
      !starcat_is_between(table->radius_rad, MIN_RADIUS_RAD, MAX_RADIUS_RAD)) {
    return STARCAT_E_OPTIONS;
  }
  call.image = image;
  call.work = work;
  call.own = &call.counters;
  const real cos_radius = STARCAT_COS(table->radius_rad);
  const real sin_radius = STARCAT_SIN(table->radius_rad);
  for (uint32_t row = 0; row < image->n_stars; row++) {
    real centre[3], axes[2][3];
    starcat_read_star(image, row, centre);
    make_axes(centre, axes);
    call.own->steps_left = UINT32_MAX;
    const uint32_t count = starcat_gather_stars(&call, centre, cos_radius, sin_radius,
                                                STARCAT_MAX_STARS, work->near_row, work->near_icrs);
    if (count > STARCAT_MAX_STARS) {
      return STARCAT_E_CAPACITY;
    }
    table->first[row] = total;
    for (uint32_t k = 0; k < count; k++) {
      const int16_t stored = image->magnitudes[work->near_row[k]];
      if (work->near_row[k] == row) {
        continue;
      }
      if (total < table->capacity) {
        starcat_neighbour *to = table->neighbour + total;
        to->apart = (uint16_t)find_apart(
            starcat_angle_of_chord(starcat_chord_square(centre, work->near_icrs[k])),
            table->radius_rad);
        to->turn = (uint8_t)find_turn(axes, work->near_icrs[k]);
        to->magnitude =
            (uint8_t)(stored == INT16_MIN ? UNKNOWN : find_magnitude(R(0.001) * (real)stored));
      }
      total++;
    }
  }
  table->first[image->n_stars] = total;
  table->n_stars = image->n_stars;
  return total <= table->capacity ? STARCAT_OK : STARCAT_E_CAPACITY;
}

/* List the centroids around the reference, the nearest first. */
static void list_voters(const starcat_call *call, uint32_t reference, surroundings *s) {
  const starcat_workspace *w = call->work;
  const real error = STARCAT_SIDE_TOLERANCE * call->tolerance_rad;
  const real radius_rad = call->image->neighbours->radius_rad;
  real axes[2][3], apart[STARCAT_MAX_VOTERS];
  make_axes(w->body[reference], axes);
  s->reference = reference;
  s->count = 0;
  s->most = 0;
  for (uint32_t i = 0; i < call->own->count; i++) {
    const real own = starcat_angle_of_chord(starcat_chord_square(w->body[reference], w->body[i]));
    uint32_t at = s->count < STARCAT_MAX_VOTERS ? s->count : STARCAT_MAX_VOTERS - 1u;
    /* A centroid that is too near has no position angle. */
    if ((own < R(2.0) * error) || (own - error > radius_rad) ||
        ((s->count == STARCAT_MAX_VOTERS) && !(own < apart[at]))) {
      continue;
    }
    s->count = at + 1u;
    while ((at > 0u) && (own < apart[at - 1u])) {
      apart[at] = apart[at - 1u];
      s->voters[at] = s->voters[at - 1u];
      at--;
    }
    apart[at] = own;
    voter *v = s->voters + at;
    v->centroid = (uint16_t)i;
    v->nearest = (uint16_t)find_apart(own - error, radius_rad);
    v->farthest = (uint16_t)find_apart(own + error, radius_rad);
    v->turn = (uint8_t)find_turn(axes, w->body[i]);
    v->sine = STARCAT_SIN(own);
    v->brightest = 0;
    v->faintest = UNKNOWN - 1u;
    if ((call->mag_reach > R(0.0)) && (w->magnitude[i] < STARCAT_UNKNOWN_MAGNITUDE)) {
      v->brightest = (uint8_t)find_magnitude(w->magnitude[i] - call->mag_reach);
      v->faintest = (uint8_t)find_magnitude(w->magnitude[i] + call->mag_reach);
    }
  }
  for (uint32_t ring = 0; ring < RINGS; ring++) {
    const uint32_t nearest = ring * PER_RING, farthest = nearest + PER_RING - 1u;
    s->first[ring] = 0;
    s->stop[ring] = 0;
    for (uint32_t n = s->count; n > 0u; n--) {
      if ((s->voters[n - 1u].nearest <= farthest) && (s->voters[n - 1u].farthest >= nearest)) {
        s->first[ring] = (uint8_t)(n - 1u);
        s->stop[ring] = s->stop[ring] == 0u ? (uint8_t)n : s->stop[ring];
      }
    }
    if ((uint32_t)s->stop[ring] - s->first[ring] > s->most) {
      s->most = (uint32_t)s->stop[ring] - s->first[ring];
    }
  }
}

static uint32_t count_bits(uint32_t bits) {
  bits -= bits >> 1 & 0x55555555u;
  bits = (bits & 0x33333333u) + (bits >> 2 & 0x33333333u);
  return (((bits + (bits >> 4)) & 0x0f0f0f0fu) * 0x01010101u) >> 24;
}

/* Count the centroids that vote for a star. Returns 0 if the budget is used up. */
static int count_votes(const starcat_call *call, const surroundings *s, leader *star) {
  const starcat_neighbours *table = call->image->neighbours;
  uint32_t voted[BINS] = {0}, total = 0, most = 0; /* a bit for each centroid */
  uint8_t votes[BINS] = {0};
  const uint32_t first = table->first[star->row], stop = table->first[star->row + 1u];
  if (!starcat_spend_steps(
          call, STEPS_OF_STAR + (stop > first ? stop - first : 0u) * (1u + s->most / 2u))) {
    return 0;
  }
  for (uint32_t at = first; (at < stop) && (at < table->capacity); at++) {
    const starcat_neighbour b = table->neighbour[at];
    const uint32_t ring = b.apart / PER_RING, end = s->stop[ring];
    for (uint32_t n = s->first[ring]; n < end; n++) {
      const voter *v = s->voters + n;
      const uint32_t is_near =
          (uint32_t)(b.apart >= v->nearest) & (uint32_t)(b.apart <= v->farthest);
      const uint32_t is_like =
          ((uint32_t)(b.magnitude >= v->brightest) & (uint32_t)(b.magnitude <= v->faintest)) |
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
  /* By chance a bin would have its share of all votes. */
  const real expected = R(2.0) / (real)BINS * (real)total + EXPECTED_AT_LEAST;
  star->weight = R(0.0);
  if ((most >= MIN_VOTES) && ((real)most > expected)) {
    star->weight = (real)most * (STARCAT_LOG((real)most / expected) - R(1.0)) + expected;
  }
  return 1;
}

/* A pair of a centroid and a star that voted: how the frame is turned by it, and the error of that. */
typedef struct {
  uint16_t voter, near;
  real turn_rad, error_rad;
} vote;

/* How a frame is turned about the reference if a centroid is a star, from the middle of two bins. */
static real measure_turn(real own[2][3], const real body[3], real axes[2][3], const real icrs[3],
                         uint32_t bin_turn) {
  const real x = starcat_dot(own[0], body), y = starcat_dot(own[1], body);
  const real p = starcat_dot(axes[0], icrs), q = starcat_dot(axes[1], icrs);
  const real middle = ((real)(bin_turn + PER_BIN) - R(0.5)) / TURNS;
  const real c = STARCAT_COS(middle), t = STARCAT_SIN(middle);
  const real sine = p * y - q * x, cosine = p * x + q * y;
  return STARCAT_ATAN2(sine * c - cosine * t, cosine * c + sine * t);
}

/* List the pairs that voted for a star. Returns their number; 0 if the budget is used up. */
static uint32_t list_votes(const starcat_call *call, const surroundings *s, const leader *star,
                           const real centre[3], vote *votes) {
  starcat_workspace *w = call->work;
  const real radius_rad = call->image->neighbours->radius_rad;
  const real error = STARCAT_SIDE_TOLERANCE * call->tolerance_rad;
  real axes[2][3], own[2][3];
  uint32_t count = 0;
  const uint32_t n_near =
      starcat_gather_stars(call, centre, STARCAT_COS(radius_rad), STARCAT_SIN(radius_rad),
                           STARCAT_MAX_STARS, w->near_row, w->near_icrs);
  if ((n_near > STARCAT_MAX_STARS) || !starcat_spend_steps(call, n_near * (s->count + 1u))) {
    return 0;
  }
  make_axes(centre, axes);
  make_axes(w->body[s->reference], own);
  for (uint32_t k = 0; k < n_near; k++) {
    const real chord = starcat_chord_square(centre, w->near_icrs[k]);
    const uint32_t apart = find_apart(starcat_angle_of_chord(chord), radius_rad);
    const uint32_t turn = find_turn(axes, w->near_icrs[k]);
    for (uint32_t n = 0; (n < s->count) && (count < STARCAT_MAX_VOTERS); n++) {
      const voter *v = s->voters + n;
      if ((apart >= v->nearest) && (apart <= v->farthest) &&
          (((turn - v->turn - star->turn) & 255u) < 2u * PER_BIN) &&
          starcat_is_compatible(call, v->centroid, w->near_row[k])) {
        votes[count].voter = v->centroid;
        votes[count].near = (uint16_t)k;
        votes[count].turn_rad =
            measure_turn(own, w->body[v->centroid], axes, w->near_icrs[k], star->turn);
        votes[count].error_rad = error / v->sine;
        count++;
      }
    }
  }
  return count;
}

/* Fit the attitude to the most pairs that voted for a star and agree with one of them, and try it.
 * Returns 1 if the search can end. */
static int try_star(starcat_call *call, const surroundings *s, const leader *star) {
  starcat_workspace *w = call->work;
  vote votes[STARCAT_MAX_VOTERS];
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
    if (agreeing > most) {
      most = agreeing;
      best = k;
    }
  }
  if ((most == 0u) || !starcat_fit_triad(w->body[s->reference], w->body[votes[best].voter], centre,
                                         w->near_icrs[votes[best].near], m)) {
    return call->own->steps_left == 0u;
  }
  for (uint32_t n = 0; (n < count) && (n_pairs < STARCAT_MAX_CENTROIDS - 1u); n++) {
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

/* Keep a star if it has more votes than one of those that are kept. Returns their number. */
static uint32_t keep_star(leader *kept, uint32_t count, const leader *star) {
  uint32_t at = count < MAX_KEPT ? count : MAX_KEPT - 1u;
  if (!(star->weight > R(0.0)) || ((count == MAX_KEPT) && !(star->weight > kept[at].weight))) {
    return count;
  }
  while ((at > 0u) && (star->weight > kept[at - 1u].weight)) {
    kept[at] = kept[at - 1u];
    at--;
  }
  kept[at] = *star;
  return count < MAX_KEPT ? count + 1u : count;
}

void starcat_search_votes(starcat_call *call) {
  const starcat_neighbours *table = call->image->neighbours;
  surroundings s;
  leader kept[MAX_KEPT], star = {0, 0, R(0.0)};
  if ((table == NULL) || (table->n_stars != call->image->n_stars)) {
    return;
  }
  for (uint32_t r = 0; (r < call->own->count) && (r < MAX_REFERENCES); r++) {
    uint32_t count = 0;
    if (call->work->best.log_chance <= STARCAT_LOG_LIKELY) {
      return; /* this is the attitude, and no other search makes it certain */
    }
    list_voters(call, r, &s);
    if (!starcat_spend_steps(call, call->image->n_stars + RINGS * s.count)) {
      return;
    }
    for (star.row = 0; star.row < call->image->n_stars; star.row++) {
      if (starcat_is_compatible(call, r, star.row)) {
        if (!count_votes(call, &s, &star)) {
          return;
        }
        count = keep_star(kept, count, &star);
      }
    }
    for (uint32_t n = 0; n < count; n++) {
      if (try_star(call, &s, kept + n)) {
        return;
      }
    }
  }
}
