/* A session: the image in use and its successor, the last attitude, the steps of a frame, idle time.
 *
 * SPDX-License-Identifier: MIT
 */
#include "starcat_session.h"
#include "internal.h"

#define DEFAULT_PRIOR_ERROR_RAD R(0.009)
#define DEFAULT_BLOCKS_PER_TICK 16u
#define CORRECTED_RAD R(1e-3) /* largest change of the attitude by correcting a frame */
#define N_REASONS 6u

void starcat_prepare_session(starcat_session *session) {
  starcat_set_default_options(&session->options);
  session->prior_error_rad = DEFAULT_PRIOR_ERROR_RAD;
  session->blocks_per_tick = DEFAULT_BLOCKS_PER_TICK;
  session->image_status = STARCAT_E_NULL;
}

/* Store the status of the image in use after a start, a change or damage. */
static starcat_status note_image(starcat_session *s, starcat_status status) {
  s->image_status = status;
  s->has_prior = 0;
  s->scrub_block = 0;
  if ((status == STARCAT_OK) && (s->has_own_camera == 0u)) {
    starcat_get_camera(&s->image, &s->camera);
  }
  return status;
}

starcat_status starcat_start_session(starcat_session *session) {
  return note_image(session, starcat_start_image(&session->slots, &session->image));
}

starcat_status starcat_use_image(starcat_session *session, const void *bytes, size_t size) {
  return note_image(session, starcat_open_image(&session->image, bytes, size, 0));
}

starcat_status starcat_check_settings(const starcat_camera *camera,
                                      const starcat_options *options) {
  starcat_optics optics;
  const starcat_status status = starcat_check_options(options);
  return (status == STARCAT_OK) && (camera != NULL) ? starcat_prepare_camera(camera, &optics)
                                                    : status;
}

/* Whether the last attitude is fresh enough for tracking; frames can come in any order. */
static int is_fresh(const starcat_session *s, uint64_t time) {
  const uint64_t apart = time > s->prior_time ? time - s->prior_time : s->prior_time - time;
  return (s->has_prior != 0u) && (apart < s->prior_age);
}

/* Whether a frame has centroids that can be corrected; if not, the library refuses it. */
static int is_correctable(const starcat_session *s, const starcat_frame *frame) {
  return (s->correct != NULL) && (frame->count <= STARCAT_MAX_CENTROIDS) && (frame->x_px != NULL) &&
         (frame->y_px != NULL);
}

/* Track a frame from an attitude, which also corrects its centroids. */
static starcat_status track_from(starcat_session *s, const starcat_frame *frame,
                                 const starcat_real q[4], starcat_real error_rad,
                                 starcat_options *left) {
  starcat_frame moved = *frame;
  if (is_correctable(s, frame) != 0) {
    for (uint32_t n = 0; n < frame->count; n++) {
      s->x_px[n] = frame->x_px[n];
      s->y_px[n] = frame->y_px[n];
    }
    s->correct(s->context, q, frame->count, s->x_px, s->y_px);
    moved.x_px = s->x_px;
    moved.y_px = s->y_px;
  }
  const starcat_status status =
      starcat_track_frame(&s->image, &s->camera, left, &moved, q, error_rad, &s->work, &s->result);
  s->steps += s->result.steps;
  left->max_steps -= s->result.steps;
  return status;
}

/* Identify a frame lost in space, then again with corrected centroids. */
static starcat_status identify_corrected(starcat_session *s, const starcat_frame *frame,
                                         starcat_options *left) {
  starcat_status status =
      starcat_identify_frame(&s->image, &s->camera, left, frame, &s->work, &s->result);
  s->steps += s->result.steps;
  left->max_steps -= s->result.steps;
  if ((status == STARCAT_IDENTIFIED) && (s->correct != NULL)) {
    starcat_real q[4];
    if (left->max_steps == 0u) {
      s->result.n_matched = 0;
      s->result.reason = STARCAT_REASON_STEPS;
      return STARCAT_E_BUDGET;
    }
    for (uint32_t n = 0; n < 4u; n++) {
      q[n] = s->result.q_body_from_icrs[n];
    }
    status = track_from(s, frame, q, CORRECTED_RAD, left);
  }
  return status;
}

