/* Sessions: tracked frames and frames lost in space, their budget, corrected centroids; images that
 * are loaded, checked, changed, scrubbed and repaired, and fallbacks.
 *
 * SPDX-License-Identifier: MIT
 */
#include <stddef.h>
#include <string.h>

#include "starcat_session.h"
#include "internal.h"
#include "unit.h"

#define BLOCK 4096u
#define CAPACITY (SKY_MOST_BYTES / BLOCK * BLOCK)
#define SHIFT_PX ((starcat_real)0.5)

static uint64_t slot_words[2][CAPACITY / 8u];
static uint32_t patch_words[4096];
static starcat_settings settings;
static starcat_session session;
static starcat_answer said;
static starcat_event event;
static sky_frame truth;
static uint64_t state;

/* What an application stores of its slots, and whether that works. */
static uint8_t records[2][STARCAT_RECORD_BYTES];
static int stores;

static int store(void *context, uint32_t place, const uint8_t *record) {
  (void)context;
  if (stores != 0) {
    memcpy(records[place], record, STARCAT_RECORD_BYTES);
  }
  return stores;
}

static uint32_t crc_of(const unit_sky *sky) {
  uint32_t crc;
  memcpy(&crc, sky->bytes + sky->size - 8u, 4);
  return crc;
}

/* A session with an image in ROM. */
static void begin_in_rom(const unit_sky *sky) {
  CHECK_IS(starcat_set_default_settings(&settings), STARCAT_OK);
  settings.options.noise_px = (starcat_real)0.3;
  settings.prior_age = 10;
  memset(&session, 0x55, sizeof session); /* what was there before does not matter */
  CHECK_IS(starcat_prepare_session(&session, &settings), STARCAT_OK);
  CHECK_IS(starcat_check_session(&session), STARCAT_E_NULL);
  CHECK_IS(starcat_use_image(&session, sky->bytes, sky->size), STARCAT_OK);
  CHECK_IS(starcat_check_session(&session), STARCAT_OK);
}

static starcat_slots make_slots(void) {
  starcat_slots slots;
  memset(&slots, 0, sizeof slots);
  slots.bytes[0] = (uint8_t *)slot_words[0];
  slots.bytes[1] = (uint8_t *)slot_words[1];
  slots.capacity = sizeof slot_words[0];
  return slots;
}

/* A session with the triangles' sky in the first slot and nothing in the other one. */
static void begin_in_slots(void) {
  starcat_slots slots = make_slots();
  memset(slot_words, 0, sizeof slot_words);
  memset(records, 0, sizeof records);
  stores = 1;
  slots.size[0] = unit_triangle.size;
  memcpy(slot_words[0], unit_triangle.bytes, unit_triangle.size);
  CHECK_IS(starcat_accept_image(&slots, 0, crc_of(&unit_triangle)), STARCAT_OK);
  CHECK_IS(starcat_set_default_settings(&settings), STARCAT_OK);
  settings.options.noise_px = (starcat_real)0.3;
  settings.prior_age = 10;
  settings.store = store;
  CHECK_IS(starcat_prepare_session(&session, &settings), STARCAT_OK);
  CHECK_IS(starcat_start_session(&session, &slots), STARCAT_OK);
}

/* The computer restarts, with what was stored and what is in the slots. */
static starcat_status restart(void) {
  starcat_slots slots = make_slots();
  (void)starcat_read_record(&slots, records[0], records[1]);
  memset(&session, 0x55, sizeof session);
  CHECK_IS(starcat_prepare_session(&session, &settings), STARCAT_OK);
  return starcat_start_session(&session, &slots);
}

static void look(void) { sky_look(&session.image, &session.camera, &state, 0.2, 12, 0, &truth); }

static starcat_status answer(uint64_t time) {
  const starcat_frame frame = unit_frame_of(&truth);
  const starcat_status status = starcat_answer_frame(&session, &frame, time, &said);
  CHECK_IS(said.status, status);
  return status;
}

static void check_modes(void) {
  state = 5;
  begin_in_rom(&unit_triangle);
  look();
  CHECK_IS(answer(100), STARCAT_IDENTIFIED);
  CHECK_IS(said.mode, STARCAT_MODE_IDENTIFY);
  CHECK_IS(said.steps, said.result.steps);
  CHECK_IS(session.counts.most_steps_identify, said.steps);
  CHECK_IS(answer(105), STARCAT_IDENTIFIED);
  CHECK_IS(said.mode, STARCAT_MODE_TRACK);
  CHECK_IS(session.counts.most_steps_track, said.steps);
  CHECK_IS(answer(96), STARCAT_IDENTIFIED); /* back in time, by little */
  CHECK_IS(said.mode, STARCAT_MODE_TRACK);
  CHECK_IS(answer(106), STARCAT_IDENTIFIED); /* too old by now */
  CHECK_IS(said.mode, STARCAT_MODE_IDENTIFY);
  look(); /* elsewhere: lost in space after tracking came to nothing */
  CHECK_IS(answer(107), STARCAT_IDENTIFIED);
  CHECK_IS(said.mode, STARCAT_MODE_IDENTIFY);
  CHECK(said.steps > said.result.steps);
  CHECK_IS(session.counts.frames_identified, 3);
  CHECK_IS(session.counts.frames_tracked, 2);
  CHECK_IS(session.counts.tracks_failed, 1);
}

/* A blank, a crowded, a refused frame: the attitude before stays until its age ends it. */
static void check_frames_between(void) {
  sky_frame kept;
  state = 5;
  begin_in_rom(&unit_triangle);
  settings.prior_age = 2000;
  look();
  CHECK_IS(answer(100), STARCAT_IDENTIFIED);
  CHECK_IS(answer(300), STARCAT_IDENTIFIED);
  settings.max_steps_identify = 1; /* the frame can only be tracked from here on */
  kept = truth;
  for (uint32_t n = 0; n < 3u; n++) {
    starcat_frame frame;
    truth.count = n == 0u ? 0u : n == 1u ? STARCAT_MAX_CENTROIDS + 1u : 3u;
    CHECK(answer(400) != STARCAT_IDENTIFIED);
    frame = unit_frame_of(&kept);
    frame.x_px = NULL;
    CHECK_IS(starcat_answer_frame(&session, &frame, 400, &said), STARCAT_E_NULL);
    CHECK_IS(starcat_answer_frame(&session, NULL, 400, &said), STARCAT_E_NULL);
    CHECK_IS(session.prior_time, n == 0u ? 300 : 500);
    truth = kept;
    CHECK_IS(answer(500), STARCAT_IDENTIFIED);
    CHECK_IS(said.mode, STARCAT_MODE_TRACK);
  }
  CHECK_IS(session.counts.errors[-STARCAT_E_TOO_MANY_CENTROIDS - 1], 1);
  CHECK_IS(session.counts.errors[-STARCAT_E_NULL - 1], 3);
  CHECK_IS(session.counts.frames_refused, 4);
  CHECK_IS(answer(2499), STARCAT_IDENTIFIED);
  CHECK_IS(answer(4499), STARCAT_E_BUDGET); /* 2000 later */
  CHECK_IS(said.mode, STARCAT_MODE_IDENTIFY);
}

