"""Types of arrays, named after the content of a row."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Real numbers of any shape."""

Directions = NDArray[np.float64]
"""Unit vectors, ICRS unless stated otherwise, shape (N, 3)."""

Pixels = NDArray[np.float64]
"""Pixel coordinates x, y from the outer corner of the top-left pixel, shape (N, 2)."""

Matrix = NDArray[np.float64]
"""A rotation, body from ICRS unless stated otherwise, shape (3, 3)."""

Rows = NDArray[np.intp]
"""Row numbers, from 0, shape (N,)."""

Mask = NDArray[np.bool_]
"""One bool per row, shape (N,)."""

Deviations = NDArray[np.int8]
"""Differences of magnitudes in whole standard deviations, rounded down, shape (N, M)."""
