/* Crowded frames of unknown brightness: triangles of near neighbours.
 *
 * SPDX-License-Identifier: MIT
 */
#include <string.h>

#include "internal.h"
#include "unit.h"

#define MOST_TAKEN 5000u
#define SPOTS 40u

static sky_frame truth;
static starcat_call call;
static unit_sky sky; /* triangles of many stars */
static uint32_t n_taken, n_again;
static uint8_t is_taken[SPOTS][SPOTS][SPOTS];

static starcat_status identify(const unit_sky *of) {
  const starcat_frame frame = {truth.count, truth.x, truth.y, NULL, NULL};
  return starcat_identify_frame(&of->image, &of->camera, &of->options, &frame, &unit_work,
                                &unit_result);
}

static starcat_status begin(const unit_sky *of) {
  const starcat_frame frame = {truth.count, truth.x, truth.y, NULL, NULL};
  return starcat_begin_call(&call, &of->image, &of->camera, &of->options, &frame, &unit_work,
                            &unit_result);
}

static int count_taken(starcat_call *of, const uint32_t triple[3], const starcat_real sides[3]) {
  (void)of;
  CHECK((triple[0] < triple[1]) && (triple[1] < triple[2]));
  CHECK(sides[0] > (starcat_real)0.0);
  n_taken++;
  if (triple[2] < SPOTS) {
    n_again += is_taken[triple[0]][triple[1]][triple[2]];
    is_taken[triple[0]][triple[1]][triple[2]] = 1;
  }
  return 0;
}

static double apart(uint32_t i, uint32_t j) {
  double square = 0.0;
  for (uint32_t k = 0; k < 3u; k++) {
    const double d = (double)unit_work.body[i][k] - (double)unit_work.body[j][k];
    square += d * d;
  }
  return 2.0 * asin(0.5 * sqrt(square));
}

/* Whether centroid j is among the centroids nearest to i. */
static int is_near(uint32_t i, uint32_t j) {
  uint32_t nearer = 0;
  for (uint32_t k = 0; k < call.own->count; k++) {
    nearer += (uint32_t)((k != i) && (k != j) && (apart(i, k) < apart(i, j)));
  }
  return nearer < STARCAT_NEIGHBOURS;
}

static int is_well_shaped(double a, double b, double c) {
  const double least = 10.0 / (double)sky.camera.focal_length_px;
  const double narrow = 0.96592582628906828675; /* cosine of 15 degrees */
  return (a > least) && (b > least) && (c > least) &&
         (b * b + c * c - a * a < 2.0 * narrow * b * c) &&
         (a * a + c * c - b * b < 2.0 * narrow * a * c) &&
         (a * a + b * b - c * c < 2.0 * narrow * a * b);
}

/* Every well-shaped triangle of a centroid and two of its nearest ones is looked up once, and no
 * other. */
static void check_each_once(void) {
  uint64_t state = 61;
  uint32_t expected = 0, missing = 0;
  sky_look(&sky.image, &sky.camera, &state, 0.0, SPOTS, SPOTS - 1u, &truth);
  CHECK_IS(begin(&sky), STARCAT_OK);
  CHECK_IS(call.own->count, SPOTS);
  n_taken = n_again = 0;
  memset(is_taken, 0, sizeof is_taken);
  starcat_search_triangles(&call, count_taken);
  for (uint32_t k = 0; k < SPOTS; k++) {
    for (uint32_t j = 0; j < k; j++) {
      for (uint32_t i = 0; i < j; i++) {
        if (((is_near(i, j) && is_near(i, k)) || (is_near(j, i) && is_near(j, k)) ||
             (is_near(k, i) && is_near(k, j))) &&
            is_well_shaped(apart(j, k), apart(i, k), apart(i, j))) {
          expected++;
          missing += (uint32_t)(is_taken[i][j][k] == 0u);
        }
      }
    }
  }
  CHECK((expected > 1000u) && (expected < MOST_TAKEN));
  CHECK_IS(n_taken, expected);
  CHECK_IS(missing, 0);
  CHECK_IS(n_again, 0);
}

/* Spots on a spiral make more triangles than may be looked up. */
static void check_most_taken(void) {
  truth.count = STARCAT_MAX_CENTROIDS;
  for (uint32_t k = 0; k < truth.count; k++) {
    const double radius_px = 250.0 * (k + 0.5) / truth.count, angle = 2.399963 * k;
    truth.x[k] = (starcat_real)(256.0 + radius_px * cos(angle));
    truth.y[k] = (starcat_real)(256.0 + radius_px * sin(angle));
  }
  CHECK_IS(begin(&sky), STARCAT_OK);
  n_taken = 0;
  starcat_search_triangles(&call, count_taken);
  CHECK_IS(n_taken, MOST_TAKEN);
  sky.options.max_steps = 10000000; /* of which it takes six million */
  CHECK_IS(identify(&sky), STARCAT_NO_MATCH);
  CHECK(unit_result.reason != (uint32_t)STARCAT_REASON_STEPS);
  (void)starcat_set_default_options(&sky.options);
}

/* Crowded frames most of whose spots are false. */
static void check_stars(void) {
  uint64_t state = 62;
  uint32_t found = 0;
  for (uint32_t n = 0; n < 40u; n++) {
    sky_look(&sky.image, &sky.camera, &state, 0.2, STARCAT_MAX_CENTROIDS, 40u, &truth);
    if (identify(&sky) == STARCAT_IDENTIFIED) {
      CHECK_IS(unit_wrong_stars(&truth), 0);
      found++;
    }
  }
  CHECK(found >= 36u);
}

void test_crowded(void) {
  const sky_recipe recipe = {1, 2, 700, 0.17, 9};
  sky.bytes = (uint8_t *)sky.words;
  sky.size = sky_image(&recipe, sky.bytes);
  CHECK_IS(starcat_open_image(&sky.image, sky.bytes, sky.size, 0), STARCAT_OK);
  (void)starcat_get_camera(&sky.image, &sky.camera);
  (void)starcat_set_default_options(&sky.options);
  check_each_once();
  check_most_taken();
  check_stars();
}