static void check_frames_without_answer(void) {
  state = 5;
  begin_in_rom(&unit_triangle);
  look();
  CHECK_IS(answer(100), STARCAT_IDENTIFIED);
  look();
  settings.max_steps_track = 60;
  settings.max_steps_identify = 1;
  CHECK_IS(answer(101), STARCAT_E_BUDGET);
  CHECK_IS(said.mode, STARCAT_MODE_IDENTIFY);
  CHECK_IS(said.steps, 61); /* the sum of both */
  CHECK_IS(session.has_prior, 1);
  CHECK_IS(session.counts.frames_not_identified[STARCAT_REASON_STEPS - 1], 1);
  settings.max_steps_identify = 0;
  CHECK_IS(answer(102), STARCAT_E_OPTIONS);
  CHECK_IS(session.counts.frames_refused, 1);
  settings.max_steps_identify = 4000000u;
  truth.count = 3;
  CHECK_IS(answer(103), STARCAT_TOO_FEW_STARS);
  CHECK_IS(session.counts.frames_not_identified[STARCAT_REASON_TOO_FEW_STARS - 1], 1);
  CHECK_IS(starcat_use_image(&session, unit_triangle.bytes, 100), STARCAT_E_SHORT);
  CHECK_IS(starcat_check_session(&session), STARCAT_E_SHORT);
  CHECK_IS(answer(104), STARCAT_E_SHORT);
  CHECK_IS(said.mode, STARCAT_MODE_NONE);
  CHECK_IS(said.result.n_usable, 0);
  CHECK_IS(session.counts.frames_without_image, 1);
}

/* A prior with which too many stars are near: the steps count, and a counter says so. */
static void check_crowded_prior(void) {
  state = 5;
  begin_in_rom(&unit_crowded);
  settings.prior_error_rad = (starcat_real)0.35;
  look();
  CHECK_IS(answer(100), STARCAT_IDENTIFIED);
  const uint32_t alone = said.steps;
  CHECK_IS(answer(101), STARCAT_IDENTIFIED);
  CHECK_IS(said.mode, STARCAT_MODE_IDENTIFY);
  CHECK_IS(session.counts.tracks_refused, 1);
  CHECK(said.steps > alone);
}

static void check_nulls(void) {
  static starcat_session zeros;
  static const starcat_slots no_slots;
  const starcat_frame frame = {0, NULL, NULL, NULL, NULL};
  uint64_t age = 0;
  begin_in_rom(&unit_triangle);
  CHECK_IS(starcat_set_default_settings(NULL), STARCAT_E_NULL);
  CHECK_IS(starcat_check_settings(NULL), STARCAT_E_NULL);
  CHECK_IS(starcat_prepare_session(NULL, &settings), STARCAT_E_NULL);
  CHECK_IS(starcat_start_session(&session, NULL), STARCAT_E_NULL);
  CHECK_IS(starcat_start_session(&session, &no_slots), STARCAT_E_NULL);
  CHECK_IS(starcat_use_image(&session, NULL, 0), STARCAT_E_NULL);
  CHECK_IS(starcat_answer_frame(&session, &frame, 0, NULL), STARCAT_E_NULL);
  CHECK_IS(starcat_find_age(&session, 0, NULL), STARCAT_E_NULL);
  CHECK_IS(starcat_do_idle_work(&session, NULL), STARCAT_E_NULL);
  for (uint32_t n = 0; n < 3u; n++) { /* null, never prepared, prepared without settings */
    starcat_session *one = n == 0u ? NULL : &zeros;
    if (n == 2u) {
      CHECK_IS(starcat_prepare_session(one, NULL), STARCAT_E_NULL);
    }
    CHECK_IS(starcat_start_session(one, &no_slots), STARCAT_E_NULL);
    CHECK_IS(starcat_use_image(one, unit_triangle.bytes, unit_triangle.size), STARCAT_E_NULL);
    CHECK_IS(starcat_check_session(one), STARCAT_E_NULL);
    CHECK_IS(starcat_answer_frame(one, &frame, 0, &said), STARCAT_E_NULL);
    CHECK_IS(starcat_find_age(one, 0, &age), STARCAT_E_NULL);
    CHECK_IS(starcat_do_idle_work(one, &event), STARCAT_E_NULL);
    CHECK_IS(starcat_begin_load(one, 8192, 0), STARCAT_E_NULL);
    CHECK_IS(starcat_begin_patch_load(one, 8192), STARCAT_E_NULL);
    CHECK_IS(starcat_load_piece(one, unit_triangle.bytes, 1), STARCAT_E_NULL);
    CHECK_IS(starcat_accept_load(one), STARCAT_E_NULL);
    CHECK_IS(starcat_refuse_load(one), STARCAT_E_NULL);
    CHECK_IS(starcat_change_image(one), STARCAT_E_NULL);
  }
  begin_in_rom(&unit_triangle); /* no slots: nothing can be loaded */
  CHECK_IS(starcat_begin_load(&session, 8192, 0), STARCAT_E_NULL);
  CHECK_IS(starcat_change_image(&session), STARCAT_INCOMPLETE);
  CHECK_IS(starcat_refuse_load(&session), STARCAT_OK);
  starcat_slots one_slot = no_slots;
  one_slot.bytes[0] = unit_triangle.bytes;
  CHECK_IS(starcat_start_session(&session, &one_slot), STARCAT_E_NULL);
  CHECK_IS(starcat_begin_load(&session, 8192, 0), STARCAT_E_NULL);
  CHECK_IS(starcat_refuse_load(&session), STARCAT_OK);
}

static void check_age(void) {
  uint64_t age = 0;
  state = 5;
  begin_in_rom(&unit_triangle);
  CHECK_IS(starcat_find_age(&session, 100, &age), STARCAT_OK);
  CHECK(age == UINT64_MAX);
  look();
  CHECK_IS(answer(100), STARCAT_IDENTIFIED);
  session.prior_time = 500; /* a filter's */
  CHECK_IS(starcat_find_age(&session, 130, &age), STARCAT_OK);
  CHECK(age == 30u);
  CHECK_IS(starcat_find_age(&session, 99, &age), STARCAT_OK); /* the clock jumped back */
  CHECK(age == UINT64_MAX);
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

static void check_self_test(void) {
  static const unit_sky *const skies[3] = {&unit_triangle, &unit_pyramid, &unit_crowded};
  for (uint32_t n = 0; n < 3u; n++) {
    begin_in_rom(skies[n]);
    CHECK_IS(starcat_test_self(&session, &said), STARCAT_OK);
    CHECK(said.steps <= 8u * settings.max_steps_identify);
    CHECK_IS(session.has_prior, 0);
    CHECK_IS(session.counts.frames_identified, 0);
  }
  begin_in_rom(&unit_triangle);
  settings.max_steps_identify = 1; /* no frame is identified */
  CHECK_IS(starcat_test_self(&session, &said), STARCAT_NO_MATCH);
  settings.max_steps_identify = 4000000u;
  unit_copy(&unit_triangle); /* stars elsewhere than the triangles of the image say */
  begin_in_rom(&unit_scratch);
  int32_t *directions =
      (int32_t *)(void *)(unit_scratch.bytes +
                          (size_t)((const uint8_t *)session.image.directions - unit_scratch.bytes));
  for (uint32_t low = 0, high = 3u * session.image.n_stars - 1u; low < high; low++, high--) {
    const int32_t kept = directions[low];
    directions[low] = directions[high];
    directions[high] = kept;
  }
  CHECK_IS(starcat_test_self(&session, &said), STARCAT_NO_MATCH);
  CHECK_IS(starcat_use_image(&session, unit_scratch.bytes, 100), STARCAT_E_SHORT);
  CHECK_IS(starcat_test_self(&session, &said), STARCAT_E_SHORT);
  CHECK_IS(starcat_test_self(&session, NULL), STARCAT_E_NULL);
  CHECK_IS(starcat_test_self(NULL, &said), STARCAT_E_NULL);
}

/* A camera in memory that a fault has changed: frames are made with it, and identified with its lens,
 * so that answers are wrong by a little, by more than a pixel in some frames, and in all. */
static void check_self_test_of_damage(void) {
  uint32_t passed = 0, mixed = 0;
  for (uint32_t n = 0; n < 60u; n++) {
    begin_in_rom(&unit_triangle);
    session.camera.p1 = (starcat_real)(0.0004 * n);
    const starcat_status status = starcat_test_self(&session, &said);
    CHECK((status == STARCAT_OK) || (status == STARCAT_NO_MATCH));
    passed += status == STARCAT_OK ? 1u : 0u;
    mixed += (status != STARCAT_OK) && (said.result.n_matched > 0u) ? 1u : 0u;
  }
  CHECK((passed > 0u) && (mixed > 0u));
  unit_copy(&unit_triangle); /* two stars at one place: one of both centroids is a repetition */
  begin_in_rom(&unit_scratch);
  const size_t at = (size_t)((const uint8_t *)session.image.directions - unit_scratch.bytes);
  memcpy(unit_scratch.bytes + at + 12u, unit_scratch.bytes + at, 12);
  CHECK_IS(starcat_test_self(&session, &said), STARCAT_OK);
}

static void check_correction(void) {
  uint32_t calls = 0;
  starcat_frame without = {1, NULL, NULL, NULL, NULL};
  state = 7;
  begin_in_rom(&unit_triangle);
  settings.correct = shift_back;
  settings.context = &calls;
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
      const starcat_real d = said.result.q_body_from_icrs[k] - truth.q_body_from_icrs[k];
      apart += d * d;
    }
    /* Half an angle; the centroids were moved by 0.7 px. */
    apart *= 4 * session.camera.focal_length_px * session.camera.focal_length_px;
    CHECK(apart < (starcat_real)(0.35 * 0.35));
  }
  CHECK_IS(said.mode, STARCAT_MODE_TRACK);
  CHECK_IS(starcat_answer_frame(&session, &without, 101, &said), STARCAT_E_NULL);
  without.x_px = truth.x;
  CHECK_IS(starcat_answer_frame(&session, &without, 101, &said), STARCAT_E_NULL);
  truth.count = STARCAT_MAX_CENTROIDS + 1u;
  CHECK_IS(answer(101), STARCAT_E_TOO_MANY_CENTROIDS);
  CHECK_IS(calls, 2);
}

