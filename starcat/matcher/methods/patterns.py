"""Identification by patterns of a star's neighbours: cells of a grid, or rings and sectors.

Grid (Padgett and Kreutz-Delgado 1997): a reference star's neighbours are projected onto the plane
that touches the sphere at it, and turned so that the nearest one beyond a buffer, the alignment
neighbour, lies on the +x axis. Every occupied cell is a vote for the stars whose pattern has it.
Needs the product ``grid``.

Radial and cyclic (Zhang et al. 2008): the rings around a centroid that contain a neighbour are
compared with the rings of every star, then the sectors, as a cycle without a beginning. The result
is a name for a single centroid, without a direction; the module `consensus` finds which names agree
with each other. Needs the product ``radial``.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array, Rows
from starcat.geometry.patterns import cell_of, cyclic_shifts, ring_of, sector_of
from starcat.geometry.sphere import separation
from starcat.matcher.database import MatcherDatabase, ProductArrays
from starcat.matcher.methods.consensus import (
    Surroundings,
    by_reference,
    consistent_candidates,
    references,
    surroundings,
)
from starcat.matcher.observation import Candidates, Observation
from starcat.matcher.settings import LOOKUP
from starcat.matcher.star_cells import rows_between

ALIGNMENTS = 2
"""Number of neighbours that are tried as the alignment neighbour: the nearest can be false."""

MAX_STARS = 64
"""Number of stars, by most votes, whose alignment star is checked."""

_TOUCHES = np.array([[0, 0], [-1, -1], [-1, 1], [1, -1], [1, 1]])
"""A centroid can be anywhere in a square: offsets of its middle and corners, along and across."""


def grid_candidates(observation: Observation, database: MatcherDatabase) -> Iterator[Candidates]:
    """Propose what a reference star and its alignment neighbour are, as far apart as the centroids.

    Padgett and Kreutz-Delgado 1997, "A grid algorithm for autonomous star identification",
    IEEE Transactions on Aerospace and Electronic Systems 33, 202.
    """
    yield from by_reference(
        observation,
        *(partial(_aligned, observation, database, choice) for choice in range(ALIGNMENTS)),
    )


def _aligned(
    observation: Observation, database: MatcherDatabase, choice: int, reference: int
) -> Candidates:
    """Return a reference star's candidates whose alignment star is as far as its neighbour."""
    product = database.products["grid"]
    around = surroundings(observation, reference, product.numbers["radius_rad"])
    alignment = alignment_of(around, product, choice)
    if alignment is None:
        nothing = np.zeros((0, 2), dtype=np.intp)
        return Candidates(nothing, nothing)
    rows, _ = most_votes(around, alignment, observation.tolerance_rad, product, MAX_STARS)
    stars = np.stack([product["star"][rows], product["alignment_star"][rows]], axis=-1)
    u = database.directions[stars.astype(np.intp)]
    difference = separation(u[:, 0], u[:, 1]) - around.separation_rad[alignment]
    stars = stars[np.abs(difference) <= observation.side_tolerance_rad].astype(np.intp)
    centroids = np.array([reference, around.centroids[alignment]])
    return Candidates(np.broadcast_to(centroids, stars.shape), stars)


def alignment_of(around: Surroundings, product: ProductArrays, choice: int) -> int | None:
    """Return the nearest neighbour beyond the buffer, or the next nearest ones."""
    buffer_rad = product.numbers["buffer_rad"]
    first = int(np.searchsorted(around.separation_rad, buffer_rad, side="right"))
    return first + choice if first + choice < len(around) else None


def most_votes(
    around: Surroundings, alignment: int, tolerance_rad: float, product: ProductArrays, most: int
) -> tuple[Rows, NDArray[np.int64]]:
    """Return the product's rows of most votes, and the votes."""
    cells = _occupied(around, alignment, tolerance_rad, product)
    offsets = product["cell_offsets"]
    _, entry = rows_between(offsets[cells], offsets[cells + 1])
    votes = np.bincount(product["cell_rows"][entry], minlength=len(product["star"]))
    size = np.diff(product["cells_offsets"])
    rows = np.lexsort((size, -votes))[:most]  # stable: the first row of equal ones comes first
    return rows, votes[rows]


def _occupied(
    around: Surroundings, alignment: int, tolerance_rad: float, product: ProductArrays
) -> NDArray[np.int64]:
    """Return the cells that the neighbours may be in, each once."""
    turn = around.position_angle_rad - around.position_angle_rad[alignment]
    along = np.tan(around.separation_rad) + _TOUCHES[:, :1] * tolerance_rad
    across = np.broadcast_to(_TOUCHES[:, 1:] * tolerance_rad, along.shape)
    x = along * np.cos(turn) - across * np.sin(turn)
    y = along * np.sin(turn) + across * np.cos(turn)
    # The alignment star is on the axis by definition. The axis can be an edge between cells: the
    # cells that the tolerance touches beyond it do not count.
    y[:, alignment] = 0.0
    side = int(product.numbers["cells_per_side"])
    return np.unique(cell_of(x, y, product.numbers["radius_rad"], side))


