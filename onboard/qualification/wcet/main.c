/* Runs calls on a simulated processor and prints, a line each, the instructions and the steps that
 * they took: ordinary frames, random adversarial ones, and a search for worse ones, which changes
 * the worst so far.
 *
 *   KIND NUMBER instructions steps status flags genes
 *
 * KIND is o, r or s; flags: 1 lens, 2 focal length sought, 4 crowded, 8 tracked, 16 pyramids, 32
 * magnitudes, 64 votes. Half of the calls have a table of neighbours, if there is memory for it;
 * these have as many more steps as are taken before votes are counted.
 *
 * SPDX-License-Identifier: MIT
 */
#include <math.h>
#include <stdio.h>
#include <string.h>

#include "adversary.h"
#include "clock.h"
#include "ticks.h"

#ifndef FRAMES
#define FRAMES 100
#endif
#ifndef SEED
#define SEED 1
#endif
#define N_WORST 8u
#define STEPS_BEFORE_VOTES 150000u /* about what triangles take before the votes */
#define TABLE_STARS 1000u
#define TABLE_NEIGHBOURS 6000u
#define WEIGHT 2000.0 /* steps that the work before the first one is worth in the search */

extern const uint64_t image_begin[], image_end[]; /* image.S */

static starcat_workspace work;
static starcat_result result;
static starcat_image image;
static adversary made;
static uint32_t first_neighbour[TABLE_STARS + 1u];
static starcat_neighbour neighbour[TABLE_NEIGHBOURS];
static starcat_neighbours table;
static uint8_t worst[N_WORST][N_GENES];
static double worst_ratio[N_WORST];

/* Whether one of the centroids that may be used has a magnitude. */
static int has_magnitudes(void) {
  int known = 0;
  for (uint32_t n = 0; n < made.sky.count; n++) {
    known |= made.has_magnitudes && isfinite(made.sky.magnitudes[n]) &&
             (result.star[n] != STARCAT_DROPPED_NOT_FINITE) &&
             (result.star[n] != STARCAT_DROPPED_OUT_OF_FRAME);
  }
  return known;
}

static int can_vote(void) {
  return (image.neighbours != NULL) && !made.is_tracked &&
         !(made.options.fov_error > (starcat_real)0.0);
}

static uint32_t flags_of(void) {
  return (uint32_t)((made.camera.k1 != (starcat_real)0.0 ? 1 : 0) |
                    (made.options.fov_error > (starcat_real)0.0 ? 2 : 0) |
                    ((result.n_usable > 32u) && !has_magnitudes() ? 4 : 0) |
                    (made.is_tracked ? 8 : 0) | (image.method == 2u ? 16 : 0) |
                    (has_magnitudes() ? 32 : 0) | (can_vote() ? 64 : 0));
}

/* List the neighbours of the stars. Returns whether the table can be used. */
static int list_neighbours(void) {
  starcat_camera camera;
  (void)starcat_get_camera(&image, &camera);
  table.radius_rad = (starcat_real)atan(hypot((double)camera.width_px, (double)camera.height_px) /
                                        (2.0 * (double)camera.focal_length_px));
  table.capacity = TABLE_NEIGHBOURS;
  table.first = first_neighbour;
  table.neighbour = neighbour;
  return (image.n_stars <= TABLE_STARS) &&
         (starcat_list_neighbours(&image, &work, &table) == STARCAT_OK);
}

/* Make a call and print it. Returns instructions for a step. */
static double measure(char kind, unsigned id, const uint8_t *genes) {
  adversary_make(&image, genes, &made);
  if (can_vote() && (kind != 'o')) {
    made.options.max_steps += STEPS_BEFORE_VOTES;
  }
  memset(&result, 0, sizeof result);
  const uint64_t before = clock_now();
  const starcat_status status = adversary_call(&image, &made, &work, &result);
  const uint64_t took = clock_now() - before + CLOCK_STEP;
  (void)printf("%c %u %llu %lu %d %lu ", kind, id, (unsigned long long)took,
               (unsigned long)result.steps, (int)status, (unsigned long)flags_of());
  for (uint32_t n = 0; n < N_GENES; n++) {
    (void)printf("%02x", genes[n]);
  }
  (void)printf("\n");
  return (double)took / ((double)result.steps + WEIGHT);
}

