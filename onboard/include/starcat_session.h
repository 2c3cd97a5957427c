/* starcat onboard: a session, what an application does with the calls of starcat.h and starcat_update.h
 * again and again.
 *
 * It has the image in use and its successor, the last attitude, and the steps of a frame:
 *
 *     starcat_prepare_session                       once, with a session of zeros (static memory)
 *     starcat_start_session or starcat_use_image    once: images in two slots, or one in ROM
 *     starcat_answer_frame                          each frame
 *     starcat_do_idle_work                          in idle time, a few blocks of an image at a time
 *     starcat_begin_load, starcat_load_piece,       a new image or a patch, which idle time then checks,
 *     starcat_change_image                          and the change to it
 *
 * A session is used by one thread. Nothing but its memory is written, and that of its slots.
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
  STARCAT_MODE_NONE = 0,     /* not at all: no image can be used */
  STARCAT_MODE_IDENTIFY = 1, /* lost in space */
  STARCAT_MODE_TRACK = 2     /* from the last attitude */
} starcat_mode;

/* How far a new image, or a patch, has come. */
typedef enum {
  STARCAT_LOAD_NONE = 0,
  STARCAT_LOAD_READING = 1,  /* its pieces */
  STARCAT_LOAD_CHECKING = 2, /* its blocks, in idle time */
  STARCAT_LOAD_READY = 3,    /* to be changed to */
  STARCAT_LOAD_FAILED = 4    /* not read, damaged, or another one than was stated */
} starcat_load;

/* What idle work came to. */
typedef enum {
  STARCAT_EVENT_NONE = 0,
  STARCAT_EVENT_READY = 1,     /* the new image is whole */
  STARCAT_EVENT_REFUSED = 2,   /* it is not, or the patch is none of this image */
  STARCAT_EVENT_MENDED = 3,    /* damage of the image in use was made good from parity */
  STARCAT_EVENT_FELL_BACK = 4, /* it could not be, and the image of the other slot is in use */
  STARCAT_EVENT_NO_IMAGE = 5   /* that cannot be used either */
} starcat_event;

/* Move centroids, in place, to where they would be in a camera at rest that is turned by the attitude
 * q: aberration shifts them by up to 20 arcseconds. */
typedef void (*starcat_correct)(void *context, const starcat_real q_body_from_icrs[4],
                                uint32_t count, starcat_real *x_px, starcat_real *y_px);

/* What a session counts; may be set to zeros at any time. */
typedef struct {
  uint32_t frames_identified;        /* lost in space */
  uint32_t frames_tracked;           /* from the last attitude */
  uint32_t frames_not_identified[6]; /* without an answer, by starcat_reason from 1 on */
  uint32_t frames_without_image;
  uint32_t frames_refused; /* their number of centroids, options or camera cannot be */
  uint32_t scrub_passes;   /* how often the whole image was checked */
  uint32_t damage_found;   /* how often a block of the image in use was damaged */
  uint32_t blocks_mended;
  uint32_t fall_backs;
} starcat_counts;

typedef struct {
  /* To be set, and changed between calls. */
  starcat_slots slots; /* of an image in ROM: zeros */
  void *patch;         /* memory for a patch, at a multiple of 4; null: none */
  size_t patch_capacity;
  starcat_camera camera;
  uint32_t has_own_camera;      /* 0: the camera is that which the image in use was built for */
  starcat_options options;      /* max_steps are those of a frame, all of its calls together */
  starcat_real prior_error_rad; /* how far the last attitude may be from the next one: up to 0.35 */
  uint64_t prior_age;           /* an attitude as old or older is no prior; 0: no tracking */
  uint32_t blocks_per_tick;     /* that idle work checks in a call, 1 or more */
  starcat_correct correct;      /* null: none */
  void *context;                /* of `correct` */

  /* The last attitude, and its time by the caller's clock, of any unit. May be set too, by a filter. */
  uint32_t has_prior;
  uint64_t prior_time;
  starcat_real q_prior[4];

  /* To be read. */
  starcat_image image;
  starcat_status image_status; /* of the image in use: STARCAT_OK, else why there is none */
  starcat_mode mode;           /* of the last frame; its result, and all steps that it took */
  starcat_result result;
  uint32_t steps;
  starcat_load load;            /* may be set to STARCAT_LOAD_FAILED, to give a load up */
  size_t load_bytes, load_size; /* that were read, of all */
  uint32_t is_patch;
  uint32_t check_block;        /* of the new image, which is checked next */
  uint32_t scrub_block;        /* of the image in use, which is checked next */
  starcat_status event_status; /* of the last event: its status, block, and blocks mended */
  uint32_t event_block, event_mended;
  starcat_counts counts;

  /* What it works in. */
  starcat_real x_px[STARCAT_MAX_CENTROIDS];
  starcat_real y_px[STARCAT_MAX_CENTROIDS];
  starcat_workspace work;
} starcat_session;

/* Set what there are defaults for: options of starcat_set_default_options, prior_error_rad 0.009,
 * prior_age 0, blocks_per_tick 16. The rest of the session has to be zeros. */
void starcat_prepare_session(starcat_session *session);

/* Take the image of the active slot into use, of the other one if that cannot be used. */
starcat_status starcat_start_session(starcat_session *session);

/* Take an image into use where it lies, in ROM. It is scrubbed, but there is nothing to mend it from. */
starcat_status starcat_use_image(starcat_session *session, const void *bytes, size_t size);

/* Check options, and a camera unless it is null, as starcat_identify_frame does. */
starcat_status starcat_check_settings(const starcat_camera *camera, const starcat_options *options);

/* Identify a frame: from the last attitude if that is fresh at `time`, and lost in space with the steps
 * that are left if that fails or is not. With `correct` the attitude is fitted to corrected
 * centroids. The attitude, if there is one, is the prior of the next frame. Without an image: its
 * status, and STARCAT_MODE_NONE. */
starcat_status starcat_answer_frame(starcat_session *session, const starcat_frame *frame,
                                    uint64_t time);

/* Check some blocks: of the new image if it is whole, else of the image in use, whose damage is mended,
 * or the other image taken into use. A patch is applied instead, at once. */
starcat_event starcat_do_idle_work(starcat_session *session);

/* Prepare for an image, as starcat_receive_image, or for a patch; one that is being read is given up.
 * STARCAT_E_SHORT: there is no memory for so much. */
starcat_status starcat_begin_load(starcat_session *session, size_t size, uint32_t crc);
starcat_status starcat_begin_patch_load(starcat_session *session, size_t size);

/* Read the next piece. STARCAT_INCOMPLETE: there is more to come. STARCAT_OK: that was the last one.
 * An error ends the load, but STARCAT_E_OPTIONS: nothing is being read. */
starcat_status starcat_load_piece(starcat_session *session, const uint8_t *bytes, size_t count);

/* Take the image of the other slot into use if it is whole; called once more, go back to the one
 * before. STARCAT_INCOMPLETE: it is being read or checked, or is not whole. Nothing changes if this
 * fails. */
starcat_status starcat_change_image(starcat_session *session);

#ifdef __cplusplus
}
#endif
#endif
