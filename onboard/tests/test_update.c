/* Images in flight: pieces that are resumed, switching and falling back, parity, patches; and each
 * error code of starcat_update.h.
 *
 * SPDX-License-Identifier: MIT
 */
#include <string.h>

#include "internal.h"
#include "starcat_session.h"
#include "unit.h"

#define BLOCK 4096u
#define CAPACITY (SKY_MOST_BYTES / BLOCK * BLOCK)

static uint64_t words[2][CAPACITY / 8u], patch_words[CAPACITY / 8u];
static starcat_slots slots;
static starcat_image image;
static uint32_t block, n_mended;

static uint32_t crc_of(const unit_sky *sky) {
  uint32_t crc;
  memcpy(&crc, sky->bytes + sky->size - 8u, 4);
  return crc;
}

/* Two slots with the triangles' sky in use and nothing in the other one. */
static void begin(void) {
  memset(words, 0, sizeof words);
  memset(&slots, 0, sizeof slots);
  slots.bytes[0] = (uint8_t *)words[0];
  slots.bytes[1] = (uint8_t *)words[1];
  slots.capacity = sizeof words[0];
  slots.size[0] = unit_triangle.size;
  memcpy(words[0], unit_triangle.bytes, unit_triangle.size);
  CHECK_IS(starcat_accept_image(&slots, 0, crc_of(&unit_triangle)), STARCAT_OK);
  CHECK_IS(starcat_start_image(&slots, &image), STARCAT_OK);
}

static void send(const unit_sky *sky, size_t from, size_t until, size_t most) {
  for (size_t at = from; at < until; at += most) {
    const size_t count = until - at < most ? until - at : most;
    CHECK_IS(starcat_put_piece(&slots, at, sky->bytes + at, count), STARCAT_OK);
  }
}

static void test_pieces(void) {
  const unit_sky *sky = &unit_pyramid;
  const uint32_t n_blocks = (uint32_t)(sky->size / BLOCK);
  begin();
  CHECK_IS(starcat_find_missing_block(&slots, 0, &block),
           STARCAT_E_LAYOUT); /* nothing is awaited */
  CHECK_IS(starcat_switch_image(&slots, &image), STARCAT_E_LAYOUT);
  CHECK_IS(starcat_receive_image(&slots, sky->size, crc_of(sky)), STARCAT_OK);
  CHECK_IS(starcat_find_missing_block(&slots, 0, &block), STARCAT_INCOMPLETE);
  CHECK_IS(block, n_blocks - 1u); /* checks come first */
  send(sky, sky->size - BLOCK, sky->size, 700);
  CHECK_IS(starcat_find_missing_block(&slots, 0, &block), STARCAT_INCOMPLETE);
  CHECK_IS(block, 0);
  send(sky, 0, 3u * BLOCK + 100u, 1000);
  CHECK_IS(starcat_find_missing_block(&slots, 0, &block), STARCAT_INCOMPLETE);
  CHECK_IS(block, 3);
  CHECK_IS(starcat_switch_image(&slots, &image), STARCAT_INCOMPLETE);
  CHECK_IS(slots.active, 0);
  /* The computer restarts with the state it kept; the transfer resumes with missing blocks. */
  CHECK_IS(starcat_start_image(&slots, &image), STARCAT_OK);
  CHECK(image.bytes == slots.bytes[0]);
  for (uint32_t n = 0;
       n < n_blocks && starcat_find_missing_block(&slots, n, &block) == STARCAT_INCOMPLETE; n++) {
    send(sky, (size_t)block * BLOCK, ((size_t)block + 1u) * BLOCK, 1);
    n = block;
  }
  CHECK_IS(starcat_find_missing_block(&slots, 0, &block), STARCAT_OK);
  CHECK_IS(block, n_blocks);
  CHECK_IS(starcat_switch_image(&slots, NULL), STARCAT_E_NULL);
  CHECK_IS(starcat_switch_image(&slots, &image), STARCAT_INCOMPLETE); /* not accepted */
  CHECK_IS(starcat_accept_image(&slots, 1, crc_of(sky)), STARCAT_OK);
  CHECK_IS(starcat_switch_image(&slots, &image), STARCAT_OK);
  CHECK_IS(slots.active, 1);
  CHECK(memcmp(image.bytes, sky->bytes, sky->size) == 0);
  CHECK_IS(starcat_switch_image(&slots, &image), STARCAT_OK); /* falls back */
  CHECK(image.bytes == slots.bytes[0]);
  /* The slot holds a complete image, but not the expected one: the previous image of this size. */
  CHECK_IS(starcat_receive_image(&slots, sky->size, crc_of(sky) ^ 1u), STARCAT_OK);
  CHECK_IS(starcat_find_missing_block(&slots, 0, &block), STARCAT_INCOMPLETE);
  CHECK_IS(block, n_blocks - 1u);
  CHECK_IS(starcat_receive_image(&slots, sky->size, 0), STARCAT_OK);
  CHECK_IS(starcat_find_missing_block(&slots, 0, &block), STARCAT_OK);
}

