/* Counts instructions. qemu with -icount shift=0 takes a nanosecond of its own clock for each.
 *
 * SPDX-License-Identifier: MIT
 */
#ifndef STARCAT_WCET_CLOCK_H
#define STARCAT_WCET_CLOCK_H

#include <stdint.h>

#if defined(__riscv)
#define CLOCK_STEP 1u
static inline void clock_start(void) {}
static inline uint64_t clock_now(void) {
  uint64_t count;
  __asm__ volatile("csrr %0, instret" : "=r"(count));
  return count;
}
#elif defined(__arm__)
/* Timer 0 of the mps2 boards counts down at 25 MHz, once in 40 instructions; 171 s around. */
#define CLOCK_STEP 40u
#define TIMER ((volatile uint32_t *)0x40000000u)
static inline void clock_start(void) {
  TIMER[2] = 0xffffffffu; /* initial value of the countdown */
  TIMER[0] = 1u;
}
static inline uint64_t clock_now(void) { return 40u * (uint64_t)(0xffffffffu - TIMER[1]); }
#else
#define CLOCK_STEP 0u /* the host: not counted */
static inline void clock_start(void) {}
static inline uint64_t clock_now(void) { return 0; }
#endif

#endif
