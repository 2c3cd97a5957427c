/* A session under operations in random order: frames of all kinds, ticks, uploads, patches, damage,
 * priors, jumps of the clock, stores that fail or are cut, restarts at any moment. After each:
 *
 * - the attitude is right or absent, and a fresh one is tracked from first; weak frames confirm each
 *   other, junk confirms nothing;
 * - the image in use was accepted, and whole when it was taken into use;
 * - what the application refused, or did not yet accept, is never in use;
 * - no tick is longer than two ordinary ones, counted in executed basic blocks of the library, and
 *   no frame takes more steps than its settings allow.
 *
 *   fuzz_session OPERATIONS SEED        prints counts; ends with 1 at the first violation
 *
 * The library is compiled with -fsanitize-coverage=trace-pc, which calls the counter below.
 *
 * SPDX-License-Identifier: MIT
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "internal.h"
#include "random_sky.h"
#include "starcat_session.h"

#define BLOCK 4096u
#define CAPACITY (SKY_MOST_BYTES / BLOCK * BLOCK)
#define MOST_PATCH 4096u
#define SLACK 6000.0  /* basic blocks of a tick that opens an image or stores a record */
#define FARTHEST_PX 6 /* error of an attitude that is right, at the corners */
#define SIGMAS 6.0    /* the same of few stars, in standard errors */
#define N_IMAGES 3u   /* two that are accepted, and one that is not */

static uint64_t images[N_IMAGES][CAPACITY / 8u], memory[2][CAPACITY / 8u];
static uint32_t patches[2][MOST_PATCH / 4u], patch_memory[MOST_PATCH / 4u]; /* a to b, b to a */
static size_t sizes[N_IMAGES], patch_sizes[2];
static starcat_settings settings;
static starcat_session session;
static starcat_answer said;
static sky_frame truth;
static uint64_t state, now, executed, longest[8];
static uint64_t n_operations, operation;
static uint32_t counts[16], restarts, answers, confirmed, absents, stored_cut, cut_at, fails_to_store;
static uint8_t records[2][STARCAT_RECORD_BYTES];
static const uint8_t *upload; /* bytes of the load in progress, of `upload_size` */
static size_t upload_size, upload_at;
static uint32_t has_truth, model_has_prior, prior_is_right;
static uint64_t model_time;

void __sanitizer_cov_trace_pc(void);
void __sanitizer_cov_trace_pc(void) { executed++; }

static void violate(const char *what) {
  (void)fprintf(stderr, "fuzz_session: operation %llu: %s\n", (unsigned long long)operation, what);
  exit(1);
}

static uint32_t pick(uint32_t count) { return (uint32_t)(sky_uniform(&state) * count) % count; }

static uint32_t crc_of(uint32_t image) {
  uint32_t crc;
  memcpy(&crc, (const uint8_t *)images[image] + sizes[image] - 8u, 4);
  return crc;
}

/* The record is stored whole, cut at a byte (the power fails), or not at all. */
static int store(void *context, uint32_t place, const uint8_t *record) {
  (void)context;
  if (fails_to_store != 0u) {
    return 0;
  }
  const size_t count = stored_cut != 0u ? cut_at : STARCAT_RECORD_BYTES;
  memcpy(records[place], record, count);
  return stored_cut != 0u ? 0 : 1;
}

static int is_image(const uint8_t *bytes, size_t size, uint32_t image) {
  return (size == sizes[image]) && (memcmp(bytes, images[image], size) == 0);
}

/* The image in use has just been taken into use: it is one of the two, whole. */
static void check_taken(void) {
  const uint8_t *bytes = session.slots.bytes[session.slots.active];
  const size_t size = session.slots.size[session.slots.active];
  if (!is_image(bytes, size, 0) && !is_image(bytes, size, 1)) {
    const uint32_t slot = session.slots.active;
    (void)fprintf(stderr, "slot %u of %zu bytes, acceptance %x, crc %x;", slot, size,
                  session.slots.acceptance[slot], session.slots.crc[slot]);
    for (uint32_t n = 0; n < N_IMAGES; n++) {
      size_t same = 0;
      while ((same < size) && (same < sizes[n]) && (bytes[same] == ((uint8_t *)images[n])[same])) {
        same++;
      }
      (void)fprintf(stderr, " image %u, crc %x, differs at %zu of %zu;", n, crc_of(n), same,
                    sizes[n]);
    }
    violate("an image that was not accepted, or is not whole, is in use");
  }
}

