"""Attitudes: quaternions, direction-cosine matrices and Wahba's problem.

Quaternions are scalar-last ``[x, y, z, w]``, unit, ``w >= 0``. ``q_body_from_icrs`` stands for the
matrix that converts ICRS components into camera components (x right, y down, z along the
boresight): ``body = matrix @ icrs``. `matrix_from_quaternion` has the formula.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property

import numpy as np

from starcat.arrays import Array, Directions, Matrix, Rows

Quaternion = tuple[float, float, float, float]

Turn = tuple[float, float, float]

_UNIT = np.eye(3)

_SINGULAR = 1e-13
"""A matrix is singular if its smallest eigenvalue is below this fraction of the largest one."""


def matrix_from_quaternion(q: Array) -> Array:
    """Return the attitude matrix of a quaternion, which is normalised here.

    With ``v = [x, y, z]`` it is ``(w^2 - v.v) I + 2 v v^T - 2 w [v x]`` (Wertz 1978; Shuster 1993;
    Markley and Crassidis 2014), the matrix of ``scipy``'s ``Rotation.from_quat(q).inv()``.
    """
    x, y, z, w = q.tolist()
    length = math.hypot(x, y, z, w)
    x, y, z, w = x / length, y / length, z / length, w / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)],
            [2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)],
            [2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_from_matrix(matrix: Matrix) -> Array:
    """Return the quaternion of a rotation matrix, with ``w >= 0``.

    The largest of the four components is found first, so that no division is by a small
    number (Shepperd 1978).
    """
    # Plain Python numbers are faster here than numpy arrays of four.
    m = matrix.tolist()
    diagonal = [m[0][0], m[1][1], m[2][2], m[0][0] + m[1][1] + m[2][2]]
    trace, largest = diagonal[3], diagonal.index(max(diagonal))
    if largest == 3:
        q = [m[1][2] - m[2][1], m[2][0] - m[0][2], m[0][1] - m[1][0], 1.0 + trace]
    else:
        i, j, k = largest, (largest + 1) % 3, (largest + 2) % 3
        q = [0.0] * 4
        q[i] = 1.0 - trace + 2.0 * m[i][i]
        q[j] = m[j][i] + m[i][j]
        q[k] = m[k][i] + m[i][k]
        q[3] = m[j][k] - m[k][j]
    length = math.copysign(math.hypot(*q), q[3])
    return np.array([part / length for part in q])


def turn_between(q_from: Sequence[float], q_to: Sequence[float]) -> Turn:
    """Return the rotation of the camera that leads from one attitude to another.

    Axis times angle, radians about the axes of the camera frame, at most pi long.

    >>> x, y, z = turn_between((0.0, 0.0, 0.0, 1.0), (0.0, 0.0, math.sin(0.1), math.cos(0.1)))
    >>> x, y, round(z, 9)
    (0.0, 0.0, 0.2)
    """
    x, y, z, w = _quaternion_product((-q_from[0], -q_from[1], -q_from[2], q_from[3]), q_to)
    sine = math.copysign(math.hypot(x, y, z), w)
    # Small angles are taken from the vector part, because the cosine would lose their digits.
    scale = 2.0 * math.atan2(abs(sine), abs(w)) / sine if sine else 0.0
    return x * scale, y * scale, z * scale


def after_turn(q: Sequence[float], turn: Turn) -> Quaternion:
    """Return the attitude that a rotation of the camera leads to.

    >>> there = after_turn((0.5, 0.5, 0.5, 0.5), (0.1, -0.2, 0.3))
    >>> [round(part, 9) for part in turn_between((0.5, 0.5, 0.5, 0.5), there)]
    [0.1, -0.2, 0.3]
    """
    half = 0.5 * math.hypot(*turn)
    scale = 0.5 * math.sin(half) / half if half else 0.5
    x, y, z = turn
    return _quaternion_product(q, (x * scale, y * scale, z * scale, math.cos(half)))


def _quaternion_product(first: Sequence[float], second: Sequence[float]) -> Quaternion:
    (a, b, c, d), (x, y, z, w) = first, second
    return (
        d * x + a * w + b * z - c * y,
        d * y - a * z + b * w + c * x,
        d * z + a * y - b * x + c * w,
        d * w - a * x - b * y - c * z,
    )


def matrix_from_radec_roll(ra_deg: float, dec_deg: float, roll_deg: float) -> Array:
    """Return the attitude matrix of a boresight and a roll.

    Row 2 is the boresight. At roll 0 the image's up is north; positive turns the camera so that
    north moves from up towards the image's left (counter-clockwise as seen in the image).

    Looking out at the sky with north up, east is to the left, so the image's right (x) is
    west and its down (y) is south.
    """
    ra, dec, roll = np.radians([ra_deg, dec_deg, roll_deg])
    east = np.array([-np.sin(ra), np.cos(ra), 0.0])
    north = np.array([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)])
    boresight = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    c, s = np.cos(roll), np.sin(roll)
    right = -c * east - s * north
    down = s * east - c * north
    return np.array([right, down, boresight])


def radec_roll_from_matrix(matrix: Matrix) -> tuple[float, float, float]:
    """Return right ascension and declination of the boresight, and roll: degrees, 0 to 360."""
    right, _, (x, y, z) = matrix.tolist()
    level = math.hypot(x, y)
    if level == 0.0:
        # Zeros with a sign would make the right ascension at a pole 180 deg; it is 0 there.
        x, y = 0.0, 0.0
    c, s = (x / level, y / level) if level > 0.0 else (1.0, 0.0)
    east = c * right[1] - s * right[0]
    north = level * right[2] - z * (c * right[0] + s * right[1])
    angles = math.atan2(y, x), math.atan2(-north, -east)
    # A tiny negative angle modulo 360 rounds to 360 itself; the second modulo makes that 0.
    ra_deg, roll_deg = (math.degrees(angle) % 360.0 % 360.0 for angle in angles)
    return ra_deg, math.degrees(math.atan2(z, level)), roll_deg


class HasAttitude:
    """The base of what has an attitude ``matrix``: its quaternion and its angles."""

    matrix: Matrix

    @cached_property
    def q_body_from_icrs(self) -> Array:
        """Attitude [x, y, z, w], shape (4,); NaN if there is none.

        ``Rotation.from_quat(q).inv()`` of scipy converts ICRS components into camera components.
        """
        return quaternion_from_matrix(self.matrix)

    @cached_property
    def _angles(self) -> tuple[float, float, float]:
        return radec_roll_from_matrix(self.matrix)

    @property
    def boresight_ra_deg(self) -> float:
        """Right ascension of the boresight; NaN if there is no attitude."""
        return self._angles[0]

    @property
    def boresight_dec_deg(self) -> float:
        """Declination of the boresight; NaN if there is no attitude."""
        return self._angles[1]

    @property
    def roll_deg(self) -> float:
        """Roll, as `matrix_from_radec_roll` has it; NaN if there is no attitude."""
        return self._angles[2]


def solve_wahba_svd(body: Directions, icrs: Directions, weights: Array | None = None) -> Array:
    """Return the rotation that best turns reference directions into observed ones.

    Observed directions in the camera frame and their stars' ICRS directions, shape (N, 3) or,
    for K problems at once, (K, N, 3), N >= 2; weights of shape (N,) are not negative. The
    result is the proper rotation with ``body = matrix @ icrs`` in the least-squares sense.

    Markley 1988, "Attitude determination using vector observations and the SVD".
    """
    weighted = body if weights is None else body * weights[:, None]
    u, _, vt = np.linalg.svd(weighted.swapaxes(-1, -2) @ icrs)
    matrix = u @ vt
    mirrored = (determinant(matrix) if matrix.ndim == 2 else np.linalg.det(matrix)) < 0.0
    if mirrored is not False:
        u[..., 2] *= np.where(mirrored, -1.0, 1.0)[..., None]
        matrix = u @ vt
    return np.asarray(matrix)


def determinant(matrix: Matrix) -> float:
    """Return the determinant of a matrix, ten times as fast as `np.linalg.det`."""
    (a, b, c), (d, e, f), (g, h, i) = matrix.tolist()
    return float(a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g))


def information(
    directions: Array, *, with_scale: bool = False, weights: Array | None = None
) -> Array:
    """Return the information matrix of an attitude that the centroids of stars determine.

    It is ``sum(w (I - b b^T))`` over the directions b. Its inverse is the covariance of the small
    rotations of the attitude's error if w is one over the variance of a direction on each axis
    across it. Without weights this variance, the same for all directions, is the unit.

    Shuster and Oh 1981, "Three-axis attitude determination from vector observations".
    """
    if weights is not None:
        return np.asarray(weights.sum() * _UNIT - (directions.T * weights) @ directions)
    of_angles = len(directions) * _UNIT - directions.T @ directions
    if not with_scale:
        return np.asarray(of_angles)
    x, y, z = directions.T
    matrix = np.empty((4, 4))
    matrix[:3, :3] = of_angles
    # A turn d moves the direction u of a star by d x u; a longer focal length moves the direction
    # of its centroid by u_z e_z - u_z^2 u, towards the axis.
    matrix[:3, 3] = matrix[3, :3] = -float(np.vdot(y, z)), float(np.vdot(x, z)), 0.0
    matrix[3, 3] = float(np.vdot(z * z, 1.0 - z * z))
    return matrix


def information_of_groups(
    directions: Directions, group: Rows, count: int, weights: Array | None = None
) -> Array:
    """Return the `information` of many groups of directions at once.

    Parameters
    ----------
    directions : ndarray of float64, shape (M, 3)
        Unit vectors; each group can have its own frame.
    group : ndarray of int, shape (M,)
        The group of each direction, from 0.
    count : int
        Number of groups.
    weights : ndarray of float64, shape (M,), optional
        One over the variance of each direction; 1 by default.

    Returns
    -------
    ndarray of float64, shape (count, 3, 3)
        Zero for a group without directions.
    """
    matrices = np.empty((count, 3, 3))
    for (i, j), term in information_terms(directions).items():
        term = term if weights is None else term * weights
        matrices[:, i, j] = matrices[:, j, i] = np.bincount(group, term, count)
    return matrices


def information_terms(directions: Directions) -> dict[tuple[int, int], Array]:
    """Return ``I - b b^T`` of each direction by row and column, on and above the diagonal.

    The diagonal is computed as sums of squares, which keep their digits in a narrow field.
    """
    x, y, z = directions.T
    xx, yy, zz = x * x, y * y, z * z
    return {
        (0, 0): yy + zz,
        (1, 1): xx + zz,
        (2, 2): xx + yy,
        (0, 1): -x * y,
        (0, 2): -x * z,
        (1, 2): -y * z,
    }


def attitude_deviations(matrices: Array) -> Array:
    """Return the standard deviations of attitudes about the three axes from their information.

    Shape (G, 3) for matrices of shape (G, 3, 3); infinite about all axes where the directions
    determine no attitude.
    """
    eigenvalues = np.linalg.eigvalsh(matrices)
    is_determined = eigenvalues[:, 0] > _SINGULAR * eigenvalues[:, 2]
    deviations = np.full((len(matrices), 3), np.inf)
    inverse = np.linalg.inv(matrices[is_determined])
    deviations[is_determined] = np.sqrt(np.diagonal(inverse, axis1=1, axis2=2))
    return deviations


def random_attitudes(count: int, generator: np.random.Generator) -> Array:
    """Return attitudes uniform over all rotations, shape (count, 3, 3)."""
    q = generator.normal(size=(count, 4))
    return np.array([matrix_from_quaternion(row) for row in q]).reshape(count, 3, 3)
