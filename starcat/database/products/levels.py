"""The product ``levels``: stars and triangles for fields wider than the camera's.

A frame shows its brightest stars best, and which these are depends on how wide it is. A database
for fields of 5 to 30 deg therefore has several sets of stars and triangles, for several widths
between the two: the wider the field, the brighter and the fewer the stars. Each level is thinned
from the previous level.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from starcat.arrays import Array, Directions
from starcat.database.products.counting import count_triangles
from starcat.database.products.index import Index, Ragged
from starcat.database.products.kind import (
    Extent,
    ProductInputs,
    ProductKind,
    ProductSection,
    SpecFacts,
)
from starcat.database.products.tiling import FieldSize, FieldStars, NominalField, tile_sphere
from starcat.database.products.triangles import distinct_triangles
from starcat.sections import FieldDeg

Rows = NDArray[np.int32]

# Smallest number of boresights of a level: wide fields need fewer, but more cost nothing.
MIN_BORESIGHTS = 1000


class Levels(ProductSection):
    """Stars and triangles for fields wider than the camera's: one database for a range of them."""

    is_later = True
    has_own_fields = True

    enabled: bool = Field(False, description="whether the database has this product")
    widest_fov_x_deg: FieldDeg = Field(
        30.0, description="largest field across the width; the range begins at the camera's own"
    )
    max_ratio: float = Field(
        1.5, ge=1.1, le=2.0, description="largest ratio of the fields of neighbouring levels"
    )
    stars_per_field: int = Field(
        20, ge=4, le=10_000, description="number of stars of each field of a level, the brightest"
    )

    def widest_field_deg(self, own_deg: float) -> float:
        """Return the wide end of the range."""
        return self.widest_fov_x_deg if self.enabled else own_deg

    def check_agrees(self, facts: SpecFacts) -> None:
        """Check that the range begins at the camera's own field and its triangles."""
        own_deg = facts.camera.fov_x_deg
        if not self.enabled:
            return
        if "triangles" not in facts.enabled:
            raise ValueError(
                "products.levels: they begin where the product triangles ends; set "
                "products.triangles.enabled = true"
            )
        if self.widest_fov_x_deg <= own_deg:
            raise ValueError(
                f"products.levels: widest_fov_x_deg {self.widest_fov_x_deg:g} is not above the "
                f"camera's own field, {own_deg:.4g} deg; the camera is the narrow end of the range"
            )

    def check_fields(self, stars: int, boresights: int, size: FieldSize, max_stars: int) -> None:
        """Check the fields of all levels, each with as many stars as it may have."""
        field_stars, total, level_stars = 0.0, 0, float(stars)
        for level in self.fields(size):
            count = boresights_of_level(boresights, size, level)
            field_stars += count * level_stars * level.fov_x_deg * level.fov_y_deg / 41_253.0 * 1.6
            level_stars = min(level_stars, float(count * self.stars_per_field))
            total += count
        if max(field_stars, total) > max_stars:
            raise ValueError(
                f"the {total:,} fields of all levels may have {field_stars:,.0f} stars, limit "
                f"{max_stars:,}; use a smaller boresights.count or "
                "products.levels.stars_per_field, or a larger products.levels.max_ratio"
            )

    def fields(self, narrowest: FieldSize) -> tuple[NominalField, ...]:
        """Return the fields of the levels, the narrowest first."""
        return level_fields(narrowest, self.widest_fov_x_deg, self.max_ratio)


@dataclass(frozen=True)
class LevelRows:
    """Stars and triangles of each level, the narrowest first."""

    level: Rows  # shape (L,): 1 to L; level 0 is the camera's own field
    fov_x_deg: Array
    fov_y_deg: Array
    stars: Ragged  # rows of the star table, ascending
    # i, j, k: triangles: rows of the star table, i < j < k, in order
    i: Ragged
    j: Ragged
    k: Ragged
    index: Index