static void count_frame(starcat_session *s, starcat_status status) {
  starcat_counts *counts = &s->counts;
  if (s->mode == STARCAT_MODE_NONE) {
    counts->frames_without_image++;
  } else if (status == STARCAT_IDENTIFIED) {
    counts->frames_tracked += s->mode == STARCAT_MODE_TRACK ? 1u : 0u;
    counts->frames_identified += s->mode == STARCAT_MODE_TRACK ? 0u : 1u;
  } else if ((status > STARCAT_IDENTIFIED) || (status == STARCAT_E_BUDGET)) {
    counts->frames_not_identified[starcat_limit_place(s->result.reason - 1u, N_REASONS)]++;
  } else {
    counts->frames_refused++;
  }
}

starcat_status starcat_answer_frame(starcat_session *session, const starcat_frame *frame,
                                    uint64_t time) {
  starcat_session *s = session;
  starcat_options left = s->options;
  starcat_status status = s->image_status;
  s->mode = STARCAT_MODE_NONE;
  s->steps = 0;
  s->result.steps = 0;
  s->result.n_matched = 0;
  s->result.n_usable = 0;
  s->result.reason = STARCAT_REASON_NONE;
  if ((status == STARCAT_OK) && (frame != NULL) && (is_fresh(s, time) != 0)) {
    s->mode = STARCAT_MODE_TRACK;
    status = track_from(s, frame, s->q_prior, s->prior_error_rad, &left);
  }
  if ((s->image_status == STARCAT_OK) &&
      ((s->mode == STARCAT_MODE_NONE) ||
       ((left.max_steps > 0u) && (status != STARCAT_IDENTIFIED)))) {
    s->mode = STARCAT_MODE_IDENTIFY;
    status = identify_corrected(s, frame, &left);
  }
  count_frame(s, status);
  s->has_prior = status == STARCAT_IDENTIFIED ? 1u : 0u;
  for (uint32_t n = 0; n < 4u; n++) {
    s->q_prior[n] = s->result.q_body_from_icrs[n];
  }
  s->prior_time = time;
  return status;
}

/* Store an event with its status, block and number of repaired blocks. */
static starcat_event note_event(starcat_session *s, starcat_event event, starcat_status status,
                                uint32_t block, uint32_t mended) {
  s->event_status = status;
  s->event_block = block;
  s->event_mended = mended;
  return event;
}

/* Check some blocks of the new image, check blocks first: they are needed to check the others. A
 * patch is applied instead, which makes and checks the new image in one go. */
static starcat_event check_load(starcat_session *s) {
  const uint32_t blocks = s->is_patch != 0u ? 0u : (uint32_t)(s->load_size / STARCAT_BLOCK_BYTES);
  uint32_t bad = 0;
  starcat_status status = s->is_patch != 0u ? starcat_apply_patch(&s->slots, s->patch, s->load_size)
                                            : starcat_find_missing_block(&s->slots, blocks, &bad);
  if ((status == STARCAT_OK) && (s->is_patch == 0u)) {
    status = starcat_scrub_image(s->slots.bytes[1u - s->slots.active], s->load_size, s->check_block,
                                 s->blocks_per_tick, &bad);
  }
  s->check_block += s->blocks_per_tick;
  if (status != STARCAT_OK) {
    s->load = STARCAT_LOAD_FAILED;
    return note_event(s, STARCAT_EVENT_REFUSED, status, bad, 0);
  }
  if (s->check_block >= blocks) {
    s->load = STARCAT_LOAD_READY;
    return note_event(s, STARCAT_EVENT_READY, status, 0, 0);
  }
  return STARCAT_EVENT_NONE;
}

