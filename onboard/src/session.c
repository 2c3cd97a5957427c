/* A session: the image in use and its successor, the last attitude, the steps of a frame, idle time.
 *
 * SPDX-License-Identifier: MIT
 */
#include "starcat_session.h"
#include "internal.h"

#define DEFAULT_PRIOR_ERROR_RAD R(0.009)
#define MOST_PRIOR_ERROR_RAD R(0.35)
#define DEFAULT_BLOCKS_PER_TICK 16u
#define BLOCKS_OF_PARITY_CHECK 4u /* a group takes at most as long as this many blocks */
#define MOST_BLOCKS_PER_TICK 65536u
#define CORRECTED_RAD R(1e-3) /* largest change of the attitude by correcting a frame */
#define MOST_TURN_RAD (R(0.5) * MOST_PRIOR_ERROR_RAD) /* between refused frames */

/* Settings and the session itself. */

/* Set a structure to zeros. */
static void clear(void *structure, size_t size) {
  uint8_t *bytes = structure;
  for (size_t n = 0; n < size; n++) {
    bytes[n] = 0;
  }
}

starcat_status starcat_set_default_settings(starcat_settings *settings) {
  if (settings == NULL) {
    return STARCAT_E_NULL;
  }
  clear(settings, sizeof *settings);
  (void)starcat_set_default_options(&settings->options);
  settings->max_steps_track = settings->options.max_steps;
  settings->max_steps_identify = settings->options.max_steps;
  settings->prior_error_rad = DEFAULT_PRIOR_ERROR_RAD;
  settings->blocks_per_tick = DEFAULT_BLOCKS_PER_TICK;
  return STARCAT_OK;
}

starcat_status starcat_check_settings(const starcat_settings *settings) {
  starcat_optics optics;
  if (settings == NULL) {
    return STARCAT_E_NULL;
  }
  starcat_options options = settings->options;
  options.max_steps = settings->max_steps_identify;
  if ((settings->max_steps_track == 0u) || (settings->blocks_per_tick > MOST_BLOCKS_PER_TICK) ||
      !starcat_is_between(settings->prior_error_rad, STARCAT_LEAST_NUMBER, MOST_PRIOR_ERROR_RAD)) {
    return STARCAT_E_OPTIONS;
  }
  const starcat_status status = starcat_check_options(&options);
  return (status == STARCAT_OK) && (settings->has_own_camera != 0u)
             ? starcat_prepare_camera(&settings->camera, &optics)
             : status;
}

starcat_status starcat_prepare_session(starcat_session *session, const starcat_settings *settings) {
  if (session == NULL) {
    return STARCAT_E_NULL;
  }
  clear(session, sizeof *session);
  session->image_fault = STARCAT_E_NULL;
  const starcat_status status = starcat_check_settings(settings);
  session->settings = status == STARCAT_OK ? settings : NULL;
  return status;
}

/* Store whether the image in use can be used after a start, a change or damage. */
static starcat_status note_image(starcat_session *s, starcat_status status) {
  s->has_image = status == STARCAT_OK ? 1u : 0u;
  s->image_fault = status;
  s->damaged = 0;
  s->mended = 0;
  s->suspect = 0;
  s->scrub_slot = s->slots.active;
  s->scrub_next = 0;
  s->composite.n_spots = 0;
  if (status == STARCAT_OK) {
    (void)starcat_get_camera(&s->image, &s->camera);
  }
  return status;
}

static int is_prepared(const starcat_session *session) {
  return (session != NULL) && (session->settings != NULL);
}

static int has_slots(const starcat_session *s) {
  return (s->slots.bytes[0] != NULL) && (s->slots.bytes[1] != NULL);
}

/* Let the application store the record of the slots. Returns whether it did. */
static int store_slots(starcat_session *s) {
  uint8_t record[STARCAT_RECORD_BYTES];
  uint32_t place = 0;
  if ((s->settings->store == NULL) || (has_slots(s) == 0)) {
    s->must_store = 0;
    return 1;
  }
  (void)starcat_write_record(&s->slots, record, &place);
  const int stored = s->settings->store(s->settings->context, place, record) == 1;
  s->must_store = stored != 0 ? 0u : 1u;
  s->counts.stores_failed += s->must_store;
  return stored;
}

starcat_status starcat_start_session(starcat_session *session, const starcat_slots *slots) {
  if ((is_prepared(session) == 0) || (slots == NULL)) {
    return STARCAT_E_NULL;
  }
  session->slots = *slots;
  session->work = STARCAT_WORK_SCRUB;
  session->load = STARCAT_LOAD_NONE;
  const starcat_status status = starcat_start_image(&session->slots, &session->image);
  if (session->slots.active != slots->active) {
    session->counts.fall_backs++;
    (void)store_slots(session);
  }
  return note_image(session, status);
}

starcat_status starcat_use_image(starcat_session *session, const void *bytes, size_t size) {
  if (is_prepared(session) == 0) {
    return STARCAT_E_NULL;
  }
  clear(&session->slots, sizeof session->slots);
  session->work = STARCAT_WORK_SCRUB;
  session->load = STARCAT_LOAD_NONE;
  return note_image(session, starcat_open_image(&session->image, bytes, size, 0));
}