/* Slots as the ground has filled them before launch. */
static void fill(starcat_slots *slots) {
  memcpy(memory[0], images[0], sizes[0]);
  memset(slots, 0, sizeof *slots);
  slots->size[0] = sizes[0];
  slots->bytes[0] = (uint8_t *)memory[0];
  slots->bytes[1] = (uint8_t *)memory[1];
  slots->capacity = CAPACITY;
  (void)starcat_accept_image(slots, 0, crc_of(0));
}

/* The computer starts again: from the records, or from the ground's image if both are gone. */
static void restart(int anew) {
  starcat_slots slots;
  uint32_t place = 0;
  memset(&slots, 0, sizeof slots);
  slots.bytes[0] = (uint8_t *)memory[0];
  slots.bytes[1] = (uint8_t *)memory[1];
  slots.capacity = CAPACITY;
  if (anew || (starcat_read_record(&slots, records[0], records[1]) != STARCAT_OK)) {
    fill(&slots);
    memset(records, 0, sizeof records);
    (void)starcat_write_record(&slots, records[1], &place);
    memcpy(records[place], records[1], STARCAT_RECORD_BYTES);
  }
  stored_cut = 0;
  memset(&session, (int)pick(256), sizeof session);
  if (starcat_prepare_session(&session, &settings) != STARCAT_OK) {
    violate("the settings are refused");
  }
  upload = NULL;
  model_has_prior = 0;
  restarts++;
  if (starcat_start_session(&session, &slots) == STARCAT_OK) {
    check_taken();
  }
}

/* A patch that copies the first block of an image and has all others as they are would be large;
 * this one makes an image of itself: a copy of all of it. */
static void make_patch(uint32_t from) {
  uint8_t *bytes = (uint8_t *)patches[from];
  const uint32_t crc = crc_of(from), count = (uint32_t)sizes[from] << 3 | 1u;
  const uint32_t words[7] = {0x01020304u, 2, (uint32_t)sizes[from], crc, (uint32_t)sizes[from],
                             crc,         0};
  memcpy(bytes, "STARPAT", 8);
  memcpy(bytes + 8, words, sizeof words);
  size_t at = 44;
  for (uint32_t number = count; number > 0u; number >>= 7) {
    bytes[at] = (uint8_t)((number & 0x7fu) | (number >= 0x80u ? 0x80u : 0u));
    at++;
  }
  bytes[at] = 0; /* from the beginning */
  at++;
  const uint32_t size = (uint32_t)at;
  memcpy(bytes + 36, &size, 4);
  const uint32_t sum = starcat_update_crc(starcat_update_crc(0, bytes, 40), bytes + 44, at - 44u);
  memcpy(bytes + 40, &sum, 4);
  patch_sizes[from] = at;
}

static void begin(void) {
  const sky_recipe recipes[2] = {{1, 2, 500, 0.35, 8}, {2, 4, 500, 0.35, 8}};
  uint8_t *refused = (uint8_t *)images[2];
  for (uint32_t n = 0; n < 2u; n++) {
    sizes[n] = sky_image(&recipes[n], (uint8_t *)images[n]);
    make_patch(n);
  }
  /* The one that is refused differs in a byte, and its last check block states the CRC of the first
   * one: whoever can write an image can write its CRCs. */
  memcpy(refused, images[0], sizes[0]);
  sizes[2] = sizes[0];
  refused[161] ^= 1u;
  sky_seal(refused);
  const uint32_t crc = crc_of(0);
  uint8_t *check = refused + sizes[2] - BLOCK;
  memcpy(check + STARCAT_WHOLE_AT, &crc, 4);
  const uint32_t own = starcat_update_crc(0, check, STARCAT_OWN_AT);
  memcpy(check + STARCAT_OWN_AT, &own, 4);
  (void)starcat_set_default_settings(&settings);
  settings.options.noise_px = (starcat_real)0.3;
  settings.prior_age = 1000;
  settings.max_steps_identify = 40000;
  settings.max_steps_track = 20000;
  settings.max_steps_confirm = 20000;
  settings.patch = patch_memory;
  settings.patch_capacity = sizeof patch_memory;
  settings.store = store;
  restart(1);
}

