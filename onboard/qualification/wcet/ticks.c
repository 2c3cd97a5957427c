/* A session with an image in two slots: scrubbing, repairs, an upload, a patch, the change, the fall
 * back; and the calls of starcat_update.h that take a whole image.
 *
 * SPDX-License-Identifier: MIT
 */
#include "ticks.h"

#include <stdio.h>
#include <string.h>

#include "clock.h"
#include "starcat_session.h"

#define BLOCK 4096u
#define SLOT_BYTES (40u * BLOCK)
#define MOST_TICKS 400u
#define N_KINDS 7u

static uint64_t memory[2][SLOT_BYTES / 8u];
static uint32_t patch[16], patch_memory[16];
static starcat_settings settings;
static starcat_session session;
static uint64_t longest[N_KINDS];

static int store(void *context, uint32_t place, const uint8_t *record) {
  (void)context;
  (void)place;
  (void)record;
  return 1;
}

/* CRC-32 as in docs/onboard-format.md. */
static uint32_t crc_of(const uint8_t *bytes, size_t count, uint32_t before) {
  uint32_t crc = ~before;
  for (size_t n = 0; n < count; n++) {
    crc ^= bytes[n];
    for (int k = 0; k < 8; k++) {
      crc = crc >> 1 ^ ((crc & 1u) != 0u ? 0xedb88320u : 0u);
    }
  }
  return ~crc;
}

/* Ticks until an event, or a pass of scrubbing. Returns whether it came. */
static int work_until(starcat_event_kind kind) {
  starcat_event event;
  for (uint32_t n = 0; n < MOST_TICKS; n++) {
    const starcat_work work = session.work;
    const uint64_t start = clock_now();
    (void)starcat_do_idle_work(&session, &event);
    const uint64_t took = clock_now() - start + CLOCK_STEP;
    longest[work] = took > longest[work] ? took : longest[work];
    if (kind == STARCAT_EVENT_NONE ? session.counts.scrub_passes > 0u : event.kind == kind) {
      return 1;
    }
  }
  return 0;
}

static void print_whole(const char *name, uint64_t start, size_t size) {
  (void)printf("whole %s %llu blocks: %u\n", name,
               (unsigned long long)(clock_now() - start + CLOCK_STEP), (unsigned)(size / BLOCK));
}

/* A patch that copies all bytes of an image. Returns its size. */
static uint32_t make_patch(size_t size, uint32_t crc) {
  uint8_t *bytes = (uint8_t *)patch;
  const uint32_t words[7] = {0x01020304u, 2, (uint32_t)size, crc, (uint32_t)size, crc, 0};
  uint32_t at = 44;
  memset(patch, 0, sizeof patch);
  memcpy(bytes, "STARPAT", 8);
  memcpy(bytes + 8, words, sizeof words);
  for (uint32_t number = (uint32_t)size << 3 | 1u; number > 0u; number >>= 7) {
    bytes[at] = (uint8_t)((number & 0x7fu) | (number >= 0x80u ? 0x80u : 0u));
    at++;
  }
  at++; /* from the beginning */
  memcpy(bytes + 36, &at, 4);
  const uint32_t sum = crc_of(bytes + 44, at - 44u, crc_of(bytes, 40, 0));
  memcpy(bytes + 40, &sum, 4);
  return at;
}

/* An upload or a patch until the session uses it. */
static int take_load(void) {
  return work_until(STARCAT_EVENT_READY) && (starcat_accept_load(&session) == STARCAT_OK) &&
         (starcat_change_image(&session) == STARCAT_OK) && work_until(STARCAT_EVENT_CHANGED);
}

static int do_all_work(const uint8_t *image, size_t size, uint32_t crc) {
  uint8_t *first = (uint8_t *)memory[0], *second = (uint8_t *)memory[1];
  if (!work_until(STARCAT_EVENT_NONE)) { /* a pass of scrubbing */
    return 0;
  }
  const size_t places[3] = {BLOCK + 9u, size - 9u, size + 9u}; /* a block, a check block, parity */
  for (uint32_t n = 0; n < 3u; n++) {
    first[places[n]] ^= 1u;
    if (!work_until(STARCAT_EVENT_MENDED)) {
      return 0;
    }
  }
  if ((starcat_begin_load(&session, size, crc) != STARCAT_OK) ||
      (starcat_load_piece(&session, image, size) != STARCAT_OK) || !take_load()) {
    return 0;
  }
  const uint32_t n_patch = make_patch(size, crc);
  if ((starcat_begin_patch_load(&session, n_patch) != STARCAT_OK) ||
      (starcat_load_piece(&session, (const uint8_t *)patch, n_patch) != STARCAT_OK) ||
      !take_load() || (starcat_begin_load(&session, size, crc) != STARCAT_OK) ||
      (starcat_load_piece(&session, image, size) != STARCAT_OK) || !take_load()) {
    return 0;
  }
  starcat_slots *slots = &session.slots; /* the first slot is the fall-back */
  (void)starcat_accept_image(slots, 0, crc);
  for (size_t at = 0; at < size; at += BLOCK) {
    second[at + 17u] ^= 1u;
  }
  return work_until(STARCAT_EVENT_FELL_BACK);
}

int measure_ticks(const void *image, size_t size) {
  static starcat_image opened;
  const uint8_t *bytes = image;
  uint32_t crc = 0, mended = 0;
  starcat_slots slots;
  memset(&slots, 0, sizeof slots);
  memcpy(&crc, bytes + size - 8u, 4);
  memcpy(memory[0], image, size);
  slots.bytes[0] = (uint8_t *)memory[0];
  slots.bytes[1] = (uint8_t *)memory[1];
  slots.capacity = SLOT_BYTES;
  slots.size[0] = size;
  (void)starcat_accept_image(&slots, 0, crc);
  (void)starcat_set_default_settings(&settings);
  settings.store = store;
  settings.patch = patch_memory;
  settings.patch_capacity = sizeof patch_memory;
  (void)starcat_prepare_session(&session, &settings);
  uint64_t start = clock_now();
  if (starcat_start_session(&session, &slots) != STARCAT_OK) {
    return 0;
  }
  print_whole("starcat_start_session", start, size);
  if (!do_all_work(bytes, size, crc)) {
    return 0;
  }
  for (uint32_t n = 0; n < N_KINDS; n++) {
    (void)printf("tick %u %llu\n", (unsigned)n, (unsigned long long)longest[n]);
  }
  slots = session.slots;
  slots.bytes[slots.active][BLOCK + 9u] ^= 1u;
  start = clock_now();
  (void)starcat_mend_image(slots.bytes[slots.active], size, &mended);
  print_whole("starcat_mend_image", start, size);
  memcpy(slots.bytes[1u - slots.active], image, size);
  slots.size[1u - slots.active] = size;
  (void)starcat_accept_image(&slots, 1u - slots.active, crc);
  start = clock_now();
  (void)starcat_switch_image(&slots, &opened);
  print_whole("starcat_switch_image", start, size);
  const uint32_t n_patch = make_patch(size, crc);
  memcpy(patch_memory, patch, sizeof patch);
  start = clock_now();
  (void)starcat_apply_patch(&slots, patch_memory, n_patch);
  print_whole("starcat_apply_patch", start, size);
  return mended == 1u;
}
