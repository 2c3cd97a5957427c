"""The product ``neighbours``: every star's neighbours by position angle.

The angle from one neighbour to the next, with the separation, is looked up in a table that leads
to the possible rows. Each row holds a neighbour of a star.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from starcat.arrays import Array, Directions
from starcat.database.products.hausdorff_angular import angular_reference_sets
from starcat.database.products.index import Index, row_offsets
from starcat.database.products.kind import (
    HALF_FIELD,
    Extent,
    ProductInputs,
    ProductKind,
    ProductSection,
    SpecFacts,
    neighbour_extent,
)
from starcat.geometry.patterns import bin_of
from starcat.geometry.sphere import radec_from_directions, tangent_axes
from starcat.sections import SmallDeg

MAX_BINS = 10_000_000
"""Largest number of bins of a look-up table; each takes 8 bytes, and more are of no use."""


class Neighbours(ProductSection):
    """Angles and separations of each star's neighbours, with a look-up table (S2)."""

    radius_deg: SmallDeg | None = Field(
        None, description=f"how far a neighbour may be; {HALF_FIELD}"
    )
    angle_bin_deg: float = Field(
        2.0, ge=0.1, le=360.0, description="width of the look-up table's bins in angle"
    )
    separation_bin_deg: SmallDeg = Field(
        0.1, description="width of the look-up table's bins in separation"
    )

    def check_agrees(self, facts: SpecFacts) -> None:
        """Check that the look-up table is not too large for the field."""
        radius_deg = self.radius_deg or facts.half_field_deg
        bins = 360.0 / self.angle_bin_deg * radius_deg / self.separation_bin_deg
        if bins > MAX_BINS:
            raise ValueError(
                f"products.neighbours: angle_bin_deg and separation_bin_deg make {bins:,.0f} bins; "
                f"at most {MAX_BINS:,} fit. Make the bins wider or radius_deg smaller"
            )


_TURN = 2.0 * np.pi


@dataclass(frozen=True)
class NeighbourRows:
    """Every star's neighbours by position angle; a row is one neighbour of one star."""

    star: NDArray[np.int32]  # shape (M,): rows of the star table, ascending
    neighbour: NDArray[np.int32]  # shape (M,): rows of the star table
    # shape (M,): position angle of the neighbour at the star, radians in [0, 2 pi), ascending
    # within a star
    position_angle_rad: Array
    # shape (M,): angle to the star's next neighbour, from the last one to the first; radians, their
    # sum over a star is 2 pi
    successive_angle_rad: Array
    separation_rad: Array  # shape (M,): great-circle separations of the two, radians
    # datasets ``star_offsets`` as above; ``lookup_offsets``, int64, shape (bins + 1,) and
    # ``lookup_rows``, int32, shape (M,): the rows in bin b of `starcat.geometry.patterns.bin_of`,
    # ascending, are ``lookup_rows[lookup_offsets[b]:lookup_offsets[b + 1]]``; the bins' numbers
    index: Index


def find_neighbours(
    directions: Directions, radius_rad: float, *, angle_bin_rad: float, separation_bin_rad: float
) -> NeighbourRows:
    """Find the neighbours of every star within a radius, counter-clockwise.

    Sorted by (star, position angle, neighbour).

    A star with one neighbour has one successive angle, 2 pi. A star at the same place is a
    neighbour with position angle 0.

    Sun et al. 2021 (S2), the feature of tables 1 and 2 and its look-up by angle and distance.
    """
    angle_bins = _bin_count(_TURN, angle_bin_rad, "angle_bin_rad")
    separation_bins = _bin_count(radius_rad, separation_bin_rad, "separation_bin_rad")
    sets = angular_reference_sets(directions, radius_rad)
    angle = position_angles(directions, sets.star, sets.neighbour)
    order = np.lexsort((sets.neighbour, angle, sets.star))
    angle, separation_rad = angle[order], sets.separation_rad[order]
    offsets = sets.index.datasets["star_offsets"]
    successive = _successive_angles(angle, offsets)
    bins = {
        "angle_bin_rad": angle_bin_rad,
        "separation_bin_rad": separation_bin_rad,
        "n_angle_bins": angle_bins,
        "n_separation_bins": separation_bins,
    }
    bin_numbers = bin_of(
        successive, separation_rad, angle_bin_rad, separation_bin_rad, angle_bins, separation_bins
    )
    rows = np.argsort(bin_numbers, kind="stable")
    lookup = {
        "star_offsets": offsets,
        "lookup_offsets": row_offsets(bin_numbers[rows], angle_bins * separation_bins),
        "lookup_rows": rows.astype(np.int32),
    }
    # The rows of one star have changed places, so that the column of stars is still the same.
    return NeighbourRows(
        sets.star, sets.neighbour[order], angle, successive, separation_rad, Index(lookup, bins)
    )


def position_angles(
    directions: Directions, star: NDArray[np.integer[Any]], neighbour: NDArray[np.integer[Any]]
) -> Array:
    """Return the position angles of neighbours at stars.

    Radians in [0, 2 pi), from north through east: counter-clockwise on the sky as seen from
    inside. 0 where the two are at the same place; at a pole the star's own right ascension
    determines the direction of east.

    >>> u = np.eye(3)
    >>> position_angles(u, np.array([0, 0]), np.array([2, 1])) * 2.0 / np.pi
    array([0., 1.])
    """
    east, north = tangent_axes(*radec_from_directions(directions))
    # The difference of two close directions is exact, the components of each are not.
    offset = directions[neighbour] - directions[star]
    x = np.einsum("ij,ij->i", offset, east[star])
    y = np.einsum("ij,ij->i", offset, north[star])
    angle = np.arctan2(x, y)
    angle = np.where(angle < 0.0, angle + _TURN, angle)
    # A tiny negative angle plus a turn rounds to a whole turn, which is 0.
    return np.where(angle >= _TURN, 0.0, angle)


def _bin_count(extent: float, width: float, name: str) -> int:
    if not width > 0.0:
        raise ValueError(f"{name} is {width}; expected more than 0")
    return max(1, int(np.ceil(extent / width)))


def _successive_angles(angle: Array, offsets: NDArray[np.int64]) -> Array:
    """Return the angle from each neighbour of a star to the next; after the last is the first."""
    step = np.empty_like(angle)
    step[:-1] = angle[1:] - angle[:-1]
    some = np.diff(offsets) > 0
    first, last = offsets[:-1][some], offsets[1:][some] - 1
    step[last] = _TURN - (angle[last] - angle[first])
    return step


def _count(inputs: ProductInputs, section: Neighbours) -> Extent:
    radius_deg = section.radius_deg or inputs.half_field_deg
    bins = np.ceil(360.0 / section.angle_bin_deg) * np.ceil(radius_deg / section.separation_bin_deg)
    return neighbour_extent(inputs, inputs.radius_rad(section.radius_deg), float(bins))


KIND = ProductKind(
    name="neighbours",
    make=lambda inputs, section: find_neighbours(
        inputs.directions,
        inputs.radius_rad(section.radius_deg),
        angle_bin_rad=float(np.radians(section.angle_bin_deg)),
        separation_bin_rad=float(np.radians(section.separation_bin_deg)),
    ),
    section=Neighbours,
    count=_count,
)
