/* Checks that count. A failed one is printed with its place, and the program goes on.
 *
 * SPDX-License-Identifier: MIT
 */
#ifndef STARCAT_TESTS_CHECK_H
#define STARCAT_TESTS_CHECK_H

#include <math.h>
#include <stdio.h>

extern unsigned check_count, check_failures;

#define CHECK(condition)                                                            \
  do {                                                                              \
    check_count++;                                                                  \
    if (!(condition)) {                                                             \
      check_failures++;                                                             \
      (void)fprintf(stderr, "%s:%d: not so: %s\n", __FILE__, __LINE__, #condition); \
    }                                                                               \
  } while (0)

/* Compare two integers; print both if they differ. */
#define CHECK_IS(found, expected)                                                           \
  do {                                                                                      \
    const long found_ = (long)(found), expected_ = (long)(expected);                        \
    check_count++;                                                                          \
    if (found_ != expected_) {                                                              \
      check_failures++;                                                                     \
      (void)fprintf(stderr, "%s:%d: %s is %ld, not %s (%ld)\n", __FILE__, __LINE__, #found, \
                    found_, #expected, expected_);                                          \
    }                                                                                       \
  } while (0)

#define CHECK_NEAR(found, expected, error) \
  CHECK(fabs((double)(found) - (double)(expected)) <= (double)(error))

#endif
