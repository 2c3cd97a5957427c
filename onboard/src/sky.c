/* The stars of the image by place: which lie within a cap of the sky.
 *
 * SPDX-License-Identifier: MIT
 */
#include "internal.h"

/* Vectors of stars were rounded, by up to 4.1e-10 of their length, and so are their products.
 * Without this margin a cap of a few arcseconds would miss the star in its centre. */
#ifdef STARCAT_SINGLE
#define COSINE_MARGIN R(3e-7)
#else
#define COSINE_MARGIN R(5e-10)
#endif

/* A number from 0 to 4 that grows with right ascension, without computing an angle. At x = 0 both
 * formulas agree; it is not used for a cap that contains a pole. */
static real longitude(real x, real y) {
  const real ax = x < R(0.0) ? -x : x, ay = y < R(0.0) ? -y : y;
  const real t = y / (ax + ay);
  if (x < R(0.0)) {
    return R(2.0) - t;
  }
  return y < R(0.0) ? R(4.0) + t : t;
}

/* The cell of a coordinate that has been scaled to 0 .. 1. */
static uint32_t cell(real fraction, uint32_t count) {
  const real scaled = fraction * (real)count;
  if (!(scaled > R(0.0))) {
    return 0;
  }
  return scaled < (real)count ? (uint32_t)scaled : count - 1u;
}

/* A cap of the sky, and the arrays that receive its stars. */
typedef struct {
  const starcat_image *image;
  const real *centre;
  real cos_r;
  uint32_t *rows;
  real (*icrs)[3];
  uint32_t most, count, visited, limit;
} cap;

static void gather_sectors(cap *query, uint32_t band, uint32_t first, uint32_t last) {
  const starcat_image *image = query->image;
  const uint32_t *offsets = image->grid + (size_t)band * image->grid_sectors;
  const real x = query->centre[0], y = query->centre[1], z = query->centre[2];
  uint32_t stop = offsets[last + 1u], count = query->count;
  if (stop > image->n_stars) { /* a damaged image */
    stop = image->n_stars;
  }
  for (uint32_t row = offsets[first]; (row < stop) && (query->visited < query->limit); row++) {
    real icrs[3];
    starcat_read_star(image, row, icrs);
    query->visited++;
    if (icrs[0] * x + icrs[1] * y + icrs[2] * z >= query->cos_r) {
      if (count >= query->most) {
        query->count = query->most + 1u;
        return;
      }
      query->rows[count] = row;
      query->icrs[count][0] = icrs[0];
      query->icrs[count][1] = icrs[1];
      query->icrs[count][2] = icrs[2];
      count++;
    }
  }
  query->count = count;
}

/* Gather the stars within an angle r below 90 degrees of a direction, and perhaps some that are a
 * little farther. Returns their number, or most + 1 if there are more than `most` or if the steps
 * are used up. It takes one step per band and one step per star that it examines, inside the cap or
 * not. */
uint32_t starcat_gather_stars(const starcat_call *call, const real centre[3], real cos_r,
                              real sin_r, uint32_t most, uint32_t *rows, real (*icrs)[3]) {
  const starcat_image *image = call->image;
  const real x = centre[0], y = centre[1], z = centre[2];
  const real level = STARCAT_SQRT(x * x + y * y);
  cap query = {image, centre, cos_r - COSINE_MARGIN, rows, icrs, most, 0, 0, call->own->steps_left};
  const int has_pole = (z >= cos_r) || (-z >= cos_r) || (level <= sin_r);
  const real high = z >= cos_r ? R(1.0) : z * cos_r + level * sin_r;
  const real low = -z >= cos_r ? R(-1.0) : z * cos_r - level * sin_r;
  const uint32_t top = cell(R(0.5) * (high + R(1.0)), image->grid_bands);
  uint32_t west = 0, east = image->grid_sectors - 1u;
  if (!has_pole) {
    /* Meridians that touch the cap are this angle away from its centre's. */
    const real s = sin_r / level, c = STARCAT_SQRT(R(1.0) - s * s);
    west = cell(R(0.25) * longitude(x * c + y * s, y * c - x * s), image->grid_sectors);
    east = cell(R(0.25) * longitude(x * c - y * s, y * c + x * s), image->grid_sectors);
  }
  for (uint32_t band = cell(R(0.5) * (low + R(1.0)), image->grid_bands);
       (band <= top) && (query.count <= most); band++) {
    query.visited++;
    if (west <= east) {
      gather_sectors(&query, band, west, east);
    } else {
      gather_sectors(&query, band, west, image->grid_sectors - 1u);
      if (query.count <= most) {
        gather_sectors(&query, band, 0, east);
      }
    }
  }
  return starcat_spend_steps(call, query.visited) ? query.count : most + 1u;
}
