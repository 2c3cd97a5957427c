/* Vectors of three numbers, and angles between unit vectors; inline, as every loop needs them.
 *
 * SPDX-License-Identifier: MIT
 */
#ifndef STARCAT_VECTORS_H
#define STARCAT_VECTORS_H

#include "starcat.h"
#include "starcat_math.h"

typedef starcat_real real;

#define R(number) ((real)(number))

/* Whether a number is in a closed range. */
static inline int starcat_is_between(real x, real low, real high) {
  return (x >= low) && (x <= high);
}

static inline real starcat_larger(real a, real b) { return a > b ? a : b; }
static inline real starcat_smaller(real a, real b) { return a < b ? a : b; }
static inline real starcat_absolute(real x) { return x < R(0.0) ? -x : x; }

static inline real starcat_dot(const real a[3], const real b[3]) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

static inline void starcat_cross(const real a[3], const real b[3], real c[3]) {
  c[0] = a[1] * b[2] - a[2] * b[1];
  c[1] = a[2] * b[0] - a[0] * b[2];
  c[2] = a[0] * b[1] - a[1] * b[0];
}

/* body = m * icrs */
static inline void starcat_turn(const real m[9], const real icrs[3], real body[3]) {
  body[0] = starcat_dot(m, icrs);
  body[1] = starcat_dot(m + 3, icrs);
  body[2] = starcat_dot(m + 6, icrs);
}

static inline real starcat_chord_square(const real a[3], const real b[3]) {
  const real x = a[0] - b[0], y = a[1] - b[1], z = a[2] - b[2];
  return x * x + y * y + z * z;
}

/* The angle between two unit vectors from the square of their distance. Below 17 degrees the
 * series of the arcsine is exact to 1e-12 of the angle. */
static inline real starcat_angle_of_chord(real square) {
  const real s = R(0.25) * square;
  const real half = STARCAT_SQRT(s);
  if (s < R(0.0225)) {
    return R(2.0) * half *
           (R(1.0) + s * (R(1.0 / 6.0) +
                          s * (R(3.0 / 40.0) +
                               s * (R(15.0 / 336.0) +
                                    s * (R(105.0 / 3456.0) +
                                         s * (R(945.0 / 42240.0) + s * R(10395.0 / 599040.0)))))));
  }
  return R(2.0) * STARCAT_ATAN2(half, STARCAT_SQRT(s < R(1.0) ? R(1.0) - s : R(0.0)));
}

/* The distance between two unit vectors at a given angle; 0 for negative angles. */
static inline real starcat_chord_of_angle(real angle_rad) {
  return angle_rad > R(0.0) ? R(2.0) * STARCAT_SIN(R(0.5) * angle_rad) : R(0.0);
}

#endif
