/* Votes for how a frame is turned about a centroid: the table of neighbours, and frames that
 * triangles do not solve.
 *
 * SPDX-License-Identifier: MIT
 */
#include <stdlib.h>
#include <string.h>

#include "internal.h"
#include "unit.h"

#define RADIUS_RAD 0.475 /* half of the diagonal of the field */
#define MOST_NEIGHBOURS 160000u
#define STEPS_BEFORE_VOTES 500000u /* about the most that the first triangles take */
#define OUTSIDE 0x5au
#define REFERENCES 12u
#define GROUP 64u /* stars whose neighbours are listed together, by rings of separation */
#define RINGS 32u
#define PER_RING 1024u

static sky_frame truth;
static starcat_call call;
static unit_sky sky; /* triangles of many stars */
static uint32_t first[SKY_MOST_STARS + 1u];
static starcat_neighbour memory[MOST_NEIGHBOURS];
static starcat_neighbours table;

/* List the neighbours of a sky, and let its frames be solved by votes. */
static void list(unit_sky *of, double radius_rad) {
  const starcat_neighbours empty = {(starcat_real)radius_rad, MOST_NEIGHBOURS, 0, first, memory};
  table = empty;
  CHECK_IS(starcat_list_neighbours(&of->image, &unit_work, &table), STARCAT_OK);
  CHECK_IS(table.n_stars, of->image.n_stars);
  of->image.neighbours = &table;
}

/* Look at stars, leave each of them out with a given chance, and add false spots. */
static void look(const unit_sky *at, uint64_t *state, double noise_px, uint32_t n_spots,
                 uint32_t n_false, double missing) {
  uint32_t count = 0;
  sky_look(&at->image, &at->camera, state, noise_px, n_spots, n_false, &truth);
  for (uint32_t i = 0; i < truth.count; i++) {
    if ((truth.star[i] < 0) || (sky_uniform(state) >= missing)) {
      truth.x[count] = truth.x[i];
      truth.y[count] = truth.y[i];
      truth.magnitudes[count] = truth.magnitudes[i];
      truth.star[count++] = truth.star[i];
    }
  }
  truth.count = count;
}

static starcat_frame frame_of(int has_magnitudes) {
  const starcat_frame frame = {truth.count, truth.x, truth.y,
                               has_magnitudes ? truth.magnitudes : NULL, NULL};
  return frame;
}

static starcat_status identify(const unit_sky *with, int has_magnitudes) {
  const starcat_frame frame = frame_of(has_magnitudes);
  return starcat_identify_frame(&with->image, &with->camera, &with->options, &frame, &unit_work,
                                &unit_result);
}

static void begin(const unit_sky *with, int has_magnitudes) {
  const starcat_frame frame = frame_of(has_magnitudes);
  CHECK_IS(starcat_begin_call(&call, &with->image, &with->camera, &with->options, &frame,
                              &unit_work, &unit_result),
           STARCAT_OK);
}

/* The angle by which the answer is off, in pixels at the centre of the field. */
static double error_px(void) {
  double cosine = 0.0;
  for (uint32_t k = 0; k < 4u; k++) {
    cosine += (double)unit_result.q_body_from_icrs[k] * (double)truth.q_body_from_icrs[k];
  }
  return 2.0 * acos(fmin(fabs(cosine), 1.0)) * (double)sky.camera.focal_length_px;
}

/* Check that an answer, if there is one, is right. Returns 1 if there is one. */
static uint32_t check_answer(starcat_status status) {
  if (status == STARCAT_IDENTIFIED) {
    CHECK(unit_wrong_stars(&truth) <= 1u);
    CHECK(error_px() < 12.0);
  }
  return (uint32_t)(status == STARCAT_IDENTIFIED);
}

static void read_unit(const starcat_image *image, uint32_t row, double u[3]) {
  double square = 0.0;
  for (uint32_t k = 0; k < 3u; k++) {
    u[k] = image->directions[3u * row + k] / 2147483647.0;
    square += u[k] * u[k];
  }
  for (uint32_t k = 0; k < 3u; k++) {
    u[k] /= sqrt(square);
  }
}