/* Angle between two attitudes, from the product of one and the transpose of the other. */
static double turn_between(const double a[9], const starcat_real b[9]) {
  double square = 0.0;
  for (uint32_t n = 0; n < 9u; n++) {
    const double d = a[n] - (double)b[n];
    square += d * d;
  }
  return sqrt(0.5 * square);
}

/* Whether the answer is near the truth, or as near as it states. */
static int is_right(void) {
  const starcat_real *c = said.result.covariance_rad2;
  const double apart = turn_between(truth.matrix, said.result.matrix);
  return (apart * (double)session.image.focal_length_px <= FARTHEST_PX) ||
         (apart * apart <= SIGMAS * SIGMAS * (double)(c[0] + c[4] + c[8]));
}

/* A frame of few of the stars and of as many false spots. */
static void weaken(starcat_frame *frame) {
  static starcat_real x[16], y[16];
  const uint32_t most = 4u + pick(2);
  uint32_t n = 0;
  for (uint32_t of = 2u + pick(2), i = pick(of); (i < truth.count) && (n < most); i += of) {
    x[n] = truth.x[i] + (starcat_real)(0.2 * sky_normal(&state));
    y[n] = truth.y[i] + (starcat_real)(0.2 * sky_normal(&state));
    n++;
  }
  for (const uint32_t count = 2u * n; n < count; n++) {
    x[n] = (starcat_real)(1000.0 * sky_uniform(&state));
    y[n] = (starcat_real)(1000.0 * sky_uniform(&state));
  }
  frame->count = n;
  frame->x_px = x;
  frame->y_px = y;
  frame->magnitudes = NULL;
}

#define N_KINDS 8u
#define WEAK 8u

static void give_frame(uint32_t kind) {
  starcat_frame frame = {0, truth.x, truth.y, truth.magnitudes, NULL};
  const int has_image = session.has_image != 0u;
  int is_junk = 0;
  now += pick(300);
  if (has_image && ((has_truth == 0u) || (pick(12) == 0u))) {
    sky_look(&session.image, &session.camera, &state, 0.2, 14, 0, &truth); /* another attitude */
    has_truth = 1;
    prior_is_right = 0;
  }
  frame.count = has_truth != 0u ? truth.count : 0u;
  if (kind == 0u) {
    frame.count = 0;
  } else if (kind == 1u) {
    frame.count = STARCAT_MAX_CENTROIDS + 1u;
  } else if (kind == 2u) {
    frame.count = frame.count > 3u ? 3u : frame.count;
  } else if (kind == WEAK) {
    weaken(&frame);
  } else if (kind == 3u) { /* spots anywhere */
    static starcat_real x[20], y[20];
    for (uint32_t n = 0; n < 20u; n++) {
      x[n] = (starcat_real)(1000.0 * sky_uniform(&state));
      y[n] = (starcat_real)(1000.0 * sky_uniform(&state));
    }
    frame.count = 20;
    frame.x_px = x;
    frame.y_px = y;
    frame.magnitudes = NULL;
    is_junk = 1;
  } else {
    /* the stars as they are */
  }
  const uint32_t before = session.counts.tracks_failed;
  const starcat_status status = starcat_answer_frame(&session, &frame, now, &said);
  const uint64_t apart = now > model_time ? now - model_time : model_time - now;
  const int is_fresh = (model_has_prior != 0u) && (apart < settings.prior_age);
  if (said.steps > settings.max_steps_track + settings.max_steps_identify +
                       settings.max_steps_confirm) {
    violate("a frame takes more steps than the settings allow");
  }
  if (!has_image && (status == STARCAT_IDENTIFIED)) {
    violate("an attitude without an image");
  }
  if (has_image && is_fresh && (said.mode != STARCAT_MODE_TRACK) &&
      (session.counts.tracks_failed == before)) {
    violate("a fresh attitude is not tracked from");
  }
  if (has_image && !is_fresh && (said.mode == STARCAT_MODE_TRACK)) {
    violate("an attitude is used that is too old");
  }
  if (status == STARCAT_IDENTIFIED) {
    answers++;
    confirmed += said.mode == STARCAT_MODE_CONFIRM ? 1u : 0u;
    if (is_junk || !is_right()) {
      (void)fprintf(stderr, "mode %d, kind %u, %g px, %u matched, log %g, steps %u\n", (int)said.mode,
                    kind,
                    turn_between(truth.matrix, said.result.matrix) *
                        (double)session.image.focal_length_px,
                    said.result.n_matched, (double)said.result.log_chance, said.steps);
      violate("a wrong attitude");
    }
    model_has_prior = 1;
    prior_is_right = 1;
    model_time = now;
  } else {
    absents++;
    if (has_image && is_fresh && (prior_is_right != 0u) && (kind > 3u) && (kind != WEAK) &&
        (session.counts.damage_found == 0u) && (counts[5] == 0u)) {
      violate("a clear frame near a fresh attitude has no answer");
    }
  }
}

