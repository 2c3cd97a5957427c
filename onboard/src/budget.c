/* The steps that a call may take, and the effort of its triangles.
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

/* Count the effort of looking up a triangle (`before`: compared with the limit first), or of trying
 * a candidate (`after`: compared with the limit at the next call). Unlike steps, the effort does not
 * depend on the implementation, so the matcher on the ground ends at the same candidate.
 * Returns 0 if the limit is reached; the limit is 0 from then on. */
int starcat_spend_effort(const starcat_call *call, uint32_t before, uint32_t after) {
  if (call->own->effort + before >= call->own->most_effort) {
    call->own->most_effort = 0;
    return 0;
  }
  call->own->effort += before + after;
  return 1;
}