/* If an answer is good enough for the application, but not certain, the search goes on to the last
 * step: no step is left to correct the answer. */
static void check_correction_without_steps(void) {
  uint32_t calls = 0, spent = 0;
  begin_in_rom(&unit_triangle);
  settings.prior_age = 0;
  settings.context = &calls;
  settings.options.log_chance = (starcat_real)-7.0;
  settings.options.noise_px = (starcat_real)1.0;
  for (uint32_t seed = 1; seed < 30u; seed++) {
    state = seed;
    settings.correct = NULL;
    settings.max_steps_identify = 4000000u;
    sky_look(&session.image, &session.camera, &state, 0.5, 8, 3, &truth);
    (void)answer(100);
    settings.max_steps_identify = said.steps - said.steps / 8u;
    if ((answer(100) == STARCAT_IDENTIFIED) && (said.steps == settings.max_steps_identify)) {
      settings.correct = shift_back;
      CHECK_IS(answer(100), STARCAT_E_BUDGET);
      CHECK_IS(said.result.n_matched, 0);
      CHECK_IS(said.result.reason, STARCAT_REASON_STEPS);
      spent++;
    }
  }
  CHECK(spent > 0u);
}

/* The stars of a frame that were detected this time, a share of them, and false spots. */
static void detect(const sky_frame *whole, double share, uint32_t n_false) {
  truth = *whole;
  truth.count = 0;
  for (uint32_t n = 0; n < whole->count; n++) {
    if (sky_uniform(&state) >= share) {
      continue;
    }
    truth.x[truth.count] = whole->x[n];
    truth.y[truth.count] = whole->y[n];
    truth.magnitudes[truth.count] = whole->magnitudes[n];
    truth.star[truth.count] = whole->star[n];
    truth.count++;
  }
  for (uint32_t n = 0; n < n_false; n++) {
    truth.x[truth.count] = (starcat_real)(sky_uniform(&state) * (double)session.camera.width_px);
    truth.y[truth.count] = (starcat_real)(sky_uniform(&state) * (double)session.camera.height_px);
    truth.magnitudes[truth.count] = (starcat_real)6.0;
    truth.star[truth.count] = -1;
    truth.count++;
  }
}

#define WEAK_SHARE 0.5
#define WEAK_FALSE 8

/* A session that acquires over several frames, and a frame of which each sees a part of the stars. */
static void begin_weak(uint64_t seed, sky_frame *whole) {
  state = seed;
  begin_in_rom(&unit_triangle);
  settings.options.noise_px = (starcat_real)2.0;
  settings.prior_error_rad = (starcat_real)0.02;
  settings.max_steps_confirm = 1000000u;
  sky_look(&session.image, &session.camera, &state, 2.0, 40, 0, whole);
}

/* Whether an answer is right, and so are its stars. */
static int is_right(void) {
  unit_result = said.result;
  return (unit_error_rad(&truth) * (double)session.camera.focal_length_px < 20.0) &&
         (unit_wrong_stars(&truth) <= 1u); /* a false spot can be near a star */
}

/* The composite has changed: state its sum again, as a fault would not. */
static void seal_composite(void) {
  session.composite.crc = starcat_update_crc(0, (const uint8_t *)&session.composite,
                                             offsetof(starcat_composite, crc));
}

/* Up to three frames of the same sky, each with other stars. Returns the number of the frame that is
 * answered, 0: none. */
static uint32_t acquire(const sky_frame *whole) {
  for (uint32_t n = 0; n < 3u; n++) {
    detect(whole, WEAK_SHARE, WEAK_FALSE);
    const starcat_status status = answer(100u + n);
    CHECK(said.steps <= settings.max_steps_identify + settings.max_steps_confirm);
    CHECK(session.composite.n_spots <= STARCAT_MAX_CENTROIDS);
    if (status == STARCAT_IDENTIFIED) {
      CHECK(is_right());
      CHECK(said.result.log_chance <= settings.options.log_chance);
      CHECK_IS(said.result.reason, STARCAT_REASON_NONE);
      CHECK_IS(session.composite.n_spots, 0);
      return n + 1u;
    }
    detect(whole, 1.0, 0);
    truth.count = 3; /* between them a frame of few stars, which changes nothing */
    CHECK_IS(answer(100u + n), STARCAT_TOO_FEW_STARS);
    CHECK((said.mode == STARCAT_MODE_IDENTIFY) && (said.result.reason != STARCAT_REASON_NONE));
  }
  return 0;
}

static void check_confirmed(void) {
  uint32_t confirmed[4] = {0};
  for (uint32_t seed = 1; seed <= 120u; seed++) {
    sky_frame whole;
    begin_weak(seed, &whole);
    const uint32_t frame = acquire(&whole);
    confirmed[frame] += said.mode == STARCAT_MODE_CONFIRM ? 1u : 0u;
    CHECK_IS(session.counts.frames_confirmed, said.mode == STARCAT_MODE_CONFIRM ? 1 : 0);
    CHECK(session.counts.most_steps_confirm <= settings.max_steps_confirm);
    if (said.mode == STARCAT_MODE_CONFIRM) { /* off: nothing is confirmed or kept */
      begin_weak(seed, &whole);
      settings.max_steps_confirm = 0;
      CHECK((acquire(&whole) == 0u) || (said.mode == STARCAT_MODE_IDENTIFY));
      CHECK_IS(session.counts.frames_confirmed, 0);
      CHECK_IS(session.composite.n_spots, 0);
      CHECK_IS(session.counts.most_steps_confirm, 0);
      begin_weak(seed, &whole); /* a fitted focal length is not confirmed */
      settings.options.fov_error = (starcat_real)0.01;
      (void)acquire(&whole);
      CHECK_IS(session.counts.frames_confirmed, 0);
    }
  }
  CHECK_IS(confirmed[1], 0);
  CHECK((confirmed[2] >= 5u) && (confirmed[3] >= 5u));
}

