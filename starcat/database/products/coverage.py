"""Coverage: the contents of each field of the tiling, and how far apart the fields lie.

Counts come from the tiling of the guide stars; a summary is made for the report and the
command line. Nothing here draws or writes.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from starcat.arrays import Array, Directions
from starcat.database.products.tiling import FieldStars
from starcat.geometry.footprint import Footprint
from starcat.geometry.sphere import radec_from_directions, separation

Counts = NDArray[np.int64]

PROBES = 20_000
"""Random directions that stand for the edge of a part of the sphere."""

MIN_GUIDE_STARS = 4
"""Smallest number of stars from which any method can identify a frame."""


@dataclass(frozen=True)
class Coverage:
    """The contents of the field of each boresight."""

    boresights: Directions
    stars: Counts  # shape (F,): guide stars in the field
    pairs: Counts  # shape (F,)
    triangles: Counts  # shape (F,): triangles of the brightest of them


@dataclass(frozen=True)
class Spread:
    """How one count is spread over the fields."""

    # minimum, one_percent, median, maximum: values that occur; at least 1 % and 50 % of the fields
    # have no more than ``one_percent`` and ``median``
    minimum: int
    one_percent: int
    median: int
    maximum: int
    mean: float


@dataclass(frozen=True)
class CoverageSummary:
    """The coverage of the sphere in a few numbers."""

    fields: int
    stars: Spread
    pairs: Spread
    triangles: Spread
    # the field with the fewest stars; if several have as few, the first along the spiral
    worst_boresight: int
    worst_ra_deg: float
    worst_dec_deg: float
    histogram: Counts  # shape (maximum + 1,): ``histogram[n]`` fields hold n stars


@dataclass(frozen=True)
class TilingGap:
    """The direction that is farthest from all boresights."""

    boresights: int  # on the whole sphere
    tile_radius_rad: float  # radius of the largest circle inside the field: seen whatever the roll
    # every direction has a boresight within it, and this one none nearer
    covering_radius_rad: float
    ra_deg: float
    dec_deg: float

    @property
    def has_holes(self) -> bool:
        """Whether a direction lies outside the circle of every field."""
        return self.covering_radius_rad > self.tile_radius_rad

    @property
    def boresights_needed(self) -> int:
        """About how many boresights leave no hole, as gaps shrink with the root of their number."""
        ratio = self.covering_radius_rad / self.tile_radius_rad
        return max(self.boresights, int(np.ceil(1.05 * self.boresights * ratio**2)))


def field_coverage(fields: FieldStars, brightest: int) -> Coverage:
    """Count stars, pairs and triangles (of the brightest stars) of each field."""
    return coverage_from_counts(fields.boresights, fields.count, brightest)


def coverage_from_counts(boresights: Directions, stars: Counts, brightest: int) -> Coverage:
    """Return the coverage of fields whose stars are counted.

    n stars make n (n - 1) / 2 pairs; the m brightest make m (m - 1) (m - 2) / 6 triangles.

    >>> made = coverage_from_counts(np.eye(3), np.array([0, 4, 30]), 6)
    >>> made.pairs, made.triangles
    (array([  0,   6, 435]), array([ 0,  4, 20]))
    """
    stars = stars.astype(np.int64)
    few = np.minimum(stars, brightest)
    triangles = few * (few - 1) * (few - 2) // 6
    return Coverage(boresights, stars, stars * (stars - 1) // 2, triangles)


def summarise_coverage(coverage: Coverage) -> CoverageSummary:
    """Return the coverage of the sphere, of one field at least, in a few numbers."""
    worst = int(np.argmin(coverage.stars))
    ra_deg, dec_deg = radec_from_directions(coverage.boresights[worst])
    return CoverageSummary(
        len(coverage.stars),
        _spread(coverage.stars),
        _spread(coverage.pairs),
        _spread(coverage.triangles),
        worst,
        float(ra_deg),
        float(dec_deg),
        np.bincount(coverage.stars).astype(np.int64),
    )


def _spread(counts: Counts) -> Spread:
    percent, median = np.quantile(counts, [0.01, 0.5], method="inverted_cdf")
    return Spread(
        int(counts.min()), int(percent), int(median), int(counts.max()), float(counts.mean())
    )


def tiling_gap(
    boresights: Directions,
    tile_radius_rad: float,
    count: int | None = None,
    part: Footprint | None = None,
) -> TilingGap:
    """Compare the gaps between boresights with the area that a field covers at any roll.

    The radius is half of the narrower angle of a field: the largest circle inside a field. The
    boresights can be those in a part of the sphere, of ``count`` on the whole sphere.

    >>> from starcat.geometry.sphere import saff_kuijlaars
    >>> tiling_gap(saff_kuijlaars(10_000), np.radians(6.0)).has_holes
    False
    """
    if part is None:
        covering_rad, direction = covering_radius(boresights)
    else:
        covering_rad, direction = _covering_radius_of_part(boresights, part)
    ra_deg, dec_deg = radec_from_directions(direction)
    total = len(boresights) if count is None else count
    return TilingGap(total, float(tile_radius_rad), covering_rad, float(ra_deg), float(dec_deg))


def covering_radius(directions: Directions) -> tuple[float, Array]:
    """Return how far a direction can be from the nearest of some directions.

    Radians, and the unit vector at that distance; of several the first by x, y and z.

    The facets of the convex hull are the spherical Delaunay triangles, and the normal of a
    facet is the centre of its circumcircle, which holds no other direction. If the farthest
    of these centres is less than 90 deg away, it is the farthest direction of all. Otherwise all
    directions lie in one half of the sphere, and the farthest direction can also be opposite to
    the middle of an edge of the hull.

    >>> octahedron = np.concatenate([np.eye(3), -np.eye(3)])
    >>> round(float(np.degrees(covering_radius(octahedron)[0])), 3)
    54.736
    """
    try:
        hull = scipy.spatial.ConvexHull(directions)
    except scipy.spatial.QhullError:  # fewer than 4 directions, or all in one plane
        return _farthest(_opposite_to_circle(directions), directions)
    centres = hull.equations[:, :3]
    radii = separation(centres, directions[hull.simplices[:, 0]])
    if radii.max() < 0.5 * np.pi:
        return _widest(centres, radii)
    edges = hull.simplices[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    candidates = np.concatenate([centres, _opposite_to_middle(*directions[edges.T])])
    return _farthest(candidates, directions)


def _covering_radius_of_part(directions: Directions, part: Footprint) -> tuple[float, Array]:
    """Return how far a direction of a part of the sphere can be from the nearest of directions.

    The farthest direction is the centre of a circumcircle, or at the edge of the part; `PROBES`
    random directions of the part stand for the edge.
    """
    candidates = part.random_directions(PROBES, np.random.default_rng(0))
    with suppress(scipy.spatial.QhullError):  # fewer than 4 directions, or all in one plane
        centres = scipy.spatial.ConvexHull(directions).equations[:, :3]
        candidates = np.concatenate([centres[part.contains(centres)], candidates])
    return _farthest(candidates, directions)


def _widest(centres: Array, radii: Array) -> tuple[float, Array]:
    # Equal circles go by direction, so that the order of the facets does not matter.
    rounded = [*np.round(centres.T, 9), -np.round(radii, 12)]
    widest = int(np.lexsort(rounded)[0])
    return float(radii[widest]), np.asarray(centres[widest])


def _farthest(candidates: Array, directions: Directions) -> tuple[float, Array]:
    _, nearest = scipy.spatial.cKDTree(directions).query(candidates)
    return _widest(candidates, separation(candidates, directions[nearest]))


def _opposite_to_middle(u: Array, v: Array) -> Array:
    """Return the directions opposite to the middles of arcs; none for antipodes."""
    middle = u + v
    length = np.sqrt(np.einsum("ij,ij->i", middle, middle))
    is_arc = length > 1e-9
    return np.asarray(-middle[is_arc] / length[is_arc, None])


def _opposite_to_circle(directions: Directions) -> Array:
    """Return where the farthest direction from the directions of one circle can be.

    This is a pole of the circle, or the place opposite to the middle of the directions at the
    ends of its largest gap.
    """
    apart = directions - directions.mean(axis=0)
    _, _, (along, across, normal) = np.linalg.svd(apart, full_matrices=len(directions) < 3)
    order = np.argsort(np.arctan2(directions @ across, directions @ along))
    around = directions[order]
    middles = _opposite_to_middle(around, np.roll(around, -1, axis=0))
    return np.concatenate([[normal, -normal], middles])
