/* Functions of numbers: whether they are finite, factorials, exponentials.
 *
 * SPDX-License-Identifier: MIT
 */
#include "internal.h"

/* Exponent bits in the first two bytes of a number: all set if it is infinite or not a number. */
#ifdef STARCAT_SINGLE
#define EXPONENT 0x7f80u
#else
#define EXPONENT 0x7ff0u
#endif

/* Whether a number is finite, judged by its exponent bits: a processor can trap if NaN is compared
 * or subtracted. */
int starcat_is_finite(const real *number) {
  const uint8_t *bytes = (const uint8_t *)(const void *)number;
  const uint16_t one = 1;
  const size_t is_little = *(const uint8_t *)(const void *)&one;
  const uint32_t first = bytes[is_little * (sizeof(real) - 1u)];
  const uint32_t second = bytes[1u + is_little * (sizeof(real) - 3u)];
  return ((first << 8 | second) & EXPONENT) != EXPONENT;
}

int starcat_are_finite(const real *numbers, uint32_t count) {
  int finite = 1;
  for (uint32_t n = 0; n < count; n++) {
    finite &= starcat_is_finite(numbers + n);
  }
  return finite;
}

/* Logarithm of a factorial, from 8 on by Stirling's series. */
real starcat_log_factorial(uint32_t n) {
  static const real table[8] = {R(0.0),
                                R(0.0),
                                R(0.69314718055994530942),
                                R(1.7917594692280550008),
                                R(3.1780538303479456197),
                                R(4.7874917427820459943),
                                R(6.5792512120101009951),
                                R(8.5251613610654143002)};
  if (n < 8u) {
    return table[n];
  }
  const real x = (real)n, inverse = R(1.0) / x, square = inverse * inverse;
  return (x + R(0.5)) * STARCAT_LOG(x) - x + R(0.91893853320467274178) +
         inverse * (R(1.0 / 12.0) -
                    square * (R(1.0 / 360.0) - square * (R(1.0 / 1260.0) - square * R(1.0 / 1680.0))));
}

/* Exponential of a number from -1 to 20, without another function of libm. */
real starcat_exponential(real x) {
  const real y = x * R(1.0 / 256.0);
  real power =
      R(1.0) +
      y * (R(1.0) + y * (R(0.5) + y * (R(1.0 / 6.0) + y * (R(1.0 / 24.0) + y * R(1.0 / 120.0)))));
  for (uint32_t n = 0; n < 8u; n++) {
    power *= power;
  }
  return power;
}
