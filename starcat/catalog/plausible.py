"""What holds for every star that is kept, whichever archive it comes from.

The readers leave out fields that their archive's layout does not allow. What a catalog module
makes of the fields is checked here once for all catalogs: a position and its epoch, a proper
motion and a magnitude that a star can have, and a number that fits its column.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from starcat.catalog.stars import StarBlock, Values
from starcat.catalog.verdict import Reason

PLAUSIBLE = {
    "star_id": (-(2.0**63), 2.0**63 - 1024.0),
    "ra_deg": (0.0, 360.0),
    "dec_deg": (-90.0, 90.0),
    "epoch_jyear": (1800.0, 2200.0),
    "pm_ra_cosdec_mas_yr": (-100_000.0, 100_000.0),
    "pm_dec_mas_yr": (-100_000.0, 100_000.0),
    "mag": (-30.0, 100.0),
    "second_mag": (-30.0, 100.0),
}
"""Least and greatest value of the columns of a star, both included. Barnard's star, the fastest
that is known, moves 10,400 mas/yr."""

_NEEDED = ("ra_deg", "dec_deg", "epoch_jyear")


def without_impossible(block: StarBlock) -> StarBlock:
    """Reject the records without a position, or with values that no star can have."""
    values = {name: _numbers(block.columns, name) for name in PLAUSIBLE if name in block.columns}
    for name in _NEEDED:
        block.verdicts.reject(np.isnan(values[name]), Reason.no_position)
    for name, found in values.items():
        least, greatest = PLAUSIBLE[name]
        block.verdicts.reject((found < least) | (found > greatest), Reason.impossible_value)
    ra_deg = np.where(values["ra_deg"] == 360.0, 0.0, values["ra_deg"])
    return replace(block, columns={**block.columns, "ra_deg": ra_deg})


def _numbers(columns: Mapping[str, Values], name: str) -> NDArray[np.float64]:
    return np.asarray(columns[name], dtype=np.float64)
