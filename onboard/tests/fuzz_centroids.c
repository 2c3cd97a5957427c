/* libFuzzer: everything else that a caller passes. Camera, options, prior and centroids come from a
 * frame of a made-up sky, and the fuzzer replaces any of them.
 *
 * SPDX-License-Identifier: MIT
 */
#include <float.h>
#include <math.h>

#include "fuzz.h"

#ifdef STARCAT_SINGLE
#define LARGE 1e37F
#define LEAST FLT_MIN
#else
#define LARGE 1e300
#define LEAST DBL_MIN
#endif

int LLVMFuzzerInitialize(int *argc, char ***argv);
int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static starcat_image images[3]; /* triangles, pairs, pairs of a crowded sky */
static starcat_neighbours tables[3];
static starcat_workspace work;
static starcat_result result;

/* The table of neighbours of an image, in memory of exactly its size. */
static void list_neighbours(const starcat_image *image, starcat_neighbours *table) {
  table->radius_rad = (starcat_real)0.475;
  table->first = malloc(((size_t)image->n_stars + 1u) * sizeof *table->first);
  if (starcat_list_neighbours(image, &work, table) != STARCAT_E_CAPACITY) {
    abort();
  }
  table->capacity = table->first[image->n_stars];
  table->neighbour = malloc(table->capacity * sizeof *table->neighbour);
  if (starcat_list_neighbours(image, &work, table) != STARCAT_OK) {
    abort();
  }
}

int LLVMFuzzerInitialize(int *argc, char ***argv) {
  (void)argc;
  (void)argv;
  for (uint32_t n = 0; n < 3u; n++) {
    const sky_recipe recipe = {n == 0u ? 1u : 2u, n == 1u ? 4u : 2u, n == 2u ? 1500u : 300u,
                               n == 2u ? 0.18 : 0.4, 8};
    static uint64_t words[SKY_MOST_BYTES / 8u];
    const size_t size = sky_image(&recipe, (uint8_t *)words);
    void *exact = malloc(size); /* so that reading past the end is found */
    if (exact == NULL) {
      abort();
    }
    memcpy(exact, words, size);
    if (starcat_open_image(&images[n], exact, size, 0) != STARCAT_OK) {
      abort();
    }
    list_neighbours(&images[n], &tables[n]);
  }
  return 0;
}

/* A number as it was, a little off, a plain one, one of the odd ones, or any bits at all. */
static void change(fuzz_bytes *bytes, starcat_real *value) {
  static const starcat_real odd[12] = {0,        -(starcat_real)0.0, 1,         -1,
                                       INFINITY, -INFINITY,          LEAST,     LARGE,
                                       1e9F,     FLT_EPSILON,        LEAST / 4, 512};
  switch (fuzz_number(bytes, 1) % 8u) {
    case 1:
      *value *= (starcat_real)(1.0 + 1e-6 * ((double)fuzz_number(bytes, 2) - 32768.0));
      break;
    case 2:
      *value = (starcat_real)((double)fuzz_number(bytes, 2) / 64.0 - 256.0);
      break;
    case 3:
      *value = odd[fuzz_number(bytes, 1) % 12u];
      break;
    case 4:
      fuzz_take(bytes, value, sizeof *value); /* a signalling NaN too, so by its bytes */
      break;
    case 5:
      *value = (starcat_real)NAN;
      break;
    default:
      break;
  }
}

static void change_camera(fuzz_bytes *bytes, starcat_camera *c) {
  starcat_real *const numbers[11] = {&c->width_px, &c->height_px,  &c->focal_length_px,
                                     &c->x0_px,    &c->y0_px,      &c->k1,
                                     &c->k2,       &c->k3,         &c->p1,
                                     &c->p2,       &c->fold_radius};
  for (uint32_t n = fuzz_number(bytes, 1) % 32u; n < 11u; n += 1u + fuzz_number(bytes, 1) % 8u) {
    change(bytes, numbers[n]);
  }
}