/* A frame of many stars, in `truth`; all are well within it. */
static void look_at_many(sky_frame *whole) {
  uint32_t seed = 0;
  do {
    seed++;
    begin_weak(seed, whole);
    for (uint32_t n = 0; n < whole->count; n++) {
      const int is_inside = (whole->x[n] > (starcat_real)40.0) && (whole->y[n] > (starcat_real)40.0) &&
                            (whole->x[n] < session.camera.width_px - (starcat_real)40.0) &&
                            (whole->y[n] < session.camera.height_px - (starcat_real)40.0);
      whole->count = is_inside ? whole->count : 0u;
    }
  } while (whole->count < 8u);
  settings.options.noise_px = (starcat_real)0.2;
  detect(whole, 1.0, 0);
}

/* Put a frame of the same spots, turned by an angle about x, after the spots in `composite`. */
static int join_again(double turn_rad, double most_rad, starcat_composite *composite) {
  const double c = cos(turn_rad), s = sin(turn_rad);
  starcat_real x[STARCAT_MAX_CENTROIDS], y[STARCAT_MAX_CENTROIDS];
  starcat_optics optics;
  starcat_frame frame = unit_frame_of(&truth);
  uint32_t steps = 0;
  CHECK_IS(starcat_prepare_camera(&session.camera, &optics), STARCAT_OK);
  for (uint32_t i = 0; i < frame.count; i++) {
    starcat_real body[3], turned[3];
    (void)starcat_find_direction(&optics, truth.x[i], truth.y[i], body);
    turned[0] = body[0];
    turned[1] = (starcat_real)(c * (double)body[1] + s * (double)body[2]);
    turned[2] = (starcat_real)(c * (double)body[2] - s * (double)body[1]);
    (void)starcat_find_pixel(&optics, turned, truth.x + i, truth.y + i);
  }
  const int is_joined =
      starcat_join_frame(&session.image, &session.camera, &settings.options, &frame, &unit_work,
                         (starcat_real)most_rad, composite, x, y, &steps);
  CHECK(steps <= settings.options.max_steps);
  CHECK(composite->n_spots <= STARCAT_MAX_CENTROIDS);
  return is_joined;
}

/* Frames that follow each other by a turn: how often each spot is seen, and where. */
static void check_joined_frames(void) {
  starcat_composite composite;
  sky_frame whole;
  look_at_many(&whole);
  memset(&composite, 0, sizeof composite);
  CHECK(!join_again(0.0, 0.01, &composite)); /* the first one */
  CHECK_IS(composite.n_spots, truth.count);
  for (uint32_t n = 1; n <= 3u; n++) {
    CHECK(join_again(0.001, 0.01, &composite));
    CHECK_IS(composite.n_spots, truth.count);
    for (uint32_t i = 0; i < composite.n_spots; i++) {
      const starcat_real *v = composite.body[i];
      CHECK_IS(composite.seen[i], n + 1u);
      CHECK(fabs((double)(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]) - 1.0) < IF_SINGLE(1e-5, 1e-12));
    }
  }
  truth.count -= 2; /* two are not there */
  CHECK(join_again(0.0, 0.01, &composite));
  CHECK_IS(composite.n_spots, truth.count + 2u);
  for (uint32_t i = 0; i < composite.n_spots; i++) { /* those of the frame are first */
    CHECK_IS(composite.seen[i], i < truth.count ? 5u : 4u);
  }
  CHECK(!join_again(0.006, 0.002, &composite)); /* farther than the turn that is allowed */
  CHECK_IS(composite.n_spots, truth.count);
  for (uint32_t i = 0; i < composite.n_spots; i++) {
    CHECK_IS(composite.seen[i], 1);
  }
  for (uint32_t i = 0; i < composite.n_spots; i++) {
    composite.seen[i] = 0; /* two frames ago; one of them is not seen again now */
  }
  truth.count--;
  CHECK(join_again(0.0, 0.01, &composite));
  CHECK_IS(composite.n_spots, truth.count);
  for (uint32_t i = 0; i < composite.n_spots; i++) {
    CHECK_IS(composite.seen[i], 2);
    composite.seen[i] = 1000;
  }
  for (uint32_t k = 0; k < 3u; k++) { /* two spots where the frame has one */
    composite.body[1][k] = composite.body[0][k];
  }
  starcat_composite three = composite;
  three.n_spots = 3; /* which are two of the frame */
  CHECK(!join_again(0.0, 0.01, &three));
  CHECK(join_again(0.0, 0.01, &composite));
  CHECK_IS(composite.n_spots, truth.count);
  for (uint32_t i = 0; i < composite.n_spots; i++) {
    CHECK_IS(composite.seen[i], i == 1u ? 1u : 1000u);
  }
}

/* Composites that are full, of which spots are behind the camera, or at one place. */
static void check_odd_composites(void) {
  starcat_composite composite;
  sky_frame whole;
  look_at_many(&whole);
  truth.count -= 2;
  const uint32_t count = truth.count;
  memset(&composite, 0, sizeof composite);
  (void)join_again(0.0, 0.01, &composite);
  for (; composite.n_spots < STARCAT_MAX_CENTROIDS; composite.n_spots++) {
    composite.body[composite.n_spots][2] = (starcat_real)-1.0;
    composite.seen[composite.n_spots] = 2;
  }
  CHECK(join_again(0.0, 0.01, &composite)); /* those behind the camera are dropped */
  CHECK_IS(composite.n_spots, count);
  for (; composite.n_spots < STARCAT_MAX_CENTROIDS; composite.n_spots++) {
    const double angle = (double)composite.n_spots;
    composite.body[composite.n_spots][0] = (starcat_real)(0.02 * cos(angle));
    composite.body[composite.n_spots][1] = (starcat_real)(0.02 * sin(angle));
    composite.body[composite.n_spots][2] = (starcat_real)cos(0.02);
    composite.seen[composite.n_spots] = 2;
  }
  detect(&whole, 1.0, 0); /* with other stars, for which there is no room */
  CHECK(truth.count > count);
  CHECK(join_again(0.0, 0.01, &composite));
  CHECK_IS(composite.n_spots, STARCAT_MAX_CENTROIDS);
  for (uint32_t i = 0; i < composite.n_spots; i++) {
    for (uint32_t k = 0; k < 3u; k++) {
      composite.body[i][k] = composite.body[0][k];
    }
  }
  CHECK(!join_again(0.0, 0.01, &composite));
  memset(&composite, 0, sizeof composite);
  (void)join_again(0.0, 0.01, &composite);
  for (uint32_t most = 1; most < 200000u; most += 1u + most / 4u) { /* steps end it anywhere */
    starcat_composite next = composite;
    settings.options.max_steps = most;
    (void)join_again(0.0, 0.01, &next);
    CHECK_IS(next.n_spots, truth.count);
  }
  truth.count = 2; /* refused: nothing changes */
  starcat_frame frame = unit_frame_of(&truth);
  uint32_t steps = 1;
  CHECK(!starcat_join_frame(&session.image, &session.camera, &settings.options, &frame, &unit_work,
                            (starcat_real)0.01, &composite, session.x_px, session.y_px, &steps));
  CHECK((steps == 0u) && (composite.n_spots > 2u));
}

/* The same spots again and again are no proof of anything, wherever they are. */
static void check_same_spots(void) {
  uint32_t refused = 0;
  for (uint32_t seed = 1; seed <= 40u; seed++) {
    sky_frame whole;
    begin_weak(seed, &whole);
    detect(&whole, WEAK_SHARE, WEAK_FALSE);
    const starcat_status first = answer(100);
    settings.prior_age = first == STARCAT_IDENTIFIED ? 0u : settings.prior_age;
    for (uint32_t n = 1; n < 5u; n++) {
      CHECK_IS(answer(100u + n), first);
      CHECK(said.mode == STARCAT_MODE_IDENTIFY);
    }
    refused += first == STARCAT_IDENTIFIED ? 0u : 1u;
  }
  CHECK(refused >= 20u);
}

