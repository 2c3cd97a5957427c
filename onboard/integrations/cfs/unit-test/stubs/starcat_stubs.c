/* The library: what it returns is a test's choice, as is what it does to a session.
 *
 * SPDX-License-Identifier: MIT
 */
#include "starcat_app_stubs.h"

#define RETURN(name) return (starcat_status)UT_DEFAULT_IMPL(name)

const char *starcat_version(void) { return "0.0.0"; }

void starcat_get_camera(const starcat_image *image, starcat_camera *camera) {
  (void)image;
  camera->focal_length_px = 1234;
  (void)UT_DEFAULT_IMPL(starcat_get_camera);
}

void starcat_prepare_session(starcat_session *session) {
  (void)session;
  (void)UT_DEFAULT_IMPL(starcat_prepare_session);
}

starcat_status starcat_start_session(starcat_session *session) {
  (void)session;
  RETURN(starcat_start_session);
}

starcat_status starcat_check_settings(const starcat_camera *camera,
                                      const starcat_options *options) {
  (void)camera;
  (void)options;
  RETURN(starcat_check_settings);
}

/* The numbers of a result come from a test's buffer; a status below 0 is that of a refused frame. */
starcat_status starcat_answer_frame(starcat_session *session, const starcat_frame *frame,
                                    uint64_t time) {
  (void)UT_Stub_CopyToLocal(UT_KEY(starcat_answer_frame), &session->result, sizeof session->result);
  session->prior_time = time;
  const starcat_status status =
      (starcat_status)UT_DEFAULT_IMPL_ARGS(starcat_answer_frame, frame->count);
  session->counts.frames_refused += status < STARCAT_OK ? 1u : 0u;
  return status;
}

starcat_event starcat_do_idle_work(starcat_session *session) {
  (void)session;
  return (starcat_event)UT_DEFAULT_IMPL(starcat_do_idle_work);
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