/* Bits of the slots, of the patch, or of many blocks. */
static void damage(void) {
  /* Not what a change has just checked: damage between its ticks is found after it. */
  const int is_checked =
      (session.work == STARCAT_WORK_CHANGE) || (session.work == STARCAT_WORK_FALL_BACK);
  const uint32_t slot = is_checked ? session.slots.active : pick(2);
  const uint32_t n_blocks = pick(4) == 0u ? 40u : 1u;
  uint8_t *bytes = (uint8_t *)memory[slot];
  const uint32_t first = pick(CAPACITY / BLOCK);
  for (uint32_t n = 0; n < n_blocks; n++) {
    const size_t at = (size_t)((first + n) % (CAPACITY / BLOCK)) * BLOCK + pick(BLOCK);
    bytes[at] = (uint8_t)(bytes[at] ^ (1u << pick(8)));
  }
  if (pick(4) == 0u) {
    patch_memory[pick(16)] ^= 1u << pick(32);
  }
}

static void begin_load(void) {
  const uint32_t image = pick(N_IMAGES), is_patch = pick(3) == 0u ? 1u : 0u;
  const uint32_t crc = pick(3) == 0u ? 0u : pick(8) == 0u ? 1u : crc_of(image);
  starcat_status status;
  if (is_patch != 0u) {
    upload = (const uint8_t *)patches[image % 2u];
    upload_size = patch_sizes[image % 2u];
    status = starcat_begin_patch_load(&session, upload_size);
  } else {
    upload = (const uint8_t *)images[image];
    upload_size = sizes[image];
    status = starcat_begin_load(&session, upload_size, crc);
  }
  upload_at = 0;
  if (status != STARCAT_OK) {
    upload = NULL;
  }
}

static void send_pieces(void) {
  for (uint32_t n = pick(12); (n > 0u) && (upload != NULL); n--) {
    const size_t left = upload_size - upload_at, most = 1u + pick(3u * BLOCK);
    const size_t count = left < most ? left : most;
    const starcat_status status = starcat_load_piece(&session, upload + upload_at, count);
    upload_at += count;
    if (status != STARCAT_INCOMPLETE) {
      upload = NULL;
    }
  }
}

/* The application knows the images that it trusts. */
static void decide(uint32_t slot) {
  const uint8_t *bytes = session.slots.bytes[slot];
  const size_t size = session.slots.size[slot];
  if (is_image(bytes, size, 0) || is_image(bytes, size, 1)) {
    if (pick(8) == 0u) {
      (void)starcat_refuse_load(&session);
    } else {
      (void)starcat_accept_load(&session);
    }
  } else if (pick(4) > 0u) { /* else it forgets to say anything */
    (void)starcat_refuse_load(&session);
  } else {
    /* nothing */
  }
}

