/* A mission in short: what flight software does with a session, from the first start to a recovery.
 *
 *   mission IMAGE NEXT FRAME
 *
 * IMAGE and NEXT are files of `starcat export --to onboard`; FRAME has one line "x y magnitude" per
 * centroid. The program prints a line for each phase. It ends with 1 if a phase does not come out
 * as it should.
 *
 * Memory that keeps its contents over a restart is stood in for by static arrays.
 *
 * SPDX-License-Identifier: MIT
 */
#include <stdio.h>
#include <string.h>

#include "starcat_session.h"

#define CAPACITY 4194304u  /* bytes of a slot: an image and its parity */
#define PIECE 1024u        /* bytes of a packet of the upload */
#define MOST_TICKS 100000u /* ticks until an event has to come */

/* What survives a restart: the slots and the two records of them. */
static uint64_t slot_memory[2][CAPACITY / 8u];
static uint8_t records[2][STARCAT_RECORD_BYTES];

static int store_record(void *context, uint32_t place, const uint8_t record[STARCAT_RECORD_BYTES]) {
  (void)context;
  memcpy(records[place], record, STARCAT_RECORD_BYTES);
  return 1;
}

/* Settings can be constants: starcat_set_default_settings writes the same numbers, except for the
 * steps (docs/onboard.md has a table of them) and the age. */
static const starcat_settings settings = {
    .options = {.tolerance_px = 1,
                .noise_px = (starcat_real)0.3,
                .log_chance = -20,
                .max_steps = 1},
    .max_steps_track = 26000,
    .max_steps_identify = 40000,
    .prior_error_rad = (starcat_real)0.009,
    .prior_age = 2000, /* the clock of this mission counts milliseconds */
    .blocks_per_tick = 16,
    .store = store_record};

static starcat_session session;
static starcat_answer answer;
static starcat_real columns[3][STARCAT_MAX_CENTROIDS];
static uint64_t upload[CAPACITY / 8u];

static size_t read_file(const char *path, void *into) {
  FILE *file = fopen(path, "rb");
  size_t size = 0;
  if (file != NULL) {
    size = fread(into, 1, CAPACITY, file);
    (void)fclose(file);
  }
  return size;
}

static uint32_t read_frame(const char *path) {
  FILE *file = fopen(path, "r");
  double x, y, magnitude;
  uint32_t count = 0;
  while ((file != NULL) && (count < STARCAT_MAX_CENTROIDS) &&
         (fscanf(file, "%lf %lf %lf", &x, &y, &magnitude) == 3)) {
    columns[0][count] = (starcat_real)x;
    columns[1][count] = (starcat_real)y;
    columns[2][count] = (starcat_real)magnitude;
    count++;
  }
  if (file != NULL) {
    (void)fclose(file);
  }
  return count;
}

/* The CRC of all data, 8 bytes before the end of an image. The ground sends it with an image. */
static uint32_t crc_of(const uint8_t *bytes, size_t size) {
  uint32_t crc = 0;
  if (size >= 8u) {
    memcpy(&crc, bytes + size - 8u, sizeof crc);
  }
  return crc;
}

/* Start or restart: the slots are as the records say. STARCAT_E_CRC: there is no record yet. */
static starcat_status start(void) {
  starcat_slots slots = {0};
  slots.bytes[0] = (uint8_t *)slot_memory[0];
  slots.bytes[1] = (uint8_t *)slot_memory[1];
  slots.capacity = CAPACITY;
  starcat_status status = starcat_read_record(&slots, records[0], records[1]);
  if (status == STARCAT_OK) {
    status = starcat_prepare_session(&session, &settings);
  }
  return status == STARCAT_OK ? starcat_start_session(&session, &slots) : status;
}

/* Before launch: an image is copied to the first slot and accepted, and a record is written. */
static void install(const char *path) {
  uint8_t record[STARCAT_RECORD_BYTES];
  uint32_t place = 0;
  starcat_slots slots = {0};
  slots.bytes[0] = (uint8_t *)slot_memory[0];
  slots.bytes[1] = (uint8_t *)slot_memory[1];
  slots.capacity = CAPACITY;
  slots.size[0] = read_file(path, slot_memory[0]);
  if ((starcat_accept_image(&slots, 0, crc_of(slots.bytes[0], slots.size[0])) == STARCAT_OK) &&
      (starcat_write_record(&slots, record, &place) == STARCAT_OK)) {
    (void)store_record(NULL, place, record);
  }
}