/* False spots, which are others in each frame. */
static void check_false_spots(void) {
  uint32_t composites = 0;
  for (uint32_t seed = 1; seed <= 120u; seed++) {
    sky_frame whole;
    begin_weak(seed, &whole);
    whole.count = 0;
    for (uint32_t n = 0; n < 6u; n++) {
      detect(&whole, 1.0, 14);
      CHECK(answer(100u + n) != STARCAT_IDENTIFIED);
      composites += session.composite.n_spots > 14u ? 1u : 0u;
    }
  }
  CHECK(composites > 0u);
}

/* Composites end: with an image, by age, by a fault in memory, if the turn is too large. */
static void check_ends_of_composites(void) {
  uint32_t confirmed = 0;
  for (uint32_t seed = 1; seed <= 120u; seed++) {
    sky_frame whole;
    for (uint32_t kind = 0; kind < 7u; kind++) {
      begin_weak(seed, &whole);
      if ((acquire(&whole) != 2u) || (said.mode != STARCAT_MODE_CONFIRM)) {
        break;
      }
      begin_weak(seed, &whole);
      detect(&whole, WEAK_SHARE, WEAK_FALSE);
      (void)answer(100);
      CHECK(session.composite.n_spots > 0u);
      detect(&whole, 1.0, 0); /* as in `acquire`, so that the next frame is the same */
      uint64_t time = 101;
      switch (kind) {
        case 0:
          CHECK_IS(starcat_use_image(&session, unit_triangle.bytes, unit_triangle.size),
                   STARCAT_OK);
          CHECK_IS(session.composite.n_spots, 0);
          break;
        case 1:
          time = 100 + settings.prior_age;
          break;
        case 2:
          session.composite.seen[0] = 5;
          break;
        case 3:
          session.composite.body[0][1] = -session.composite.body[0][1];
          break;
        case 4:
          session.composite.n_spots = STARCAT_MAX_CENTROIDS + 1u;
          seal_composite();
          break;
        case 5: /* the turn is too large for the settings */
          settings.prior_error_rad = (starcat_real)1e-5;
          for (uint32_t n = 0; n < session.composite.n_spots; n++) {
            session.composite.body[n][0] += (starcat_real)0.1;
          }
          seal_composite();
          break;
        default: /* nothing ends it */
          confirmed++;
          break;
      }
      detect(&whole, WEAK_SHARE, WEAK_FALSE);
      CHECK_IS(answer(time) == STARCAT_IDENTIFIED, kind > 5u);
      CHECK_IS(session.counts.frames_confirmed, kind > 5u ? 1 : 0);
    }
  }
  CHECK(confirmed >= 5u);
}

/* Steps end a confirmation, wherever it is, and a frame whose own steps are used up can be confirmed. */
static void check_steps_of_confirming(void) {
  uint32_t confirmed = 0, short_of = 0;
  for (uint32_t seed = 1; seed <= 120u; seed++) {
    sky_frame whole;
    begin_weak(seed, &whole);
    const uint32_t frame = acquire(&whole);
    if (said.mode != STARCAT_MODE_CONFIRM) {
      continue;
    }
    for (uint32_t most = 1; most < 40000u; most += 1u + most / 4u) {
      begin_weak(seed, &whole);
      settings.max_steps_confirm = most;
      short_of += acquire(&whole) == 0u ? 1u : 0u;
      CHECK(session.counts.most_steps_confirm <= most);
    }
    begin_weak(seed, &whole);
    for (uint32_t n = 0; n < frame; n++) {
      settings.max_steps_identify = n + 1u < frame ? 4000000u : 1u;
      detect(&whole, WEAK_SHARE, WEAK_FALSE);
      (void)answer(100u + n);
    }
    confirmed += said.mode == STARCAT_MODE_CONFIRM ? 1u : 0u;
  }
  CHECK((confirmed >= 5u) && (short_of > 0u));
}

/* Centroids are corrected before they are compared. */
static void check_confirmed_with_correction(void) {
  uint32_t calls = 0, confirmed = 0;
  for (uint32_t seed = 1; seed <= 120u; seed++) {
    sky_frame whole;
    begin_weak(seed, &whole);
    settings.correct = shift_back;
    settings.context = &calls;
    for (uint32_t n = 0; n < whole.count; n++) {
      whole.x[n] += SHIFT_PX;
      whole.y[n] -= SHIFT_PX;
    }
    (void)acquire(&whole);
    confirmed += said.mode == STARCAT_MODE_CONFIRM ? 1u : 0u;
  }
  CHECK(confirmed >= 5u);
}

static void check_settings(void) {
  starcat_settings one;
  CHECK_IS(starcat_set_default_settings(&one), STARCAT_OK);
  CHECK_IS(starcat_check_settings(&one), STARCAT_OK);
  one.has_own_camera = 1;
  CHECK_IS(starcat_check_settings(&one), STARCAT_E_CAMERA);
  CHECK_IS(starcat_prepare_session(&session, &one), STARCAT_E_CAMERA);
  CHECK_IS(starcat_check_session(&session), STARCAT_E_NULL); /* not prepared */
  one.camera = unit_triangle.camera;
  CHECK_IS(starcat_check_settings(&one), STARCAT_OK);
  one.max_steps_identify = 0;
  CHECK_IS(starcat_check_settings(&one), STARCAT_E_OPTIONS);
  one.max_steps_identify = 1;
  one.max_steps_track = 0;
  CHECK_IS(starcat_check_settings(&one), STARCAT_E_OPTIONS);
  one.max_steps_track = 1;
  one.prior_error_rad = (starcat_real)0.36;
  CHECK_IS(starcat_check_settings(&one), STARCAT_E_OPTIONS);
  one.prior_error_rad = (starcat_real)0.35;
  one.blocks_per_tick = 65537;
  CHECK_IS(starcat_check_settings(&one), STARCAT_E_OPTIONS);
}

/* Ticks until an event. */
static uint32_t work_until(starcat_event_kind expected) {
  uint32_t n = 0;
  event.kind = STARCAT_EVENT_NONE;
  for (; (n < 3000u) && (event.kind == STARCAT_EVENT_NONE); n++) {
    CHECK_IS(starcat_do_idle_work(&session, &event), STARCAT_OK);
  }
  CHECK_IS(event.kind, expected);
  return n;
}

static starcat_status load(const uint8_t *bytes, size_t size) {
  starcat_status status = STARCAT_INCOMPLETE;
  for (size_t at = 0; (at < size) && (status == STARCAT_INCOMPLETE); at += BLOCK) {
    const size_t count = size - at < BLOCK ? size - at : BLOCK;
    status = starcat_load_piece(&session, bytes + at, count);
  }
  return status;
}

/* Load an image until it is ready. */
static void load_ready(const unit_sky *sky) {
  CHECK_IS(starcat_begin_load(&session, sky->size, crc_of(sky)), STARCAT_OK);
  CHECK_IS(load(sky->bytes, sky->size), STARCAT_OK);
  (void)work_until(STARCAT_EVENT_READY);
}

static void load_accepted(const unit_sky *sky) {
  load_ready(sky);
  CHECK_IS(starcat_accept_load(&session), STARCAT_OK);
  CHECK_IS(session.load, STARCAT_LOAD_ACCEPTED);
}

static void damage(uint32_t slot, uint32_t first, uint32_t count) {
  for (uint32_t n = 0; n < count; n++) {
    session.slots.bytes[slot][(size_t)(first + n) * BLOCK + 9u + 29u * n] ^= 0x10u;
  }
}

