/* Sessions: tracked frames and frames lost in space, their budget, corrected centroids; images that
 * are loaded, checked, changed, scrubbed and repaired, and fallbacks.
 *
 * SPDX-License-Identifier: MIT
 */
#include <string.h>

#include "starcat_session.h"
#include "unit.h"

#define BLOCK 4096u
#define CAPACITY (SKY_MOST_BYTES / BLOCK * BLOCK)
#define SHIFT_PX ((starcat_real)0.5)

static uint64_t slot_words[2][CAPACITY / 8u];
static uint32_t patch_words[4096];
static starcat_session session;
static sky_frame truth;
static uint64_t state;

/* A session with an image in ROM. */
static void begin_in_rom(const unit_sky *sky) {
  memset(&session, 0, sizeof session);
  starcat_prepare_session(&session);
  CHECK_IS(session.image_status, STARCAT_E_NULL);
  CHECK_IS(starcat_use_image(&session, sky->bytes, sky->size), STARCAT_OK);
  session.options.noise_px = (starcat_real)0.3;
  session.prior_age = 10;
}

/* A session with the triangles' sky in the first slot and nothing in the other one. */
static void begin_in_slots(void) {
  memset(slot_words, 0, sizeof slot_words);
  memset(&session, 0, sizeof session);
  starcat_prepare_session(&session);
  session.slots.bytes[0] = (uint8_t *)slot_words[0];
  session.slots.bytes[1] = (uint8_t *)slot_words[1];
  session.slots.capacity = sizeof slot_words[0];
  session.slots.size[0] = unit_triangle.size;
  memcpy(slot_words[0], unit_triangle.bytes, unit_triangle.size);
  CHECK_IS(starcat_start_session(&session), STARCAT_OK);
}

static void look(void) { sky_look(&session.image, &session.camera, &state, 0.2, 12, 0, &truth); }

static starcat_status answer(uint64_t time) {
  const starcat_frame frame = unit_frame_of(&truth);
  return starcat_answer_frame(&session, &frame, time);
}

static void check_modes(void) {
  state = 5;
  begin_in_rom(&unit_triangle);
  look();
  CHECK_IS(answer(100), STARCAT_IDENTIFIED);
  CHECK_IS(session.mode, STARCAT_MODE_IDENTIFY);
  CHECK_IS(session.steps, session.result.steps);
  CHECK_IS(answer(105), STARCAT_IDENTIFIED);
  CHECK_IS(session.mode, STARCAT_MODE_TRACK);
  CHECK_IS(answer(96), STARCAT_IDENTIFIED); /* back in time, by little */
  CHECK_IS(session.mode, STARCAT_MODE_TRACK);
  CHECK_IS(answer(106), STARCAT_IDENTIFIED); /* too old by now */
  CHECK_IS(session.mode, STARCAT_MODE_IDENTIFY);
  look(); /* elsewhere: lost in space after tracking came to nothing */
  CHECK_IS(answer(107), STARCAT_IDENTIFIED);
  CHECK_IS(session.mode, STARCAT_MODE_IDENTIFY);
  CHECK(session.steps > session.result.steps);
  CHECK_IS(session.counts.frames_identified, 3);
  CHECK_IS(session.counts.frames_tracked, 2);
}

static void check_frames_without_answer(void) {
  state = 5;
  begin_in_rom(&unit_triangle);
  look();
  CHECK_IS(answer(100), STARCAT_IDENTIFIED);
  look();
  session.options.max_steps = 60; /* which tracking takes alone */
  CHECK_IS(answer(101), STARCAT_E_BUDGET);
  CHECK_IS(session.mode, STARCAT_MODE_TRACK);
  CHECK_IS(session.steps, 60);
  CHECK_IS(session.has_prior, 0);
  CHECK_IS(session.counts.frames_not_identified[STARCAT_REASON_STEPS - 1], 1);
  session.options.max_steps = 0;
  CHECK_IS(answer(102), STARCAT_E_OPTIONS);
  CHECK_IS(session.counts.frames_refused, 1);
  session.options.max_steps = 4000000u;
  truth.count = 3;
  CHECK_IS(answer(103), STARCAT_TOO_FEW_STARS);
  CHECK_IS(session.counts.frames_not_identified[STARCAT_REASON_TOO_FEW_STARS - 1], 1);
  session.has_prior = 1;
  CHECK_IS(starcat_answer_frame(&session, NULL, 103), STARCAT_E_NULL);
  CHECK_IS(starcat_use_image(&session, unit_triangle.bytes, 100), STARCAT_E_SHORT);
  session.has_prior = 1;
  CHECK_IS(answer(104), STARCAT_E_SHORT);
  CHECK_IS(session.mode, STARCAT_MODE_NONE);
  CHECK_IS(session.result.n_usable, 0);
  CHECK_IS(session.counts.frames_without_image, 1);
}