static void check_update_errors(void) {
  const uint8_t byte = 0;
  begin();
  CHECK_IS(starcat_start_image(NULL, &image), STARCAT_E_NULL);
  CHECK_IS(starcat_start_image(&slots, NULL), STARCAT_E_NULL);
  CHECK_IS(starcat_put_piece(NULL, 0, &byte, 1), STARCAT_E_NULL);
  CHECK_IS(starcat_put_piece(&slots, 0, NULL, 1), STARCAT_E_NULL);
  slots.acceptance[1] = STARCAT_ACCEPTED;
  CHECK_IS(starcat_put_piece(&slots, 0, &byte, 0), STARCAT_E_OPTIONS);
  slots.acceptance[1] = 0;
  CHECK_IS(starcat_put_piece(&slots, 0, &byte, 1), STARCAT_E_SHORT);
  CHECK_IS(starcat_put_piece(&slots, 1, &byte, 0), STARCAT_E_SHORT);
  CHECK_IS(starcat_find_missing_block(NULL, 0, &block), STARCAT_E_NULL);
  CHECK_IS(starcat_find_missing_block(&slots, 0, NULL), STARCAT_E_NULL);
  CHECK_IS(starcat_mend_image(NULL, BLOCK, &n_mended), STARCAT_E_NULL);
  CHECK_IS(starcat_mend_image(words, 2u * BLOCK, NULL), STARCAT_E_NULL);
  CHECK_IS(starcat_mend_image((uint8_t *)words + 4, 2u * BLOCK, &n_mended), STARCAT_E_ALIGNMENT);
  CHECK_IS(starcat_mend_image(words, BLOCK, &n_mended), STARCAT_E_LAYOUT);
  CHECK_IS(starcat_mend_image(words, 2u * BLOCK + 8u, &n_mended), STARCAT_E_LAYOUT);
  if (sizeof(size_t) > 4u) {
    CHECK_IS(starcat_count_parity_bytes((size_t)BLOCK * 1048575u), (size_t)BLOCK * 32768u);
    CHECK_IS(starcat_count_parity_bytes((size_t)BLOCK * 1048576u), 0);
  }
  CHECK_IS(starcat_count_parity_bytes(33u * BLOCK), 2u * BLOCK);
  CHECK_IS(starcat_receive_image(NULL, BLOCK, 0), STARCAT_E_NULL);
  CHECK_IS(starcat_receive_image(&slots, BLOCK - 1u, 0), STARCAT_E_LAYOUT);
  CHECK_IS(starcat_receive_image(&slots, slots.capacity, 0), STARCAT_E_SHORT);
  CHECK_IS(starcat_receive_image(&slots, slots.capacity + BLOCK, 0), STARCAT_E_SHORT);
  slots.active = 2;
  CHECK_IS(starcat_start_image(&slots, &image), STARCAT_E_OPTIONS);
  for (uint32_t n = 0; n < 2u; n++) {
    begin();
    slots.bytes[n] = NULL;
    CHECK_IS(starcat_start_image(&slots, &image), STARCAT_E_NULL);
  }
}

/* An image of another sky is in the other slot, and was in use before. */
static void fill_both(void) {
  begin();
  CHECK_IS(starcat_receive_image(&slots, unit_pyramid.size, 0), STARCAT_OK);
  send(&unit_pyramid, 0, unit_pyramid.size, BLOCK);
  CHECK_IS(starcat_accept_image(&slots, 1, crc_of(&unit_pyramid)), STARCAT_OK);
  CHECK_IS(starcat_switch_image(&slots, &image), STARCAT_OK);
  CHECK_IS(starcat_switch_image(&slots, &image), STARCAT_OK);
}

static void damage(uint32_t slot, uint32_t first, uint32_t count) {
  for (uint32_t n = 0; n < count; n++) {
    slots.bytes[slot][(size_t)(first + n) * BLOCK + (size_t)(977u * n % BLOCK)] ^= 0x10u;
  }
}