static void change_options(fuzz_bytes *bytes, starcat_options *o) {
  starcat_real *const numbers[6] = {&o->tolerance_px, &o->noise_px, &o->noise_mag, &o->log_chance,
                                    &o->fov_error,    &o->camera_error};
  for (uint32_t n = fuzz_number(bytes, 1) % 8u; n < 6u; n++) {
    change(bytes, numbers[n]);
  }
  o->max_steps = 65535u - fuzz_number(bytes, 2);
}

/* A column of exactly one number per centroid; the first `known` numbers come from the frame. */
static starcat_real *column(fuzz_bytes *bytes, const starcat_real *values, uint32_t known,
                            uint32_t count, uint32_t some) {
  starcat_real *made = malloc(((size_t)count + (count == 0u)) * sizeof *made);
  for (uint32_t i = 0; (made != NULL) && (i < count); i++) {
    made[i] = values[i % known];
    if ((i >= known) || (fuzz_number(bytes, 1) % 8u < some)) {
      change(bytes, &made[i]);
    }
  }
  return made;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size) {
  fuzz_bytes bytes = {data, size};
  traps_on();
  const uint32_t sky = fuzz_number(&bytes, 1) % 3u;
  const starcat_image *image = &images[sky];
  uint64_t seed = fuzz_number(&bytes, 1);
  starcat_camera camera;
  starcat_options options;
  sky_frame truth;
  (void)starcat_get_camera(image, &camera);
  (void)starcat_set_default_options(&options);
  const uint32_t n_false = fuzz_number(&bytes, 1);
  sky_look(image, &camera, &seed, 0.2, sky == 2u ? STARCAT_MAX_CENTROIDS : SKY_SPOTS, n_false % 4u,
           &truth);
  change_camera(&bytes, &camera);
  change_options(&bytes, &options);
  images[sky].neighbours = (n_false & 4u) != 0u ? &tables[sky] : NULL;
  options.max_steps *=
      (n_false & 8u) != 0u ? 6u : 1u; /* triangles alone take 150,000 before votes */
  starcat_real q[4], uncertainty_rad = (starcat_real)0.02;
  const uint32_t prior = fuzz_number(&bytes, 1);
  for (uint32_t n = 0; n < 4u; n++) {
    q[n] = truth.q_body_from_icrs[n];
    if ((prior >> n & 1u) != 0u) {
      change(&bytes, &q[n]);
    }
  }
  if ((prior >> 4 & 1u) != 0u) {
    change(&bytes, &uncertainty_rad);
  }
  const uint32_t change = fuzz_number(&bytes, 1);
  const uint32_t count = (change & 1u) != 0u ? fuzz_number(&bytes, 1) % 70u : truth.count;
  starcat_real *x = column(&bytes, truth.x, truth.count, count, change >> 1 & 3u);
  starcat_real *y = column(&bytes, truth.y, truth.count, count, change >> 3 & 3u);
  starcat_real *magnitudes = column(&bytes, truth.magnitudes, truth.count, count, change >> 5 & 3u);
  const starcat_frame frame = {count, x, y, (change & 128u) != 0u ? NULL : magnitudes,
                               (count & 2u) != 0u ? y : NULL};
  fuzz_check(image, &options, &frame,
             starcat_identify_frame(image, &camera, &options, &frame, &work, &result), &result);
  fuzz_check(
      image, &options, &frame,
      starcat_track_frame(image, &camera, &options, &frame, q, uncertainty_rad, &work, &result),
      &result);
  starcat_real(*vectors)[3] = malloc((size_t)(count / 3u + 1u) * sizeof *vectors);
  if ((vectors != NULL) && (x != NULL) && (y != NULL)) {
    for (uint32_t n = 0; n < count / 3u; n++) {
      memcpy(vectors[n], x + 3u * n, sizeof vectors[n]);
    }
    (void)starcat_fit_attitude((const starcat_real(*)[3])vectors, (const starcat_real(*)[3])vectors,
                               count / 3u, q);
  }
  free(vectors);
  free(x);
  free(y);
  free(magnitudes);
  traps_off();
  return 0;
}