static void tick(void) {
  const starcat_work work = session.work;
  const uint32_t blocks = settings.blocks_per_tick;
  starcat_event event;
  executed = 0;
  (void)starcat_do_idle_work(&session, &event);
  const uint64_t took = executed;
  longest[work] = took > longest[work] ? took : longest[work];
  if ((double)took > 2.0 * (double)(blocks > 16u ? blocks : 16u) * BLOCK + SLACK) {
    (void)fprintf(stderr, "work %d, %llu blocks, %u per tick, event %d\n", (int)work,
                  (unsigned long long)took, blocks, (int)event.kind);
    violate("a tick is longer than two ordinary ones");
  }
  counts[event.kind]++;
  switch (event.kind) {
    case STARCAT_EVENT_READY:
      decide(event.slot);
      break;
    case STARCAT_EVENT_CHANGED:
    case STARCAT_EVENT_FELL_BACK:
      check_taken();
      break;
    default:
      break;
  }
}

static void set_prior(void) {
  double m[9], q[4];
  sky_rotation(&state, m, q);
  session.has_prior = 1;
  session.prior_time = now;
  for (uint32_t n = 0; n < 4u; n++) {
    session.q_prior[n] = (starcat_real)q[n];
  }
  model_has_prior = 1;
  model_time = now;
  prior_is_right = 0;
}

static void operate(void) {
  const uint32_t what = pick(1000);
  if (what < 720u) {
    tick();
  } else if (what < 840u) {
    give_frame(pick(N_KINDS));
  } else if (what < 850u) {
    begin_load();
  } else if (what < 910u) {
    send_pieces();
  } else if (what < 930u) {
    (void)starcat_change_image(&session);
  } else if (what < 935u) {
    if (session.load == STARCAT_LOAD_READY) {
      decide(1u - session.slots.active);
    }
  } else if (what < 938u) {
    (void)starcat_refuse_load(&session);
    upload = NULL;
  } else if (what < 950u) {
    damage();
  } else if (what < 955u) {
    fails_to_store = pick(6) == 0u ? 1u : 0u;
  } else if (what < 956u) {
    stored_cut = 1; /* the next record is cut, and the power fails with it */
    cut_at = pick(STARCAT_RECORD_BYTES);
  } else if (what < 968u) {
    static const uint32_t blocks[8] = {1, 3, 16, 16, 16, 40, 16, 0};
    settings.blocks_per_tick = blocks[pick(8)];
  } else if (what < 972u) { /* weak frames after another */
    has_truth = 0;
    for (uint32_t n = 0; n < 4u; n++) {
      give_frame(WEAK);
    }
  } else if (what < 975u) {
    now = pick(4) == 0u ? (uint64_t)pick(1000000) << 20 : now + pick(3000);
  } else if (what < 980u) {
    set_prior();
  } else if (what < 982u) {
    restart(0);
  } else if ((session.has_image == 0u) && (what < 990u)) {
    restart(1); /* the ground gives up, and fills the slots again */
  } else {
    tick();
  }
}

int main(int argc, char **argv) {
  if (argc != 3) {
    (void)fprintf(stderr, "fuzz_session OPERATIONS SEED\n");
    return 2;
  }
  n_operations = strtoull(argv[1], NULL, 10);
  state = strtoull(argv[2], NULL, 10);
  begin();
  for (operation = 0; operation < n_operations; operation++) {
    const uint32_t was_cut = stored_cut;
    const uint32_t failed = session.counts.stores_failed;
    operate();
    if ((was_cut != 0u) && (session.counts.stores_failed > failed) && (fails_to_store == 0u)) {
      restart(0); /* the power failed while the record was stored */
    }
  }
  (void)printf(
      "fuzz_session: %llu operations, %u answers, %u of them confirmed, %u frames without, %u restarts;"
      " events: %u ready, %u refused, %u mended, %u fell back, %u no image, %u changed,"
      " %u other lost\n",
      (unsigned long long)n_operations, answers, confirmed, absents, restarts, counts[1], counts[2], counts[3],
      counts[4], counts[5], counts[6], counts[7]);
  (void)printf(
      "fuzz_session: basic blocks of the longest tick: scrub %llu, patch %llu and %llu,"
      " load %llu, parity %llu, change %llu, fall back %llu; 0 violations\n",
      (unsigned long long)longest[0], (unsigned long long)longest[1],
      (unsigned long long)longest[2], (unsigned long long)longest[3],
      (unsigned long long)longest[4], (unsigned long long)longest[5],
      (unsigned long long)longest[6]);
  return 0;
}