static void test_parity(void) {
  const uint32_t n_blocks = (uint32_t)(unit_triangle.size / BLOCK);
  const uint32_t groups = (uint32_t)(starcat_count_parity_bytes(unit_triangle.size) / BLOCK);
  fill_both();
  for (uint32_t n = 0; n < n_blocks + groups; n++) { /* any one block, also of parity */
    damage(0, n, 1);
    CHECK_IS(starcat_mend_image(slots.bytes[0], slots.size[0], &n_mended), STARCAT_OK);
    CHECK_IS(n_mended, n < n_blocks ? 1 : 0);
    CHECK(memcmp(slots.bytes[0], unit_triangle.bytes, unit_triangle.size) == 0);
  }
  damage(0, 0, groups); /* as many at once as there are groups, if they are neighbours */
  CHECK_IS(starcat_start_image(&slots, &image), STARCAT_OK);
  CHECK_IS(slots.active, 0);
  CHECK(memcmp(slots.bytes[0], unit_triangle.bytes, unit_triangle.size) == 0);
  damage(0, 0, groups + 1u);
  CHECK_IS(starcat_mend_image(slots.bytes[0], slots.size[0], &n_mended), STARCAT_E_CRC);
  CHECK_IS(n_mended, groups - 1u);
  CHECK_IS(starcat_start_image(&slots, &image), STARCAT_OK); /* falls back by itself */
  CHECK_IS(slots.active, 1);
  CHECK(image.bytes == slots.bytes[1]);
  CHECK_IS(starcat_switch_image(&slots, &image), STARCAT_INCOMPLETE);
  damage(1, 0, n_blocks);
  CHECK_IS(starcat_start_image(&slots, &image), STARCAT_E_CRC);
  CHECK_IS(slots.active, 1);
  /* A slot that is larger than the image that is in it. */
  begin();
  slots.size[0] += BLOCK;
  CHECK_IS(starcat_start_image(&slots, &image), STARCAT_E_CRC);
  begin();
  memcpy(words[0], &(uint32_t){0}, 4); /* sound blocks, but no image */
  sky_seal((uint8_t *)words[0]);
  CHECK_IS(starcat_start_image(&slots, &image), STARCAT_INCOMPLETE); /* not the accepted one */
  memcpy(&slots.crc[0], (uint8_t *)words[0] + slots.size[0] - 8u, 4);
  CHECK_IS(starcat_start_image(&slots, &image), STARCAT_E_MAGIC);
}

/* A patch, written step by step. */
static struct { size_t size; } patch;

static void put_byte(uint32_t byte) { ((uint8_t *)patch_words)[patch.size++] = (uint8_t)byte; }

static void put_number(uint32_t number) {
  for (; number >= 0x80u; number >>= 7) {
    put_byte((number & 0x7fu) | 0x80u);
  }
  put_byte(number);
}

static void put_word(size_t at, uint32_t word) { memcpy((uint8_t *)patch_words + at, &word, 4); }

enum { LITERAL, COPY, RENUMBER_16, RENUMBER_32, ADD_16, ADD_32, ZEROS, NO_STEP };

static void put_step(uint32_t kind, uint32_t count, int32_t jump) {
  put_number(count << 3 | kind);
  if ((kind != LITERAL) && (kind != ZEROS)) {
    put_number((uint32_t)(jump < 0 ? -2 * jump - 1 : 2 * jump));
  }
}

static void put_literal(const uint8_t *bytes, uint32_t count) {
  put_step(LITERAL, count, 0);
  for (uint32_t n = 0; n < count; n++) {
    put_byte(bytes[n]);
  }
}

/* Begin a patch from the active image to the scratch image: rows from 100 on become one less, and
 * rows from 200 on become three more. */
static void begin_patch(void) {
  static const uint32_t runs[4] = {100, 0xffffffffu, 200, 3};
  memset(patch_words, 0, sizeof patch_words);
  memcpy(patch_words, "STARPAT", 8);
  put_word(8, 0x01020304u);
  put_word(12, 2);
  put_word(16, (uint32_t)slots.size[slots.active]);
  put_word(20, crc_of(&unit_triangle));
  put_word(24, (uint32_t)unit_scratch.size);
  put_word(28, crc_of(&unit_scratch));
  put_word(32, 2);
  memcpy((uint8_t *)patch_words + 44, runs, sizeof runs);
  patch.size = 60;
}

/* Write the size and the CRC of the patch. */
static void seal_patch(void) {
  put_word(36, (uint32_t)patch.size);
  const uint32_t start = starcat_update_crc(0, (const uint8_t *)patch_words, 40);
  put_word(40, starcat_update_crc(start, (const uint8_t *)patch_words + 44, patch.size - 44u));
}

static starcat_status apply(void) {
  seal_patch();
  return starcat_apply_patch(&slots, patch_words, patch.size);
}

static uint32_t number_at(size_t at) {
  uint32_t number;
  memcpy(&number, unit_scratch.bytes + at, 4);
  return number;
}

/* Offset of a section of the scratch image, and its bytes. */
static size_t section(uint32_t kind, uint32_t *bytes) {
  size_t entry = 256;
  while (number_at(entry) != kind) {
    entry += 16;
  }
  *bytes = number_at(entry + 8u);
  return number_at(entry + 4u);
}

static void change_u32(size_t at, uint32_t by) {
  const uint32_t changed = number_at(at) + by;
  memcpy(unit_scratch.bytes + at, &changed, 4);
}

