"""Every star's neighbours: by separation, by planar distance, and by position angle.

Separations do not change as the camera turns; planar distances over the smallest one depend not
even on its focal length; the angle from one neighbour to the next, with the separation, is looked
up in a table that leads to the rows that may be meant. A row is one neighbour of one star.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array, Directions
from starcat.geometry.patterns import bin_of
from starcat.geometry.proximity import pairs_within
from starcat.geometry.sphere import radec_from_directions, tangent_axes
from starcat.products.index import Index, row_offsets, stable_order

# Number of stars whose rows are sorted together, few enough for the processor's cache.
STARS_AT_ONCE = 4096


@dataclass(frozen=True)
class AngularReferenceSets:
    """Every star's neighbours by separation; a row is one neighbour of one star."""

    star: NDArray[np.int32]  # shape (M,): rows of the star table, ascending
    neighbour: NDArray[np.int32]  # shape (M,): rows of the star table
    # shape (M,): great-circle separations of the two, radians, ascending within a star
    separation_rad: Array
    index: Index  # dataset ``star_offsets``: the `row_offsets` of the stars; ``radius_rad``


def angular_reference_sets(directions: Directions, radius_rad: float) -> AngularReferenceSets:
    """Find the neighbours of every star within a radius, nearest first.

    Sorted by (star, separation, neighbour); the radius is included.

    Every pair of stars makes two rows, one from either end. Stars at the same place are
    neighbours at separation 0. The star itself is not in its set.

    Rotation-invariant feature with modified Hausdorff distance (S5), the feature of a star.

    >>> found = angular_reference_sets(np.eye(3)[:2], 2.0)
    >>> found.star, found.neighbour, found.separation_rad
    (array([0, 1], dtype=int32), array([1, 0], dtype=int32), array([1.570..., 1.570...]))
    """
    pairs, angle = pairs_within(directions, radius_rad)
    i, j = pairs.astype(np.int32).T
    star, neighbour = np.concatenate([i, j]), np.concatenate([j, i])
    both = np.concatenate([angle, angle])
    order = stable_order(star, len(directions))
    star, neighbour, both = star[order], neighbour[order], both[order]
    offsets = row_offsets(star, len(directions))
    for first in range(0, len(directions), STARS_AT_ONCE):
        last = min(first + STARS_AT_ONCE, len(directions))
        rows = slice(int(offsets[first]), int(offsets[last]))
        nearest = _nearest_first(star[rows] - first, neighbour[rows], both[rows])
        neighbour[rows], both[rows] = neighbour[rows][nearest], both[rows][nearest]
    index = Index({"star_offsets": offsets}, {"radius_rad": radius_rad})
    return AngularReferenceSets(star, neighbour, both, index)


def _nearest_first(
    star: NDArray[np.int32], neighbour: NDArray[np.int32], separation_rad: Array
) -> NDArray[np.int64]:
    """Return the order of (star, separation, neighbour); the stars ascend already."""
    order = np.argsort(separation_rad)
    order = order[stable_order(star[order], STARS_AT_ONCE)]
    same = np.diff(separation_rad[order]) == 0.0
    if bool(np.any(same & (np.diff(star[order]) == 0))):
        order = np.lexsort((neighbour, separation_rad, star))
    return order


@dataclass(frozen=True)
class PlanarReferenceSets:
    """Every star's neighbours by planar distance; a row is one neighbour of one star."""

    star: NDArray[np.int32]  # shape (M,): rows of the star table, ascending
    neighbour: NDArray[np.int32]  # shape (M,): rows of the star table
    # shape (M,): gnomonic distance over the star's smallest one, 1 or more, ascending within a star
    ratio: Array
    # datasets ``star_offsets`` as above, and ``smallest_distance``, float64, shape (N,): what was
    # divided by, in units of the focal length, NaN for a star without rows; ``radius_rad``
    index: Index


def planar_reference_sets(directions: Directions, radius_rad: float) -> PlanarReferenceSets:
    """Find the ratios of the gnomonic distances around every star.

    Sorted by (star, ratio, neighbour); the radius is below pi / 2, where the tangent plane
    ends.

    On the plane that touches the sphere at the star, a neighbour lies at the tangent of its
    separation. Stars at the same place have distance 0 and are left out: the method divides by
    the smallest distance that is not 0. The star itself, the method's leading 0, has no row.

    Wang et al. 2020 (S1), eqs. 6, 9 and 12.
    """
    if not radius_rad < 0.5 * np.pi:
        raise ValueError(f"radius_rad is {radius_rad}; expected less than pi / 2")
    sets = angular_reference_sets(directions, radius_rad)
    apart = sets.separation_rad > 0.0
    star, neighbour = sets.star[apart], sets.neighbour[apart]
    distance = np.tan(sets.separation_rad[apart])
    offsets = row_offsets(star, len(directions))
    smallest = np.full(len(directions), np.nan)
    # The nearest comes first.
    smallest[np.diff(offsets) > 0] = distance[offsets[:-1][np.diff(offsets) > 0]]
    ratio = distance / smallest[star]
    # Ratios that differed may be equal after rounding, and equal ratios are in order of neighbour.
    order = np.lexsort((neighbour, ratio, star))
    index = Index(
        {"star_offsets": offsets, "smallest_distance": smallest}, {"radius_rad": radius_rad}
    )
    return PlanarReferenceSets(star, neighbour[order], ratio[order], index)


_TURN = 2.0 * np.pi


@dataclass(frozen=True)
class Neighbours:
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
) -> Neighbours:
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
    found = bin_of(
        successive, separation_rad, angle_bin_rad, separation_bin_rad, angle_bins, separation_bins
    )
    rows = np.argsort(found, kind="stable")
    lookup = {
        "star_offsets": offsets,
        "lookup_offsets": row_offsets(found[rows], angle_bins * separation_bins),
        "lookup_rows": rows.astype(np.int32),
    }
    # The rows of one star have changed places, so that the column of stars is still the same.
    return Neighbours(
        sets.star, sets.neighbour[order], angle, successive, separation_rad, Index(lookup, bins)
    )


def position_angles(
    directions: Directions, star: NDArray[np.integer[Any]], neighbour: NDArray[np.integer[Any]]
) -> Array:
    """Return the position angles of neighbours at stars.

    Radians in [0, 2 pi), from north through east: counter-clockwise on the sky as seen from
    inside. 0 where the two are at the same place; at a pole the star's own right ascension says
    which way east is.

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
