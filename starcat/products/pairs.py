"""Star pairs by separation, with a K-vector over it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array
from starcat.geometry.kvector import KVector, build_kvector
from starcat.geometry.proximity import pairs_within
from starcat.products.index import Index, kvector_index


@dataclass(frozen=True)
class StarPairs:
    """All pairs of stars within a range of separations."""

    # i, j: shape (M,): rows of the star table, i < j
    i: NDArray[np.int32]
    j: NDArray[np.int32]
    # over the separations, radians; ``kvector.values`` are the separations themselves, ascending,
    # equal ones in order of (i, j)
    kvector: KVector

    @property
    def index(self) -> Index:
        """The K-vector as the database holds it."""
        return kvector_index(self.kvector)

    @property
    def separation_rad(self) -> Array:
        """Separations in radians, ascending, shape (M,)."""
        return self.kvector.values


def find_pairs(
    directions: Array, min_separation_rad: float, max_separation_rad: float
) -> StarPairs:
    """Find all pairs of stars whose separation lies in a range.

    The interval is closed; the rows are sorted by (separation, i, j).
    """
    found, angle = pairs_within(directions, max_separation_rad)
    far = angle >= min_separation_rad
    found, angle = found[far].astype(np.int32), angle[far]
    order = np.argsort(angle)
    if bool(np.any(np.diff(angle[order]) == 0.0)):
        # The pairs come in order of (i, j), which a stable sort keeps for equal separations.
        order = np.argsort(angle, kind="stable")
    i, j = found[order, 0], found[order, 1]
    return StarPairs(i, j, build_kvector(angle[order]))