starcat_status starcat_check_session(const starcat_session *session) {
  if (is_prepared(session) == 0) {
    return STARCAT_E_NULL;
  }
  return session->has_image != 0u ? STARCAT_OK : session->image_fault;
}

/* Frames. */

/* Time between two moments; frames can come in any order. */
static uint64_t find_distance(uint64_t a, uint64_t b) { return a > b ? a - b : b - a; }

static int is_fresh(const starcat_session *s, uint64_t time) {
  return (s->has_prior != 0u) && (find_distance(time, s->prior_time) < s->settings->prior_age);
}

/* Whether a frame has centroids that can be corrected; if not, the library refuses it. */
static int is_correctable(const starcat_session *s, const starcat_frame *frame) {
  return (s->settings->correct != NULL) && (frame->count <= STARCAT_MAX_CENTROIDS) &&
         (frame->x_px != NULL) && (frame->y_px != NULL);
}

static const starcat_camera *choose_camera(const starcat_session *s) {
  return s->settings->has_own_camera != 0u ? &s->settings->camera : &s->camera;
}

/* Track a frame from an attitude, which also corrects its centroids. */
static starcat_status track_from(starcat_session *s, const starcat_frame *frame,
                                 const starcat_real q[4], starcat_real error_rad,
                                 uint32_t max_steps, starcat_answer *answer) {
  starcat_options options = s->settings->options;
  starcat_frame moved = *frame;
  options.max_steps = max_steps;
  if (is_correctable(s, frame) != 0) {
    for (uint32_t n = 0; n < frame->count; n++) {
      s->x_px[n] = frame->x_px[n];
      s->y_px[n] = frame->y_px[n];
    }
    s->settings->correct(s->settings->context, q, frame->count, s->x_px, s->y_px);
    moved.x_px = s->x_px;
    moved.y_px = s->y_px;
  }
  answer->result.steps = 0;
  const starcat_status status =
      starcat_track_frame(&s->image, choose_camera(s), &options, &moved, q, error_rad,
                          &s->workspace, &answer->result);
  answer->steps += answer->result.steps;
  s->counts.tracks_refused += status == STARCAT_E_CAPACITY ? 1u : 0u;
  return status;
}

/* Track a frame from the last attitude. */
static starcat_status track_frame(starcat_session *s, const starcat_frame *frame,
                                  starcat_answer *answer) {
  starcat_counts *counts = &s->counts;
  answer->mode = STARCAT_MODE_TRACK;
  const starcat_status status = track_from(s, frame, s->q_prior, s->settings->prior_error_rad,
                                           s->settings->max_steps_track, answer);
  counts->tracks_failed += status == STARCAT_IDENTIFIED ? 0u : 1u;
  if (answer->steps > counts->most_steps_track) {
    counts->most_steps_track = answer->steps;
  }
  return status;
}

/* Track a frame from the attitude that was found in it, with corrected centroids. */
static starcat_status track_again(starcat_session *s, const starcat_frame *frame,
                                  starcat_real error_rad, uint32_t max_steps,
                                  starcat_answer *answer) {
  starcat_real q[4];
  for (uint32_t n = 0; n < 4u; n++) {
    q[n] = answer->result.q_body_from_icrs[n];
  }
  return track_from(s, frame, q, error_rad, max_steps, answer);
}

/* Identify a frame lost in space, then again with corrected centroids. */
static starcat_status identify_frame(starcat_session *s, const starcat_frame *frame,
                                     starcat_answer *answer) {
  const uint32_t before = answer->steps;
  starcat_options options = s->settings->options;
  starcat_result *result = &answer->result;
  options.max_steps = s->settings->max_steps_identify;
  answer->mode = STARCAT_MODE_IDENTIFY;
  result->steps = 0;
  starcat_status status =
      starcat_identify_frame(&s->image, choose_camera(s), &options, frame, &s->workspace, result);
  answer->steps += result->steps;
  if ((status == STARCAT_IDENTIFIED) && (s->settings->correct != NULL)) {
    const uint32_t left = options.max_steps - result->steps;
    if (left == 0u) {
      result->n_matched = 0;
      result->reason = STARCAT_REASON_STEPS;
      status = STARCAT_E_BUDGET;
    } else {
      status = track_again(s, frame, CORRECTED_RAD, left, answer);
    }
  }
  if (answer->steps - before > s->counts.most_steps_identify) {
    s->counts.most_steps_identify = answer->steps - before;
  }
  return status;
}

static uint32_t find_composite_crc(const starcat_session *s) {
  return starcat_update_crc(0, (const uint8_t *)&s->composite, offsetof(starcat_composite, crc));
}

/* Whether a frame can follow the composite. What chance has to be compared with must not change by
 * a fault in memory. */
static int has_composite(const starcat_session *s, uint64_t time) {
  return (s->composite.n_spots <= STARCAT_MAX_CENTROIDS) &&
         (find_distance(time, s->composite.time) < s->settings->prior_age) &&
         (find_composite_crc(s) == s->composite.crc);
}

static int can_confirm(const starcat_session *s, starcat_status status) {
  return (s->settings->max_steps_confirm > 0u) && !(s->settings->options.fov_error > R(0.0)) &&
         ((status == STARCAT_NO_MATCH) || (status == STARCAT_E_BUDGET));
}

