/* The steps that a call may take.
 *
 * SPDX-License-Identifier: MIT
 */
#include "internal.h"

/* Subtract steps from the remaining budget. Returns 0 if the budget is used up. */
int starcat_spend_steps(const starcat_call *call, uint32_t steps) {
  if (steps >= call->own->steps_left) {
    call->own->steps_left = 0;
    return 0;
  }
  call->own->steps_left -= steps;
  return 1;
}