/* Make the scratch image from the triangle image with stars of other rows, another K-vector, other
 * magnitudes, and zeros for the first star numbers. */
static void patch_all(void) {
  uint32_t bytes[4];
  unit_copy(&unit_triangle);
  const size_t mags = section(2, &bytes[0]), ids = section(3, &bytes[1]);
  const size_t kvector = section(5, &bytes[2]), rows = section(6, &bytes[3]);
  uint16_t *row = (uint16_t *)(void *)(unit_scratch.bytes + rows);
  for (uint32_t n = 0; n < bytes[3] / 2u; n++) {
    row[n] = (uint16_t)(row[n] < 100u ? row[n] : row[n] < 200u ? row[n] - 1u : row[n] + 3u);
  }
  for (uint32_t n = 0; n < bytes[2] / 4u; n++) {
    change_u32(kvector + 4u * n, n < 5u ? 0u : n < 9u ? 7u : 0xfffffffeu);
  }
  int16_t *mag = (int16_t *)(void *)(unit_scratch.bytes + mags);
  mag[0] = (int16_t)(mag[0] - 1);
  memset(unit_scratch.bytes + ids, 0, 80);
  sky_seal(unit_scratch.bytes);
  begin_patch();
  put_step(COPY, (uint32_t)mags, 0);
  put_step(ADD_16, 2, 0);
  put_number(1); /* -1 */
  put_number(2); /* and back */
  put_step(COPY, (uint32_t)(ids - mags) - 4u, 0);
  put_step(ZEROS, 80, 0);
  put_step(COPY, (uint32_t)(kvector - ids) - 80u, 80);
  put_step(ADD_32, bytes[2] / 4u, 0);
  put_number(0);
  put_number(4);
  put_number(14);
  put_number(0);
  put_number(2);
  put_number(17);
  put_number(0);
  put_number(bytes[2] / 4u - 11u);
  put_step(COPY, (uint32_t)(rows - kvector) - bytes[2], 0);
  put_step(RENUMBER_16, bytes[3] / 2u, 0);
  put_literal(unit_scratch.bytes + rows + bytes[3],
              (uint32_t)(unit_scratch.size - rows) - bytes[3]);
}

static starcat_session session;
static starcat_settings settings;

/* Load the sealed patch into a session that does idle work of some blocks. */
static void load_patch(uint32_t blocks, starcat_store store) {
  seal_patch();
  CHECK_IS(starcat_set_default_settings(&settings), STARCAT_OK);
  settings.blocks_per_tick = blocks;
  settings.patch = patch_words;
  settings.patch_capacity = sizeof patch_words;
  settings.store = store;
  CHECK_IS(starcat_prepare_session(&session, &settings), STARCAT_OK);
  CHECK_IS(starcat_start_session(&session, &slots), STARCAT_OK);
  CHECK_IS(starcat_begin_patch_load(&session, patch.size), STARCAT_OK);
  CHECK_IS(starcat_load_piece(&session, (const uint8_t *)patch_words, patch.size), STARCAT_OK);
}

/* The same patch in a session, which applies it in idle time. */
static void check_patch_of_session(void) {
  starcat_event event = {STARCAT_EVENT_NONE, STARCAT_OK, 0, 0};
  for (uint32_t blocks = 1; blocks < 40u; blocks += 13u) {
    begin();
    patch_all();
    load_patch(blocks, NULL);
    for (uint32_t n = 0; (n < 3000u) && (event.kind == STARCAT_EVENT_NONE); n++) {
      CHECK_IS(starcat_do_idle_work(&session, &event), STARCAT_OK);
    }
    CHECK_IS(event.kind, STARCAT_EVENT_READY);
    CHECK(memcmp(slots.bytes[1], unit_scratch.bytes, unit_scratch.size) == 0);
    CHECK_IS(starcat_accept_load(&session), STARCAT_OK);
    CHECK_IS(starcat_change_image(&session), STARCAT_OK);
    for (event.kind = STARCAT_EVENT_NONE; event.kind == STARCAT_EVENT_NONE;) {
      (void)starcat_do_idle_work(&session, &event);
    }
    CHECK_IS(event.kind, STARCAT_EVENT_CHANGED);
    event.kind = STARCAT_EVENT_NONE;
  }
}

/* A patch that is refused while the new image is made, and when the image is ready: the slot is
 * empty. */
