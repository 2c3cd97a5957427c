/* From reset to main(), for a Cortex-M4F without an operating system.
 *
 * SPDX-License-Identifier: MIT
 */
#include <stdint.h>
#include <stdlib.h>

#define CPACR (*(volatile uint32_t *)0xe000ed88u) /* who may use the floating-point unit */

extern uint32_t data_from[], data_begin[], data_end[], bss_begin[], bss_end[], stack_end[];

int main(void);
void initialise_monitor_handles(void);

/* Every exception except a reset ends here: it stops the program through semihosting. */
static void stop(void) { _Exit(3); }

static void reset(void) {
  CPACR |= 0xfu << 20;
  __asm volatile("dsb\n isb");
  for (uint32_t *to = data_begin, *from = data_from; to < data_end;) {
    *to++ = *from++;
  }
  for (uint32_t *to = bss_begin; to < bss_end;) {
    *to++ = 0;
  }
  initialise_monitor_handles();
  exit(main());
}

__attribute__((section(".vectors"), used)) static const void *const VECTORS[16] = {
    stack_end,          (const void *)reset, (const void *)stop, (const void *)stop,
    (const void *)stop, (const void *)stop,  (const void *)stop};

void _init(void);
void _init(void) {}
void _fini(void);
void _fini(void) {}