/* What moves centroids back that were moved by as much. */
static void shift_back(void *context, const starcat_real q[4], uint32_t count, starcat_real *x,
                       starcat_real *y) {
  uint32_t *calls = context;
  CHECK(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3] > (starcat_real)0.99);
  for (uint32_t n = 0; n < count; n++) {
    x[n] -= SHIFT_PX;
    y[n] += SHIFT_PX;
  }
  (*calls)++;
}

static void check_correction(void) {
  uint32_t calls = 0;
  starcat_frame without = {1, NULL, NULL, NULL, NULL};
  state = 7;
  begin_in_rom(&unit_triangle);
  session.correct = shift_back;
  session.context = &calls;
  look();
  for (uint32_t n = 0; n < truth.count; n++) {
    truth.x[n] += SHIFT_PX;
    truth.y[n] -= SHIFT_PX;
  }
  for (uint32_t n = 1; n <= 2u; n++) {
    CHECK_IS(answer(100), STARCAT_IDENTIFIED);
    CHECK_IS(calls, n); /* once a frame, lost in space and from the last attitude */
    starcat_real apart = 0;
    for (uint32_t k = 0; k < 4u; k++) {
      const starcat_real d = session.result.q_body_from_icrs[k] - truth.q_body_from_icrs[k];
      apart += d * d;
    }
    /* Half an angle; the centroids were moved by 0.7 px. */
    apart *= 4 * session.camera.focal_length_px * session.camera.focal_length_px;
    CHECK(apart < (starcat_real)(0.35 * 0.35));
  }
  CHECK_IS(session.mode, STARCAT_MODE_TRACK);
  CHECK_IS(starcat_answer_frame(&session, &without, 101), STARCAT_E_NULL);
  session.has_prior = 1;
  without.x_px = truth.x;
  CHECK_IS(starcat_answer_frame(&session, &without, 101), STARCAT_E_NULL);
  session.has_prior = 1;
  truth.count = STARCAT_MAX_CENTROIDS + 1u;
  CHECK_IS(answer(101), STARCAT_E_TOO_MANY_CENTROIDS);
  CHECK_IS(calls, 2);
}

/* If the last step is used for the attitude, no step is left to correct it. Here the last steps are
 * used for a false spot beside a star, whose test changes nothing. */
static void check_correction_without_steps(void) {
  uint32_t calls = 0, spent = 0;
  begin_in_rom(&unit_triangle);
  session.prior_age = 0;
  session.context = &calls;
  for (uint32_t seed = 1; seed < 30u; seed++) {
    state = seed;
    session.correct = NULL;
    session.options.max_steps = 4000000u;
    sky_look(&session.image, &session.camera, &state, 0.05, 14, 1, &truth);
    truth.x[truth.count - 1u] = truth.x[0] + 4;
    truth.y[truth.count - 1u] = truth.y[0];
    (void)answer(100);
    session.options.max_steps = session.steps - session.steps / 8u;
    if ((answer(100) == STARCAT_IDENTIFIED) && (session.steps == session.options.max_steps)) {
      session.correct = shift_back;
      CHECK_IS(answer(100), STARCAT_E_BUDGET);
      CHECK_IS(session.result.n_matched, 0);
      CHECK_IS(session.result.reason, STARCAT_REASON_STEPS);
      spent++;
    }
  }
  CHECK(spent > 0u);
  CHECK_IS(calls, 0);
}

static void check_settings(void) {
  starcat_options options;
  starcat_camera camera = unit_triangle.camera;
  starcat_set_default_options(&options);
  CHECK_IS(starcat_check_settings(&camera, &options), STARCAT_OK);
  CHECK_IS(starcat_check_settings(NULL, &options), STARCAT_OK);
  camera.focal_length_px = 0;
  CHECK_IS(starcat_check_settings(&camera, &options), STARCAT_E_CAMERA);
  options.max_steps = 0;
  CHECK_IS(starcat_check_settings(&camera, &options), STARCAT_E_OPTIONS);
}

