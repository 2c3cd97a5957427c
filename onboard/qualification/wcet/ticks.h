/* Idle work and the calls of a whole image, measured on a simulated processor.
 *
 * SPDX-License-Identifier: MIT
 */
#ifndef STARCAT_WCET_TICKS_H
#define STARCAT_WCET_TICKS_H

#include <stddef.h>

/* Do all the work of idle time with an image, and print the longest tick of each kind of work:
 *
 *   tick KIND instructions
 *
 * then each call of a whole image, "whole NAME instructions blocks: NUMBER". Returns 0 if an event
 * did not come. */
int measure_ticks(const void *image, size_t size);

#endif