/* The separation of two directions, and a position angle from a zero of the centre's own. */
static double measure(const double c[3], const double u[3], double *angle) {
  const uint32_t k = (fabs(c[0]) < fabs(c[1])) && (fabs(c[0]) < fabs(c[2])) ? 0u
                     : fabs(c[1]) < fabs(c[2])                              ? 1u
                                                                            : 2u;
  double e[3] = {0.0, 0.0, 0.0}, x = 0.0, y = 0.0, z = 0.0;
  e[k] = 1.0;
  const double a[3] = {e[1] * c[2] - e[2] * c[1], e[2] * c[0] - e[0] * c[2],
                       e[0] * c[1] - e[1] * c[0]};
  const double b[3] = {c[1] * a[2] - c[2] * a[1], c[2] * a[0] - c[0] * a[2],
                       c[0] * a[1] - c[1] * a[0]};
  for (uint32_t n = 0; n < 3u; n++) {
    x += a[n] * u[n];
    y += b[n] * u[n];
    z += c[n] * u[n];
  }
  const double length = sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2]);
  *angle = atan2(x, y);
  return atan2(hypot(x, y) / length, z);
}

/* The unit of a magnitude as the table has it. */
static uint32_t unit_of(int16_t stored) {
  const double units = floor(16.0 * (0.001 * stored + 2.0) + 0.5);
  return stored == INT16_MIN ? 255u : (uint32_t)fmin(fmax(units, 0.0), 254.0);
}

/* If star `other` is the neighbour `b` of a star, in a ring: its azimuth minus that in the table, in
 * units; else -1. */
static double compare(const starcat_image *image, const double centre[3], uint32_t other,
                      uint32_t ring, const starcat_neighbour *b) {
  double u[3], angle;
  read_unit(image, other, u);
  const double apart = measure(centre, u, &angle) / RADIUS_RAD * 32767.0;
  const uint32_t listed = PER_RING * ring + b->place / GROUP;
  if ((fabs(fmin(apart, 32767.0) - listed) > 1.0) ||
      (unit_of(image->magnitudes[other]) != b->magnitude)) {
    return -1.0;
  }
  return fmod(angle * 128.0 / 3.141592653589793 - b->turn + 512.0, 256.0);
}

/* The table has the stars around every star, and no others; its position angles equal the angles on
 * the sky except for a zero point of each star. */
static void check_neighbours(unit_sky *of) {
  list(of, RADIUS_RAD);
  uint32_t unlike = 0, unknown = 0;
  for (uint32_t row = 0; row < table.n_stars; row++) {
    double centre[3], offset = -1.0;
    uint32_t least = 0, most = 0;
    read_unit(&of->image, row, centre);
    for (uint32_t other = 0; other < table.n_stars; other++) {
      double u[3], angle;
      read_unit(&of->image, other, u);
      const double apart = measure(centre, u, &angle);
      least += (uint32_t)((other != row) && (apart < RADIUS_RAD - 1e-5));
      most += (uint32_t)((other != row) && (apart < RADIUS_RAD + 1e-5));
    }
    const uint32_t *rings = first + row / GROUP * RINGS;
    uint32_t count = 0, ring = 0;
    for (uint32_t at = rings[0]; at < rings[RINGS]; at++) {
      int is_found = 0;
      while (at >= rings[ring + 1u]) {
        ring++;
      }
      CHECK((at == rings[ring]) || (memory[at - 1u].place <= memory[at].place));
      if (memory[at].place % GROUP != row % GROUP) {
        continue;
      }
      count++;
      for (uint32_t other = 0; (other < table.n_stars) && !is_found; other++) {
        const double turned =
            other == row ? -1.0 : compare(&of->image, centre, other, ring, &memory[at]);
        const double apart = fabs(turned - offset);
        if ((turned >= 0.0) && ((offset < 0.0) || (apart < 2.0) || (apart > 254.0))) {
          offset = offset < 0.0 ? turned : offset;
          is_found = 1;
        }
      }
      unlike += (uint32_t)!is_found;
      unknown += (uint32_t)(memory[at].magnitude == 255u);
    }
    CHECK((count >= least) && (count <= most));
  }
  CHECK_IS(unlike, 0);
  CHECK(unknown > 0u);
  CHECK_IS(first[0], 0);
}