/* Answer a refused frame if it has an attitude near that of the spots of all refused frames: those
 * before it do not show that the last turn was found. An attitude that is near after the turn that
 * was found is near after every turn that is allowed, within twice the turn. */
static starcat_status confirm_frame(starcat_session *s, const starcat_frame *frame, uint64_t time,
                                    starcat_answer *answer) {
  const starcat_answer refused = *answer;
  const real turn_rad = starcat_smaller(s->settings->prior_error_rad, MOST_TURN_RAD);
  starcat_options options = s->settings->options;
  starcat_result *result = &answer->result;
  starcat_status status = STARCAT_NO_MATCH;
  uint32_t left = s->settings->max_steps_confirm, steps = 0;
  options.max_steps = left;
  s->composite.n_spots = has_composite(s, time) != 0 ? s->composite.n_spots : 0u;
  const int is_joined =
      starcat_join_frame(&s->image, choose_camera(s), &options, frame, &s->workspace, turn_rad,
                         &s->composite, s->x_px, s->y_px, &steps);
  s->composite.time = time;
  s->composite.crc = find_composite_crc(s);
  left -= steps;
  if (is_joined != 0) {
    const starcat_frame whole = {s->composite.n_spots, s->x_px, s->y_px, s->composite.magnitude,
                                 NULL};
    options.max_steps = left;
    result->steps = 0;
    status = starcat_identify_frame(&s->image, choose_camera(s), &options, &whole, &s->workspace,
                                    result);
    left -= result->steps;
  }
  answer->steps += s->settings->max_steps_confirm - left;
  if (status == STARCAT_IDENTIFIED) {
    const real log_chance = result->log_chance;
    status = track_again(s, frame, R(2.0) * turn_rad, left, answer);
    if (status == STARCAT_IDENTIFIED) {
      result->log_chance = starcat_larger(result->log_chance, log_chance);
      answer->mode = STARCAT_MODE_CONFIRM;
      return status;
    }
  }
  *result = refused.result;
  return refused.status;
}

static void count_frame(starcat_session *s, const starcat_answer *answer) {
  starcat_counts *counts = &s->counts;
  const starcat_status status = answer->status;
  if (answer->mode == STARCAT_MODE_NONE) {
    counts->frames_without_image++;
  } else if (status == STARCAT_IDENTIFIED) {
    counts->frames_tracked += answer->mode == STARCAT_MODE_TRACK ? 1u : 0u;
    counts->frames_identified += answer->mode == STARCAT_MODE_IDENTIFY ? 1u : 0u;
    counts->frames_confirmed += answer->mode == STARCAT_MODE_CONFIRM ? 1u : 0u;
  } else if ((status > STARCAT_IDENTIFIED) || (status == STARCAT_E_BUDGET)) {
    const uint32_t reason = answer->result.reason - 1u;
    counts->frames_not_identified[starcat_limit_place(reason, STARCAT_N_REASONS)]++;
  } else {
    counts->frames_refused++;
    counts->errors[starcat_limit_place((uint32_t)(-1 - (int)status), STARCAT_N_ERRORS)]++;
  }
}

starcat_status starcat_answer_frame(starcat_session *session, const starcat_frame *frame,
                                    uint64_t time, starcat_answer *answer) {
  starcat_session *s = session;
  if (answer == NULL) {
    return STARCAT_E_NULL;
  }
  clear(answer, sizeof *answer);
  answer->status = STARCAT_E_NULL;
  if ((is_prepared(s) == 0) || (frame == NULL)) {
    return answer->status;
  }
  answer->status = starcat_check_session(s);
  if (answer->status == STARCAT_OK) {
    answer->status = is_fresh(s, time) != 0 ? track_frame(s, frame, answer) : STARCAT_NO_MATCH;
    if (answer->status != STARCAT_IDENTIFIED) {
      answer->status = identify_frame(s, frame, answer);
    }
    if (can_confirm(s, answer->status) != 0) {
      const uint32_t before = answer->steps;
      answer->status = confirm_frame(s, frame, time, answer);
      if (answer->steps - before > s->counts.most_steps_confirm) {
        s->counts.most_steps_confirm = answer->steps - before;
      }
    }
  }
  count_frame(s, answer);
  if ((answer->mode != STARCAT_MODE_NONE) && (answer->status == STARCAT_IDENTIFIED)) {
    s->has_prior = 1;
    s->prior_time = time;
    s->has_attitude = 1;
    s->composite.n_spots = 0;
    s->attitude_time = time;
    for (uint32_t n = 0; n < 4u; n++) {
      s->q_prior[n] = answer->result.q_body_from_icrs[n];
    }
  }
  return answer->status;
}

starcat_status starcat_find_age(const starcat_session *session, uint64_t time, uint64_t *age) {
  if ((is_prepared(session) == 0) || (age == NULL)) {
    return STARCAT_E_NULL;
  }
  *age = (session->has_attitude != 0u) && (time >= session->attitude_time)
             ? time - session->attitude_time
             : UINT64_MAX;
  return STARCAT_OK;
}

/* The self-test. */

#define TEST_FRAMES 8u
#define TEST_PX R(1.0)     /* largest error of a star of the answer, put where it has to be */
#define LEAST_DEPTH R(0.1) /* cosine of the largest angle from the boresight */
#define LARGEST_COMPONENT R(0.6)

