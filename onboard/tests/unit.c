/* The unit test: every part on images of two made-up skies. Prints each check that fails, and with
 * an argument the checks of each part; the exit code is 0 if no check failed.
 *
 * SPDX-License-Identifier: MIT
 */
#include "unit.h"
#include "traps.h"

#include <string.h>

unsigned check_count, check_failures;
unit_sky unit_triangle, unit_pyramid, unit_crowded, unit_scratch;
starcat_workspace unit_work;
starcat_result unit_result;

static void open_sky(unit_sky *sky) {
  CHECK_IS(starcat_open_image(&sky->image, sky->bytes, sky->size, 0), STARCAT_OK);
  (void)starcat_get_camera(&sky->image, &sky->camera);
  (void)starcat_set_default_options(&sky->options);
}

static void make_sky(unit_sky *sky, const sky_recipe *recipe) {
  sky->bytes = (uint8_t *)sky->words;
  sky->size = sky_image(recipe, sky->bytes);
  open_sky(sky);
}

void unit_copy(const unit_sky *from) {
  unit_scratch = *from;
  unit_scratch.bytes = (uint8_t *)unit_scratch.words;
  open_sky(&unit_scratch);
}

starcat_status unit_open_with(size_t at, uint32_t value) {
  memcpy(unit_scratch.bytes + at, &value, 4);
  sky_seal(unit_scratch.bytes);
  return starcat_open_image(&unit_scratch.image, unit_scratch.bytes, unit_scratch.size, 0);
}

starcat_frame unit_frame_of(const sky_frame *truth) {
  const starcat_frame frame = {truth->count, truth->x, truth->y, truth->magnitudes, NULL};
  return frame;
}

starcat_status unit_identify(const unit_sky *sky, const sky_frame *truth) {
  const starcat_frame frame = unit_frame_of(truth);
  return starcat_identify_frame(&sky->image, &sky->camera, &sky->options, &frame, &unit_work,
                                &unit_result);
}

uint32_t unit_wrong_stars(const sky_frame *truth) {
  uint32_t wrong = 0;
  for (uint32_t i = 0; i < truth->count; i++) {
    wrong += (uint32_t)((unit_result.star[i] >= 0) && (unit_result.star[i] != truth->star[i]));
  }
  return wrong;
}

void unit_matrix_of(const sky_frame *truth, starcat_real m[9]) {
  for (uint32_t k = 0; k < 9u; k++) {
    m[k] = (starcat_real)truth->matrix[k];
  }
}

double unit_error_rad(const sky_frame *truth) {
  double square = 0.0;
  for (uint32_t k = 6; k < 9u; k++) {
    const double apart = (double)unit_result.matrix[k] - truth->matrix[k];
    square += apart * apart;
  }
  return sqrt(square);
}

int main(int argc, char **argv) {
  static const struct {
    const char *name;
    void (*run)(void);
  } tests[] = {{"open", test_open},       {"scrub", test_scrub},       {"damaged", test_damaged},
               {"errors", test_errors},   {"dropped", test_dropped},   {"track", test_track},
               {"budget", test_budget},   {"identify", test_identify}, {"camera", test_camera},
               {"kernels", test_kernels}, {"attitude", test_attitude}, {"rare", test_rare},
               {"answer", test_answer},   {"crowded", test_crowded},   {"scale", test_scale},
               {"shape", test_shape},     {"votes", test_votes},       {"update", test_update},
               {"session", test_session}};
  const sky_recipe triangles = {1, 2, SKY_STARS, 0.42, 8}, pairs = {2, 4, SKY_STARS, 0.698, 8};
  const sky_recipe crowded = {2, 2, 1500, 0.18, 9};
  (void)argv;
  traps_on();
  make_sky(&unit_triangle, &triangles);
  make_sky(&unit_pyramid, &pairs);
  make_sky(&unit_crowded, &crowded);
  for (size_t n = 0; n < sizeof tests / sizeof tests[0]; n++) {
    const unsigned before = check_failures, count_before = check_count;
    tests[n].run();
    CHECK_IS(traps_seen(), 0);
    if (check_failures != before) {
      (void)fprintf(stderr, "test %s: %u failed\n", tests[n].name, check_failures - before);
    }
    if (argc > 1) {
      (void)printf("%s: %u checks, %u failed\n", tests[n].name, check_count - count_before,
                   check_failures - before);
    }
  }
  (void)printf("%u checks, %u failed\n", check_count, check_failures);
  return check_failures == 0u ? 0 : 1;
}
