"""Whether the stars of an image are trails: long, and all in one direction.

Input is sep's table of objects, output the length of the trails. A lens that draws long spots
draws them in different directions over the image, which is no trail.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_FEWEST, _MOST = 5, 30
_LONG = 2.5
"""Length over width from which a spot is long, by standard deviations along its axes."""
_ALIGNED = 0.9
"""Length of the mean of unit vectors with twice the angle: 1 if all are parallel."""


def trail_px(found: NDArray[Any]) -> float | None:
    """Return the length of trails."""
    bright = found[np.argsort(-found["flux"], kind="stable")[:_MOST]]
    if len(bright) < _FEWEST:
        return None
    long, wide = bright["a"].astype(np.float64), bright["b"].astype(np.float64)
    is_long = long > _LONG * np.maximum(wide, 0.3)
    if is_long.mean() <= 0.5:
        return None
    if abs(np.exp(2j * bright["theta"][is_long].astype(np.float64)).mean()) < _ALIGNED:
        return None
    # The variance of a bar along itself is a twelfth of its length squared.
    return float(np.median(np.sqrt(12.0 * (long**2 - wide**2)[is_long])))
