/* Identifies the stars of one frame and prints the attitude.
 *
 *   identify IMAGE FRAME
 *
 * Frames that triangles do not solve are solved by votes, with a table of neighbours of every star.
 *
 * IMAGE is a file of `starcat export --to onboard`; FRAME has one line "x y magnitude" per
 * centroid. If an image is linked in (`starcat export --to c`), no file is read:
 * starcat_open_image(&image, starcat_sao_12deg_1_0_0, sizeof starcat_sao_12deg_1_0_0, 0).
 *
 * SPDX-License-Identifier: MIT
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "starcat.h"

/* The memory of the calls; static, as in flight software. */
static starcat_workspace work;
static starcat_result result;

static void *read_image(const char *path, size_t *size) {
  FILE *file = fopen(path, "rb");
  long end = -1;
  void *bytes = NULL;
  *size = 0;
  if (file == NULL) {
    return NULL;
  }
  if (fseek(file, 0, SEEK_END) == 0) {
    end = ftell(file);
  }
  if (end > 0) {
    rewind(file);
    bytes = malloc((size_t)end); /* aligned for any type, as the library requires */
    *size = bytes == NULL ? 0u : fread(bytes, 1, (size_t)end, file);
  }
  (void)fclose(file);
  return bytes;
}

static uint32_t read_frame(const char *path, starcat_real (*columns)[STARCAT_MAX_CENTROIDS]) {
  FILE *file = fopen(path, "r");
  double x, y, magnitude;
  uint32_t count = 0;
  while ((file != NULL) && (count < STARCAT_MAX_CENTROIDS) &&
         (fscanf(file, "%lf %lf %lf", &x, &y, &magnitude) == 3)) {
    columns[0][count] = (starcat_real)x;
    columns[1][count] = (starcat_real)y;
    columns[2][count] = (starcat_real)magnitude;
    count++;
  }
  if (file != NULL) {
    (void)fclose(file);
  }
  return count;
}

/* List the neighbours of every star within half of the diagonal of the field. The first call
 * returns their number. If there is not enough memory for them, the image is not changed. */
static void list_neighbours(starcat_image *image, const starcat_camera *camera,
                            starcat_neighbours *table) {
  const double diagonal_px = hypot((double)camera->width_px, (double)camera->height_px);
  table->radius_rad = (starcat_real)atan(0.5 * diagonal_px / (double)camera->focal_length_px);
  table->first = malloc(((size_t)image->n_stars + 1u) * sizeof *table->first);
  if ((starcat_list_neighbours(image, &work, table) == STARCAT_E_CAPACITY) &&
      (table->first[image->n_stars] > 0u)) {
    table->capacity = table->first[image->n_stars];
    table->neighbour = malloc((size_t)table->capacity * sizeof *table->neighbour);
    if (starcat_list_neighbours(image, &work, table) == STARCAT_OK) {
      image->neighbours = table;
    }
  }
}

int main(int argc, char **argv) {
  static starcat_real columns[3][STARCAT_MAX_CENTROIDS];
  starcat_image image;
  starcat_camera camera;
  starcat_options options;
  starcat_neighbours table = {0};
  size_t size = 0;
  if (argc != 3) {
    (void)fprintf(stderr, "identify IMAGE FRAME\n");
    return 2;
  }
  void *bytes = read_image(argv[1], &size);
  starcat_status status = starcat_open_image(&image, bytes, size, 0);
  if (status != STARCAT_OK) {
    (void)fprintf(stderr, "%s: status %d\n", argv[1], (int)status);
    free(bytes);
    return 2;
  }
  (void)starcat_get_camera(&image, &camera);
  (void)starcat_set_default_options(&options);
  list_neighbours(&image, &camera, &table);
  const uint32_t count = read_frame(argv[2], columns);
  const starcat_frame frame = {count, columns[0], columns[1], columns[2], NULL};
  status = starcat_identify_frame(&image, &camera, &options, &frame, &work, &result);
  (void)printf("%.96s: %u stars, status %d after %u steps\n", image.name, (unsigned)image.n_stars,
               (int)status, (unsigned)result.steps);
  if (status == STARCAT_IDENTIFIED) {
    const starcat_real *q = result.q_body_from_icrs;
    (void)printf("attitude %.9f %.9f %.9f %.9f, %u stars, chance below 1e%.0f\n", (double)q[0],
                 (double)q[1], (double)q[2], (double)q[3], (unsigned)result.n_matched,
                 (double)result.log_chance * 0.4342944819);
    for (uint32_t i = 0; i < count; i++) {
      const int32_t row = result.star[i];
      const long found = row < 0 ? (long)row : (long)image.star_ids[row];
      (void)printf("centroid %u: %ld\n", (unsigned)i, found);
    }
  }
  free(table.first);
  free(table.neighbour);
  free(bytes);
  return status == STARCAT_IDENTIFIED ? 0 : 1;
}