/* A camera axis at a star: the rows of the attitude. */
static void point_at(const starcat_image *image, uint32_t row, real m[9]) {
  real other[3] = {R(1.0), R(0.0), R(0.0)};
  starcat_read_star(image, row, m + 6);
  if (starcat_absolute(m[6]) > LARGEST_COMPONENT) {
    other[0] = R(0.0);
    other[1] = R(1.0);
  }
  starcat_cross(other, m + 6, m);
  const real length = STARCAT_SQRT(starcat_dot(m, m));
  for (uint32_t k = 0; k < 3u; k++) {
    m[k] /= length;
  }
  starcat_cross(m + 6, m, m + 3);
}

/* The pixel of a star, as a camera without distortion shows it; 0 if it is outside of the frame. */
static int find_test_pixel(const starcat_session *s, const real m[9], uint32_t row, real pixel[2]) {
  real icrs[3], body[3];
  starcat_read_star(&s->image, starcat_limit_place(row, s->image.n_stars), icrs);
  starcat_turn(m, icrs, body);
  if (body[2] < LEAST_DEPTH) {
    pixel[0] = STARCAT_LARGEST_PX;
    pixel[1] = STARCAT_LARGEST_PX;
    return 0;
  }
  pixel[0] = s->camera.x0_px + s->camera.focal_length_px * body[0] / body[2];
  pixel[1] = s->camera.y0_px + s->camera.focal_length_px * body[1] / body[2];
  return starcat_is_between(pixel[0], R(0.0), s->camera.width_px) &&
         starcat_is_between(pixel[1], R(0.0), s->camera.height_px);
}

/* Whether an answer puts each of its stars where the frame has it, and where the attitude of the
 * frame does. */
static int is_test_right(const starcat_session *s, const real m[9], uint32_t count,
                         const starcat_result *result) {
  real largest_px = R(0.0);
  for (uint32_t n = 0; n < count; n++) {
    if (result->star[n] >= 0) {
      real made[2], found[2];
      (void)find_test_pixel(s, m, (uint32_t)result->star[n], made);
      (void)find_test_pixel(s, result->matrix, (uint32_t)result->star[n], found);
      const real x = starcat_larger(starcat_absolute(made[0] - s->x_px[n]),
                                    starcat_absolute(found[0] - made[0]));
      const real y = starcat_larger(starcat_absolute(made[1] - s->y_px[n]),
                                    starcat_absolute(found[1] - made[1]));
      largest_px = starcat_larger(largest_px, starcat_larger(x, y));
    }
  }
  return largest_px < TEST_PX;
}

/* Make a frame around a star and identify it. Returns the status; STARCAT_E_CRC: it is wrong. */
static starcat_status try_test_frame(starcat_session *s, uint32_t row, starcat_answer *answer) {
  starcat_frame frame = {0, s->x_px, s->y_px, NULL, NULL};
  starcat_options options;
  real m[9], pixel[2];
  (void)starcat_set_default_options(&options);
  options.max_steps = s->settings->max_steps_identify;
  point_at(&s->image, row, m);
  for (uint32_t n = 0; (n < s->image.n_stars) && (frame.count < STARCAT_MAX_CENTROIDS); n++) {
    if (find_test_pixel(s, m, n, pixel) != 0) {
      s->x_px[frame.count] = pixel[0];
      s->y_px[frame.count] = pixel[1];
      frame.count++;
    }
  }
  const starcat_status status = starcat_identify_frame(&s->image, &s->camera, &options, &frame,
                                                       &s->workspace, &answer->result);
  answer->steps += answer->result.steps;
  return (status == STARCAT_IDENTIFIED) && (is_test_right(s, m, frame.count, &answer->result) == 0)
             ? STARCAT_E_CRC
             : status;
}

starcat_status starcat_test_self(starcat_session *session, starcat_answer *answer) {
  static const uint8_t digits[9] = {0x31, 0x32, 0x33, 0x34, 0x35, 0x36, 0x37, 0x38, 0x39};
  starcat_session *s = session;
  uint32_t n_right = 0, n_wrong = starcat_update_crc(0, digits, 9) == 0xcbf43926u ? 0u : 1u;
  if (answer == NULL) {
    return STARCAT_E_NULL;
  }
  clear(answer, sizeof *answer);
  answer->status = starcat_check_session(s);
  if (answer->status != STARCAT_OK) {
    return answer->status;
  }
  answer->mode = STARCAT_MODE_IDENTIFY;
  for (uint32_t n = 0; n < TEST_FRAMES; n++) {
    const uint32_t row = (uint32_t)((uint64_t)s->image.n_stars * n / TEST_FRAMES);
    const starcat_status status = try_test_frame(s, row, answer);
    n_right += status == STARCAT_IDENTIFIED ? 1u : 0u;
    n_wrong += status == STARCAT_E_CRC ? 1u : 0u;
  }
  answer->status = (n_right > 0u) && (n_wrong == 0u) ? STARCAT_OK : STARCAT_NO_MATCH;
  return answer->status;
}

/* Idle time. */