/* Memory for none, for one too few, and for all. */
static void check_capacity(void) {
  list(&sky, RADIUS_RAD);
  const uint32_t needed = first[table.n_stars];
  CHECK((needed > 10000u) && (needed < MOST_NEIGHBOURS));
  table.capacity = 0;
  table.neighbour = NULL;
  CHECK_IS(starcat_list_neighbours(&sky.image, &unit_work, &table), STARCAT_E_CAPACITY);
  CHECK_IS(first[sky.image.n_stars], needed);
  CHECK_IS(table.n_stars, 0);
  table.neighbour = memory;
  for (uint32_t more = 0; more < 2u; more++) {
    memset(memory, OUTSIDE, sizeof memory);
    table.capacity = needed - 1u + more;
    CHECK_IS(starcat_list_neighbours(&sky.image, &unit_work, &table),
             more == 0u ? STARCAT_E_CAPACITY : STARCAT_OK);
    CHECK_IS(first[sky.image.n_stars], needed);
    CHECK_IS(table.n_stars, more * sky.image.n_stars);
    CHECK_IS(memory[table.capacity].place, OUTSIDE << 8 | OUTSIDE);
    CHECK_IS(memory[table.capacity].turn, OUTSIDE);
    CHECK_IS(memory[table.capacity].magnitude, OUTSIDE);
  }
  table.capacity = MOST_NEIGHBOURS;
  first[unit_crowded.image.n_stars] = 1;
  table.radius_rad = (starcat_real)1.5; /* more stars than a call can hold */
  CHECK_IS(starcat_list_neighbours(&unit_crowded.image, &unit_work, &table), STARCAT_E_CAPACITY);
  CHECK_IS(first[unit_crowded.image.n_stars], 0);
  CHECK_IS(table.n_stars, 0);
}

/* An image of few stars has no table. */
static void check_few_stars(void) {
  starcat_image few = sky.image;
  few.n_stars = 31;
  list(&sky, RADIUS_RAD);
  first[31] = 1;
  CHECK_IS(starcat_list_neighbours(&few, &unit_work, &table), STARCAT_E_CAPACITY);
  CHECK_IS(first[31], 0);
  CHECK_IS(table.n_stars, 0);
  sky.image.neighbours = NULL;
}

/* A frame that is solved before it needs votes asks for no neighbours; another one does, and gets its
 * answer once they are there. Nothing else is asked for, and a frame of an unknown scale has no votes. */
static void check_asked_for(void) {
  const starcat_neighbours empty = {(starcat_real)RADIUS_RAD, 0, 0, first, NULL};
  uint64_t state = 18;
  uint32_t asked = 0, answered = 0;
  for (uint32_t n = 0; n < 40u; n++) {
    const uint32_t is_hard = n % 2u;
    look(&sky, &state, 0.5, 24, is_hard != 0u ? 8 : 0, is_hard != 0u ? 0.5 : 0.0);
    list(&sky, RADIUS_RAD);
    const starcat_status with = identify(&sky, 0);
    table = empty;
    const starcat_status without = identify(&sky, 0);
    CHECK((without == with) || (without == STARCAT_INCOMPLETE));
    answered += (uint32_t)(without == STARCAT_IDENTIFIED);
    if (without == STARCAT_INCOMPLETE) {
      asked++;
      CHECK_IS(unit_result.n_matched, 0);
      CHECK((unit_result.steps > 0u) && (unit_result.steps <= STEPS_BEFORE_VOTES));
      for (uint32_t i = 0; i < truth.count; i++) {
        CHECK(unit_result.star[i] < 0);
      }
      list(&sky, RADIUS_RAD);
      CHECK_IS(identify(&sky, 0), with);
    }
  }
  CHECK(asked >= 10u);
  CHECK(answered >= 18u);
  table = empty;
  sky.options.fov_error = (starcat_real)0.01;
  CHECK(identify(&sky, 0) != STARCAT_INCOMPLETE);
  sky.image.neighbours = NULL;
  (void)starcat_set_default_options(&sky.options);
}

