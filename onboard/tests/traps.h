/* Floating-point exceptions except inexact and underflow stop the program, as on many flight
 * computers. If a processor has no traps, traps_seen() reports the exceptions afterwards.
 *
 * SPDX-License-Identifier: MIT
 */
#ifndef STARCAT_TESTS_TRAPS_H
#define STARCAT_TESTS_TRAPS_H

#include <fenv.h>
#include <stdlib.h>

#define TRAPS (FE_INVALID | FE_DIVBYZERO | FE_OVERFLOW)

#ifdef __GLIBC__
int feenableexcept(int exceptions); /* of the GNU C library; hidden by -std=c99 */
int fedisableexcept(int exceptions);
#endif

static inline void traps_on(void) {
  (void)feclearexcept(TRAPS);
#ifdef __GLIBC__
  (void)feenableexcept(TRAPS);
#endif
}

/* The exceptions since then. */
static inline int traps_seen(void) { return fetestexcept(TRAPS); }

static inline void traps_off(void) {
#ifdef __GLIBC__
  (void)fedisableexcept(TRAPS);
#endif
  if (traps_seen() != 0) {
    abort();
  }
}

#endif