static starcat_event work_until(starcat_event expected) {
  starcat_event event = STARCAT_EVENT_NONE;
  for (uint32_t n = 0; (n < 300u) && (event == STARCAT_EVENT_NONE); n++) {
    event = starcat_do_idle_work(&session);
  }
  CHECK_IS(event, expected);
  return event;
}

static starcat_status load(const uint8_t *bytes, size_t size) {
  starcat_status status = STARCAT_INCOMPLETE;
  for (size_t at = 0; (at < size) && (status == STARCAT_INCOMPLETE); at += BLOCK) {
    const size_t count = size - at < BLOCK ? size - at : BLOCK;
    status = starcat_load_piece(&session, bytes + at, count);
  }
  return status;
}

static void check_load(void) {
  const unit_sky *sky = &unit_pyramid;
  begin_in_slots();
  session.blocks_per_tick = 2;
  CHECK_IS(starcat_load_piece(&session, sky->bytes, BLOCK), STARCAT_E_OPTIONS);
  CHECK_IS(starcat_begin_load(&session, sky->size, 0), STARCAT_OK);
  CHECK_IS(session.load, STARCAT_LOAD_READING);
  CHECK_IS(starcat_do_idle_work(&session), STARCAT_EVENT_NONE); /* scrubs */
  CHECK_IS(session.scrub_block, 2);
  CHECK_IS(starcat_change_image(&session), STARCAT_INCOMPLETE);
  CHECK_IS(load(sky->bytes, sky->size), STARCAT_OK);
  CHECK_IS(session.load, STARCAT_LOAD_CHECKING);
  CHECK_IS(starcat_change_image(&session), STARCAT_INCOMPLETE);
  (void)work_until(STARCAT_EVENT_READY);
  CHECK(session.check_block >= sky->size / BLOCK);
  CHECK_IS(session.load, STARCAT_LOAD_READY);
  session.has_own_camera = 1;
  CHECK_IS(starcat_change_image(&session), STARCAT_OK);
  CHECK_IS(session.load, STARCAT_LOAD_NONE);
  CHECK_IS(session.image.method, unit_pyramid.image.method);
  CHECK(session.camera.focal_length_px == unit_triangle.camera.focal_length_px);
  session.has_own_camera = 0;
  CHECK_IS(starcat_change_image(&session), STARCAT_OK); /* back */
  CHECK_IS(session.image.method, unit_triangle.image.method);
}

static void check_loads_that_fail(void) {
  const unit_sky *sky = &unit_pyramid;
  begin_in_slots();
  CHECK_IS(starcat_begin_load(&session, BLOCK + 1u, 0), STARCAT_E_LAYOUT);
  CHECK_IS(session.load, STARCAT_LOAD_FAILED);
  CHECK_IS(starcat_begin_load(&session, sky->size, 1), STARCAT_OK); /* the stated CRC is wrong */
  CHECK_IS(load(sky->bytes, sky->size), STARCAT_OK);
  (void)work_until(STARCAT_EVENT_REFUSED);
  CHECK_IS(session.event_status, STARCAT_INCOMPLETE);
  CHECK_IS(session.event_block, sky->size / BLOCK - 1u);
  CHECK_IS(starcat_begin_load(&session, sky->size, 0), STARCAT_OK);
  CHECK_IS(load(sky->bytes, sky->size), STARCAT_OK);
  session.slots.bytes[1][3u * BLOCK] ^= 1u;
  (void)work_until(STARCAT_EVENT_REFUSED);
  CHECK_IS(session.event_status, STARCAT_E_CRC);
  CHECK_IS(session.event_block, 3);
  CHECK_IS(session.load, STARCAT_LOAD_FAILED);
  CHECK_IS(starcat_change_image(&session), STARCAT_INCOMPLETE);
  CHECK_IS(session.image_status, STARCAT_OK); /* nothing changes */
  CHECK_IS(starcat_begin_load(&session, sky->size, 0), STARCAT_OK);
  CHECK_IS(starcat_load_piece(&session, sky->bytes, sky->size + 1u), STARCAT_E_SHORT);
  CHECK_IS(session.load, STARCAT_LOAD_FAILED);
}