static uint32_t blocks_of(const unit_sky *sky) { return (uint32_t)(sky->size / BLOCK); }

static void check_load(void) {
  const unit_sky *sky = &unit_pyramid;
  begin_in_slots();
  settings.blocks_per_tick = 2;
  CHECK_IS(starcat_load_piece(&session, sky->bytes, BLOCK), STARCAT_E_OPTIONS);
  CHECK_IS(starcat_begin_load(&session, sky->size, 0), STARCAT_OK);
  CHECK_IS(session.load, STARCAT_LOAD_READING);
  CHECK_IS(starcat_do_idle_work(&session, &event), STARCAT_OK); /* scrubs */
  CHECK_IS(session.scrub_next, 2);
  CHECK_IS(starcat_accept_load(&session), STARCAT_INCOMPLETE);
  CHECK_IS(starcat_change_image(&session), STARCAT_INCOMPLETE);
  CHECK_IS(load(sky->bytes, sky->size), STARCAT_OK);
  CHECK_IS(session.load, STARCAT_LOAD_CHECKING);
  CHECK_IS(starcat_accept_load(&session), STARCAT_INCOMPLETE);
  CHECK_IS(starcat_change_image(&session), STARCAT_INCOMPLETE);
  (void)work_until(STARCAT_EVENT_READY);
  CHECK_IS(event.slot, 1);
  CHECK_IS(session.load, STARCAT_LOAD_READY);
  CHECK_IS(starcat_change_image(&session), STARCAT_INCOMPLETE); /* not accepted */
  CHECK_IS(starcat_accept_load(&session), STARCAT_OK);
  state = 5;
  look();
  CHECK_IS(answer(100), STARCAT_IDENTIFIED);
  CHECK_IS(starcat_change_image(&session), STARCAT_OK);
  CHECK_IS(starcat_change_image(&session), STARCAT_INCOMPLETE); /* it is changing */
  CHECK_IS(starcat_begin_load(&session, sky->size, 0), STARCAT_INCOMPLETE);
  CHECK_IS(session.image.method, unit_triangle.image.method);
  (void)work_until(STARCAT_EVENT_CHANGED);
  CHECK_IS(session.load, STARCAT_LOAD_NONE);
  CHECK_IS(session.image.method, unit_pyramid.image.method);
  CHECK_IS(answer(101), STARCAT_IDENTIFIED); /* the last attitude is that of the sky, and stays */
  CHECK_IS(said.mode, STARCAT_MODE_TRACK);
  CHECK_IS(starcat_change_image(&session), STARCAT_OK); /* back */
  (void)work_until(STARCAT_EVENT_CHANGED);
  CHECK_IS(session.image.method, unit_triangle.image.method);
  settings.blocks_per_tick = 0; /* off: nothing is begun that would not end */
  CHECK_IS(starcat_do_idle_work(&session, &event), STARCAT_OK);
  CHECK_IS(session.scrub_next, 0);
  CHECK_IS(starcat_begin_load(&session, sky->size, 0), STARCAT_E_OPTIONS);
  CHECK_IS(starcat_begin_patch_load(&session, 100), STARCAT_E_OPTIONS);
  CHECK_IS(starcat_change_image(&session), STARCAT_E_OPTIONS);
}

static void check_own_camera(void) {
  state = 5;
  begin_in_slots();
  look();
  settings.camera = unit_triangle.camera;
  settings.camera.focal_length_px *= 2;
  settings.has_own_camera = 1;
  CHECK(answer(100) != STARCAT_IDENTIFIED);
  settings.has_own_camera = 0;
  CHECK_IS(answer(100), STARCAT_IDENTIFIED);
}

static void check_loads_that_fail(void) {
  const unit_sky *sky = &unit_pyramid;
  begin_in_slots();
  CHECK_IS(starcat_begin_load(&session, BLOCK + 1u, 0), STARCAT_E_LAYOUT);
  CHECK_IS(session.load, STARCAT_LOAD_FAILED);
  CHECK_IS(starcat_begin_load(&session, sky->size, 1), STARCAT_OK); /* the stated CRC is wrong */
  CHECK_IS(load(sky->bytes, sky->size), STARCAT_OK);
  (void)work_until(STARCAT_EVENT_REFUSED);
  CHECK_IS(event.status, STARCAT_INCOMPLETE);
  CHECK_IS(event.block, blocks_of(sky) - 1u);
  CHECK_IS(starcat_begin_load(&session, sky->size, 0), STARCAT_OK);
  CHECK_IS(load(sky->bytes, sky->size), STARCAT_OK);
  damage(1, 3, 1);
  (void)work_until(STARCAT_EVENT_REFUSED);
  CHECK_IS(event.status, STARCAT_E_CRC);
  CHECK_IS(event.block, 3);
  CHECK_IS(session.load, STARCAT_LOAD_FAILED);
  CHECK_IS(session.counts.loads_refused, 2);
  CHECK_IS(starcat_accept_load(&session), STARCAT_INCOMPLETE);
  CHECK_IS(starcat_change_image(&session), STARCAT_INCOMPLETE);
  CHECK_IS(starcat_check_session(&session), STARCAT_OK); /* nothing changes */
  CHECK_IS(starcat_begin_load(&session, sky->size, 0), STARCAT_OK);
  CHECK_IS(starcat_load_piece(&session, sky->bytes, sky->size + 1u), STARCAT_E_SHORT);
  CHECK_IS(session.load, STARCAT_LOAD_FAILED);
  unit_copy(&unit_triangle); /* sound blocks, but no image */
  memset(unit_scratch.bytes, 0, 4);
  sky_seal(unit_scratch.bytes);
  CHECK_IS(starcat_begin_load(&session, unit_scratch.size, 0), STARCAT_OK);
  CHECK_IS(load(unit_scratch.bytes, unit_scratch.size), STARCAT_OK);
  (void)work_until(STARCAT_EVENT_REFUSED);
  CHECK_IS(event.status, STARCAT_E_MAGIC);
}

/* What the application refused is not used: by a change, in place of a damaged image, or after a
 * restart; nor is what it has not yet accepted. */
static void check_refused(void) {
  for (uint32_t n = 0; n < 4u; n++) {
    const int is_refused = n % 2u == 0u;
    begin_in_slots();
    load_ready(&unit_pyramid);
    if (is_refused) {
      CHECK_IS(starcat_refuse_load(&session), STARCAT_OK);
      CHECK_IS(session.load, STARCAT_LOAD_FAILED);
      CHECK_IS(starcat_accept_load(&session), STARCAT_INCOMPLETE);
    }
    CHECK_IS(starcat_change_image(&session), STARCAT_INCOMPLETE);
    damage(0, 0, blocks_of(&unit_triangle));
    if (n < 2u) {
      (void)work_until(STARCAT_EVENT_NO_IMAGE);
      CHECK_IS(starcat_check_session(&session), STARCAT_E_CRC);
    }
    CHECK_IS(restart(), STARCAT_E_CRC);
    CHECK_IS(session.slots.active, 0);
    CHECK_IS(starcat_change_image(&session), STARCAT_INCOMPLETE);
  }
  /* An accepted one that is withdrawn. */
  begin_in_slots();
  load_accepted(&unit_pyramid);
  CHECK_IS(starcat_refuse_load(&session), STARCAT_OK);
  damage(0, 0, blocks_of(&unit_triangle));
  CHECK_IS(restart(), STARCAT_E_CRC);
}