/* How many references a frame needs: fewer stars are enough if the noise is small, and then more of
 * the centroids can be false. Without a star in the field each centroid is needed. */
static void check_references(void) {
  uint64_t state = 19;
  look(&sky, &state, 0.1, 24, 24, 0.0);
  begin(&sky, 0);
  const uint32_t usual = starcat_count_references(&call);
  CHECK((usual > 1u) && (usual < call.own->count));
  call.noise_px = (starcat_real)0.01;
  const uint32_t exact = starcat_count_references(&call);
  CHECK((exact > usual) && (exact < call.own->count));
  call.focal_px *= (starcat_real)1000.0;
  CHECK_IS(starcat_count_references(&call), call.own->count);
}

/* Frames of nothing but false spots, with a prior: every anchor is tried. */
static void check_anchors(void) {
  uint64_t state = 20;
  for (uint32_t n = 0; n < 4u; n++) {
    const uint32_t count = n < 2u ? 10u : 24u;
    look(&sky, &state, 0.5, count, count, 0.0);
    const starcat_frame frame = frame_of(0);
    CHECK_IS(starcat_track_frame(&sky.image, &sky.camera, &sky.options, &frame,
                                 truth.q_body_from_icrs, (starcat_real)0.01, &unit_work,
                                 &unit_result),
             STARCAT_NO_MATCH);
  }
}

static void check_refused(void) {
  const starcat_neighbours good = {(starcat_real)RADIUS_RAD, MOST_NEIGHBOURS, 0, first, memory};
  const starcat_real radii[7] = {(starcat_real)0.0,      (starcat_real)-0.1, (starcat_real)9e-5,
                                 (starcat_real)1.58,     (starcat_real)NAN,  (starcat_real)INFINITY,
                                 -(starcat_real)INFINITY};
  table = good;
  CHECK_IS(starcat_list_neighbours(NULL, &unit_work, &table), STARCAT_E_NULL);
  CHECK_IS(starcat_list_neighbours(&sky.image, NULL, &table), STARCAT_E_NULL);
  CHECK_IS(starcat_list_neighbours(&sky.image, &unit_work, NULL), STARCAT_E_NULL);
  table.first = NULL;
  CHECK_IS(starcat_list_neighbours(&sky.image, &unit_work, &table), STARCAT_E_NULL);
  table = good;
  table.neighbour = NULL;
  CHECK_IS(starcat_list_neighbours(&sky.image, &unit_work, &table), STARCAT_E_NULL);
  for (uint32_t n = 0; n < 7u; n++) {
    table = good;
    table.radius_rad = radii[n];
    CHECK_IS(starcat_list_neighbours(&sky.image, &unit_work, &table), STARCAT_E_OPTIONS);
  }
}

/* Directions and magnitudes of a damaged image: of no length, along the axis alone, very bright. */
static void check_odd_stars(void) {
  static const int16_t magnitudes[4] = {-30000, 30000, -2000, 32767};
  uint32_t at[2];
  unit_copy(&sky);
  for (uint32_t n = 0; n < 2u; n++) {
    memcpy(&at[n], unit_scratch.bytes + 256u + 16u * n + 4u, 4);
  }
  for (uint32_t n = 0; n < 4u; n++) {
    const int32_t odd[3] = {0, 0, n == 0u ? 0 : (int32_t)(300000000u * n)};
    memcpy(unit_scratch.bytes + at[0] + 12u * 100u * (size_t)n, odd, sizeof odd);
    memcpy(unit_scratch.bytes + at[1] + 2u * (size_t)n, &magnitudes[n], 2);
  }
  list(&unit_scratch, RADIUS_RAD);
  uint32_t units[256] = {0};
  for (uint32_t k = 0; k < first[table.n_stars]; k++) {
    units[memory[k].magnitude]++;
  }
  CHECK((units[0] > 0u) && (units[254] > 0u));
  uint64_t state = 3;
  look(&sky, &state, 0.5, 24, 8, 0.5);
  (void)check_answer(identify(&unit_scratch, 1));
}

