/* What frames reach seldom or never: the branches behind rare numbers.
 *
 * SPDX-License-Identifier: MIT
 */
#include "internal.h"
#include "unit.h"

void test_rare(void) {
  CHECK(1);
}