static void keep(double ratio, const uint8_t *genes) {
  uint32_t least = 0;
  for (uint32_t n = 1; n < N_WORST; n++) {
    least = worst_ratio[n] < worst_ratio[least] ? n : least;
  }
  if (ratio > worst_ratio[least]) {
    worst_ratio[least] = ratio;
    memcpy(worst[least], genes, N_GENES);
  }
}

/* What opening takes, and scrubbing a block. */
static int measure_open(void) {
  const size_t size = (size_t)((const char *)image_end - (const char *)image_begin);
  uint32_t bad = 0;
  clock_start();
  const uint64_t start = clock_now();
  const starcat_status status = starcat_open_image(&image, image_begin, size, 0);
  const uint64_t opened = clock_now();
  (void)starcat_scrub_image(image_begin, size, 1, 1, &bad);
  const uint64_t scrubbed = clock_now();
  (void)printf("open %llu blocks: %lu\nscrub %llu\n",
               (unsigned long long)(opened - start + CLOCK_STEP),
               (unsigned long)(image.total_bytes / 4096u),
               (unsigned long long)(scrubbed - opened + CLOCK_STEP));
  return status == STARCAT_IDENTIFIED;
}

/* An attitude of pairs that are far apart and do not agree, so that it is refined to the end. */
static void measure_attitude(void) {
  static starcat_real body[STARCAT_MAX_CENTROIDS][3], icrs[STARCAT_MAX_CENTROIDS][3];
  starcat_real q[4];
  uint64_t state = SEED;
  for (uint32_t n = 0; n < STARCAT_MAX_CENTROIDS; n++) {
    for (uint32_t k = 0; k < 3u; k++) {
      body[n][k] = (starcat_real)(2.0 * sky_uniform(&state) - 1.0);
      icrs[n][k] = (starcat_real)(2.0 * sky_uniform(&state) - 1.0);
    }
  }
  const uint64_t before = clock_now();
  (void)starcat_fit_attitude((const starcat_real(*)[3])body, (const starcat_real(*)[3])icrs,
                             STARCAT_MAX_CENTROIDS, q);
  (void)printf("attitude %llu pairs: %u\n", (unsigned long long)(clock_now() - before + CLOCK_STEP),
               STARCAT_MAX_CENTROIDS);
}

int main(void) {
  uint64_t state = SEED;
  uint8_t genes[N_GENES];
  if (!measure_open()) {
    (void)printf("the image is not opened\n");
    return 2;
  }
  const int has_table = list_neighbours();
  measure_attitude();
  if (!measure_ticks(image_begin,
                     (size_t)((const char *)image_end - (const char *)image_begin))) {
    (void)printf("the work of idle time does not end\n");
    return 2;
  }
  for (unsigned n = 0; 10u * n + 10u <= FRAMES; n++) {
    image.neighbours = has_table && (n % 2u == 1u) ? &table : NULL;
    adversary_draw(&state, 1, genes);
    (void)measure('o', n, genes);
  }
  for (unsigned n = 0; n < FRAMES; n++) {
    image.neighbours = has_table && (n / 2u % 2u == 1u) ? &table : NULL;
    const int is_search = (n > FRAMES / 4u) && (n % 2u == 1u);
    if (is_search) {
      memcpy(genes, worst[n / 2u % N_WORST], N_GENES);
      adversary_mutate(&state, genes);
    } else {
      adversary_draw(&state, 0, genes);
    }
    keep(measure(is_search ? 's' : 'r', n, genes), genes);
  }
  (void)printf("done\n");
  return 0;
}