static void check_patch_loads(void) {
  const uint8_t *bytes = unit_triangle.bytes;
  begin_in_slots();
  CHECK_IS(starcat_begin_patch_load(&session, 100), STARCAT_E_SHORT); /* no memory */
  session.patch = patch_words;
  session.patch_capacity = sizeof patch_words;
  CHECK_IS(starcat_begin_patch_load(&session, sizeof patch_words + 1u), STARCAT_E_SHORT);
  CHECK_IS(starcat_begin_patch_load(&session, 2u * BLOCK), STARCAT_OK);
  CHECK_IS(starcat_load_piece(&session, NULL, 1), STARCAT_E_NULL);
  CHECK_IS(starcat_begin_patch_load(&session, 2u * BLOCK), STARCAT_OK);
  CHECK_IS(starcat_load_piece(&session, bytes, BLOCK), STARCAT_INCOMPLETE);
  CHECK_IS(starcat_load_piece(&session, bytes, BLOCK + 1u), STARCAT_E_SHORT);
  CHECK_IS(starcat_begin_patch_load(&session, 2u * BLOCK), STARCAT_OK);
  CHECK_IS(load(bytes, 2u * BLOCK), STARCAT_OK);
  CHECK_IS(memcmp(patch_words, bytes, 2u * BLOCK), 0);
  (void)work_until(STARCAT_EVENT_REFUSED); /* an image is not a patch */
  CHECK_IS(session.event_status, STARCAT_E_MAGIC);
}

static void damage(uint32_t slot, uint32_t first, uint32_t count) {
  for (uint32_t n = 0; n < count; n++) {
    session.slots.bytes[slot][(size_t)(first + n) * BLOCK + 9u] ^= 0x10u;
  }
}

static void check_scrubbing(void) {
  begin_in_slots();
  session.blocks_per_tick = 7;
  const uint32_t blocks = session.image.total_bytes / BLOCK;
  for (uint32_t n = 0; n < (blocks + 6u) / 7u; n++) {
    CHECK_IS(session.scrub_block, 7u * n);
    CHECK_IS(starcat_do_idle_work(&session), STARCAT_EVENT_NONE);
  }
  CHECK_IS(session.scrub_block, 0);
  CHECK_IS(session.counts.scrub_passes, 1);
  damage(0, 2, 1);
  (void)work_until(STARCAT_EVENT_MENDED);
  CHECK_IS(session.event_block, 2);
  CHECK_IS(session.event_mended, 1);
  CHECK_IS(session.counts.damage_found, 1);
  CHECK_IS(session.counts.blocks_mended, 1);
  CHECK_IS(memcmp(session.slots.bytes[0], unit_triangle.bytes, unit_triangle.size), 0);
  CHECK_IS(starcat_begin_load(&session, unit_pyramid.size, 0), STARCAT_OK);
  CHECK_IS(load(unit_pyramid.bytes, unit_pyramid.size), STARCAT_OK);
  (void)work_until(STARCAT_EVENT_READY);
  CHECK_IS(session.event_mended, 0); /* number of this event, not of the previous one */
  damage(0, 0, blocks);              /* more than parity can repair */
  (void)work_until(STARCAT_EVENT_FELL_BACK);
  CHECK_IS(session.load, STARCAT_LOAD_NONE);
  CHECK_IS(starcat_load_piece(&session, unit_pyramid.bytes, BLOCK), STARCAT_E_OPTIONS);
  CHECK_IS(session.counts.fall_backs, 1);
  CHECK_IS(session.slots.active, 1);
  CHECK_IS(session.image.method, unit_pyramid.image.method);
  damage(1, 0, blocks);
  (void)work_until(STARCAT_EVENT_NO_IMAGE);
  CHECK(session.image_status < STARCAT_OK);
  CHECK_IS(session.event_status, session.image_status);
  CHECK_IS(starcat_do_idle_work(&session), STARCAT_EVENT_NONE);
}

static void check_scrubbing_of_rom(void) {
  unit_copy(&unit_triangle);
  begin_in_rom(&unit_scratch);
  unit_scratch.bytes[5u * BLOCK] ^= 1u;
  (void)work_until(STARCAT_EVENT_NO_IMAGE); /* it has no parity to repair it from */
  CHECK_IS(session.image_status, STARCAT_E_CRC);
  CHECK_IS(session.event_block, 5);
}

void test_session(void) {
  check_modes();
  check_frames_without_answer();
  check_correction();
  check_correction_without_steps();
  check_settings();
  check_load();
  check_loads_that_fail();
  check_patch_loads();
  check_scrubbing();
  check_scrubbing_of_rom();
}
