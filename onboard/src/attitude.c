/* Attitudes from pairs of directions: Wahba's problem.
 *
 * SPDX-License-Identifier: MIT
 */
#include "internal.h"

/* The attitude that rotates a1 to b1 and a2 to b2 with equal errors: it rotates the direction between
 * the two, and the plane of both, exactly (TRIAD of these; Black 1964). Returns 0 if two directions
 * coincide. */
int starcat_fit_triad(const real b1[3], const real b2[3], const real a1[3], const real a2[3],
                      real m[9]) {
  real bn[3], an[3], bt[3], at[3], bs[3], as[3];
  starcat_cross(b1, b2, bn);
  starcat_cross(a1, a2, an);
  const real b = starcat_dot(bn, bn), a = starcat_dot(an, an);
  if (!(b > R(1e-14)) || !(a > R(1e-14))) {
    return 0;
  }
  for (uint32_t i = 0; i < 3u; i++) {
    bs[i] = b1[i] + b2[i];
    as[i] = a1[i] + a2[i];
  }
  const real scale = R(1.0) / STARCAT_SQRT(a * b);
  const real between = R(1.0) / STARCAT_SQRT(starcat_dot(bs, bs) * starcat_dot(as, as));
  starcat_cross(bn, bs, bt);
  starcat_cross(an, as, at);
  for (uint32_t i = 0; i < 3u; i++) {
    for (uint32_t j = 0; j < 3u; j++) {
      m[3u * i + j] = between * (bs[i] * as[j] + scale * bt[i] * at[j]) + scale * bn[i] * an[j];
    }
  }
  return 1;
}

/* Solve a symmetric system of three: m is xx, xy, xz, yy, yz, zz, and so is its inverse.
 * Returns 0 if the matrix is not positive definite. */
int starcat_solve_symmetric(const real m[6], const real v[3], real x[3], real inverse[6]) {
  const real xx = m[3] * m[5] - m[4] * m[4];
  const real xy = m[2] * m[4] - m[1] * m[5];
  const real xz = m[1] * m[4] - m[2] * m[3];
  const real determinant = m[0] * xx + m[1] * xy + m[2] * xz;
  if (!(determinant > STARCAT_LEAST_DETERMINANT)) {
    return 0;
  }
  const real scale = R(1.0) / determinant;
  inverse[0] = xx * scale;
  inverse[1] = xy * scale;
  inverse[2] = xz * scale;
  inverse[3] = (m[0] * m[5] - m[2] * m[2]) * scale;
  inverse[4] = (m[1] * m[2] - m[0] * m[4]) * scale;
  inverse[5] = (m[0] * m[3] - m[1] * m[1]) * scale;
  x[0] = inverse[0] * v[0] + inverse[1] * v[1] + inverse[2] * v[2];
  x[1] = inverse[1] * v[0] + inverse[3] * v[1] + inverse[4] * v[2];
  x[2] = inverse[2] * v[0] + inverse[4] * v[1] + inverse[5] * v[2];
  return 1;
}

/* Rotate an attitude by the small angles w about the camera's axes (Cayley's rotation). */
void starcat_turn_matrix(real m[9], const real w[3]) {
  const real h[3] = {R(0.5) * w[0], R(0.5) * w[1], R(0.5) * w[2]};
  const real scale = R(2.0) / (R(1.0) + starcat_dot(h, h));
  for (uint32_t k = 0; k < 3u; k++) {
    const real v[3] = {m[k], m[k + 3u], m[k + 6u]};
    real first[3], second[3];
    starcat_cross(h, v, first);
    starcat_cross(h, first, second);
    m[k] += scale * (first[0] + second[0]);
    m[k + 3u] += scale * (first[1] + second[1]);
    m[k + 6u] += scale * (first[2] + second[2]);
  }
}

/* Refine an attitude on pairs of directions to the least-squares optimum: Newton's method on
 * Wahba's loss, each step of which squares the error. body[i] belongs to icrs[which[i]], or to
 * icrs[i] if `which` is null; all weights are equal if `weight` is null. It computes with
 * differences of directions, so that narrow fields lose no digits. */