static void check_patch_is_refused(void) {
  for (uint32_t n = 0; n < 2u; n++) {
    starcat_event event = {STARCAT_EVENT_NONE, STARCAT_OK, 0, 0};
    fill_both();
    patch_all();
    load_patch(1, NULL);
    for (uint32_t k = 0; (k < 3000u) && (event.kind == STARCAT_EVENT_NONE) &&
                         ((n == 1u) || (session.work != STARCAT_WORK_RUN_PATCH));
         k++) {
      CHECK_IS(starcat_do_idle_work(&session, &event), STARCAT_OK);
    }
    CHECK_IS(session.load, n == 0u ? STARCAT_LOAD_CHECKING : STARCAT_LOAD_READY);
    CHECK_IS(starcat_refuse_load(&session), STARCAT_OK);
    CHECK_IS(session.slots.acceptance[1], 0);
    CHECK_IS(session.slots.size[1], 0);
    CHECK_IS(starcat_accept_load(&session), STARCAT_INCOMPLETE);
  }
}

static int cannot_store(void *context, uint32_t place, const uint8_t *record) {
  (void)context;
  (void)place;
  (void)record;
  return 0;
}

/* Patches that a session refuses after they were checked: as the record of the slots cannot be
 * stored, before anything is written; or as their steps are invalid. */
static void check_patches_refused_late(void) {
  for (uint32_t n = 0; n < 2u; n++) {
    starcat_event event = {STARCAT_EVENT_NONE, STARCAT_OK, 0, 0};
    fill_both();
    patch_all();
    if (n == 1u) {
      patch.size -= 100u; /* the last step goes beyond the end */
    }
    load_patch(16, n == 0u ? cannot_store : NULL);
    for (uint32_t k = 0; (k < 3000u) && (event.kind == STARCAT_EVENT_NONE); k++) {
      CHECK_IS(starcat_do_idle_work(&session, &event), STARCAT_OK);
    }
    CHECK_IS(event.kind, STARCAT_EVENT_REFUSED);
    CHECK_IS(event.status, n == 0u ? STARCAT_INCOMPLETE : STARCAT_E_LAYOUT);
    CHECK_IS(session.slots.acceptance[1], n == 0u ? STARCAT_ACCEPTED : 0u);
    CHECK((n == 1u) || (memcmp(words[1], unit_pyramid.bytes, unit_pyramid.size) == 0));
  }
}

/* A damaged patch is refused before anything is written: 320 of them, each with one flipped bit. */
static void check_damaged_patches(void) {
  fill_both();
  patch_all();
  seal_patch();
  for (uint32_t n = 0; n < 320u; n++) {
    const size_t at = n < 40u ? 44u + n * (patch.size - 44u) / 40u : n * patch.size / 320u;
    uint8_t *byte = (uint8_t *)patch_words + at;
    *byte = (uint8_t)(*byte ^ (1u << (n % 8u)));
    CHECK(starcat_apply_patch(&slots, patch_words, patch.size) < STARCAT_OK);
    *byte = (uint8_t)(*byte ^ (1u << (n % 8u)));
    CHECK(memcmp(words[1], unit_pyramid.bytes, unit_pyramid.size) == 0);
    CHECK_IS(slots.acceptance[1], STARCAT_ACCEPTED);
  }
  CHECK_IS(starcat_switch_image(&slots, &image), STARCAT_OK); /* the fall-back is whole */
  CHECK_IS(starcat_switch_image(&slots, &image), STARCAT_OK);
  damage(0, 1, 1); /* a damaged image makes no other one either */
  CHECK_IS(apply(), STARCAT_E_CRC);
  CHECK_IS(slots.acceptance[1], STARCAT_ACCEPTED);
}

static void check_steps(void) {
  begin();
  patch_all();
  CHECK_IS(apply(), STARCAT_OK);
  CHECK(memcmp(slots.bytes[1], unit_scratch.bytes, unit_scratch.size) == 0);
  CHECK_IS(starcat_accept_image(&slots, 1, crc_of(&unit_scratch)), STARCAT_OK);
  CHECK_IS(starcat_switch_image(&slots, &image), STARCAT_OK);
  CHECK(image.bytes == slots.bytes[1]);
  CHECK_IS(apply(), STARCAT_E_VERSION); /* it is not for the image that it made */
  CHECK_IS(starcat_switch_image(&slots, &image), STARCAT_OK);
  damage(0, 1, 1);
  CHECK_IS(apply(), STARCAT_E_CRC); /* of a damaged image comes a damaged one */
  CHECK_IS(starcat_switch_image(&slots, &image), STARCAT_OK); /* nothing was written */
  /* Rows of four bytes, and a step back. */
  begin();
  memcpy(words[0], unit_pyramid.bytes, unit_pyramid.size);
  slots.size[0] = unit_pyramid.size;
  unit_copy(&unit_pyramid);
  uint32_t bytes;
  const size_t rows = section(8, &bytes);
  uint32_t *row = (uint32_t *)(void *)(unit_scratch.bytes + rows);
  for (uint32_t n = 0; n < bytes / 4u; n++) {
    row[n] = row[n] < 100u ? row[n] : row[n] < 200u ? row[n] - 1u : row[n] + 3u;
  }
  sky_seal(unit_scratch.bytes);
  begin_patch();
  put_word(20, crc_of(&unit_pyramid));
  put_step(COPY, (uint32_t)rows, 0);
  put_step(RENUMBER_32, bytes / 4u - 2u, 0);
  put_step(RENUMBER_32, 1, 4);
  put_step(RENUMBER_32, 1, -8);
  put_literal(unit_scratch.bytes + rows + bytes, (uint32_t)(unit_scratch.size - rows) - bytes);
  CHECK_IS(apply(), STARCAT_E_CRC); /* the last two are exchanged */
  const uint32_t last = row[bytes / 4u - 1u];
  row[bytes / 4u - 1u] = row[bytes / 4u - 2u];
  row[bytes / 4u - 2u] = last;
  CHECK(memcmp(slots.bytes[1], unit_scratch.bytes, rows + bytes) == 0);
}