/* Frames of half of the stars, as many false spots, and noise: votes solve many that triangles do
 * not, by triangles and by pairs, with magnitudes and without. */
static void check_missing(unit_sky *of, int has_magnitudes, uint32_t n_spots, uint32_t n_false,
                          double noise_px, uint32_t more) {
  uint64_t state = 5;
  uint32_t alone = 0, found = 0, lost = 0;
  of->options.noise_mag = (starcat_real)(has_magnitudes ? 0.3 : 0.0);
  list(of, RADIUS_RAD);
  for (uint32_t n = 0; n < 40u; n++) {
    look(of, &state, noise_px, n_spots, n_false, 0.5);
    if (n % 8u == 7u) {
      truth.magnitudes[1] = (starcat_real)NAN;
    }
    of->image.neighbours = NULL;
    const uint32_t without = check_answer(identify(of, has_magnitudes));
    of->image.neighbours = &table;
    const uint32_t with = check_answer(identify(of, has_magnitudes));
    alone += without;
    found += with;
    lost += (uint32_t)(with < without);
  }
  CHECK(found >= alone + more);
  CHECK(lost <= 2u);
  of->image.neighbours = NULL;
  (void)starcat_set_default_options(&of->options);
}

/* Stars of unknown magnitude vote for every centroid that is as far away. */
static void check_unknown_magnitudes(void) {
  uint32_t at;
  unit_copy(&sky);
  memcpy(&at, unit_scratch.bytes + 256u + 16u + 4u, 4);
  for (uint32_t n = 0; n < sky.image.n_stars; n++) {
    const int16_t unknown = INT16_MIN;
    memcpy(unit_scratch.bytes + at + 2u * (size_t)n, &unknown, 2);
  }
  check_missing(&unit_scratch, 1, 24, 8, 0.3, 3);
  for (uint32_t k = 0; k < first[table.n_stars]; k++) {
    CHECK_IS(memory[k].magnitude, 255);
  }
}

/* Whether a frame gets the same answer with the table and without it. With it the search can end
 * sooner. */
static void check_unused(unit_sky *of) {
  static starcat_result other;
  uint64_t state = 9;
  for (uint32_t n = 0; n < 8u; n++) {
    look(&sky, &state, 0.5, 24, 8, 0.5);
    of->image.neighbours = NULL;
    const starcat_status without = identify(of, 1);
    other = unit_result;
    of->image.neighbours = &table;
    CHECK_IS(identify(of, 1), without);
    CHECK_IS(unit_result.n_matched, other.n_matched);
    CHECK(unit_result.n_tried <= other.n_tried);
    CHECK_IS(memcmp(unit_result.star, other.star, truth.count * sizeof other.star[0]), 0);
  }
  of->image.neighbours = NULL;
}

/* The table of another image is not used, nor is any if the focal length is sought. */
static void check_others(void) {
  list(&unit_triangle, RADIUS_RAD);
  unit_triangle.image.neighbours = NULL;
  check_unused(&sky);
  list(&sky, RADIUS_RAD);
  sky.options.fov_error = (starcat_real)0.01;
  sky.options.max_steps = 400000;
  check_unused(&sky);
  (void)starcat_set_default_options(&sky.options);
}

/* Frames of more centroids than have a vote: after the votes triangles go on, unless they had been
 * looked up all. */
