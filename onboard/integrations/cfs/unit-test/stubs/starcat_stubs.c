/* The library: what it returns is a test's choice, as are the numbers that it writes.
 *
 * SPDX-License-Identifier: MIT
 */
#include "starcat_app_stubs.h"

#define RETURN(name) return (starcat_status)UT_DEFAULT_IMPL(name)

const char *starcat_version(void) { return "0.0.0"; }

void starcat_camera_of(const starcat_image *image, starcat_camera *camera) {
  (void)image;
  camera->focal_length_px = 1234;
  (void)UT_DEFAULT_IMPL(starcat_camera_of);
}

starcat_status starcat_scrub(const void *bytes, size_t size, uint32_t first, uint32_t count,
                             uint32_t *bad_block) {
  (void)bytes;
  (void)size;
  (void)first;
  (void)count;
  *bad_block = 7;
  RETURN(starcat_scrub);
}

/* The numbers of a result come from a test's buffers, one a call. */
starcat_status starcat_identify(const starcat_image *image, const starcat_camera *camera,
                                const starcat_options *options, const starcat_frame *frame,
                                starcat_workspace *work, starcat_result *result) {
  (void)image;
  (void)camera;
  (void)work;
  (void)UT_Stub_CopyToLocal(UT_KEY(starcat_identify), result, sizeof *result);
  return (starcat_status)UT_DEFAULT_IMPL_ARGS(starcat_identify, options->max_steps, frame->count);
}

starcat_status starcat_track(const starcat_image *image, const starcat_camera *camera,
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
  (void)UT_Stub_CopyToLocal(UT_KEY(starcat_track), result, sizeof *result);
  RETURN(starcat_track);
}

starcat_status starcat_start(starcat_places *places, starcat_image *image) {
  (void)places;
  (void)image;
  RETURN(starcat_start);
}

starcat_status starcat_receive(starcat_places *places, size_t size, uint32_t crc) {
  (void)places;
  (void)size;
  (void)crc;
  RETURN(starcat_receive);
}

starcat_status starcat_put(starcat_places *places, size_t offset, const uint8_t *bytes,
                           size_t count) {
  (void)places;
  (void)offset;
  (void)bytes;
  (void)count;
  RETURN(starcat_put);
}

starcat_status starcat_missing(const starcat_places *places, uint32_t first, uint32_t *block) {
  (void)places;
  (void)first;
  *block = 3;
  RETURN(starcat_missing);
}

starcat_status starcat_patch(starcat_places *places, const void *patch, size_t size) {
  (void)places;
  (void)patch;
  (void)size;
  RETURN(starcat_patch);
}

starcat_status starcat_switch(starcat_places *places, starcat_image *image) {
  (void)places;
  image->n_stars = 4321;
  RETURN(starcat_switch);
}

starcat_status starcat_mend(void *bytes, size_t size, uint32_t *n_mended) {
  (void)bytes;
  (void)size;
  *n_mended = 2;
  RETURN(starcat_mend);
}