static void note_event(starcat_event *event, starcat_event_kind kind, starcat_status status,
                       uint32_t slot, uint32_t block) {
  event->kind = kind;
  event->status = status;
  event->slot = slot;
  event->block = block;
}

static uint32_t count_blocks(const starcat_session *s, uint32_t slot) {
  return (uint32_t)(s->slots.size[slot] / STARCAT_BLOCK_BYTES);
}

static uint32_t count_groups(const starcat_session *s, uint32_t slot) {
  return (uint32_t)(starcat_count_parity_bytes(s->slots.size[slot]) / STARCAT_BLOCK_BYTES);
}

/* Groups of parity that a tick can take. */
static uint32_t count_groups_per_tick(const starcat_session *s) {
  const uint32_t groups = s->settings->blocks_per_tick / BLOCKS_OF_PARITY_CHECK;
  return groups > 0u ? groups : 1u;
}

static void begin_work(starcat_session *s, starcat_work work) {
  s->work = work;
  s->next = 0;
  s->damaged = 0;
  s->mended = 0;
  s->suspect = 0;
  s->scrub_slot = s->slots.active;
  s->scrub_next = 0;
}

static void refuse_load(starcat_session *s, starcat_status status, uint32_t block,
                        starcat_event *event) {
  s->load = STARCAT_LOAD_FAILED;
  s->counts.loads_refused++;
  begin_work(s, STARCAT_WORK_SCRUB);
  note_event(event, STARCAT_EVENT_REFUSED, status, 1u - s->slots.active, block);
}

/* Prepare the other slot for an image, and have that stored before anything is written. */
static starcat_status empty_other(starcat_session *s, size_t size, uint32_t crc) {
  const starcat_slots before = s->slots;
  starcat_status status = starcat_receive_image(&s->slots, size, crc);
  if ((status == STARCAT_OK) && (store_slots(s) == 0)) {
    const uint32_t sequence = s->slots.sequence;
    s->slots = before;
    s->slots.sequence = sequence; /* the failed record may still be there */
    status = STARCAT_INCOMPLETE;
  }
  return status;
}

/* Check a patch and the image that it is for; then make the new image. */
static void check_patch(starcat_session *s, starcat_event *event) {
  starcat_status status = STARCAT_OK;
  if (s->next == 0u) {
    s->next = 1;
    status = starcat_begin_patch(&s->slots, s->settings->patch, s->load_size, &s->patching);
  }
  if (status == STARCAT_OK) {
    status = starcat_check_patch(&s->patching, s->settings->blocks_per_tick * STARCAT_BLOCK_BYTES);
  }
  if (status == STARCAT_OK) {
    status = empty_other(s, s->patching.made_bytes, s->patching.made_crc);
    if (status == STARCAT_OK) {
      begin_work(s, STARCAT_WORK_RUN_PATCH);
    } else {
      refuse_load(s, status, 0, event);
    }
  } else if (status != STARCAT_INCOMPLETE) {
    refuse_load(s, status, 0, event);
  } else {
    /* more to check */
  }
}

static void run_patch(starcat_session *s, starcat_event *event) {
  const starcat_status status = starcat_run_patch(
      &s->slots, &s->patching, s->settings->blocks_per_tick * STARCAT_BLOCK_BYTES);
  if (status == STARCAT_OK) {
    begin_work(s, STARCAT_WORK_CHECK_LOAD);
  } else if (status != STARCAT_INCOMPLETE) {
    refuse_load(s, status, 0, event);
  } else {
    /* more to make */
  }
}

/* Check some blocks of the other slot from `next` on. */
static starcat_status check_other(starcat_session *s, uint32_t *block) {
  const starcat_status status = starcat_check_blocks(&s->slots, 1u - s->slots.active, s->next,
                                                     s->settings->blocks_per_tick, block);
  s->next += status == STARCAT_OK ? s->settings->blocks_per_tick : 0u;
  return status;
}

static void check_load(starcat_session *s, starcat_event *event) {
  uint32_t bad = 0;
  const starcat_status status = check_other(s, &bad);
  if (status != STARCAT_OK) {
    refuse_load(s, status, bad, event);
  } else if (s->next >= count_blocks(s, 1u - s->slots.active)) {
    begin_work(s, STARCAT_WORK_PARITY);
  } else {
    /* more to check */
  }
}

/* Write the parity of the new image, and look whether it can be opened. */
static void write_parity(starcat_session *s, starcat_event *event) {
  const uint32_t other = 1u - s->slots.active, groups = count_groups(s, other);
  const size_t size = s->slots.size[other];
  for (uint32_t n = count_groups_per_tick(s); (n > 0u) && (s->next < groups); n--) {
    (void)starcat_write_parity(s->slots.bytes[other], size, s->next);
    s->next++;
  }
  if (s->next >= groups) {
    starcat_image image;
    const starcat_status status =
        starcat_open_image(&image, s->slots.bytes[other], size, STARCAT_SKIP_CRC);
    if (status != STARCAT_OK) {
      refuse_load(s, status, 0, event);
    } else {
      s->load = STARCAT_LOAD_READY;
      begin_work(s, STARCAT_WORK_SCRUB);
      note_event(event, STARCAT_EVENT_READY, STARCAT_OK, other, 0);
    }
  }
}