static void check_many(void) {
  uint64_t state = 11;
  uint32_t found = 0, onward = 0;
  list(&sky, RADIUS_RAD);
  for (uint32_t n = 0; n < 24u; n++) {
    look(&sky, &state, 0.5, 64, n < 12u ? 40u : 64u, n < 12u ? 0.3 : 0.0);
    sky.options.tolerance_px = (starcat_real)(n % 2u == 0u ? 2.0 : 0.05);
    found += check_answer(identify(&sky, (int)(n / 2u % 2u)));
    onward += (uint32_t)(unit_result.steps > 2u * STEPS_BEFORE_VOTES);
  }
  CHECK(found > 0u);
  CHECK(onward > 0u);
  sky.image.neighbours = NULL;
  (void)starcat_set_default_options(&sky.options);
}

/* An attitude that is likely, but that the caller refuses, ends the search: the remaining steps are
 * not spent on votes or on more triangles. */
static void check_likely(void) {
  uint64_t state = 12;
  list(&sky, RADIUS_RAD);
  sky.options.log_chance = (starcat_real)-1000.0;
  for (uint32_t n = 0; n < 8u; n++) {
    sky_look(&sky.image, &sky.camera, &state, 0.2, n < 4u ? 64u : 12u, n < 4u ? 30u : 0u, &truth);
    CHECK_IS(identify(&sky, 0), STARCAT_NO_MATCH);
    CHECK(unit_result.best_log_chance <= (starcat_real)-6.9);
    CHECK(unit_result.steps <= STEPS_BEFORE_VOTES);
  }
  /* By votes alone the first reference that gives it is the last one. */
  (void)starcat_set_default_options(&sky.options);
  sky.options.log_chance = (starcat_real)-1000.0;
  begin(&sky, 0);
  starcat_search_votes(&call, REFERENCES);
  CHECK(unit_work.best.log_bound <= STARCAT_LOG_LIKELY);
  const uint32_t n_tried = call.own->n_tried;
  starcat_search_votes(&call, REFERENCES);
  CHECK_IS(call.own->n_tried, n_tried);
  sky.image.neighbours = NULL;
  (void)starcat_set_default_options(&sky.options);
}

/* Every number of steps around the end of a search by votes, and fewer of them farther from it. */
static void check_budgets(void) {
  uint64_t state = 13;
  uint32_t ended = 0;
  list(&unit_triangle, RADIUS_RAD);
  unit_triangle.options.noise_mag = (starcat_real)0.3;
  look(&unit_triangle, &state, 0.3, 16, 4, 0.2);
  begin(&unit_triangle, 1);
  call.own->steps_left = 10000000;
  starcat_search_votes(&call, REFERENCES);
  CHECK(unit_work.best.n_matched >= 4u);
  const uint32_t needed = 10000000u - call.own->steps_left;
  for (uint32_t n = 1; n < needed + 100u; n += n + 3000u < needed ? 61u : 1u) {
    begin(&unit_triangle, 1);
    call.own->steps_left = n;
    starcat_search_votes(&call, REFERENCES);
    ended += (uint32_t)(call.own->steps_left == 0u);
    CHECK(call.own->steps_left < n);
  }
  CHECK(ended > 3000u);
  unit_triangle.image.neighbours = NULL;
  (void)starcat_set_default_options(&unit_triangle.options);
  /* And of a whole call. */
  list(&sky, RADIUS_RAD);
  for (uint32_t steps = 1; steps < 4000000u; steps += 1u + steps / 3u) {
    sky.options.max_steps = steps;
    look(&sky, &state, 0.5, 40, 16, 0.5);
    (void)check_answer(identify(&sky, 0));
    CHECK(unit_result.steps <= steps);
  }
  sky.image.neighbours = NULL;
  (void)starcat_set_default_options(&sky.options);
}

/* A table of any bytes: no answer is wrong, nothing outside of the memory is read, and a call takes no
 * more steps than it may. The memory is exactly as large as the table. */
