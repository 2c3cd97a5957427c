/* Numbers and bytes that may be anything, as Frama-C's Eva takes them.
 *
 * SPDX-License-Identifier: MIT
 */
#ifndef STARCAT_PROOF_H
#define STARCAT_PROOF_H

#include "__fc_builtin.h"
#include "math.h"
#include "internal.h"

#define make_any(memory, count) Frama_C_make_unknown((char *)(memory), (count))
#define any(low, high) Frama_C_interval((low), (high))

static inline uint32_t any_u32(void) { return Frama_C_unsigned_int_interval(0u, UINT32_MAX); }
static inline size_t any_size(void) { return Frama_C_unsigned_long_interval(0u, SIZE_MAX); }

/* Any number, including infinities and NaN. */
static inline real any_real(void) {
  real number;
  make_any(&number, sizeof number);
  return number;
}

/* Any number of a range. */
static inline real any_from(real low, real high) { return Frama_C_double_interval(low, high); }

#endif