/* The record of the slots cannot be stored: what must not be forgotten is not begun. */
static void check_stores(void) {
  begin_in_slots();
  load_accepted(&unit_pyramid);
  stores = 0;
  CHECK_IS(starcat_begin_load(&session, unit_pyramid.size, 0), STARCAT_INCOMPLETE);
  CHECK_IS(session.slots.acceptance[1], STARCAT_ACCEPTED); /* the fall-back stays */
  CHECK_IS(starcat_refuse_load(&session), STARCAT_INCOMPLETE);
  CHECK_IS(session.slots.acceptance[1], 0);
  CHECK(session.counts.stores_failed >= 2u);
  stores = 1;
  CHECK_IS(starcat_do_idle_work(&session, &event), STARCAT_OK); /* stores it now */
  damage(0, 0, blocks_of(&unit_triangle));
  CHECK_IS(restart(), STARCAT_E_CRC);
  begin_in_slots();
  load_ready(&unit_pyramid);
  stores = 0;
  CHECK_IS(starcat_accept_load(&session), STARCAT_INCOMPLETE);
  CHECK_IS(session.load, STARCAT_LOAD_READY);
  stores = 1;
  CHECK_IS(starcat_accept_load(&session), STARCAT_OK);
  CHECK_IS(restart(), STARCAT_OK);
  CHECK_IS(starcat_change_image(&session), STARCAT_OK);
  (void)work_until(STARCAT_EVENT_CHANGED);
  damage(1, 0, blocks_of(&unit_pyramid));
  CHECK_IS(restart(), STARCAT_OK); /* falls back at the start */
  CHECK_IS(session.slots.active, 0);
  CHECK_IS(session.counts.fall_backs, 1);
}

/* A record that could not be stored is not stored later if an image in ROM was taken into use. */
static void check_store_of_rom(void) {
  begin_in_slots();
  load_ready(&unit_pyramid);
  stores = 0;
  CHECK_IS(starcat_refuse_load(&session), STARCAT_INCOMPLETE);
  CHECK_IS(session.must_store, 1);
  CHECK_IS(starcat_use_image(&session, unit_triangle.bytes, unit_triangle.size), STARCAT_OK);
  stores = 1;
  memset(records, 0, sizeof records);
  CHECK_IS(starcat_do_idle_work(&session, &event), STARCAT_OK);
  CHECK_IS(session.must_store, 0);
  CHECK_IS(records[0][0] | records[1][0], 0);
}

static void check_patch_loads(void) {
  const uint8_t *bytes = unit_triangle.bytes;
  begin_in_slots();
  load_accepted(&unit_pyramid);
  CHECK_IS(starcat_begin_patch_load(&session, 100), STARCAT_E_SHORT); /* no memory */
  settings.patch = patch_words;
  settings.patch_capacity = sizeof patch_words;
  CHECK_IS(starcat_begin_patch_load(&session, sizeof patch_words + 1u), STARCAT_E_SHORT);
  CHECK_IS(starcat_begin_patch_load(&session, 0), STARCAT_E_SHORT);
  CHECK_IS(starcat_begin_patch_load(&session, 2u * BLOCK), STARCAT_OK);
  CHECK_IS(starcat_load_piece(&session, NULL, 1), STARCAT_E_NULL);
  CHECK_IS(starcat_begin_patch_load(&session, 2u * BLOCK), STARCAT_OK);
  CHECK_IS(starcat_load_piece(&session, bytes, BLOCK), STARCAT_INCOMPLETE);
  CHECK_IS(starcat_load_piece(&session, bytes, BLOCK + 1u), STARCAT_E_SHORT);
  CHECK_IS(starcat_begin_patch_load(&session, 2u * BLOCK), STARCAT_OK);
  CHECK_IS(starcat_refuse_load(&session), STARCAT_OK); /* cancelled: nothing was written */
  CHECK_IS(starcat_begin_patch_load(&session, 2u * BLOCK), STARCAT_OK);
  CHECK_IS(load(bytes, 2u * BLOCK), STARCAT_OK);
  CHECK_IS(starcat_refuse_load(&session), STARCAT_OK); /* while it is checked */
  CHECK_IS(starcat_begin_patch_load(&session, 2u * BLOCK), STARCAT_OK);
  CHECK_IS(load(bytes, 2u * BLOCK), STARCAT_OK);
  CHECK_IS(memcmp(patch_words, bytes, 2u * BLOCK), 0);
  (void)work_until(STARCAT_EVENT_REFUSED); /* an image is not a patch */
  CHECK_IS(event.status, STARCAT_E_MAGIC);
  CHECK_IS(session.slots.acceptance[1], STARCAT_ACCEPTED); /* the fall-back was not touched */
  CHECK(memcmp(slot_words[1], unit_pyramid.bytes, unit_pyramid.size) == 0);
}

static void check_scrubbing(void) {
  const uint32_t blocks = blocks_of(&unit_triangle);
  const uint32_t groups = (uint32_t)(starcat_count_parity_bytes(unit_triangle.size) / BLOCK);
  begin_in_slots();
  settings.blocks_per_tick = 7;
  for (uint32_t n = 0; n < (blocks + 6u) / 7u; n++) {
    CHECK_IS(session.scrub_next, 7u * n);
    CHECK_IS(starcat_do_idle_work(&session, &event), STARCAT_OK);
  }
  CHECK_IS(session.scrub_next, blocks);
  for (uint32_t n = 0; n < groups; n++) { /* seven blocks are one group */
    CHECK_IS(session.counts.scrub_passes, 0);
    CHECK_IS(starcat_do_idle_work(&session, &event), STARCAT_OK);
  }
  CHECK_IS(session.scrub_next, 0);
  CHECK_IS(session.counts.scrub_passes, 1);
  damage(0, 2, 1);
  (void)work_until(STARCAT_EVENT_MENDED);
  CHECK_IS(event.block, 2);
  damage(0, 9, 1);
  (void)work_until(STARCAT_EVENT_MENDED);
  CHECK_IS(event.block, 9);
  CHECK_IS(session.counts.damage_found, 2);
  CHECK_IS(session.counts.blocks_mended, 2);
  CHECK_IS(memcmp(session.slots.bytes[0], unit_triangle.bytes, unit_triangle.size), 0);
  damage(0, blocks, 1); /* parity itself */
  (void)work_until(STARCAT_EVENT_MENDED);
  CHECK_IS(event.block, blocks);
  CHECK_IS(session.counts.parity_mended, 1);
  CHECK_IS(starcat_check_parity(session.slots.bytes[0], unit_triangle.size, 0), STARCAT_OK);
  /* A block that is damaged after it was checked is found with its group, and no parity is written. */
  session.scrub_next = blocks;
  damage(0, groups, 1);
  (void)work_until(STARCAT_EVENT_MENDED);
  CHECK_IS(event.block, groups);
  CHECK_IS(session.counts.parity_mended, 1);
  CHECK_IS(memcmp(session.slots.bytes[0], unit_triangle.bytes, unit_triangle.size), 0);
}