/* The image of the other slot cannot be used: it is not fallen back to. */
static void lose_other(starcat_session *s, starcat_status status, uint32_t block,
                       starcat_event *event) {
  const uint32_t other = 1u - s->slots.active;
  const int was_needed = s->work == STARCAT_WORK_FALL_BACK;
  s->slots.acceptance[other] = 0;
  s->load = s->load == STARCAT_LOAD_ACCEPTED ? STARCAT_LOAD_NONE : s->load;
  (void)store_slots(s);
  begin_work(s, STARCAT_WORK_SCRUB);
  note_event(event, was_needed ? STARCAT_EVENT_NO_IMAGE : STARCAT_EVENT_OTHER_LOST, status, other,
             block);
}

/* The image in use is lost. Frames have no answer until the other image was checked. */
static void lose_image(starcat_session *s, starcat_status status, uint32_t block,
                       starcat_event *event) {
  (void)note_image(s, status);
  begin_work(s, STARCAT_WORK_SCRUB);
  if ((has_slots(s) != 0) && (s->slots.acceptance[1u - s->slots.active] == STARCAT_ACCEPTED)) {
    s->work = STARCAT_WORK_FALL_BACK;
  } else {
    note_event(event, STARCAT_EVENT_NO_IMAGE, status, s->slots.active, block);
  }
}

/* Repair the block of a slot that the last tick found. Returns whether it could. A block that is
 * damaged again at once is of another image, or its memory does not hold it. */
static int mend(starcat_session *s, uint32_t slot, starcat_event *event) {
  const uint32_t block = s->damaged - 1u;
  const int again = s->mended == s->damaged;
  s->mended = s->damaged;
  s->damaged = 0;
  s->counts.damage_found++;
  if (again ||
      (starcat_mend_block(s->slots.bytes[slot], s->slots.size[slot], block) != STARCAT_OK)) {
    return 0;
  }
  s->counts.blocks_mended++;
  note_event(event, STARCAT_EVENT_MENDED, STARCAT_OK, slot, block);
  return 1;
}

/* Take the other image into use, which was checked. */
static void take_other(starcat_session *s, starcat_event *event) {
  const uint32_t other = 1u - s->slots.active;
  const int fell_back = s->work == STARCAT_WORK_FALL_BACK;
  starcat_image image;
  const starcat_status status =
      starcat_open_image(&image, s->slots.bytes[other], s->slots.size[other], STARCAT_SKIP_CRC);
  if (status != STARCAT_OK) {
    lose_other(s, status, 0, event);
    return;
  }
  s->image = image;
  s->slots.active = other;
  s->load = s->load == STARCAT_LOAD_ACCEPTED ? STARCAT_LOAD_NONE : s->load;
  if (fell_back != 0) {
    s->slots.acceptance[1u - other] = 0;
    s->counts.fall_backs++;
  }
  begin_work(s, STARCAT_WORK_SCRUB);
  (void)note_image(s, STARCAT_OK);
  (void)store_slots(s);
  note_event(event, fell_back ? STARCAT_EVENT_FELL_BACK : STARCAT_EVENT_CHANGED, STARCAT_OK, other,
             0);
}

/* Check the other image, and repair it, before it is taken into use. */
static void check_and_take(starcat_session *s, starcat_event *event) {
  const uint32_t other = 1u - s->slots.active;
  uint32_t bad = 0;
  if (s->slots.acceptance[other] != STARCAT_ACCEPTED) {
    lose_other(s, STARCAT_INCOMPLETE, 0, event);
  } else if (s->damaged > 0u) {
    bad = s->damaged - 1u;
    if (mend(s, other, event) == 0) {
      lose_other(s, STARCAT_E_CRC, bad, event);
    }
  } else {
    const starcat_status status = check_other(s, &bad);
    s->mended = status == STARCAT_OK ? 0u : s->mended;
    if (status == STARCAT_E_LAYOUT) {
      lose_other(s, status, 0, event);
    } else if (status != STARCAT_OK) {
      s->damaged = bad + 1u;
    } else if (s->next >= count_blocks(s, other)) {
      take_other(s, event);
    } else {
      /* more to check */
    }
  }
}

/* A block of the slot that is scrubbed cannot be repaired. */
static void lose_scrubbed(starcat_session *s, uint32_t block, starcat_event *event) {
  if (s->scrub_slot == s->slots.active) {
    lose_image(s, STARCAT_E_CRC, block, event);
  } else {
    lose_other(s, STARCAT_E_CRC, block, event);
  }
}

/* A slot was scrubbed: go on with the other one if it has an accepted image. */
static void end_pass(starcat_session *s) {
  const uint32_t other = 1u - s->slots.active;
  s->scrub_next = 0;
  if (s->scrub_slot == s->slots.active) {
    s->counts.scrub_passes++;
    s->scrub_slot = s->slots.acceptance[other] == STARCAT_ACCEPTED ? other : s->slots.active;
  } else {
    s->scrub_slot = s->slots.active;
  }
}

