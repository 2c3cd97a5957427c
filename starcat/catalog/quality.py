"""The bits of ``quality_flags`` in the star table, as its schema lists them."""

from __future__ import annotations

from enum import IntFlag

import numpy as np
from numpy.typing import NDArray


class Quality(IntFlag):
    """What a reader of a star's position and magnitude should know."""

    ESTIMATED_MAGNITUDE = 1
    COLOUR_OUT_OF_RANGE = 2
    SATURATED = 4
    NO_PROPER_MOTION = 8
    PHOTOCENTRE = 16
    BLENDED = 32
    POOR_PHOTOMETRY = 64
    DUBIOUS_POSITION = 128
    CONTAMINATED = 256
    MERGED = 512
    PERHAPS_NOT_A_STAR = 1024


def quality_flags(count: int, bits: dict[Quality, NDArray[np.bool_]]) -> NDArray[np.int32]:
    """Return the sum of the bits that apply to each star."""
    flags = np.zeros(count, dtype=np.int32)
    for bit, where in bits.items():
        flags |= np.where(where, np.int32(bit), np.int32(0))
    return flags
