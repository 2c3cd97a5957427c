/* Code that both fuzzers share: it takes bytes of the fuzzer in turn, and checks the rules that
 * every answer must obey.
 *
 * SPDX-License-Identifier: MIT
 */
#ifndef STARCAT_TESTS_FUZZ_H
#define STARCAT_TESTS_FUZZ_H

#include <stdlib.h>
#include <string.h>

#include "random_sky.h"
#include "traps.h"

typedef struct {
  const uint8_t *at;
  size_t left;
} fuzz_bytes;

/* Copy the next bytes; copy zeros if none are left. */
static inline void fuzz_take(fuzz_bytes *bytes, void *into, size_t count) {
  const size_t given = count < bytes->left ? count : bytes->left;
  memset(into, 0, count);
  if (given > 0u) {
    memcpy(into, bytes->at, given);
    bytes->at += given;
    bytes->left -= given;
  }
}

static inline uint32_t fuzz_number(fuzz_bytes *bytes, size_t count) {
  uint8_t taken[4];
  fuzz_take(bytes, taken, count);
  uint32_t number = 0;
  for (size_t n = 0; n < count; n++) {
    number = number << 8 | taken[n];
  }
  return number;
}

/* Stop the fuzzer if an answer breaks a promise of starcat.h. */
static inline void fuzz_check(const starcat_image *image, const starcat_options *options,
                              const starcat_frame *frame, starcat_status status,
                              const starcat_result *result) {
  if (result->steps > options->max_steps) {
    abort();
  }
  if (status == STARCAT_IDENTIFIED) {
    const starcat_real *q = result->q_body_from_icrs;
    const double square = (double)(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    uint32_t matched = 0;
    for (uint32_t i = 0; i < frame->count; i++) {
      const int32_t star = result->star[i];
      if ((star < STARCAT_DROPPED_DUPLICATE) || (star >= (int32_t)image->n_stars)) {
        abort();
      }
      for (uint32_t k = 0; k < i; k++) {
        if ((star >= 0) && (result->star[k] == star)) {
          abort(); /* one star is two centroids */
        }
      }
      matched += (uint32_t)(star >= 0);
    }
    if ((matched != result->n_matched) || (matched < 4u) || !(q[3] >= (starcat_real)0.0) ||
        !(square > 0.999) || !(square < 1.001) || !(result->log_chance <= options->log_chance)) {
      abort();
    }
  }
}

#endif