/* Check the blocks of a group whose parity differs; write the parity if they are sound. */
static void scrub_group(starcat_session *s, uint32_t group, starcat_event *event) {
  const uint32_t slot = s->scrub_slot, blocks = count_blocks(s, slot);
  const uint32_t groups = count_groups(s, slot);
  const uint8_t *image = s->slots.bytes[slot];
  const size_t size = s->slots.size[slot];
  if (s->member >= blocks) {
    (void)starcat_write_parity(s->slots.bytes[slot], size, group);
    s->suspect = 0;
    s->scrub_next++;
    s->counts.parity_mended++;
    note_event(event, STARCAT_EVENT_MENDED, STARCAT_OK, slot, blocks + group);
    return;
  }
  for (uint32_t n = s->settings->blocks_per_tick;
       (n > 0u) && (s->member < blocks) && (s->damaged == 0u); n--) {
    uint32_t bad = 0;
    if (starcat_scrub_image(image, size, s->member, 1, &bad) != STARCAT_OK) {
      s->damaged = bad + 1u;
      s->suspect = 0;
    }
    s->member += groups;
  }
}

/* Compare the parity of some groups with their blocks. */
static void scrub_parity(starcat_session *s, starcat_event *event) {
  const uint32_t slot = s->scrub_slot, blocks = count_blocks(s, slot);
  const uint32_t groups = count_groups(s, slot);
  if (s->suspect != 0u) {
    scrub_group(s, s->scrub_next - blocks, event);
    return;
  }
  for (uint32_t n = count_groups_per_tick(s);
       (n > 0u) && (s->scrub_next - blocks < groups) && (s->suspect == 0u); n--) {
    const uint32_t group = s->scrub_next - blocks;
    if (starcat_check_parity(s->slots.bytes[slot], s->slots.size[slot], group) != STARCAT_OK) {
      s->suspect = 1;
      s->member = group;
    } else {
      s->scrub_next++;
    }
  }
}

/* Check some blocks or groups of the images in the slots, or repair the block that was found. */
static void scrub_slots(starcat_session *s, starcat_event *event) {
  const uint32_t slot = s->scrub_slot, blocks = count_blocks(s, slot);
  uint32_t bad = s->damaged - 1u;
  if (s->damaged > 0u) {
    if (mend(s, slot, event) == 0) {
      lose_scrubbed(s, bad, event);
    }
  } else if (s->scrub_next < blocks) {
    const starcat_status status =
        starcat_check_blocks(&s->slots, slot, s->scrub_next, s->settings->blocks_per_tick, &bad);
    s->damaged = status == STARCAT_OK ? 0u : bad + 1u;
    s->mended = status == STARCAT_OK ? 0u : s->mended;
    s->scrub_next += status == STARCAT_OK ? s->settings->blocks_per_tick : 0u;
    s->scrub_next = s->scrub_next > blocks ? blocks : s->scrub_next;
  } else {
    scrub_parity(s, event);
    if (s->scrub_next - blocks >= count_groups(s, slot)) {
      end_pass(s);
    }
  }
}

/* Check some blocks of an image in ROM. */
static void scrub_rom(starcat_session *s, starcat_event *event) {
  uint32_t bad = 0;
  const starcat_status status = starcat_scrub_image(
      s->image.bytes, s->image.total_bytes, s->scrub_next, s->settings->blocks_per_tick, &bad);
  if (status != STARCAT_OK) {
    s->counts.damage_found++;
    lose_image(s, status, bad, event);
    return;
  }
  s->scrub_next += s->settings->blocks_per_tick;
  if (s->scrub_next >= s->image.total_bytes / STARCAT_BLOCK_BYTES) {
    s->scrub_next = 0;
    s->counts.scrub_passes++;
  }
}

static void scrub(starcat_session *s, starcat_event *event) {
  if (s->has_image == 0u) {
    return;
  }
  if (has_slots(s) != 0) {
    scrub_slots(s, event);
  } else {
    scrub_rom(s, event);
  }
}

starcat_status starcat_do_idle_work(starcat_session *session, starcat_event *event) {
  starcat_session *s = session;
  if (event == NULL) {
    return STARCAT_E_NULL;
  }
  note_event(event, STARCAT_EVENT_NONE, STARCAT_OK, 0, 0);
  if (is_prepared(s) == 0) {
    return STARCAT_E_NULL;
  }
  if (s->settings->blocks_per_tick == 0u) {
    return STARCAT_OK;
  }
  if (s->must_store != 0u) {
    (void)store_slots(s);
  }
  switch (s->work) {
    case STARCAT_WORK_CHECK_PATCH:
      check_patch(s, event);
      break;
    case STARCAT_WORK_RUN_PATCH:
      run_patch(s, event);
      break;
    case STARCAT_WORK_CHECK_LOAD:
      check_load(s, event);
      break;
    case STARCAT_WORK_PARITY:
      write_parity(s, event);
      break;
    case STARCAT_WORK_CHANGE:
    case STARCAT_WORK_FALL_BACK:
      check_and_take(s, event);
      break;
    case STARCAT_WORK_SCRUB:
    default:
      scrub(s, event);
      break;
  }
  return STARCAT_OK;
}

/* Loads. */

/* Whether a new image or a change can begin now. */
static starcat_status check_begin(const starcat_session *s) {
  if (is_prepared(s) == 0) {
    return STARCAT_E_NULL;
  }
  if (s->settings->blocks_per_tick == 0u) {
    return STARCAT_E_OPTIONS;
  }
  return (s->work == STARCAT_WORK_CHANGE) || (s->work == STARCAT_WORK_FALL_BACK)
             ? STARCAT_INCOMPLETE
             : STARCAT_OK;
}

