/* starcat onboard: a session, which makes the calls of starcat.h and starcat_update.h that every
 * application needs for each frame and each image.
 *
 * It holds the image in use and its successor, the last attitude, and the steps left for a frame:
 *
 *     starcat_prepare_session                       once, with a session of zeros (static memory)
 *     starcat_start_session or starcat_use_image    once: images in two slots, or one in ROM
 *     starcat_answer_frame                          each frame
 *     starcat_do_idle_work                          in idle time, a few blocks of an image at a time
 *     starcat_begin_load, starcat_load_piece,       a new image or a patch, which idle time then checks,
 *     starcat_change_image                          and the change to it
 *
 * Only one thread uses a session. Calls write only the memory of the session and of its slots.
 *
 * SPDX-License-Identifier: MIT
 */
#ifndef STARCAT_SESSION_H
#define STARCAT_SESSION_H

#include "starcat_update.h"

#ifdef __cplusplus
extern "C" {
#endif

#define starcat_prepare_session STARCAT_SYMBOL(starcat_prepare_session)
#define starcat_start_session STARCAT_SYMBOL(starcat_start_session)
#define starcat_use_image STARCAT_SYMBOL(starcat_use_image)
#define starcat_check_settings STARCAT_SYMBOL(starcat_check_settings)
#define starcat_answer_frame STARCAT_SYMBOL(starcat_answer_frame)
#define starcat_do_idle_work STARCAT_SYMBOL(starcat_do_idle_work)
#define starcat_begin_load STARCAT_SYMBOL(starcat_begin_load)
#define starcat_begin_patch_load STARCAT_SYMBOL(starcat_begin_patch_load)
#define starcat_load_piece STARCAT_SYMBOL(starcat_load_piece)
#define starcat_change_image STARCAT_SYMBOL(starcat_change_image)

/* How a frame was answered. */
typedef enum {
  STARCAT_MODE_NONE = 0,     /* not answered: no image can be used */
  STARCAT_MODE_IDENTIFY = 1, /* lost in space */
  STARCAT_MODE_TRACK = 2     /* near the last attitude */
} starcat_mode;

/* State of the load of a new image or patch. */
typedef enum {
  STARCAT_LOAD_NONE = 0,
  STARCAT_LOAD_READING = 1,  /* pieces are being read */
  STARCAT_LOAD_CHECKING = 2, /* blocks are being checked, in idle time */
  STARCAT_LOAD_READY = 3,    /* the image can be taken into use */
  STARCAT_LOAD_FAILED = 4    /* not read, damaged, or not the stated image */
} starcat_load;

/* Result of a call of starcat_do_idle_work. */
typedef enum {
  STARCAT_EVENT_NONE = 0,
  STARCAT_EVENT_READY = 1,     /* the new image is complete and undamaged */
  STARCAT_EVENT_REFUSED = 2,   /* the new image is not, or the patch is for another image */
  STARCAT_EVENT_MENDED = 3,    /* the image in use was repaired from its parity */
  STARCAT_EVENT_FELL_BACK = 4, /* it could not; the image of the other slot is now in use */
  STARCAT_EVENT_NO_IMAGE = 5   /* neither image can be used */
} starcat_event;

/* Move centroids, in place, to their positions in a camera at rest that has the attitude q.
 * Aberration shifts them by up to 20 arcseconds. */
typedef void (*starcat_correct)(void *context, const starcat_real q_body_from_icrs[4],
                                uint32_t count, starcat_real *x_px, starcat_real *y_px);

/* Counts of a session. The application can set them to zeros at any time. */
typedef struct {
  uint32_t frames_identified;        /* identified lost in space */
  uint32_t frames_tracked;           /* identified near the last attitude */
  uint32_t frames_not_identified[6]; /* without an answer, by starcat_reason from 1 on */
  uint32_t frames_without_image;
  uint32_t frames_refused; /* invalid number of centroids, options or camera */
  uint32_t scrub_passes;   /* how often the whole image was checked */
  uint32_t damage_found;   /* how often a block of the image in use was damaged */
  uint32_t blocks_mended;
  uint32_t fall_backs;
} starcat_counts;

typedef struct {
  /* Set by the application, which can change them between calls. */
  starcat_slots slots; /* zeros for an image in ROM */
  void *patch;         /* memory for a patch, at a multiple of 4; null: no patches */
  size_t patch_capacity;
  starcat_camera camera;
  uint32_t has_own_camera;      /* 0: use the camera that the image in use was built for */
  starcat_options options;      /* max_steps is the total for one frame */
  starcat_real prior_error_rad; /* largest error of the last attitude as prior: up to 0.35 */
  uint64_t prior_age;           /* attitudes of this age or older are not used; 0: no tracking */
  uint32_t blocks_per_tick;     /* checked per call of starcat_do_idle_work, 1 or more */
  starcat_correct correct;      /* null: no correction */
  void *context;                /* passed to `correct` */

  /* The last attitude and its time, in any unit of the caller's clock. A filter can set both. */
  uint32_t has_prior;
  uint64_t prior_time;
  starcat_real q_prior[4];

  /* Read by the application. */
  starcat_image image;
  starcat_status image_status; /* STARCAT_OK, or why no image is in use */
  starcat_mode mode;           /* mode, result and total steps of the last frame */
  starcat_result result;
  uint32_t steps;
  starcat_load load;            /* set it to STARCAT_LOAD_FAILED to cancel a load */
  size_t load_bytes, load_size; /* bytes read so far; total */
  uint32_t is_patch;
  uint32_t check_block;        /* next block of the new image to check */
  uint32_t scrub_block;        /* next block of the image in use to check */
  starcat_status event_status; /* last event: status, block, number of repaired blocks */
  uint32_t event_block, event_mended;
  starcat_counts counts;

  /* Working memory. */
  starcat_real x_px[STARCAT_MAX_CENTROIDS];
  starcat_real y_px[STARCAT_MAX_CENTROIDS];
  starcat_workspace work;
} starcat_session;

/* Set the defaults: options of starcat_set_default_options, prior_error_rad 0.009, prior_age 0,
 * blocks_per_tick 16. All other fields of the session must be zeros. */
void starcat_prepare_session(starcat_session *session);

/* Open the image of the active slot, or the image of the other slot if that one cannot be used. */
starcat_status starcat_start_session(starcat_session *session);

/* Use an image in place, in ROM. Idle work checks it but cannot repair it: ROM has no parity. */
starcat_status starcat_use_image(starcat_session *session, const void *bytes, size_t size);

/* Check options, and a camera unless it is null, with the tests of starcat_identify_frame. */
starcat_status starcat_check_settings(const starcat_camera *camera, const starcat_options *options);

/* Identify a frame. If the last attitude is fresh at `time`, the frame is tracked first; if it is
 * not, or if tracking fails, the frame is identified lost in space with the steps that are left.
 * With `correct` the attitude is fitted to corrected centroids. The attitude, if found, is the
 * prior of the next frame. Without an image: the image's status, and STARCAT_MODE_NONE. */
starcat_status starcat_answer_frame(starcat_session *session, const starcat_frame *frame,
                                    uint64_t time);

/* Check a few blocks of the new image if it is complete, else of the image in use, and repair
 * damage or use the other image. A complete patch is applied at once instead. */
starcat_event starcat_do_idle_work(starcat_session *session);

/* Prepare for an image (see starcat_receive_image) or a patch; a load in progress is cancelled.
 * STARCAT_E_SHORT: the memory is too small for `size` bytes. */
starcat_status starcat_begin_load(starcat_session *session, size_t size, uint32_t crc);
starcat_status starcat_begin_patch_load(starcat_session *session, size_t size);

/* Read the next piece. STARCAT_INCOMPLETE: more pieces follow. STARCAT_OK: it was the last one. An
 * error ends the load, except STARCAT_E_OPTIONS: no load is in progress. */
starcat_status starcat_load_piece(starcat_session *session, const uint8_t *bytes, size_t count);

/* Use the image of the other slot if it is complete; a second call goes back to the previous image.
 * STARCAT_INCOMPLETE: it is still being read or checked, or is not complete. If the call fails
 * nothing changes. */
starcat_status starcat_change_image(starcat_session *session);

#ifdef __cplusplus
}
#endif
#endif
