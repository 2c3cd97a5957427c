/* The library: what it returns is a test's choice, as is what it does to a session.
 *
 * SPDX-License-Identifier: MIT
 */
#include <string.h>

#include "starcat_app_stubs.h"

#define RETURN(name) return (starcat_status)UT_DEFAULT_IMPL(name)

const char *starcat_version(void) { return "0.0.0"; }

starcat_status starcat_set_default_settings(starcat_settings *settings) {
  (void)settings;
  RETURN(starcat_set_default_settings);
}

starcat_status starcat_prepare_session(starcat_session *session, const starcat_settings *settings) {
  session->settings = settings;
  RETURN(starcat_prepare_session);
}

starcat_status starcat_accept_image(starcat_slots *slots, uint32_t slot, uint32_t crc) {
  (void)slots;
  (void)slot;
  (void)crc;
  RETURN(starcat_accept_image);
}

starcat_status starcat_start_session(starcat_session *session, const starcat_slots *slots) {
  session->slots = *slots;
  RETURN(starcat_start_session);
}

starcat_status starcat_check_session(const starcat_session *session) {
  (void)session;
  RETURN(starcat_check_session);
}

starcat_status starcat_check_settings(const starcat_settings *settings) {
  (void)settings;
  RETURN(starcat_check_settings);
}

/* The numbers of a result come from a test's buffer; a status below 0 is that of a refused frame. */
starcat_status starcat_answer_frame(starcat_session *session, const starcat_frame *frame,
                                    uint64_t time, starcat_answer *answer) {
  (void)UT_Stub_CopyToLocal(UT_KEY(starcat_answer_frame), &answer->result, sizeof answer->result);
  session->prior_time = time;
  const starcat_status status =
      (starcat_status)UT_DEFAULT_IMPL_ARGS(starcat_answer_frame, frame->count);
  session->counts.frames_refused += status < STARCAT_OK ? 1u : 0u;
  return status;
}

/* The kind of the event is what a test has the call return. */
starcat_status starcat_do_idle_work(starcat_session *session, starcat_event *event) {
  (void)session;
  memset(event, 0, sizeof *event);
  event->kind = (starcat_event_kind)UT_DEFAULT_IMPL(starcat_do_idle_work);
  return STARCAT_OK;
}

starcat_status starcat_accept_load(starcat_session *session) {
  (void)session;
  RETURN(starcat_accept_load);
}

starcat_status starcat_refuse_load(starcat_session *session) {
  session->load = STARCAT_LOAD_FAILED;
  RETURN(starcat_refuse_load);
}

starcat_status starcat_begin_load(starcat_session *session, size_t size, uint32_t crc) {
  (void)crc;
  session->load = STARCAT_LOAD_READING;
  session->load_size = size;
  RETURN(starcat_begin_load);
}

starcat_status starcat_begin_patch_load(starcat_session *session, size_t size) {
  session->load = STARCAT_LOAD_READING;
  session->load_size = size;
  RETURN(starcat_begin_patch_load);
}

starcat_status starcat_load_piece(starcat_session *session, const uint8_t *bytes, size_t count) {
  (void)bytes;
  session->load_bytes += count;
  const starcat_status status = (starcat_status)UT_DEFAULT_IMPL(starcat_load_piece);
  session->load = status == STARCAT_OK ? STARCAT_LOAD_CHECKING : session->load;
  return status;
}

starcat_status starcat_change_image(starcat_session *session) {
  (void)session;
  RETURN(starcat_change_image);
}
