"""QUEST: Wahba's problem by other means than the package's, which it is compared with."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def solve_wahba_quest(body: Array, icrs: Array, weights: Array | None = None) -> Array:
    """Return the quaternion that best turns reference directions into observed ones.

    The check of `solve_wahba_svd` by other means: the largest eigenvalue of Davenport's matrix
    by Newton's method, its eigenvector from the cofactors.

    Parameters
    ----------
    body, icrs : ndarray of float64, shape (N, 3)
        Observed directions in the camera frame and their stars' ICRS directions, N >= 2.
    weights : ndarray of float64, shape (N,), optional
        Non-negative; 1 each by default.

    Returns
    -------
    ndarray of float64, shape (4,)
        ``q_body_from_icrs``, unit, scalar last, ``w >= 0``.

    Notes
    -----
    The eigenvector is the longest column of the adjugate of ``K - lambda I``, which has no
    singular attitude, so no rotated frames are tried as in the original.

    References
    ----------
    Shuster and Oh 1981, "Three-axis attitude determination from vector observations".
    """
    weight = np.ones(len(body)) if weights is None else weights
    b = (body * weight[:, None]).T @ icrs
    z = np.array([b[1, 2] - b[2, 1], b[2, 0] - b[0, 2], b[0, 1] - b[1, 0]])
    k = np.empty((4, 4))
    k[:3, :3] = b + b.T - np.trace(b) * np.eye(3)
    k[:3, 3] = k[3, :3] = z
    k[3, 3] = np.trace(b)
    largest = _largest_eigenvalue(b + b.T, z, float(weight.sum()))
    q = _eigenvector(k, largest)
    # The equation's coefficients lose digits for stars close together; the quotient does not.
    q = _eigenvector(k, float(q @ k @ q))
    return -q if q[3] < 0.0 else q


def _eigenvector(k: Array, eigenvalue: float) -> Array:
    """Return the unit eigenvector of a symmetric matrix: the longest column of cofactors."""
    cofactors = _adjugate(k - eigenvalue * np.eye(len(k)))
    q = cofactors[:, np.argmax(np.einsum("ij,ij->j", cofactors, cofactors))]
    return np.asarray(q / np.sqrt(q @ q))


def _largest_eigenvalue(s: Array, z: Array, start: float) -> float:
    """Return the largest root of the characteristic equation of Davenport's matrix."""
    half = 0.5 * np.trace(s)
    adjoint_trace = 0.5 * (np.trace(s) ** 2 - np.trace(s @ s))
    a, b = half**2 - adjoint_trace, half**2 + z @ z
    c, d = np.linalg.det(s) + z @ s @ z, z @ s @ s @ z
    root = start
    for _ in range(50):
        value = ((root * root - (a + b)) * root - c) * root + (a * b + c * half - d)
        step = value / ((4.0 * root * root - 2.0 * (a + b)) * root - c)
        root -= step
        if abs(step) <= 1e-16 * start:
            break
    return float(root)


def _adjugate(matrix: Array) -> Array:
    """Return the transposed cofactors of a symmetric matrix."""
    size = len(matrix)
    rest = [np.delete(np.arange(size), n) for n in range(size)]
    return np.array(
        [
            [(-1) ** (i + j) * np.linalg.det(matrix[np.ix_(rest[i], rest[j])]) for j in range(size)]
            for i in range(size)
        ]
    )
