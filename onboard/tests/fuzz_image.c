/* libFuzzer: images. A sound image is changed at places that the fuzzer chooses, or its bytes are
 * the image; CRCs are not checked; frames are identified and tracked with what opens.
 *
 * SPDX-License-Identifier: MIT
 */
#include "fuzz.h"

#define N_FRAMES 2u

int LLVMFuzzerInitialize(int *argc, char ***argv);
int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static uint64_t sound[2][SKY_MOST_BYTES / 8u];
static size_t sizes[2];
static sky_frame frames[N_FRAMES];
static starcat_camera camera_of_sound;
static starcat_workspace work;
static starcat_result result;

int LLVMFuzzerInitialize(int *argc, char ***argv) {
  starcat_image image;
  uint64_t state = 2;
  (void)argc;
  (void)argv;
  for (uint32_t n = 0; n < 2u; n++) {
    const sky_recipe recipe = {n + 1u, n == 0u ? 2u : 4u, 150, 0.5, 8};
    sizes[n] = sky_image(&recipe, (uint8_t *)sound[n]);
    if (starcat_open_image(&image, sound[n], sizes[n], 0) != STARCAT_OK) {
      abort();
    }
  }
  (void)starcat_get_camera(&image, &camera_of_sound);
  for (uint32_t n = 0; n < N_FRAMES; n++) {
    sky_look(&image, &camera_of_sound, &state, 0.2, SKY_SPOTS, n, &frames[n]);
  }
  return 0;
}

/* Memory of exactly the image's size, so that reading past its end is found. */
static uint8_t *make_image(fuzz_bytes *bytes, size_t *size) {
  const uint32_t kind = fuzz_number(bytes, 1) % 8u;
  if (kind == 7u) {
    *size = bytes->left;
    uint8_t *image = malloc(*size + 1u);
    if (image != NULL) {
      fuzz_take(bytes, image, *size);
    }
    return image;
  }
  *size = sizes[kind % 2u];
  uint8_t *image = malloc(*size);
  if (image != NULL) {
    memcpy(image, sound[kind % 2u], *size);
    while (bytes->left > 0u) {
      /* Half of the changes are in header and section table, where the most depends on them. */
      const uint32_t place = fuzz_number(bytes, 4);
      const size_t at = (place & 1u) != 0u ? (place >> 1) % 512u : (place >> 1) % *size;
      const size_t count = 1u + fuzz_number(bytes, 1) % 8u;
      fuzz_take(bytes, image + at, count < *size - at ? count : *size - at);
    }
  }
  return image;
}

/* The neighbours of the stars of whatever opened, in memory of exactly their number. */
static void list_neighbours(starcat_image *image, starcat_neighbours *table) {
  memset(table, 0, sizeof *table);
  table->radius_rad = (starcat_real)0.475;
  table->first = malloc(((size_t)image->n_stars + 1u) * sizeof *table->first);
  if ((starcat_list_neighbours(image, &work, table) == STARCAT_E_CAPACITY) &&
      (table->first[image->n_stars] > 0u)) {
    table->capacity = table->first[image->n_stars];
    table->neighbour = malloc(table->capacity * sizeof *table->neighbour);
    if ((table->neighbour != NULL) &&
        (starcat_list_neighbours(image, &work, table) != STARCAT_OK)) {
      abort();
    }
  }
  image->neighbours = table;
}

static void use(const starcat_image *image, const starcat_camera *camera) {
  starcat_options options;
  (void)starcat_set_default_options(&options);
  options.max_steps = 20000;
  for (uint32_t n = 0; n < N_FRAMES; n++) {
    const sky_frame *f = &frames[n];
    const starcat_frame frame = {f->count, f->x, f->y, n == 0u ? NULL : f->magnitudes, NULL};
    options.noise_mag = (starcat_real)(n == 0u ? 0.0 : 0.3);
    fuzz_check(image, &options, &frame,
               starcat_identify_frame(image, camera, &options, &frame, &work, &result), &result);
    fuzz_check(image, &options, &frame,
               starcat_track_frame(image, camera, &options, &frame, f->q_body_from_icrs,
                                   (starcat_real)0.02, &work, &result),
               &result);
  }
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size) {
  fuzz_bytes bytes = {data, size};
  starcat_image image;
  starcat_camera camera;
  starcat_neighbours table;
  uint32_t bad;
  traps_on();
  uint8_t *made = make_image(&bytes, &size);
  if (made != NULL) {
    (void)starcat_open_image(&image, made, size, 0);
    (void)starcat_scrub_image(made, size, 1, 3, &bad);
    if (starcat_open_image(&image, made, size, STARCAT_SKIP_CRC) == STARCAT_OK) {
      (void)starcat_get_camera(&image, &camera);
      use(&image, &camera);
      use(&image, &camera_of_sound);
      list_neighbours(&image, &table);
      use(&image, &camera);
      use(&image, &camera_of_sound);
      free(table.first);
      free(table.neighbour);
    }
  }
  free(made);
  traps_off();
  return 0;
}