void starcat_refine_attitude(real m[9], const real *body, const real *icrs, const uint16_t *which,
                             const real *weight, uint32_t count, uint32_t most) {
  for (uint32_t step = 0; step < most; step++) {
    real h[6] = {0}, g[3] = {0}, w[3], inverse[6];
    for (uint32_t i = 0; i < count; i++) {
      const real *b = body + 3u * i;
      const real v = weight != NULL ? weight[i] : R(1.0);
      real a[3], e[3], c[3];
      starcat_turn(m, icrs + 3u * (which != NULL ? which[i] : i), a);
      e[0] = b[0] - a[0];
      e[1] = b[1] - a[1];
      e[2] = b[2] - a[2];
      starcat_cross(a, e, c);
      const real d = starcat_dot(a, b), half = R(0.5) * v;
      g[0] += v * c[0];
      g[1] += v * c[1];
      g[2] += v * c[2];
      h[0] += v * (d - a[0] * b[0]);
      h[1] -= half * (a[0] * b[1] + a[1] * b[0]);
      h[2] -= half * (a[0] * b[2] + a[2] * b[0]);
      h[3] += v * (d - a[1] * b[1]);
      h[4] -= half * (a[1] * b[2] + a[2] * b[1]);
      h[5] += v * (d - a[2] * b[2]);
    }
    if (!starcat_solve_symmetric(h, g, w, inverse)) {
      return;
    }
    starcat_turn_matrix(m, w);
    if (starcat_dot(w, w) < R(1e-12)) {
      return;
    }
  }
}

/* Quaternion of a rotation matrix; the largest component first (Shepperd 1978). */
void starcat_make_quaternion(const real m[9], real q[4]) {
  const real trace = m[0] + m[4] + m[8];
  uint32_t i = 0;
  real largest = m[0];
  if (m[4] > largest) {
    largest = m[4];
    i = 1;
  }
  if (m[8] > largest) {
    largest = m[8];
    i = 2;
  }
  if (trace >= largest) {
    q[0] = m[5] - m[7];
    q[1] = m[6] - m[2];
    q[2] = m[1] - m[3];
    q[3] = R(1.0) + trace;
  } else {
    const uint32_t j = (i + 1u) % 3u, k = (i + 2u) % 3u;
    q[i] = R(1.0) - trace + R(2.0) * m[4u * i];
    q[j] = m[3u * j + i] + m[3u * i + j];
    q[k] = m[3u * k + i] + m[3u * i + k];
    q[3] = m[3u * j + k] - m[3u * k + j];
  }
  real scale = R(1.0) / STARCAT_SQRT(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  if (q[3] < R(0.0)) {
    scale = -scale;
  }
  for (uint32_t n = 0; n < 4u; n++) {
    q[n] *= scale;
  }
}

/* Rotation matrix of a unit quaternion. */
void starcat_make_matrix(const real q[4], real m[9]) {
  const real x = q[0], y = q[1], z = q[2], w = q[3];
  m[0] = R(1.0) - R(2.0) * (y * y + z * z);
  m[1] = R(2.0) * (x * y + z * w);
  m[2] = R(2.0) * (x * z - y * w);
  m[3] = R(2.0) * (x * y - z * w);
  m[4] = R(1.0) - R(2.0) * (x * x + z * z);
  m[5] = R(2.0) * (y * z + x * w);
  m[6] = R(2.0) * (x * z + y * w);
  m[7] = R(2.0) * (y * z - x * w);
  m[8] = R(1.0) - R(2.0) * (x * x + y * y);
}

static int is_direction(const real v[3]) {
  return starcat_are_finite(v, 3) && (starcat_absolute(v[0]) <= R(2.0)) &&
         (starcat_absolute(v[1]) <= R(2.0)) && (starcat_absolute(v[2]) <= R(2.0));
}

/* How well two pairs determine an attitude: the sine of the angle between their directions. */
static real spread(const real (*v)[3], uint32_t i, uint32_t j) {
  real normal[3];
  starcat_cross(v[i], v[j], normal);
  return starcat_dot(normal, normal);
}

starcat_status starcat_fit_attitude(const starcat_real (*body)[3], const starcat_real (*icrs)[3],
                                    uint32_t count, starcat_real q_body_from_icrs[4]) {
  real m[9], widest = R(0.0);
  uint32_t second = 0;
  if ((body == NULL) || (icrs == NULL) || (q_body_from_icrs == NULL)) {
    return STARCAT_E_NULL;
  }
  for (uint32_t i = 0; i < count; i++) {
    if (!is_direction(body[i]) || !is_direction(icrs[i])) {
      return STARCAT_E_NOT_FINITE;
    }
    const real apart = spread(body, 0, i);
    if (apart > widest) {
      widest = apart;
      second = i;
    }
  }
  if ((count < 2u) || !starcat_fit_triad(body[0], body[second], icrs[0], icrs[second], m)) {
    return STARCAT_TOO_FEW_STARS;
  }
  starcat_refine_attitude(m, &body[0][0], &icrs[0][0], NULL, NULL, count, STARCAT_STEPS_FROM_AFAR);
  starcat_make_quaternion(m, q_body_from_icrs);
  return STARCAT_OK;
}
