"""The tiling of the sphere: Saff-Kuijlaars points and the stars in the field of each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
import scipy
from numpy.typing import NDArray

from starcat.arrays import Array, Directions, Mask
from starcat.geometry.footprint import Footprint
from starcat.geometry.sphere import (
    chord_from_separation,
    radec_from_directions,
    saff_kuijlaars,
    separation,
    tangent_axes,
)


class FieldSize(Protocol):
    """Anything with a full angle across its width and its height, such as a camera."""

    @property
    def fov_x_deg(self) -> float:
        """Full angle across the width, degrees."""

    @property
    def fov_y_deg(self) -> float:
        """Full angle across the height, degrees."""


@dataclass(frozen=True)
class NominalField:
    """A field of view that is stated, not that of a detector."""

    fov_x_deg: float
    fov_y_deg: float


@dataclass(frozen=True)
class FieldStars:
    """The stars in each of a number of fields."""

    boresights: Directions
    # shape (F + 1,): the stars of field f are ``star_index[offsets[f]:offsets[f + 1]]``
    offsets: NDArray[np.int64]
    # shape (M,): rows of the star table, brightest first within a field
    star_index: NDArray[np.int32]

    @property
    def count(self) -> NDArray[np.int64]:
        """Number of stars in each field, shape (F,)."""
        return np.diff(self.offsets)

    @property
    def field(self) -> NDArray[np.int64]:
        """The field of each entry of ``star_index``, shape (M,)."""
        return np.repeat(np.arange(len(self.boresights)), self.count)

    def seen(self, directions: Directions) -> Directions:
        """Return the directions of the stars in the frame of their field at roll 0, shape (M, 3).

        x to the right, which is west, y down, z along the boresight.
        """
        east, north = tangent_axes(*radec_from_directions(self.boresights))
        axes = np.stack([-east, -north, self.boresights], axis=1)
        return np.asarray(np.einsum("mij,mj->mi", axes[self.field], directions[self.star_index]))

    @property
    def nbytes(self) -> int:
        """Memory that it takes."""
        return int(self.boresights.nbytes + self.offsets.nbytes + self.star_index.nbytes)

    def brightest(self, most: int) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
        """Return offsets and rows of the ``most`` brightest stars of each field."""
        rank = np.arange(len(self.star_index)) - np.repeat(self.offsets[:-1], self.count)
        offsets = np.concatenate([[0], np.cumsum(np.minimum(self.count, most))])
        return offsets, self.star_index[rank < most]


def stars_in_fields(
    boresights: Directions,
    directions: Directions,
    mag: Array,
    size: FieldSize,
    field: Literal["rectangular", "circular"] = "rectangular",
) -> FieldStars:
    """Find the stars in the field of each boresight.

    A rectangular field is the frame at roll 0 (rows along right ascension), a circular one has
    the radius of half of the narrower side. Edges belong to the field; equal magnitudes go by
    row.
    """
    half_x, half_y = np.radians(0.5 * size.fov_x_deg), np.radians(0.5 * size.fov_y_deg)
    radius = reach_rad(size, field)
    if not len(directions):
        none = np.zeros(len(boresights) + 1, dtype=np.int64)
        return FieldStars(boresights, none, np.empty(0, dtype=np.int32))
    chord = chord_from_separation(radius) * (1.0 + 1e-9)
    near = scipy.spatial.cKDTree(boresights).sparse_distance_matrix(
        scipy.spatial.cKDTree(directions), chord, output_type="ndarray"
    )
    tile, star = near["i"], near["j"]
    if field == "circular":
        inside = separation(boresights[tile], directions[star]) <= radius
    else:
        inside = _in_frame(boresights, tile, directions[star], np.tan(half_x), np.tan(half_y))
    tile, star = tile[inside], star[inside]
    # Field and rank in one number, as sorting numbers is several times faster.
    by_brightness = np.argsort(mag, kind="stable")
    rank = np.empty(len(mag), dtype=np.int64)
    rank[by_brightness] = np.arange(len(mag))
    key = np.sort(tile.astype(np.int64) * len(mag) + rank[star])
    count = np.bincount(tile, minlength=len(boresights))
    offsets = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
    return FieldStars(boresights, offsets, by_brightness[key % len(mag)].astype(np.int32))


def reach_rad(size: FieldSize, field: Literal["rectangular", "circular"]) -> float:
    """Return how far from its boresight a field reaches: its corner, or the edge of the circle."""
    half_x, half_y = np.radians(0.5 * size.fov_x_deg), np.radians(0.5 * size.fov_y_deg)
    corner = np.arctan(np.hypot(np.tan(half_x), np.tan(half_y)))
    return float(min(half_x, half_y) if field == "circular" else corner)


def tile_radius_rad(size: FieldSize) -> float:
    """Return the radius of the largest circle inside a field, which is seen at any roll."""
    return 0.5 * float(np.radians(min(size.fov_x_deg, size.fov_y_deg)))


def _in_frame(
    boresights: Directions, tile: NDArray[np.int64], u: Array, half_x: float, half_y: float
) -> Mask:
    """Return which directions project into the frame of their tile at roll 0."""
    east, north = tangent_axes(*radec_from_directions(boresights))
    along = np.einsum("ij,ij->i", u, boresights[tile])
    x = np.einsum("ij,ij->i", u, east[tile])
    y = np.einsum("ij,ij->i", u, north[tile])
    return np.asarray((along > 0) & (np.abs(x) <= half_x * along) & (np.abs(y) <= half_y * along))


def spiral_points(count: int, part: Footprint | None = None) -> Directions:
    """Return the Saff-Kuijlaars points of the sphere that are in a part of it."""
    points = saff_kuijlaars(count)
    return points if part is None else np.asarray(points[part.contains(points)])


def tile_sphere(
    count: int,
    directions: Directions,
    mag: Array,
    size: FieldSize,
    field: Literal["rectangular", "circular"] = "rectangular",
) -> FieldStars:
    """Tile the sphere with Saff-Kuijlaars boresights and find the stars in each field."""
    return stars_in_fields(saff_kuijlaars(count), directions, mag, size, field)