ROUNDS = ((3, 16), (12, 32), (48, 64))
"""Number of centroids that are compared, from the centre, and of names that each of them gets."""

MAX_PAIRS = 200
"""Largest number of pairs of names that are proposed in one round."""

COMPARED = 2
"""Number of stars whose sectors are compared, over the number of stars that are needed."""

TOUCHED = 0.5
"""Weight of a ring without a centroid that a centroid's tolerance touches."""

SECTORS = 0.2
"""Weight of the sectors relative to the rings."""


def radial_candidates(observation: Observation, database: MatcherDatabase) -> Iterator[Candidates]:
    """Propose names of centroids that agree with each other.

    The first round uses a few centroids nearest to the centre of the frame and their best names,
    the next more centroids and names.

    Zhang, Wei and Jiang 2008, "Full-sky autonomous star identification based on radial and
    cyclic features of star pattern", Image and Vision Computing 26, 891.
    """
    order = references(observation)
    names = np.full((len(observation), ROUNDS[-1][1]), -1, dtype=np.intp)
    done = 0
    for first, most in ROUNDS:
        for reference in order[done:first]:
            observation.budget.spend(LOOKUP)
            stars, _ = rank_by_rings(observation, database, int(reference), most=names.shape[1])
            names[reference, : len(stars)] = stars
        done = first
        yield from consistent_candidates(names[:, :most], observation, database, MAX_PAIRS)


def rank_by_rings(
    observation: Observation,
    database: MatcherDatabase,
    reference: int,
    *,
    most: int = ROUNDS[-1][1],
) -> tuple[Rows, Array]:
    """Rank the stars that a reference star may be by the rings and sectors in common.

    The best first; none without a neighbour. A score is twice the weight of the rings in common
    over the weight of the rings of both, 0 to 1, less `SECTORS` times the share of the sectors of
    both that differ.

    Centroids err: a ring that only a tolerance touches counts half. The cyclic pattern as the
    smallest of its shifts changes altogether with one sector, so the sectors are compared in
    all positions and the best counts. The best star of the reference star nearest to the centre is
    the paper's own answer.
    """
    product = database.products["radial"]
    around = surroundings(observation, reference, product.numbers["radius_rad"])
    if not len(around):
        return np.zeros(0, dtype=np.intp), np.zeros(0)
    score = _rings_in_common(around, observation.tolerance_rad, product)
    rows = np.argsort(-score, kind="stable")[: COMPARED * most]
    sectors = int(product.numbers["sectors"])
    pattern = sector_pattern(around.position_angle_rad, sectors)
    total = score[rows] - SECTORS * _difference(pattern, product["sector_pattern"][rows], sectors)
    order = np.lexsort((rows, -total))[:most]
    return product["star"][rows[order]].astype(np.intp), total[order]


def _rings_in_common(around: Surroundings, tolerance_rad: float, product: ProductArrays) -> Array:
    """Return the share of the rings of both that every star has in common with an observation."""
    radius_rad, rings = product.numbers["radius_rad"], int(product.numbers["rings"])
    apart = around.separation_rad
    weight = np.zeros(rings)
    for touched in (np.maximum(apart - tolerance_rad, 0.0), apart + tolerance_rad):
        weight[ring_of(touched, radius_rad, rings)] = TOUCHED
    weight[ring_of(apart, radius_rad, rings)] = 1.0
    ring = np.flatnonzero(weight)
    offsets = product["ring_offsets"]
    run, entry = rows_between(offsets[ring], offsets[ring + 1])
    rows = product["ring_rows"][entry]
    common = np.bincount(rows, weight[ring][run], minlength=len(product["star"]))
    return np.asarray(2.0 * common / (weight.sum() + np.diff(product["rings_offsets"])))


def sector_pattern(position_angle_rad: Array, sectors: int) -> int:
    """Return the sectors around a star that contain a neighbour: bit s for sector s.

    Angles run counter-clockwise, the nearest neighbour first; sectors are counted from it.

    Examples
    --------
    >>> bin(sector_pattern(np.radians([10.0, 105.0, 5.0]), 4))
    '0b1011'
    """
    sector = sector_of(position_angle_rad - position_angle_rad[0], sectors)
    return int(np.bitwise_or.reduce(1 << sector))


def _difference(pattern: int, others: NDArray[np.int32], sectors: int) -> Array:
    """Return the share of the sectors of both that differ, in the position where fewest do."""
    turned = cyclic_shifts(pattern, sectors)
    differ = np.bitwise_count(turned[:, None] ^ others.astype(np.int64)).min(axis=0)
    return np.asarray(differ / (pattern.bit_count() + np.bitwise_count(others)))
