/* Single-event upsets: flips one random bit of the image, of the workspace or of the table of
 * neighbours while a call runs, and counts what comes of it.
 *
 *   upsets FLIPS SEED
 *
 * The library is compiled with -fsanitize-coverage=trace-pc, so that each basic block of it calls
 * the function below: the n-th one flips the bit, every n of a call being as likely. Half of the
 * flips are in the image, half in the workspace. A fourth as many flips are added during calls that
 * solve frames by votes: half of these in the workspace, the others in image and table. Each chunk runs in a process of its own, so that
 * one that dies is counted and the rest goes on. The same seed flips the same bits.
 *
 * SPDX-License-Identifier: MIT
 */
#define _DEFAULT_SOURCE
#include <fenv.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/wait.h>
#include <unistd.h>

#include "random_sky.h"

#define N_SKIES 3u /* triangles; pairs; triangles and votes */
#define VOTES 2u
#define N_FRAMES 16u
#define N_WAYS 8u /* triangle or pyramid, identify or track, noise stated or not */
#define MAX_STEPS 100000u
#define STEPS_OF_VOTES 300000u
#define MOST_BLOCKS (64u * (uint64_t)STEPS_OF_VOTES + 4000000u) /* limit for a call that ends */
#define REACHES 2.0 /* largest error at a corner of the detector, in reaches of a match */
#define REACH 1.5   /* in tolerances */
#define NOISE_PX 0.3
#define ENDLESS 99

enum { NONE, CAUGHT, RIGHT, WRONG, CRASH, N_OUTCOMES };