/* A patch of one step that cannot be. */
static void refuse_step(uint32_t kind, uint32_t count, int32_t jump) {
  begin_patch();
  put_step(kind, count, jump);
  CHECK_IS(apply(), STARCAT_E_LAYOUT);
}

static void check_refused(void) {
  begin();
  unit_copy(&unit_triangle);
  const uint32_t size = (uint32_t)unit_scratch.size;
  refuse_step(NO_STEP, 1, 0);
  refuse_step(COPY, 0, 0);
  refuse_step(COPY, size + 1u, 0);
  refuse_step(RENUMBER_32, size / 4u + 1u, 0);
  refuse_step(LITERAL, 1, 0);
  refuse_step(COPY, 1, -1);
  refuse_step(COPY, 8, (int32_t)size - 7);
  refuse_step(ADD_16, 1, 1);
  begin_patch();
  put_step(ZEROS, 2, 0);
  put_step(ADD_32, 1, 0);
  CHECK_IS(apply(), STARCAT_E_LAYOUT); /* made_at is not a multiple of 4 */
  begin_patch();
  CHECK_IS(apply(), STARCAT_E_LAYOUT); /* no step */
  for (uint32_t n = 0; n < 7u; n++) {
    put_byte(0xffu); /* a number that does not end */
  }
  CHECK_IS(apply(), STARCAT_E_LAYOUT);
  CHECK_IS(starcat_apply_patch(NULL, patch_words, patch.size), STARCAT_E_NULL);
  CHECK_IS(starcat_apply_patch(&slots, NULL, patch.size), STARCAT_E_NULL);
  CHECK_IS(starcat_apply_patch(&slots, (uint8_t *)patch_words + 2, patch.size),
           STARCAT_E_ALIGNMENT);
  CHECK_IS(starcat_apply_patch(&slots, patch_words, 43), STARCAT_E_SHORT);
  CHECK_IS(starcat_apply_patch(&slots, patch_words, patch.size - 1u), STARCAT_E_SHORT);
  static const struct {
    size_t at;
    uint32_t value;
    starcat_status status;
  } headers[] = {{0, 0, STARCAT_E_MAGIC},         {8, 0x04030201u, STARCAT_E_BYTE_ORDER},
                 {12, 1, STARCAT_E_VERSION},      {16, 4096, STARCAT_E_VERSION},
                 {20, 0, STARCAT_E_VERSION},      {24, 100, STARCAT_E_LAYOUT},
                 {24, CAPACITY, STARCAT_E_SHORT}, {32, 3, STARCAT_E_LAYOUT},
                 {36, 43, STARCAT_E_LAYOUT},      {40, 0, STARCAT_E_CRC}};
  for (size_t n = 0; n < sizeof headers / sizeof headers[0]; n++) {
    begin_patch();
    seal_patch();
    put_word(headers[n].at, headers[n].value);
    CHECK_IS(starcat_apply_patch(&slots, patch_words, patch.size), headers[n].status);
  }
  begin_patch();
  slots.size[0] = 0;
  CHECK_IS(apply(), STARCAT_E_VERSION); /* no image is in use */
}