/* Begin to read an image or patch; `fits` is STARCAT_OK if there is memory for it. */
static starcat_status begin_reading(starcat_session *s, starcat_status fits, size_t size,
                                    uint32_t is_patch) {
  s->load = fits == STARCAT_OK ? STARCAT_LOAD_READING : STARCAT_LOAD_FAILED;
  s->load_bytes = 0;
  s->load_size = size;
  s->is_patch = is_patch;
  begin_work(s, STARCAT_WORK_SCRUB);
  return fits;
}

starcat_status starcat_begin_load(starcat_session *session, size_t size, uint32_t crc) {
  const starcat_status status = check_begin(session);
  return status == STARCAT_OK ? begin_reading(session, empty_other(session, size, crc), size, 0)
                              : status;
}

starcat_status starcat_begin_patch_load(starcat_session *session, size_t size) {
  const starcat_status status = check_begin(session);
  if (status != STARCAT_OK) {
    return status;
  }
  const int fits = (session->settings->patch != NULL) && (size > 0u) &&
                   (size <= session->settings->patch_capacity);
  return begin_reading(session, fits ? STARCAT_OK : STARCAT_E_SHORT, size, 1);
}

/* Copy a piece of a patch to its memory. */
static starcat_status copy_piece(const starcat_session *s, const uint8_t *bytes, size_t count) {
  uint8_t *patch = s->settings->patch;
  if (bytes == NULL) {
    return STARCAT_E_NULL;
  }
  if (count > s->load_size - s->load_bytes) {
    return STARCAT_E_SHORT;
  }
  for (size_t n = 0; n < count; n++) {
    patch[s->load_bytes + n] = bytes[n];
  }
  return STARCAT_OK;
}

starcat_status starcat_load_piece(starcat_session *session, const uint8_t *bytes, size_t count) {
  starcat_session *s = session;
  if (is_prepared(s) == 0) {
    return STARCAT_E_NULL;
  }
  if (s->load != STARCAT_LOAD_READING) {
    return STARCAT_E_OPTIONS;
  }
  const starcat_status status = s->is_patch != 0u
                                    ? copy_piece(s, bytes, count)
                                    : starcat_put_piece(&s->slots, s->load_bytes, bytes, count);
  if (status != STARCAT_OK) {
    s->load = STARCAT_LOAD_FAILED;
    return status;
  }
  s->load_bytes += count;
  if (s->load_bytes < s->load_size) {
    return STARCAT_INCOMPLETE;
  }
  s->load = STARCAT_LOAD_CHECKING;
  begin_work(s, s->is_patch != 0u ? STARCAT_WORK_CHECK_PATCH : STARCAT_WORK_CHECK_LOAD);
  return STARCAT_OK;
}

starcat_status starcat_accept_load(starcat_session *session) {
  starcat_session *s = session;
  if (is_prepared(s) == 0) {
    return STARCAT_E_NULL;
  }
  if (s->load != STARCAT_LOAD_READY) {
    return STARCAT_INCOMPLETE;
  }
  const uint32_t other = 1u - s->slots.active;
  const uint8_t *end = s->slots.bytes[other] + s->slots.size[other] - STARCAT_BLOCK_BYTES;
  const uint32_t stated = s->slots.crc[other];
  const uint32_t found = *(const uint32_t *)(const void *)(end + STARCAT_WHOLE_AT);
  (void)starcat_accept_image(&s->slots, other, stated != 0u ? stated : found);
  if (store_slots(s) == 0) {
    s->slots.acceptance[other] = 0;
    return STARCAT_INCOMPLETE;
  }
  s->load = STARCAT_LOAD_ACCEPTED;
  return STARCAT_OK;
}

starcat_status starcat_refuse_load(starcat_session *session) {
  starcat_session *s = session;
  if (is_prepared(s) == 0) {
    return STARCAT_E_NULL;
  }
  if (s->work == STARCAT_WORK_FALL_BACK) {
    return STARCAT_INCOMPLETE;
  }
  const int is_only_read = (s->is_patch != 0u) && ((s->load == STARCAT_LOAD_READING) ||
                                                   (s->work == STARCAT_WORK_CHECK_PATCH));
  s->load = STARCAT_LOAD_FAILED;
  s->counts.loads_refused++;
  begin_work(s, STARCAT_WORK_SCRUB);
  if (is_only_read || (has_slots(s) == 0)) {
    return STARCAT_OK;
  }
  (void)starcat_refuse_image(&s->slots, 1u - s->slots.active);
  return store_slots(s) != 0 ? STARCAT_OK : STARCAT_INCOMPLETE;
}

starcat_status starcat_change_image(starcat_session *session) {
  starcat_session *s = session;
  const starcat_status status = check_begin(s);
  if (status != STARCAT_OK) {
    return status;
  }
  if ((s->load == STARCAT_LOAD_READING) || (s->load == STARCAT_LOAD_CHECKING) ||
      (s->slots.acceptance[1u - s->slots.active] != STARCAT_ACCEPTED)) {
    return STARCAT_INCOMPLETE;
  }
  begin_work(s, STARCAT_WORK_CHANGE);
  return STARCAT_OK;
}
