"""The product ``pairs``: star pairs by separation, with a K-vector over it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from starcat.arrays import Array, Directions
from starcat.database.products.index import Index, kvector_index
from starcat.database.products.kind import (
    Extent,
    ProductInputs,
    ProductKind,
    ProductSection,
    SpecFacts,
)
from starcat.geometry.kvector import KVector, build_kvector
from starcat.geometry.proximity import pairs_within


class Pairs(ProductSection):
    """Star pairs and their K-vector."""

    min_separation_deg: float = Field(
        0.0, ge=0.0, le=180.0, description="pairs that are closer are left out"
    )
    max_separation_deg: float | None = Field(
        None, ge=0.001, le=180.0, description="pairs up to here; default: the field's diagonal"
    )

    @model_validator(mode="after")
    def _limits_in_order(self) -> Pairs:
        most = self.max_separation_deg
        if most is not None and self.min_separation_deg >= most:
            raise ValueError(
                f"min_separation_deg {self.min_separation_deg} is not below max_separation_deg "
                f"{most}; swap them"
            )
        return self

    def check_agrees(self, facts: SpecFacts) -> None:
        """Check that pairs up to the field's diagonal are not all left out."""
        diagonal_deg = float(np.degrees(facts.camera.diagonal_rad))
        if self.max_separation_deg is None and self.min_separation_deg >= diagonal_deg:
            raise ValueError(
                f"products.pairs: min_separation_deg {self.min_separation_deg:g} is not below the "
                f"field's diagonal, {diagonal_deg:.4g} deg, up to which there are pairs"
            )

    def range_rad(self, inputs: ProductInputs) -> tuple[float, float]:
        """Return the smallest and the largest separation."""
        most = self.max_separation_deg
        reach = inputs.diagonal_rad if most is None else inputs.radius_rad(most)
        return float(np.radians(self.min_separation_deg)), reach


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
    directions: Directions, min_separation_rad: float, max_separation_rad: float
) -> StarPairs:
    """Find all pairs of stars whose separation lies in a range.

    The interval is closed; the rows are sorted by (separation, i, j).
    """
    pairs, angle = pairs_within(directions, max_separation_rad)
    far = angle >= min_separation_rad
    pairs, angle = pairs[far].astype(np.int32), angle[far]
    order = np.argsort(angle)
    if bool(np.any(np.diff(angle[order]) == 0.0)):
        # The pairs come in order of (i, j), which a stable sort keeps for equal separations.
        order = np.argsort(angle, kind="stable")
    i, j = pairs[order, 0], pairs[order, 1]
    return StarPairs(i, j, build_kvector(angle[order]))


def _count(inputs: ProductInputs, section: Pairs) -> Extent:
    near, (least, reach) = inputs.neighbourhoods, section.range_rad(inputs)
    # Each pair is a neighbour of either of its stars.
    rows = float(0.5 * len(inputs.directions) * (near.within(reach) - near.within(least)).mean())
    return Extent(rows, steps=0.5 * near.total(reach))


KIND = ProductKind(
    name="pairs",
    make=lambda inputs, section: find_pairs(inputs.directions, *section.range_rad(inputs)),
    section=Pairs,
    count=_count,
)