static void check_other_slot(void) {
  const uint32_t blocks = blocks_of(&unit_pyramid);
  begin_in_slots();
  load_accepted(&unit_pyramid);
  damage(1, 4, 1); /* the other image is looked after, too */
  (void)work_until(STARCAT_EVENT_MENDED);
  CHECK_IS(event.slot, 1);
  CHECK_IS(event.block, 4);
  damage(1, blocks, 1);
  (void)work_until(STARCAT_EVENT_MENDED);
  CHECK_IS(event.slot, 1);
  CHECK_IS(event.block, blocks);
  for (uint32_t n = 0; n < 500u; n++) {
    (void)starcat_do_idle_work(&session, &event);
  }
  CHECK(session.counts.scrub_passes > 2u);
  damage(1, 0, blocks);
  (void)work_until(STARCAT_EVENT_OTHER_LOST);
  CHECK_IS(session.slots.acceptance[1], 0);
  CHECK_IS(session.load, STARCAT_LOAD_NONE);
  CHECK_IS(starcat_change_image(&session), STARCAT_INCOMPLETE);
  /* Damage that is found on the way to a change. */
  load_accepted(&unit_pyramid);
  damage(1, blocks - 1u, 1);
  CHECK_IS(starcat_change_image(&session), STARCAT_OK);
  (void)work_until(STARCAT_EVENT_MENDED);
  damage(1, 7, 1);
  (void)work_until(STARCAT_EVENT_MENDED);
  (void)work_until(STARCAT_EVENT_CHANGED);
  CHECK_IS(memcmp(session.slots.bytes[1], unit_pyramid.bytes, unit_pyramid.size), 0);
  damage(0, 0, blocks_of(&unit_triangle));
  CHECK_IS(starcat_change_image(&session), STARCAT_OK);
  (void)work_until(STARCAT_EVENT_OTHER_LOST);
  CHECK_IS(starcat_check_session(&session), STARCAT_OK);
  /* What has to be repaired does not stay repaired: a sound block of another image. */
  begin_in_slots();
  load_accepted(&unit_pyramid);
  session.slots.crc[1] ^= 1u;
  CHECK_IS(starcat_change_image(&session), STARCAT_OK);
  (void)work_until(STARCAT_EVENT_MENDED);
  (void)work_until(STARCAT_EVENT_OTHER_LOST);
  CHECK_IS(session.slots.active, 0);
  /* The image opens no longer, or its size is lost, or its acceptance, before it is taken. */
  for (uint32_t n = 0; n < 3u; n++) {
    begin_in_slots();
    load_accepted(&unit_pyramid);
    CHECK_IS(starcat_change_image(&session), STARCAT_OK);
    if (n == 0u) {
      session.slots.size[1] = 0;
    } else if (n == 1u) {
      session.slots.acceptance[1] ^= 1u;
    } else {
      session.next = 100000;
      session.slots.bytes[1][0] ^= 1u;
    }
    (void)work_until(STARCAT_EVENT_OTHER_LOST);
    CHECK_IS(starcat_check_session(&session), STARCAT_OK);
  }
}

static void check_fall_back(void) {
  begin_in_slots();
  load_accepted(&unit_pyramid);
  state = 5;
  look();
  CHECK_IS(answer(100), STARCAT_IDENTIFIED);
  damage(0, 0, blocks_of(&unit_triangle)); /* more than parity can repair */
  for (uint32_t n = 0; (n < 9u) && (session.work != STARCAT_WORK_FALL_BACK); n++) {
    CHECK_IS(starcat_do_idle_work(&session, &event), STARCAT_OK);
    CHECK_IS(event.kind, STARCAT_EVENT_NONE);
  }
  CHECK_IS(answer(100), STARCAT_E_CRC); /* no answer from an image that is lost */
  CHECK_IS(starcat_refuse_load(&session), STARCAT_INCOMPLETE);
  CHECK_IS(starcat_begin_load(&session, unit_pyramid.size, 0), STARCAT_INCOMPLETE);
  CHECK_IS(starcat_begin_patch_load(&session, 100), STARCAT_INCOMPLETE);
  damage(1, 3, 1);
  (void)work_until(STARCAT_EVENT_MENDED);
  (void)work_until(STARCAT_EVENT_FELL_BACK);
  CHECK_IS(session.counts.fall_backs, 1);
  CHECK_IS(session.slots.active, 1);
  CHECK_IS(session.slots.acceptance[0], 0);
  CHECK_IS(session.image.method, unit_pyramid.image.method);
  CHECK_IS(answer(101), STARCAT_IDENTIFIED);
  CHECK_IS(said.mode, STARCAT_MODE_TRACK);
  CHECK_IS(restart(), STARCAT_OK);
  CHECK_IS(session.slots.active, 1);
  damage(1, 0, blocks_of(&unit_pyramid));
  (void)work_until(STARCAT_EVENT_NO_IMAGE);
  CHECK_IS(event.status, STARCAT_E_CRC);
  CHECK_IS(starcat_check_session(&session), STARCAT_E_CRC);
  CHECK_IS(starcat_do_idle_work(&session, &event), STARCAT_OK);
  CHECK_IS(event.kind, STARCAT_EVENT_NONE);
  load_accepted(&unit_triangle); /* recovery by an upload */
  CHECK_IS(starcat_change_image(&session), STARCAT_OK);
  (void)work_until(STARCAT_EVENT_CHANGED);
  CHECK_IS(starcat_check_session(&session), STARCAT_OK);
  /* Both are lost. */
  begin_in_slots();
  load_accepted(&unit_pyramid);
  damage(0, 0, blocks_of(&unit_triangle));
  damage(1, 0, blocks_of(&unit_pyramid));
  (void)work_until(STARCAT_EVENT_NO_IMAGE);
  CHECK_IS(session.slots.acceptance[1], 0);
}

/* No tick is longer than two ordinary ones, counted in ticks: each takes one part of the work. */
static void check_ticks(void) {
  static unit_sky large; /* two groups of parity */
  static const sky_recipe pairs = {2, 4, 700, 0.698, 8};
  const unit_sky *sky = &large;
  large.bytes = (uint8_t *)large.words;
  large.size = sky_image(&pairs, large.bytes);
  const uint32_t blocks = blocks_of(sky);
  begin_in_slots();
  settings.blocks_per_tick = 1;
  CHECK_IS(starcat_begin_load(&session, sky->size, 0), STARCAT_OK);
  CHECK_IS(load(sky->bytes, sky->size), STARCAT_OK);
  const uint32_t groups = (uint32_t)(starcat_count_parity_bytes(sky->size) / BLOCK);
  CHECK(groups > 1u);
  CHECK_IS(work_until(STARCAT_EVENT_READY), blocks + groups);
  CHECK_IS(starcat_accept_load(&session), STARCAT_OK);
  CHECK_IS(starcat_change_image(&session), STARCAT_OK);
  CHECK_IS(work_until(STARCAT_EVENT_CHANGED), blocks);
  for (uint32_t n = 0; n < 3u; n++) {
    damage(1, n, 1);
    (void)work_until(STARCAT_EVENT_MENDED); /* one block a tick */
    CHECK_IS(session.counts.blocks_mended, n + 1u);
  }
}

static void check_scrubbing_of_rom(void) {
  unit_copy(&unit_triangle);
  begin_in_rom(&unit_scratch);
  settings.blocks_per_tick = 2;
  for (uint32_t n = 0; (n < 100u) && (session.counts.scrub_passes == 0u); n++) {
    (void)starcat_do_idle_work(&session, &event);
  }
  CHECK_IS(session.counts.scrub_passes, 1);
  unit_scratch.bytes[5u * BLOCK] ^= 1u;
  (void)work_until(STARCAT_EVENT_NO_IMAGE); /* it has no parity to repair it from */
  CHECK_IS(event.status, STARCAT_E_CRC);
  CHECK_IS(event.block, 5);
  CHECK_IS(starcat_check_session(&session), STARCAT_E_CRC);
}

void test_session(void) {
  check_modes();
  check_frames_between();
  check_frames_without_answer();
  check_crowded_prior();
  check_nulls();
  check_age();
  check_self_test();
  check_self_test_of_damage();
  check_correction();
  check_correction_without_steps();
  check_confirmed();
  check_joined_frames();
  check_odd_composites();
  check_same_spots();
  check_false_spots();
  check_ends_of_composites();
  check_steps_of_confirming();
  check_confirmed_with_correction();
  check_settings();
  check_load();
  check_own_camera();
  check_loads_that_fail();
  check_refused();
  check_stores();
  check_store_of_rom();
  check_patch_loads();
  check_scrubbing();
  check_other_slot();
  check_fall_back();
  check_ticks();
  check_scrubbing_of_rom();
}