static void check_damaged(void) {
  uint64_t state = 14;
  uint32_t found = 0;
  list(&sky, RADIUS_RAD);
  const uint32_t n_stars = sky.image.n_stars, count = first[n_stars];
  starcat_neighbours exact = {table.radius_rad, count, n_stars, NULL, NULL};
  exact.first = malloc((n_stars + 1u) * sizeof *exact.first);
  exact.neighbour = malloc(count * sizeof *exact.neighbour);
  CHECK((exact.first != NULL) && (exact.neighbour != NULL));
  if ((exact.first == NULL) || (exact.neighbour == NULL)) {
    return;
  }
  sky.image.neighbours = &exact;
  for (uint32_t n = 0; n < 48u; n++) {
    memcpy(exact.first, first, (n_stars + 1u) * sizeof first[0]);
    memcpy(exact.neighbour, memory, count * sizeof memory[0]);
    const double share = n % 8u < 4u ? 0.01 : 1.0;
    for (uint32_t k = 0; k <= n_stars; k++) {
      if ((n % 4u > 0u) && (sky_uniform(&state) < share)) {
        const double any = sky_uniform(&state);
        exact.first[k] = n % 4u == 1u   ? (uint32_t)(4294967296.0 * any)
                         : n % 4u == 2u ? count - 50u + (uint32_t)(100.0 * any)
                                        : UINT32_MAX;
      }
    }
    for (uint32_t k = 0; (k < count) && (n % 3u > 0u); k++) {
      if (sky_uniform(&state) < share) {
        const starcat_neighbour any = {(uint16_t)(65536.0 * sky_uniform(&state)),
                                       (uint8_t)(256.0 * sky_uniform(&state)),
                                       (uint8_t)(256.0 * sky_uniform(&state))};
        exact.neighbour[k] = any;
      }
    }
    look(&sky, &state, 0.5, 24, 8, 0.5);
    found += check_answer(identify(&sky, (int)(n % 2u)));
    CHECK(unit_result.steps <= sky.options.max_steps);
  }
  CHECK(found >= 12u);
  sky.image.neighbours = NULL;
  free(exact.first);
  free(exact.neighbour);
}

/* A radius smaller than the field; a radius that differs from the table's; tolerances so large that
 * every star has many votes; and magnitudes beyond the range of stars. */
static void check_extremes(void) {
  uint64_t state = 15;
  for (uint32_t n = 0; n < 24u; n++) {
    list(&sky, n % 3u == 1u ? 0.1 : RADIUS_RAD);
    table.radius_rad = n % 3u == 2u ? (starcat_real)1.2 : table.radius_rad;
    sky.options.tolerance_px = (starcat_real)(n < 12u ? 2.0 : 30.0);
    sky.options.noise_mag = (starcat_real)(n % 4u == 0u ? 1e6 : 0.3);
    look(&sky, &state, 0.5, 40, 16, 0.5);
    truth.magnitudes[0] = (starcat_real)2.9e38;
    truth.magnitudes[1] = (starcat_real)-2.9e38;
    begin(&sky, (int)(n % 2u));
    call.own->steps_left = 3000000;
    starcat_search_votes(&call, REFERENCES);
    CHECK(call.own->steps_left < 3000000u);
    if (n < 12u) {
      (void)check_answer(starcat_end_call(&call, &sky.options, &unit_result));
    }
  }
  sky.image.neighbours = NULL;
  (void)starcat_set_default_options(&sky.options);
}

/* So many stars, and a tolerance so large, that more pairs vote for a star than the list holds. Then
 * a damaged table gives one star of each group the votes of all: more than the first count goes up to,
 * but of as many centroids in every bin. */