def level_fields(
    narrowest: FieldSize, widest_fov_x_deg: float, max_ratio: float
) -> tuple[NominalField, ...]:
    """Return the fields of the levels.

    The narrowest field is first. Level 0, the camera's own field, is left out; all levels have its
    proportions. The focal lengths of neighbouring levels have the same ratio, at most
    ``max_ratio``, and the widest frames are wider than the last level by that ratio too.

    A level serves frames that are as wide as its fields, or wider, up to the fields of the next
    level. Such a frame contains whole fields of the level, and their triangles. A frame that is
    narrower than the fields by a sixth can contain no triangle at all.

    >>> fields = level_fields(NominalField(10.0, 7.5), 30.0, 1.5)
    >>> [round(field.fov_x_deg, 2) for field in fields]
    [14.48, 20.91]
    """
    across, down = (
        math.tan(math.radians(0.5 * angle)) for angle in (narrowest.fov_x_deg, narrowest.fov_y_deg)
    )
    whole = math.tan(math.radians(0.5 * widest_fov_x_deg)) / across
    # A range that is exactly a number of ratios gets no further level because of rounding.
    steps = max(2, math.ceil(math.log(whole) / math.log(max_ratio) - 1e-9))
    factors = [whole ** (step / steps) for step in range(1, steps)]
    return tuple(
        NominalField(
            2.0 * math.degrees(math.atan(across * factor)),
            2.0 * math.degrees(math.atan(down * factor)),
        )
        for factor in factors
    )


def find_levels(
    directions: Directions,
    mag: Array,
    narrowest: FieldSize,
    fields: Sequence[FieldSize],
    *,
    boresights: int,
    stars_per_field: int,
    brightest: int,
) -> LevelRows:
    """Find the stars and the triangles of each level.

    ``boresights`` tile the sphere for the camera's field; a level has fewer. A star is kept if it
    is among the brightest ``stars_per_field`` of some field; the ``brightest`` stars of a field
    make its triangles. Each level is thinned from the previous level.
    """
    stars, triangles = [], []
    for level in thin_levels(directions, mag, narrowest, fields, boresights, stars_per_field):
        level_triangles, _ = distinct_triangles(level.tiled, len(level.before), brightest)
        triangles.append(level.before[level_triangles])
        stars.append(level.rows)
    i, j, k = (_ragged([level_triangles[:, n] for level_triangles in triangles]) for n in range(3))
    return LevelRows(
        np.arange(1, len(fields) + 1, dtype=np.int32),
        np.array([field.fov_x_deg for field in fields]),
        np.array([field.fov_y_deg for field in fields]),
        _ragged(stars),
        i,
        j,
        k,
        Index(),
    )


@dataclass(frozen=True)
class Level:
    """The stars of a level."""

    before: Rows  # shape (M,): rows of the star table that the level is chosen from
    tiled: FieldStars  # these in the fields of the level; its star numbers are places in ``before``
    rows: Rows  # shape (K,): rows of the star table that are left, ascending


def thin_levels(
    directions: Directions,
    mag: Array,
    narrowest: FieldSize,
    fields: Sequence[FieldSize],
    boresights: int,
    stars_per_field: int,
) -> Iterator[Level]:
    """Thin stars for each level, the narrowest first; each level starts from the previous one."""
    rows = np.arange(len(directions), dtype=np.int32)
    for field in fields:
        count = boresights_of_level(boresights, narrowest, field)
        tiled = tile_sphere(count, directions[rows], mag[rows], field)
        kept = rows[np.unique(tiled.brightest(stars_per_field)[1])]
        yield Level(rows, tiled, kept)
        rows = kept


def boresights_of_level(boresights: int, narrowest: FieldSize, field: FieldSize) -> int:
    """Return how many boresights tile the sphere for a level: the wider its field, the fewer."""
    area, larger = (size.fov_x_deg * size.fov_y_deg for size in (narrowest, field))
    return max(MIN_BORESIGHTS, round(boresights * (area / larger)))


def _ragged(lists: Sequence[Rows]) -> Ragged:
    offsets = np.cumsum([0, *(len(values) for values in lists)]).astype(np.int64)
    return Ragged(offsets, np.concatenate([np.empty(0, dtype=np.int32), *lists]))


def _count(inputs: ProductInputs, section: Levels) -> Extent:
    fields = section.fields(inputs.field_size)
    stars, triangles, records = 0.0, 0.0, 0.0
    sizes = (inputs.field_size, fields, inputs.boresights, section.stars_per_field)
    for level in thin_levels(inputs.directions, inputs.mag, *sizes):
        each, distinct = count_triangles(level.tiled, len(level.before), inputs.brightest)
        stars, triangles, records = stars + len(level.rows), triangles + distinct, records + each
    lists = {"stars": stars, **dict.fromkeys(("i", "j", "k"), triangles)}
    return Extent(float(len(fields)), lists, steps=records)


KIND = ProductKind(
    name="levels",
    make=lambda inputs, section: find_levels(
        inputs.directions,
        inputs.mag,
        inputs.field_size,
        section.fields(inputs.field_size),
        boresights=inputs.boresights,
        stars_per_field=section.stars_per_field,
        brightest=inputs.brightest,
    ),
    section=Levels,
    count=_count,
    parquet_factor=0.1,
)