/* Repair damage of the image in use from its parity; if that fails, use the other image. */
static starcat_event repair_image(starcat_session *s, starcat_status found, uint32_t block) {
  const uint32_t active = s->slots.active;
  starcat_status status = found;
  uint32_t mended = 0;
  s->counts.damage_found++;
  if (s->slots.bytes[0] != NULL) {
    status = starcat_mend_image(s->slots.bytes[active], s->slots.size[active], &mended);
    s->counts.blocks_mended += mended;
    if (status == STARCAT_OK) {
      return note_event(s, STARCAT_EVENT_MENDED, status, block, mended);
    }
    status = starcat_start_image(&s->slots, &s->image);
  }
  (void)note_image(s, status);
  if (status == STARCAT_OK) {
    s->counts.fall_backs++;
    s->load = STARCAT_LOAD_NONE; /* the other slot is now in use: nothing may be loaded into it */
    return note_event(s, STARCAT_EVENT_FELL_BACK, status, block, mended);
  }
  return note_event(s, STARCAT_EVENT_NO_IMAGE, status, block, mended);
}

/* Check some blocks of the image in use; the next call checks damaged blocks again. */
static starcat_event scrub_some(starcat_session *s) {
  uint32_t bad = 0;
  const starcat_status status = starcat_scrub_image(s->image.bytes, s->image.total_bytes,
                                                    s->scrub_block, s->blocks_per_tick, &bad);
  if (status != STARCAT_OK) {
    return repair_image(s, status, bad);
  }
  s->scrub_block += s->blocks_per_tick;
  if (s->scrub_block >= s->image.total_bytes / STARCAT_BLOCK_BYTES) {
    s->scrub_block = 0;
    s->counts.scrub_passes++;
  }
  return STARCAT_EVENT_NONE;
}

starcat_event starcat_do_idle_work(starcat_session *session) {
  if (session->load == STARCAT_LOAD_CHECKING) {
    return check_load(session);
  }
  return session->image_status == STARCAT_OK ? scrub_some(session) : STARCAT_EVENT_NONE;
}

/* Begin to read an image or patch; `fits` is STARCAT_OK if there is memory for it. */
static starcat_status begin_reading(starcat_session *s, starcat_status fits, size_t size,
                                    uint32_t is_patch) {
  s->load = fits == STARCAT_OK ? STARCAT_LOAD_READING : STARCAT_LOAD_FAILED;
  s->load_bytes = 0;
  s->load_size = size;
  s->is_patch = is_patch;
  s->check_block = 0;
  return fits;
}

starcat_status starcat_begin_load(starcat_session *session, size_t size, uint32_t crc) {
  return begin_reading(session, starcat_receive_image(&session->slots, size, crc), size, 0);
}

starcat_status starcat_begin_patch_load(starcat_session *session, size_t size) {
  const int fits = (session->patch != NULL) && (size <= session->patch_capacity);
  return begin_reading(session, fits ? STARCAT_OK : STARCAT_E_SHORT, size, 1);
}

/* Copy a piece of a patch to its memory. */
static starcat_status copy_piece(const starcat_session *s, const uint8_t *bytes, size_t count) {
  uint8_t *patch = s->patch;
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
  return STARCAT_OK;
}

starcat_status starcat_change_image(starcat_session *session) {
  starcat_image image; /* also written by a change that fails */
  /* A half-read image can be the old one still; an unchecked or failed image must not be used. */
  if ((session->load == STARCAT_LOAD_READING) || (session->load == STARCAT_LOAD_CHECKING)) {
    return STARCAT_INCOMPLETE;
  }
  const starcat_status status = starcat_switch_image(&session->slots, &image);
  if (status != STARCAT_OK) {
    return status;
  }
  session->load = STARCAT_LOAD_NONE;
  session->image = image;
  return note_image(session, status);
}