static void check_crowded(void) {
  uint64_t state = 17;
  list(&unit_crowded, RADIUS_RAD);
  unit_crowded.options.tolerance_px = (starcat_real)40.0;
  for (uint32_t n = 0; n < 6u; n++) {
    for (uint32_t k = 0; (k < first[table.n_stars]) && (n == 4u); k++) {
      memory[k].place = (uint16_t)(memory[k].place / GROUP * GROUP);
    }
    sky_look(&unit_crowded.image, &unit_crowded.camera, &state, 0.5, 64, 24, &truth);
    begin(&unit_crowded, 0);
    call.own->steps_left = 40000000;
    starcat_search_votes(&call, REFERENCES);
    CHECK((call.own->n_tried > 0u) == (n < 4u));
  }
  unit_crowded.image.neighbours = NULL;
  (void)starcat_set_default_options(&unit_crowded.options);
}

#ifndef STARCAT_SINGLE
/* Two stars within a hundredth of an arcsecond, too near for an attitude, which have the most votes. */
static void check_too_near(void) {
  static const uint32_t rows[1] = {350};
  uint32_t at, near[STARCAT_MAX_STARS];
  starcat_real centre[3], icrs[STARCAT_MAX_STARS][3];
  uint64_t state = 16;
  unit_copy(&sky);
  look(&unit_scratch, &state, 0.0, SKY_SPOTS, 0, 0.0);
  begin(&unit_scratch, 0);
  memcpy(&at, unit_scratch.bytes + 256u + 4u, 4);
  starcat_read_star(&unit_scratch.image, rows[0], centre);
  const uint32_t n_near = starcat_gather_stars(
      &call, centre, (starcat_real)cos(0.4), (starcat_real)sin(0.4), STARCAT_MAX_STARS, near, icrs);
  CHECK((n_near > 10u) && (n_near <= STARCAT_MAX_STARS));
  const int32_t *place = unit_scratch.image.directions + 3u * (size_t)rows[0];
  const int32_t moved[3] = {place[0] + 140, place[1], place[2]};
  memcpy(unit_scratch.bytes + at + 12u * (size_t)near[0], moved, sizeof moved);
  list(&unit_scratch, RADIUS_RAD);
  call.image = &unit_scratch.image;
  call.own->count = 0;
  for (uint32_t n = 0; n < 9u; n++) {
    starcat_real *body = unit_work.body[n];
    if ((n < 2u) || (near[n] != rows[0])) {
      starcat_read_star(&unit_scratch.image, n == 0u ? rows[0] : near[n - 1u], body);
      const starcat_real length = STARCAT_SQRT(starcat_dot(body, body));
      for (uint32_t k = 0; k < 3u; k++) {
        body[k] /= length;
      }
    }
  }
  call.own->count = 9;
  call.tolerance_rad = (starcat_real)1.5e-8;
  call.own->steps_left = 10000000;
  const uint32_t n_tried = call.own->n_tried;
  starcat_search_votes(&call, REFERENCES);
  CHECK(call.own->n_tried > n_tried);
}
#endif

void test_votes(void) {
  const sky_recipe recipe = {1, 2, 700, 0.17, 8};
  sky.bytes = (uint8_t *)sky.words;
  sky.size = sky_image(&recipe, sky.bytes);
  CHECK_IS(starcat_open_image(&sky.image, sky.bytes, sky.size, 0), STARCAT_OK);
  CHECK(sky.image.neighbours == NULL);
  (void)starcat_get_camera(&sky.image, &sky.camera);
  (void)starcat_set_default_options(&sky.options);
  check_neighbours(&unit_triangle);
  unit_triangle.image.neighbours = NULL;
  check_capacity();
  check_few_stars();
  check_asked_for();
  check_references();
  check_anchors();
  check_refused();
  check_odd_stars();
  check_missing(&sky, 1, 24, 8, 0.5, 10);
  check_missing(&sky, 0, 24, 8, 0.3, 3);
  unit_copy(&unit_pyramid);
  check_missing(&unit_scratch, 1, 24, 8, 0.5, 0);
  check_unknown_magnitudes();
  check_others();
  check_many();
  check_likely();
  check_budgets();
  check_damaged();
  check_extremes();
  check_crowded();
#ifndef STARCAT_SINGLE
  check_too_near();
#endif
}