/* Idle time, until an event. */
static starcat_event wait_for_event(void) {
  starcat_event event = {STARCAT_EVENT_NONE, STARCAT_OK, 0, 0};
  for (uint32_t n = 0; (n < MOST_TICKS) && (event.kind == STARCAT_EVENT_NONE); n++) {
    (void)starcat_do_idle_work(&session, &event);
  }
  return event;
}

/* Send an image in pieces. Returns the event that ends it: READY, or REFUSED. */
static starcat_event_kind send_image(size_t size) {
  const uint8_t *bytes = (const uint8_t *)upload;
  starcat_status status = starcat_begin_load(&session, size, crc_of(bytes, size));
  for (size_t at = 0; (at < size) && (status >= STARCAT_OK); at += PIECE) {
    status = starcat_load_piece(&session, bytes + at, size - at < PIECE ? size - at : PIECE);
  }
  return status == STARCAT_OK ? wait_for_event().kind : STARCAT_EVENT_NONE;
}

static void damage(uint32_t slot) {
  for (size_t at = 600; at < session.slots.size[slot]; at += 4099u) {
    session.slots.bytes[slot][at] ^= 0x10u;
  }
}

static int failed;

static void tell(const char *phase, int is_right) {
  (void)printf("%-64s %s\n", phase, is_right ? "yes" : "NO");
  failed |= is_right ? 0 : 1;
}

int main(int argc, char **argv) {
  if (argc != 4) {
    (void)fprintf(stderr, "mission IMAGE NEXT FRAME\n");
    return 2;
  }
  const uint32_t count = read_frame(argv[3]);
  const starcat_frame frame = {count, columns[0], columns[1], columns[2], NULL};
  const starcat_frame blank = {0, NULL, NULL, NULL, NULL};
  tell("a start without a record is refused", start() == STARCAT_E_CRC);
  install(argv[1]);
  tell("the installed image is in use", start() == STARCAT_OK);
  (void)starcat_answer_frame(&session, &frame, 1000, &answer);
  tell("a frame is identified lost in space",
       (answer.status == STARCAT_IDENTIFIED) && (answer.mode == STARCAT_MODE_IDENTIFY));
  (void)starcat_answer_frame(&session, &blank, 1100, &answer);
  tell("a blank frame has no attitude", answer.status != STARCAT_IDENTIFIED);
  (void)starcat_answer_frame(&session, &frame, 1200, &answer);
  tell("the next frame is tracked all the same",
       (answer.status == STARCAT_IDENTIFIED) && (answer.mode == STARCAT_MODE_TRACK));

  const size_t size = read_file(argv[2], upload);
  ((uint8_t *)upload)[4096] ^= 1u;
  tell("a damaged upload is refused", send_image(size) == STARCAT_EVENT_REFUSED);
  ((uint8_t *)upload)[4096] ^= 1u;
  tell("an upload is whole", send_image(size) == STARCAT_EVENT_READY);
  tell("it cannot be used before it is accepted", starcat_change_image(&session) != STARCAT_OK);
  tell("its signature is wrong: the application refuses it",
       (starcat_refuse_load(&session) == STARCAT_OK) &&
           (starcat_change_image(&session) != STARCAT_OK));
  tell("a second upload is whole", send_image(size) == STARCAT_EVENT_READY);
  tell("it is accepted", starcat_accept_load(&session) == STARCAT_OK);
  tell("the change to it begins", starcat_change_image(&session) == STARCAT_OK);
  tell("and ends", wait_for_event().kind == STARCAT_EVENT_CHANGED);
  (void)starcat_answer_frame(&session, &frame, 1300, &answer);
  tell("frames are tracked with the new image",
       (answer.status == STARCAT_IDENTIFIED) && (answer.mode == STARCAT_MODE_TRACK));

  session.slots.bytes[1][5000] ^= 4u;
  tell("a flipped bit is repaired", wait_for_event().kind == STARCAT_EVENT_MENDED);
  damage(1);
  starcat_event event = wait_for_event();
  while (event.kind == STARCAT_EVENT_MENDED) { /* what parity can repair */
    event = wait_for_event();
  }
  tell("an image beyond repair is replaced by the other one",
       event.kind == STARCAT_EVENT_FELL_BACK);
  tell("after a restart that image is in use",
       (start() == STARCAT_OK) && (session.slots.active == 0u));
  (void)starcat_answer_frame(&session, &frame, 9000, &answer);
  tell("and frames are identified lost in space",
       (answer.status == STARCAT_IDENTIFIED) && (answer.mode == STARCAT_MODE_IDENTIFY));
  return failed;
}