/* Acceptance: what was not accepted is not opened, and not fallen back to. */
static void check_acceptance(void) {
  begin();
  CHECK_IS(starcat_receive_image(&slots, unit_pyramid.size, crc_of(&unit_pyramid)), STARCAT_OK);
  send(&unit_pyramid, 0, unit_pyramid.size, BLOCK);
  damage(0, 0, (uint32_t)(unit_triangle.size / BLOCK));
  CHECK_IS(starcat_start_image(&slots, &image), STARCAT_E_CRC); /* the other one is whole */
  CHECK_IS(slots.active, 0);
  CHECK_IS(starcat_accept_image(&slots, 1, crc_of(&unit_pyramid) ^ 1u), STARCAT_OK);
  CHECK_IS(starcat_start_image(&slots, &image), STARCAT_E_CRC); /* another one was accepted */
  CHECK_IS(starcat_accept_image(&slots, 1, crc_of(&unit_pyramid)), STARCAT_OK);
  CHECK_IS(starcat_refuse_image(&slots, 1), STARCAT_OK);
  CHECK_IS(slots.size[1], 0);
  CHECK_IS(starcat_start_image(&slots, &image), STARCAT_E_CRC);
  CHECK_IS(starcat_accept_image(&slots, 1, crc_of(&unit_pyramid)), STARCAT_E_LAYOUT);
  slots.size[1] = unit_pyramid.size;
  CHECK_IS(starcat_accept_image(&slots, 1, crc_of(&unit_pyramid)), STARCAT_OK);
  CHECK_IS(starcat_start_image(&slots, &image), STARCAT_OK);
  CHECK_IS(slots.active, 1);
  CHECK_IS(starcat_accept_image(NULL, 0, 0), STARCAT_E_NULL);
  CHECK_IS(starcat_accept_image(&slots, 2, 0), STARCAT_E_OPTIONS);
  CHECK_IS(starcat_refuse_image(NULL, 0), STARCAT_E_NULL);
  CHECK_IS(starcat_refuse_image(&slots, 2), STARCAT_E_OPTIONS);
}

/* Blocks and groups one by one, as idle time takes them. */
static void check_parts(void) {
  const uint32_t n_blocks = (uint32_t)(unit_triangle.size / BLOCK);
  const size_t size = unit_triangle.size;
  fill_both();
  CHECK_IS(starcat_check_blocks(&slots, 0, 0, n_blocks, &block), STARCAT_OK);
  damage(0, 3, 1);
  CHECK_IS(starcat_check_blocks(&slots, 0, 0, 4, &block), STARCAT_OK); /* places 0 to 3 */
  CHECK_IS(starcat_check_blocks(&slots, 0, 4, 1, &block), STARCAT_E_CRC);
  CHECK_IS(block, 3);
  CHECK_IS(starcat_check_parity(words[0], size,
                                3u % (uint32_t)(starcat_count_parity_bytes(size) / BLOCK)),
           STARCAT_E_CRC);
  CHECK_IS(starcat_mend_block(words[0], size, 3), STARCAT_OK);
  CHECK_IS(starcat_mend_block(words[0], size, 3), STARCAT_OK);
  CHECK(memcmp(words[0], unit_triangle.bytes, size) == 0);
  CHECK_IS(starcat_check_parity(words[0], size, 0), STARCAT_OK);
  damage(0, n_blocks, 1);
  CHECK_IS(starcat_check_parity(words[0], size, 0), STARCAT_E_CRC);
  CHECK_IS(starcat_write_parity(words[0], size, 0), STARCAT_OK);
  CHECK_IS(starcat_check_parity(words[0], size, 0), STARCAT_OK);
  slots.crc[0] ^= 1u;
  CHECK_IS(starcat_check_blocks(&slots, 0, 0, 1, &block), STARCAT_INCOMPLETE);
  CHECK_IS(block, n_blocks - 1u);
  slots.size[0] = 0;
  CHECK_IS(starcat_check_blocks(&slots, 0, 0, 1, &block), STARCAT_E_LAYOUT);
  slots.size[1] = slots.capacity + BLOCK;
  CHECK_IS(starcat_find_missing_block(&slots, 0, &block), STARCAT_E_LAYOUT);
  CHECK_IS(starcat_check_blocks(NULL, 0, 0, 1, &block), STARCAT_E_NULL);
  CHECK_IS(starcat_check_blocks(&slots, 0, 0, 1, NULL), STARCAT_E_NULL);
  CHECK_IS(starcat_mend_block(NULL, size, 0), STARCAT_E_NULL);
  CHECK_IS(starcat_mend_block(words[0], size, n_blocks), STARCAT_E_OPTIONS);
  CHECK_IS(starcat_check_parity(NULL, size, 0), STARCAT_E_NULL);
  CHECK_IS(starcat_check_parity(words[0], size, n_blocks), STARCAT_E_OPTIONS);
  CHECK_IS(starcat_write_parity(words[0], BLOCK, 0), STARCAT_E_LAYOUT);
  CHECK_IS(starcat_write_parity(words[0], size, n_blocks), STARCAT_E_OPTIONS);
}