/* Parts of the workspace and of the image, by which the outcomes are listed. */
#define FIELD(name) \
  { #name, offsetof(starcat_workspace, name) }
static const struct {
  const char *name;
  size_t at;
} FIELDS[] = {FIELD(row),
              FIELD(x),
              FIELD(y),
              FIELD(magnitude),
              FIELD(square),
              FIELD(body),
              FIELD(scaled),
              FIELD(column),
              FIELD(in_column),
              FIELD(separation_rad),
              FIELD(heap),
              FIELD(neighbour),
              FIELD(either),
              FIELD(corner),
              FIELD(third),
              FIELD(near_row),
              FIELD(near_icrs),
              FIELD(within),
              FIELD(x_of),
              FIELD(y_of),
              FIELD(nearest),
              FIELD(nearest_square),
              FIELD(match),
              FIELD(before),
              FIELD(match_square),
              FIELD(log_ways),
              FIELD(sums),
              FIELD(found),
              FIELD(wider),
              FIELD(best),
              FIELD(seen),
              FIELD(seen_body),
              FIELD(seen_icrs),
              FIELD(weight)};
#define N_FIELDS (sizeof FIELDS / sizeof FIELDS[0])
static const char *const SECTIONS[] = {"header", "directions", "magnitudes", "star_ids",
                                       "grid",   "kvector",    "triangles",  "radii",
                                       "pairs",  "checks",     "first",      "neighbour"};
#define N_SECTIONS 10u
#define TABLE (N_FIELDS + N_SECTIONS)
#define N_PARTS (TABLE + 2u)

typedef struct {
  uint8_t *bytes;
  size_t size;
  starcat_image image;
  starcat_camera camera;
  starcat_neighbours table; /* for the sky whose frames are solved by votes */
  size_t table_size;        /* bytes of its memory, from table.first on */
} sky;

typedef struct {
  starcat_status status;
  starcat_result result;
  uint64_t blocks;
} answer;

/* What the processes share: how far they are, and what they counted. */
typedef struct {
  uint64_t at;
  uint64_t missed;  /* flips in the image whose block starcat_scrub_image did not name */
  uint64_t traps;   /* calls that raised a floating-point exception */
  uint64_t longest; /* call, in basic blocks */
  uint64_t counts[N_PARTS][N_OUTCOMES];
  uint32_t part;
  double largest; /* error of a corner, in reaches */
} tally;

static sky skies[N_SKIES];
static sky_frame frames[N_SKIES][N_FRAMES]; /* the first two skies have the same ones */
static answer expected[N_SKIES][N_FRAMES][N_WAYS];
static starcat_workspace *work;
static uint64_t blocks, due, limit;
static uint8_t *flipped, mask;

void __sanitizer_cov_trace_pc(void);
void __sanitizer_cov_trace_pc(void) {
  blocks++;
  if (blocks == due) {
    *flipped = (uint8_t)(*flipped ^ mask);
  }
  if (blocks > limit) {
    _exit(ENDLESS);
  }
}

/* Identify or track a frame; at a block above 0 the bit is flipped. */
static answer call(uint32_t which, uint32_t n, uint32_t way, uint64_t at_block) {
  const sky *s = &skies[which];
  const sky_frame *f = &frames[which][n];
  const starcat_frame frame = {f->count, f->x, f->y, (way & 2u) != 0u ? f->magnitudes : NULL, NULL};
  const starcat_camera camera = s->camera;
  starcat_options options;
  answer a;
  memset(work, 0, sizeof *work);
  memset(&a.result, 0, sizeof a.result);
  (void)starcat_set_default_options(&options);
  options.max_steps = which == VOTES ? STEPS_OF_VOTES : MAX_STEPS;
  if ((way & 4u) != 0u) {
    options.noise_px = (starcat_real)NOISE_PX;
    options.noise_mag = (starcat_real)0.3;
  }
  blocks = 0;
  due = at_block;
  a.status = (way & 1u) != 0u
                 ? starcat_track_frame(&s->image, &camera, &options, &frame, f->q_body_from_icrs,
                                       (starcat_real)0.009, work, &a.result)
                 : starcat_identify_frame(&s->image, &camera, &options, &frame, work, &a.result);
  a.blocks = blocks;
  due = 0;
  return a;
}

/* Largest distance between the answer's and the true position of a detector corner, in reaches. */
static double error_of(const starcat_camera *camera, const starcat_result *result,
                       const double m[9], uint32_t way) {
  const double reach = REACH * ((way & 4u) != 0u ? 3.0 * NOISE_PX : 2.0);
  double worst = 0.0;
  for (int corner = 0; corner < 4; corner++) {
    const double f = (double)camera->focal_length_px;
    const double x = ((corner & 1) ? 0.5 : -0.5) * (double)camera->width_px;
    const double y = ((corner & 2) ? 0.5 : -0.5) * (double)camera->height_px;
    const double body[3] = {x / f, y / f, 1.0};
    double there[3] = {0.0, 0.0, 0.0}; /* matrix * m^T * body */
    for (int k = 0; k < 3; k++) {
      double icrs = 0.0;
      for (int j = 0; j < 3; j++) {
        icrs += m[3 * j + k] * body[j];
      }
      for (int j = 0; j < 3; j++) {
        there[j] += (double)result->matrix[3 * j + k] * icrs;
      }
    }
    const double error = hypot(there[0] / there[2] * f - x, there[1] / there[2] * f - y);
    worst = (there[2] > 0.0) && (error >= 0.0) ? fmax(worst, error) : 1e9; /* NaN too */
  }
  return worst / reach;
}

/* Whether two answers are the same in every number but the steps. */
static int is_as(answer a, answer b) {
  a.result.steps = b.result.steps = 0;
  a.result.n_tried = b.result.n_tried = 0;
  return (a.status == b.status) && (memcmp(&a.result, &b.result, sizeof a.result) == 0);
}

static uint32_t field_of(size_t at) {
  uint32_t field = 0;
  for (uint32_t n = 0; n < N_FIELDS; n++) {
    field = FIELDS[n].at <= at ? n : field;
  }
  return field;
}

/* The section of an image that contains a byte; padding belongs to the section before it. */
static uint32_t section_of(const sky *s, size_t at) {
  uint32_t section = 0, from = 0;
  for (uint32_t n = 0; n < 16u; n++) {
    uint32_t entry[2];
    memcpy(entry, s->bytes + 256u + 16u * n, sizeof entry);
    if ((entry[1] >= from) && (entry[1] <= at)) {
      section = entry[0];
      from = entry[1];
    }
  }
  return (uint32_t)N_FIELDS + (at >= s->image.data_bytes ? 9u : section);
}

static const char *name_of(uint32_t part) {
  return part < N_FIELDS ? FIELDS[part].name : SECTIONS[part - N_FIELDS];
}

static const char *memory_of(uint32_t part) {
  return part < N_FIELDS ? "workspace" : part < TABLE ? "image" : "table";
}

static void tell(const char *what, uint64_t index, const tally *t) {
  (void)fprintf(stderr, "%s: flip %llu, in %s of the %s\n", what, (unsigned long long)index,
                name_of(t->part), memory_of(t->part));
}

static void flip(uint64_t index, int is_voting, uint64_t seed, tally *t) {
  uint64_t state = seed * 0x9e3779b97f4a7c15u + index * 0xd1342543de82ef95u;
  (void)sky_uniform(&state);
  const uint32_t any_sky = (uint32_t)(2.0 * sky_uniform(&state));
  const uint32_t which = is_voting ? VOTES : any_sky;
  const uint32_t n = (uint32_t)((double)N_FRAMES * sky_uniform(&state));
  const uint32_t any_way = (uint32_t)((double)N_WAYS * sky_uniform(&state));
  const uint32_t way = is_voting ? any_way & ~1u : any_way; /* tracking has no votes */
  const sky *s = &skies[which];
  const answer *golden = &expected[which][n][way];
  const int in_table = is_voting && ((index & 3u) == 1u);
  const int in_image = ((index & 1u) != 0u) && !in_table;
  const size_t size = in_table ? s->table_size : in_image ? s->size : sizeof(starcat_workspace);
  const size_t at = (size_t)((double)size * sky_uniform(&state));
  uint32_t bad = 0;
  mask = (uint8_t)(1u << (unsigned)(8.0 * sky_uniform(&state)));
  flipped = in_table   ? (uint8_t *)s->table.first + at
            : in_image ? s->bytes + at
                       : (uint8_t *)work + at;
  const uint64_t at_block = 1u + (uint64_t)((double)golden->blocks * sky_uniform(&state));
  const size_t first_bytes = (s->image.n_stars + 1u) * sizeof *s->table.first;
  t->part = in_table   ? (uint32_t)TABLE + (uint32_t)(at >= first_bytes)
            : in_image ? section_of(s, at)
                       : field_of(at);
  (void)feclearexcept(FE_ALL_EXCEPT);
  const answer a = call(which, n, way, at_block);
  if (in_image) {
    const uint32_t block = (uint32_t)(at / 4096u);
    t->missed +=
        (uint64_t)((starcat_scrub_image(s->bytes, s->size, block, 1, &bad) >= 0) || (bad != block));
  }
  if (in_image || in_table) {
    *flipped = (uint8_t)(*flipped ^ mask);
  }
  t->traps += (uint64_t)(fetestexcept(FE_INVALID | FE_DIVBYZERO | FE_OVERFLOW) != 0);
  t->longest = a.blocks > t->longest ? a.blocks : t->longest;
  int outcome = NONE;
  if (!is_as(a, *golden)) {
    const double error = a.status == STARCAT_IDENTIFIED
                             ? error_of(&s->camera, &a.result, frames[which][n].matrix, way)
                             : 0.0;
    outcome = a.status != STARCAT_IDENTIFIED ? CAUGHT : error <= REACHES ? RIGHT : WRONG;
    t->largest = fmax(t->largest, error);
  }
  if (outcome == WRONG) {
    tell("wrong", index, t);
  }
  t->counts[t->part][outcome]++;
}

/* List the neighbours of the stars of a sky, in one piece of memory and no byte more. */
static void list_neighbours(sky *s) {
  const size_t rows = s->image.n_stars + 1u;
  uint32_t *first = malloc(rows * sizeof *first);
  s->table.radius_rad = (starcat_real)0.475;
  s->table.first = first;
  if (starcat_list_neighbours(&s->image, work, &s->table) != STARCAT_E_CAPACITY) {
    abort();
  }
  s->table.capacity = first[s->image.n_stars];
  s->table_size = rows * sizeof *first + s->table.capacity * sizeof *s->table.neighbour;
  free(first);
  s->table.first = malloc(s->table_size);
  s->table.neighbour = (starcat_neighbour *)(void *)(s->table.first + rows);
  if (starcat_list_neighbours(&s->image, work, &s->table) != STARCAT_OK) {
    abort();
  }
  s->image.neighbours = &s->table;
}

/* A frame of at least seven stars and up to two false spots. */
static void look(sky_frame *frame, uint32_t n_false, uint64_t *state) {
  do {
    sky_look(&skies[0].image, &skies[0].camera, state, 0.2, SKY_SPOTS, n_false, frame);
  } while (frame->count < 7u + n_false);
}

/* A frame of half of the stars and as many false spots, which votes identify and triangles do not. The
 * answer has at least nine stars: one star of fewer, moved by a flip, could turn the attitude. */
static void look_for_votes(uint32_t n, uint64_t *state) {
  sky *s = &skies[VOTES];
  sky_frame *f = &frames[VOTES][n];
  answer by_triangles, by_votes;
  do {
    uint32_t count = 0;
    sky_look(&s->image, &s->camera, state, NOISE_PX, 40, 14, f);
    for (uint32_t i = 0; i < f->count; i++) {
      if ((f->star[i] < 0) || (sky_uniform(state) < 0.5)) {
        f->x[count] = f->x[i];
        f->y[count] = f->y[i];
        f->magnitudes[count] = f->magnitudes[i];
        f->star[count++] = f->star[i];
      }
    }
    f->count = count;
    s->image.neighbours = NULL;
    by_triangles = call(VOTES, n, 6, 0);
    s->image.neighbours = &s->table;
    by_votes = call(VOTES, n, 6, 0);
  } while ((by_triangles.status == STARCAT_IDENTIFIED) || (by_votes.status != STARCAT_IDENTIFIED) ||
           (by_votes.result.n_matched < 9u));
}

static void prepare(void) {
  static const sky_recipe recipes[N_SKIES] = {
      {1, 2, SKY_STARS, 0.42, 8}, {2, 4, SKY_STARS, 0.698, 8}, {1, 2, 700, 0.17, 8}};
  uint64_t state = 3, state_of_votes = 4;
  limit = UINT64_MAX;
  work = malloc(sizeof *work);
  for (uint32_t which = 0; which < N_SKIES; which++) {
    sky *s = &skies[which];
    static uint64_t words[SKY_MOST_BYTES / 8u];
    s->size = sky_image(&recipes[which], (uint8_t *)words);
    s->bytes = malloc(s->size); /* no byte more, so that a read beyond it is found */
    memcpy(s->bytes, words, s->size);
    if (starcat_open_image(&s->image, s->bytes, s->size, 0) != STARCAT_OK) {
      abort();
    }
    (void)starcat_get_camera(&s->image, &s->camera);
  }
  list_neighbours(&skies[VOTES]);
  for (uint32_t n = 0; n < N_FRAMES; n++) {
    look(&frames[0][n], n % 3u, &state);
    frames[1][n] = frames[0][n];
    look_for_votes(n, &state_of_votes);
    for (uint32_t which = 0; which < N_SKIES; which++) {
      for (uint32_t way = 0; way < N_WAYS; way++) {
        answer *a = &expected[which][n][way];
        *a = call(which, n, way, 0);
        if ((a->status == STARCAT_IDENTIFIED) &&
            !(error_of(&skies[which].camera, &a->result, frames[which][n].matrix, way) < REACHES)) {
          abort();
        }
      }
    }
  }
  limit = MOST_BLOCKS;
}

int main(int argc, char **argv) {
  const uint64_t count = argc == 3 ? strtoull(argv[1], NULL, 10) : 0;
  tally *t = mmap(NULL, sizeof *t, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
  if ((count == 0u) || (t == MAP_FAILED)) {
    (void)fprintf(stderr, "upsets FLIPS SEED\n");
    return 2;
  }
  const uint64_t seed = strtoull(argv[2], NULL, 10);
  prepare();
  const uint64_t all = count + count / 4u;
  while (t->at < all) {
    const pid_t child = fork();
    if (child == 0) {
      for (; t->at < all; t->at++) {
        flip(t->at, t->at >= count, seed, t);
      }
      _exit(0);
    }
    int status = 0;
    (void)waitpid(child, &status, 0);
    if (status != 0) {
      tell(WIFEXITED(status) && (WEXITSTATUS(status) == ENDLESS) ? "endless" : "crash", t->at, t);
      t->counts[t->part][CRASH]++;
      t->at++;
    }
  }
  for (uint32_t part = 0; part < N_PARTS; part++) {
    (void)printf("%s,%s", memory_of(part), name_of(part));
    for (uint32_t k = 0; k < N_OUTCOMES; k++) {
      (void)printf(",%llu", (unsigned long long)t->counts[part][k]);
    }
    (void)printf("\n");
  }
  (void)printf("missed,%llu\ntraps,%llu\nlargest,%.2f\nlongest,%llu\n",
               (unsigned long long)t->missed, (unsigned long long)t->traps, t->largest,
               (unsigned long long)t->longest);
  return 0;
}
