/* starcat onboard: a session, which makes the calls of starcat.h and starcat_update.h that every
 * application needs for each frame and each image.
 *
 * The settings are the application's and can be constant. The session is state: the image in use
 * and its successor, the last attitude, counts. Answers and events are written to memory of the
 * application.
 *
 *     starcat_set_default_settings                  once, or constants
 *     starcat_prepare_session                       once
 *     starcat_start_session or starcat_use_image    once: images in two slots, or one in ROM
 *     starcat_answer_frame                          each frame
 *     starcat_do_idle_work                          in idle time: a tick, which is short
 *     starcat_begin_load, starcat_load_piece        a new image or a patch, which idle time then
 *                                                   checks
 *     starcat_accept_load or starcat_refuse_load    what the application decides about it
 *     starcat_change_image                          the change to it, in idle time
 *
 * Only one thread uses a session. Calls write only the memory of the session and of its slots, and
 * the structures that they are given. A null pointer gives STARCAT_E_NULL, as does a session that
 * was not prepared.
 *
 * SPDX-License-Identifier: MIT
 */
#ifndef STARCAT_SESSION_H
#define STARCAT_SESSION_H

#include "starcat_update.h"

#ifdef __cplusplus
extern "C" {
#endif

#define starcat_set_default_settings STARCAT_SYMBOL(starcat_set_default_settings)
#define starcat_check_settings STARCAT_SYMBOL(starcat_check_settings)
#define starcat_prepare_session STARCAT_SYMBOL(starcat_prepare_session)
#define starcat_start_session STARCAT_SYMBOL(starcat_start_session)
#define starcat_use_image STARCAT_SYMBOL(starcat_use_image)
#define starcat_check_session STARCAT_SYMBOL(starcat_check_session)
#define starcat_test_self STARCAT_SYMBOL(starcat_test_self)
#define starcat_answer_frame STARCAT_SYMBOL(starcat_answer_frame)
#define starcat_find_age STARCAT_SYMBOL(starcat_find_age)
#define starcat_do_idle_work STARCAT_SYMBOL(starcat_do_idle_work)
#define starcat_begin_load STARCAT_SYMBOL(starcat_begin_load)
#define starcat_begin_patch_load STARCAT_SYMBOL(starcat_begin_patch_load)
#define starcat_load_piece STARCAT_SYMBOL(starcat_load_piece)
#define starcat_accept_load STARCAT_SYMBOL(starcat_accept_load)
#define starcat_refuse_load STARCAT_SYMBOL(starcat_refuse_load)
#define starcat_change_image STARCAT_SYMBOL(starcat_change_image)

/* How a frame was answered. */
typedef enum {
  STARCAT_MODE_NONE = 0,     /* not answered: no image can be used */
  STARCAT_MODE_IDENTIFY = 1, /* lost in space */
  STARCAT_MODE_TRACK = 2,    /* near the last attitude */
  STARCAT_MODE_CONFIRM = 3   /* together with the refused frames before it */
} starcat_mode;

/* State of the load of a new image or patch. */
typedef enum {
  STARCAT_LOAD_NONE = 0,
  STARCAT_LOAD_READING = 1,  /* pieces are being read */
  STARCAT_LOAD_CHECKING = 2, /* idle time checks the blocks, applies the patch, writes parity */
  STARCAT_LOAD_READY = 3,    /* the image is whole: it can be accepted */
  STARCAT_LOAD_FAILED = 4,   /* not read, damaged, refused, or not the stated image */
  STARCAT_LOAD_ACCEPTED = 5  /* it can be taken into use, and fallen back to */
} starcat_load;

/* What idle time works at. */
typedef enum {
  STARCAT_WORK_SCRUB = 0,       /* checks the images of both slots and their parity, repairs */
  STARCAT_WORK_CHECK_PATCH = 1, /* checks a patch and the image that it is for */
  STARCAT_WORK_RUN_PATCH = 2,   /* makes the new image */
  STARCAT_WORK_CHECK_LOAD = 3,  /* checks the new image */
  STARCAT_WORK_PARITY = 4,      /* writes the parity of the new image */
  STARCAT_WORK_CHANGE = 5,      /* checks the other image before the change to it */
  STARCAT_WORK_FALL_BACK = 6    /* the same, as the image in use is lost; frames have no answer */
} starcat_work;

typedef enum {
  STARCAT_EVENT_NONE = 0,
  STARCAT_EVENT_READY = 1,     /* the new image is complete and undamaged: examine it */
  STARCAT_EVENT_REFUSED = 2,   /* the new image is not, or the patch is for another image */
  STARCAT_EVENT_MENDED = 3,    /* a block was repaired from its parity, or parity rewritten */
  STARCAT_EVENT_FELL_BACK = 4, /* the image in use was lost; that of the other slot is in use */
  STARCAT_EVENT_NO_IMAGE = 5,  /* neither image can be used */
  STARCAT_EVENT_CHANGED = 6,   /* the image of the other slot is now in use, as asked */
  STARCAT_EVENT_OTHER_LOST = 7 /* the image of the other slot is damaged beyond its parity, and
                                     no longer accepted: there is nothing to fall back to */
} starcat_event_kind;

/* Result of a tick of idle time. */
typedef struct {
  starcat_event_kind kind;
  starcat_status status; /* why, for STARCAT_EVENT_REFUSED and STARCAT_EVENT_NO_IMAGE */
  uint32_t slot, block;  /* where; a block of parity has a number from that of the blocks on */
} starcat_event;

/* Move centroids, in place, to their positions in a camera at rest that has the attitude q.
 * Aberration shifts them by up to 20 arcseconds. */
typedef void (*starcat_correct)(void *context, const starcat_real q_body_from_icrs[4],
                                uint32_t count, starcat_real *x_px, starcat_real *y_px);

/* Store a record of the slots (starcat_write_record) in memory that survives a restart. Returns 1 if
 * it was stored, 0 if not. */
typedef int (*starcat_store)(void *context, uint32_t place,
                             const uint8_t record[STARCAT_RECORD_BYTES]);

/* Settings, which no call writes. The application can change them between calls. */
typedef struct {
  starcat_camera camera;    /* used if has_own_camera is not 0 */
  uint32_t has_own_camera;  /* 0: use the camera that the image in use was built for */
  starcat_options options;  /* its max_steps is not used */
  uint32_t max_steps_track; /* most steps of tracking a frame */
  uint32_t
      max_steps_identify; /* and of identifying it lost in space */
  uint32_t max_steps_confirm; /* and of confirming a refused frame by the frames before it; 0: off.
                               * All three together bound a frame */
  /* Largest error of the last attitude as prior, up to 0.35; attitudes of this age or older are not
   * used, 0: no tracking. Both hold for the turn and the time between refused frames, too. */
  starcat_real prior_error_rad;
  uint64_t prior_age;
  uint32_t blocks_per_tick;     /* work of a tick of idle time, in blocks; 0: no idle work */
  void *patch;                  /* memory for a patch, at a multiple of 4; null: no patches */
  size_t patch_capacity;
  starcat_correct correct; /* null: no correction */
  starcat_store store;     /* null: the application keeps the slots itself */
  void *context;           /* passed to `correct` and `store` */
} starcat_settings;

/* The answer of a frame. */
typedef struct {
  starcat_status status;
  starcat_mode mode;
  uint32_t steps; /* of tracking, identifying and confirming together */
  starcat_result result;
} starcat_answer;

#define STARCAT_N_REASONS 6u
#define STARCAT_N_ERRORS 14u

/* Counts of a session. The application can set them to zeros at any time. */
typedef struct {
  uint32_t frames_identified;                        /* identified lost in space */
  uint32_t frames_tracked;                           /* identified near the last attitude */
  uint32_t frames_confirmed;                         /* identified by several frames together */
  uint32_t frames_not_identified[STARCAT_N_REASONS]; /* without an answer, by starcat_reason - 1 */
  uint32_t frames_without_image;
  uint32_t frames_refused;           /* invalid number of centroids, options or camera */
  uint32_t errors[STARCAT_N_ERRORS]; /* frames_refused by status: STARCAT_E_NULL is the first */
  uint32_t tracks_failed;            /* tracked in vain: a wrong prior, or a bad frame */
  uint32_t tracks_refused; /* too many stars within prior_error_rad, or twice that to confirm */
  uint32_t most_steps_track;         /* high-water marks */
  uint32_t most_steps_identify;
  uint32_t most_steps_confirm;
  uint32_t scrub_passes; /* how often the image in use and its parity were checked */
  uint32_t damage_found; /* damaged blocks of the two images */
  uint32_t blocks_mended;
  uint32_t parity_mended;
  uint32_t fall_backs;
  uint32_t loads_refused;
  uint32_t stores_failed; /* how often settings.store failed; idle time repeats it */
} starcat_counts;

/* Spots of successive frames without an answer, in the camera frame of the last one. */
typedef struct {
  uint64_t time; /* of the last frame */
  uint32_t n_spots;
  uint16_t seen[STARCAT_MAX_CENTROIDS]; /* frames that have the spot; 0: one, but not the last one */
  starcat_real magnitude[STARCAT_MAX_CENTROIDS];
  starcat_real body[STARCAT_MAX_CENTROIDS][3];
  uint32_t crc; /* of the members above */
} starcat_composite;

typedef struct {
  const starcat_settings *settings; /* null: not prepared */

  /* The last attitude and its time, in any unit of the caller's clock. A filter can set all three;
   * has_prior 1: there is one. */
  uint32_t has_prior;
  uint64_t prior_time;
  starcat_real q_prior[4];

  /* Read by the application. */
  starcat_slots slots;
  starcat_image image;
  uint32_t has_image; /* 1: an image is in use; 0: starcat_check_session says why not */
  starcat_load load;
  size_t load_bytes, load_size; /* bytes read so far; total */
  starcat_counts counts;

  /* Working memory. */
  starcat_status image_fault; /* why no image is in use */
  uint32_t has_attitude;      /* whether a frame was identified, and the time of the last one */
  uint64_t attitude_time;
  starcat_camera camera; /* of the image in use */
  starcat_work work;
  uint32_t is_patch, must_store;
  uint32_t next;                   /* next block, in the order of the work */
  uint32_t damaged;                /* block to be repaired in the next tick, plus 1; 0: none */
  uint32_t mended;                 /* block that the last tick repaired, plus 1; 0: none */
  uint32_t scrub_slot, scrub_next; /* slot that is scrubbed; its next block or group */
  uint32_t suspect, member;        /* 1: blocks of the group are checked, from `member` on, as its
                                      parity differs */
  starcat_patching patching;
  starcat_composite composite;
  starcat_real x_px[STARCAT_MAX_CENTROIDS];
  starcat_real y_px[STARCAT_MAX_CENTROIDS];
  starcat_workspace workspace;
} starcat_session;

/* Set the defaults: options of starcat_set_default_options, whose max_steps is that of both modes,
 * prior_error_rad 0.009, prior_age 0, blocks_per_tick 16; zeros elsewhere. */
starcat_status starcat_set_default_settings(starcat_settings *settings);

/* Check options, steps and the camera of settings with the tests of starcat_identify_frame,
 * prior_error_rad, and blocks_per_tick, which is up to 65536. */
starcat_status starcat_check_settings(const starcat_settings *settings);

/* Clear a session, whatever it contains, and give it its settings, which have to stay. If they are
 * refused by starcat_check_settings the session is not prepared. */
starcat_status starcat_prepare_session(starcat_session *session, const starcat_settings *settings);

/* Take slots over, and open the image of the active slot, or that of the other slot if that one
 * cannot be used. Only accepted images are opened. It checks whole images: see the manual. */
starcat_status starcat_start_session(starcat_session *session, const starcat_slots *slots);

/* Use an image in place, in ROM. Idle work checks it but cannot repair it: ROM has no parity. */
starcat_status starcat_use_image(starcat_session *session, const void *bytes, size_t size);

/* STARCAT_OK: an image is in use. Otherwise why not. */
starcat_status starcat_check_session(const starcat_session *session);

/* Test processor, compiled library and image together, after the start: a CRC of known result, and
 * frames that are made of the stars of the image in use and identified with it. Up to eight frames
 * are made, one around each of eight stars, each within settings.max_steps_identify. STARCAT_OK: at
 * least one was identified, and each identified one has the stars and the attitude that it was made
 * of. STARCAT_NO_MATCH: not so. Without an image: why there is none. Counts and the last attitude do
 * not change; `answer` has the last frame. */
starcat_status starcat_test_self(starcat_session *session, starcat_answer *answer);

/* Identify a frame. If the last attitude is fresh at `time`, the frame is tracked first; if it is
 * not, or if tracking fails, the frame is identified lost in space. With `correct` the attitude is
 * fitted to corrected centroids. An attitude that is found becomes the last attitude. A frame
 * without one changes only counts and the composite of such frames: the last attitude is used until
 * its age ends it. Without an image: why there is none, and STARCAT_MODE_NONE.
 *
 * With max_steps_confirm the spots of refused frames are put together, if each frame follows the one
 * before it within prior_age, and by a turn of at most prior_error_rad, or 0.175 if that is more. If
 * they have an attitude together, and the last frame has one near it, that frame is answered. Its
 * log_chance is the larger one of both. fov_error has to be 0. */
starcat_status starcat_answer_frame(starcat_session *session, const starcat_frame *frame,
                                    uint64_t time, starcat_answer *answer);

/* Time from the last attitude that was found until `time`, or the largest number if there is none
 * or it is later. */
starcat_status starcat_find_age(const starcat_session *session, uint64_t time, uint64_t *age);

/* Do a tick of work. It takes at most twice as long as checking settings.blocks_per_tick blocks, or
 * 16 if that is more: twice only while a check block and other blocks are damaged. */
starcat_status starcat_do_idle_work(starcat_session *session, starcat_event *event);

/* Prepare for an image (see starcat_receive_image) or a patch; a load in progress is cancelled. From
 * the first on, and from the writing of a patched image on, there is no image to fall back to.
 * STARCAT_E_SHORT: the memory is too small for `size` bytes. STARCAT_E_OPTIONS: there is no idle
 * work. STARCAT_INCOMPLETE: the session falls back or changes just now, or settings.store failed. */
starcat_status starcat_begin_load(starcat_session *session, size_t size, uint32_t crc);
starcat_status starcat_begin_patch_load(starcat_session *session, size_t size);

/* Read the next piece. STARCAT_INCOMPLETE: more pieces follow. STARCAT_OK: it was the last one. An
 * error ends the load, except STARCAT_E_OPTIONS: no load is in progress. */
starcat_status starcat_load_piece(starcat_session *session, const uint8_t *bytes, size_t count);

/* Accept the new image, which is in the slot that is not active, after STARCAT_EVENT_READY.
 * STARCAT_INCOMPLETE: there is none that is ready, or settings.store failed. */
starcat_status starcat_accept_load(starcat_session *session);

/* Refuse it, or cancel a load in any state, or withdraw an accepted image. The other slot is empty
 * then, unless only a patch was being read. STARCAT_INCOMPLETE: the session falls back just now; or
 * settings.store failed, and only a restart could still take it for accepted: idle time stores. */
starcat_status starcat_refuse_load(starcat_session *session);

/* Change to the image of the other slot, in idle time: STARCAT_EVENT_CHANGED says when. A later call
 * goes back to the previous image. STARCAT_INCOMPLETE: it was not accepted, or a load is in
 * progress. */
starcat_status starcat_change_image(starcat_session *session);

#ifdef __cplusplus
}
#endif
#endif