/* The calls of a patch in parts, when they are misused. */
static void check_patch_parts(void) {
  starcat_patching work;
  begin();
  patch_all();
  seal_patch();
  CHECK_IS(starcat_begin_patch(&slots, patch_words, patch.size, NULL), STARCAT_E_NULL);
  CHECK_IS(starcat_begin_patch(&slots, patch_words, patch.size, &work), STARCAT_OK);
  CHECK_IS(starcat_check_patch(NULL, 0), STARCAT_E_NULL);
  starcat_status checked = STARCAT_INCOMPLETE;
  for (uint32_t n = 0; (n < 1000u) && (checked == STARCAT_INCOMPLETE);
       n++) { /* small parts, large */
    checked = starcat_check_patch(&work, n % 2u == 0u ? 1u : 2u * BLOCK);
  }
  CHECK_IS(checked, STARCAT_OK);
  CHECK_IS(starcat_run_patch(NULL, &work, 0), STARCAT_E_NULL);
  CHECK_IS(starcat_run_patch(&slots, NULL, 0), STARCAT_E_NULL);
  CHECK_IS(starcat_run_patch(&slots, &work, 0), STARCAT_E_OPTIONS); /* nothing is received */
  CHECK_IS(starcat_receive_image(&slots, work.made_bytes, 0), STARCAT_OK);
  slots.acceptance[1] = STARCAT_ACCEPTED;
  CHECK_IS(starcat_run_patch(&slots, &work, 0), STARCAT_E_OPTIONS);
  slots.acceptance[1] = 0;
  CHECK_IS(starcat_run_patch(&slots, &work, 0), STARCAT_INCOMPLETE);
  slots.active = 1;
  CHECK_IS(starcat_run_patch(&slots, &work, 0), STARCAT_E_OPTIONS);
  memset(&work, 0, sizeof work);
  CHECK_IS(starcat_check_patch(&work, 0), STARCAT_E_LAYOUT);
}

/* The record of the slots: a store that is cut at any byte leaves the record before it. */
static void check_record(void) {
  uint8_t stored[2][STARCAT_RECORD_BYTES], record[STARCAT_RECORD_BYTES], kept;
  starcat_slots read;
  uint32_t place = 0, cut_place = 0;
  fill_both();
  memset(stored, 0xff, sizeof stored);
  CHECK_IS(starcat_read_record(&read, stored[0], stored[1]), STARCAT_E_CRC);
  slots.sequence = 0xfffffff0u; /* it passes its largest number */
  for (uint32_t n = 0; n < 40u; n++) {
    slots.active = n % 2u;
    slots.crc[0] = n;
    slots.acceptance[1] = n % 3u == 0u ? STARCAT_ACCEPTED : 0u;
    CHECK_IS(starcat_write_record(&slots, record, &place), STARCAT_OK);
    CHECK((n == 0u) || (place == 1u - cut_place));
    cut_place = place;
    for (size_t cut = 0; cut <= sizeof record; cut++) {
      memcpy(stored[place], record, cut);
      memset(&read, 0, sizeof read);
      if (cut == sizeof record) {
        CHECK_IS(starcat_read_record(&read, stored[0], stored[1]), STARCAT_OK);
        CHECK_IS(read.crc[0], n);
      } else if (n > 0u) { /* the first record has none before it */
        CHECK_IS(starcat_read_record(&read, stored[0], stored[1]), STARCAT_OK);
        CHECK((read.crc[0] == n - 1u) || (memcmp(stored[place], record, sizeof record) == 0));
      } else {
        CHECK_IS(starcat_read_record(&read, stored[0], stored[1]), STARCAT_E_CRC);
      }
    }
    CHECK_IS(read.active, slots.active);
    CHECK_IS(read.size[1], unit_pyramid.size);
    CHECK_IS(read.acceptance[1], slots.acceptance[1]);
    CHECK_IS(read.sequence, slots.sequence);
  }
  for (size_t at = 0; at < 8u * sizeof record; at++) { /* no flipped bit is taken for a record */
    kept = stored[place][at / 8u];
    stored[place][at / 8u] = (uint8_t)(kept ^ (1u << (at % 8u)));
    CHECK_IS(starcat_read_record(&read, stored[0], stored[1]), STARCAT_OK);
    CHECK_IS(read.crc[0], 38);
    stored[place][at / 8u] = kept;
  }
  CHECK_IS(starcat_write_record(NULL, record, &place), STARCAT_E_NULL);
  CHECK_IS(starcat_write_record(&slots, NULL, &place), STARCAT_E_NULL);
  CHECK_IS(starcat_write_record(&slots, record, NULL), STARCAT_E_NULL);
  CHECK_IS(starcat_read_record(NULL, record, record), STARCAT_E_NULL);
  CHECK_IS(starcat_read_record(&read, NULL, record), STARCAT_E_NULL);
  CHECK_IS(starcat_read_record(&read, record, NULL), STARCAT_E_NULL);
}

void test_update(void) {
  test_pieces();
  check_update_errors();
  check_acceptance();
  test_parity();
  check_parts();
  check_record();
  check_steps();
  check_damaged_patches();
  check_patch_parts();
  check_patch_of_session();
  check_patch_is_refused();
  check_patches_refused_late();
  check_refused();
}
