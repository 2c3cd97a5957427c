/* Claim: starcat_find_rows (the K-vector), starcat_read_rows (features), starcat_read_star (directions),
 * and of sky.c cell and gather_sectors (the grid) cause no run-time error on an opened image,
 * whatever its directions, grid, K-vector and features are, and whatever is looked up.
 *
 * Preconditions: what starcat_open_image leaves: arrays of exactly as many elements as the image says,
 * here 30 stars, 12 bands of 24 sectors, 50 features and 14 entries of the K-vector, with indices of
 * 2 or 4 bytes, and the line of the K-vector in its ranges; a feature is below n_features. Values
 * that are looked up are from -1e6 to 1e6; fractions of cell are finite, and any band and
 * sectors of the grid may be gathered, around any centre.
 *
 * Not claimed: the rest of starcat_gather_stars, which turns a centre into bands and sectors by cell. Eva 25
 * does not see that a comparison with NaN is false, on which cell relies there.
 *
 * SPDX-License-Identifier: MIT
 */
#include "proof.h"

#include "../../../src/sky.c"

#define STARS 30u
#define BANDS 12u
#define SECTORS 24u
#define FEATURES 50u
#define ENTRIES 14u
#define MOST 8u

static int32_t directions[3u * STARS];
static uint32_t grid[BANDS * SECTORS + 1u], kvector[ENTRIES], wide[3u * FEATURES];
static uint16_t narrow[3u * FEATURES];

static void look_up(const starcat_image *image, uint32_t width) {
  uint32_t start, stop, rows[3];
  real icrs[3];
  starcat_find_rows(image, any_from(-1e6, 1e6), any_from(-1e6, 1e6), &start, &stop);
  for (uint32_t feature = start; feature < stop; feature++) {
    starcat_read_rows(image, feature, width, rows);
    if (rows[0] < image->n_stars) {
      starcat_read_star(image, rows[0], icrs);
    }
  }
}

int main(void) {
  starcat_image image;
  uint32_t rows[MOST];
  real near[MOST][3];
  const real centre[3] = {any_real(), any_real(), any_real()};
  make_any(directions, sizeof directions);
  make_any(grid, sizeof grid);
  make_any(kvector, sizeof kvector);
  make_any(wide, sizeof wide);
  make_any(narrow, sizeof narrow);
  make_any(&image, sizeof image);
  image.n_stars = STARS;
  image.grid_bands = BANDS;
  image.grid_sectors = SECTORS;
  image.n_features = FEATURES;
  image.n_kvector = ENTRIES;
  image.directions = directions;
  image.grid = grid;
  image.kvector = kvector;
  image.kvector_intercept = any_from(-1e6, 1e6);
  image.kvector_slope = any_from(1e-25, 1e6);
  image.index_bytes = 2;
  image.features = narrow;
  look_up(&image, 2);
  look_up(&image, 3);
  image.index_bytes = 4;
  image.features = wide;
  look_up(&image, 2);
  look_up(&image, 3);
  (void)cell(any_from(-1.7e308, 1.7e308), any_u32());
  cap query = {&image, centre, any_real(), rows, near, MOST, 0, 0, any_u32()};
  query.count = (uint32_t)any(0, MOST);
  query.visited = any_u32();
  gather_sectors(&query, (uint32_t)any(0, BANDS - 1), (uint32_t)any(0, SECTORS - 1),
                 (uint32_t)any(0, SECTORS - 1));
  return 0;
}
