/* The library: what it returns is a test's choice, as are the numbers that it writes.
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

starcat_status starcat_scrub_image(const void *bytes, size_t size, uint32_t first, uint32_t count,
                             uint32_t *bad_block) {
  (void)bytes;
  (void)size;
  (void)first;
  (void)count;
  *bad_block = 7;
  RETURN(starcat_scrub_image);
}

/* The numbers of a result come from a test's buffers, one a call. */
starcat_status starcat_identify_frame(const starcat_image *image, const starcat_camera *camera,
                                const starcat_options *options, const starcat_frame *frame,
                                starcat_workspace *work, starcat_result *result) {
  (void)image;
  (void)camera;
  (void)work;
  (void)UT_Stub_CopyToLocal(UT_KEY(starcat_identify_frame), result, sizeof *result);
  return (starcat_status)UT_DEFAULT_IMPL_ARGS(starcat_identify_frame, options->max_steps, frame->count);
}

starcat_status starcat_track_frame(const starcat_image *image, const starcat_camera *camera,
                             const starcat_options *options, const starcat_frame *frame,
                             const starcat_real q_prior[4], starcat_real uncertainty_rad,
                             starcat_workspace *work, starcat_result *result) {
  (void)image;
  (void)camera;
  (void)options;
  (void)frame;
  (void)q_prior;
  (void)uncertainty_rad;
  (void)work;
  (void)UT_Stub_CopyToLocal(UT_KEY(starcat_track_frame), result, sizeof *result);
  RETURN(starcat_track_frame);
}

starcat_status starcat_start_image(starcat_slots *slots, starcat_image *image) {
  (void)slots;
  (void)image;
  RETURN(starcat_start_image);
}

starcat_status starcat_receive_image(starcat_slots *slots, size_t size, uint32_t crc) {
  (void)slots;
  (void)size;
  (void)crc;
  RETURN(starcat_receive_image);
}

starcat_status starcat_put_piece(starcat_slots *slots, size_t offset, const uint8_t *bytes,
                           size_t count) {
  (void)slots;
  (void)offset;
  (void)bytes;
  (void)count;
  RETURN(starcat_put_piece);
}

starcat_status starcat_find_missing_block(const starcat_slots *slots, uint32_t first, uint32_t *block) {
  (void)slots;
  (void)first;
  *block = 3;
  RETURN(starcat_find_missing_block);
}

starcat_status starcat_apply_patch(starcat_slots *slots, const void *patch, size_t size) {
  (void)slots;
  (void)patch;
  (void)size;
  RETURN(starcat_apply_patch);
}

starcat_status starcat_switch_image(starcat_slots *slots, starcat_image *image) {
  (void)slots;
  image->n_stars = 4321;
  RETURN(starcat_switch_image);
}

starcat_status starcat_mend_image(void *bytes, size_t size, uint32_t *n_mended) {
  (void)bytes;
  (void)size;
  *n_mended = 2;
  RETURN(starcat_mend_image);
}
