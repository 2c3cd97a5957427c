"""Identification by grid patterns (Padgett and Kreutz-Delgado 1997): cells in common.

A reference star's neighbours are projected onto the plane that touches the sphere at it, and
turned so that the nearest one beyond a buffer, the alignment neighbour, lies on the +x axis.
Every occupied cell is a vote for the stars whose pattern has it. Needs the product ``grid``.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Rows
from starcat.geometry.patterns import cell_of
from starcat.geometry.sphere import separation
from starcat.matcher.database import Database, ProductArrays
from starcat.matcher.methods.candidates import Candidates
from starcat.matcher.methods.pairs import side_tolerance_rad
from starcat.matcher.methods.reference import Surroundings, by_reference, rows_between, surroundings
from starcat.matcher.methods.triangle_order import TriangleOrder
from starcat.matcher.observation import Observation

PRODUCTS = ("grid",)

ALIGNMENTS = 2
"""How many neighbours are tried as the alignment neighbour: the nearest may be a false star."""

MOST_STARS = 64
"""Stars of most votes whose alignment star is looked at."""

_TOUCHES = np.array([[0, 0], [-1, -1], [-1, 1], [1, -1], [1, 1]])
"""A centroid may be anywhere in a square: its middle and corners, along and across."""


def candidates(
    observation: Observation, database: Database, selection: TriangleOrder
) -> Iterator[Candidates]:
    """Propose what a reference star and its alignment neighbour are.

    Parameters
    ----------
    observation : Observation
        The frame.
    database : Database
        With the product ``grid``.
    selection : TriangleOrder
        Without effect: no triangles are chosen.

    Yields
    ------
    Candidates
        Two stars each, as far apart as the centroids; the reference star nearest to the centre
        of the frame first.

    References
    ----------
    Padgett and Kreutz-Delgado 1997, "A grid algorithm for autonomous star identification",
    IEEE Transactions on Aerospace and Electronic Systems 33, 202.
    """
    yield from by_reference(
        observation,
        *(partial(_aligned, observation, database, choice) for choice in range(ALIGNMENTS)),
    )


def rank_stars(
    observation: Observation, database: Database, reference: int, *, most: int = MOST_STARS
) -> tuple[Rows, NDArray[np.int64]]:
    """Rank the stars that a reference star may be by the cells that they have in common.

    Parameters
    ----------
    observation : Observation
        The frame.
    database : Database
        With the product ``grid``.
    reference : int
        Row of the observation.
    most : int
        How many stars at the most.

    Returns
    -------
    stars : ndarray of int, shape (K,)
        Rows of the database's stars, the best first; of equal ones those that occupy fewer
        cells. None without an alignment neighbour.
    scores : ndarray of int64, shape (K,)
        Cells in common.

    References
    ----------
    Padgett and Kreutz-Delgado 1997; the best star of the reference star nearest to the centre
    is the method's own answer.
    """
    product = database.products["grid"]
    around = surroundings(observation, reference, product.numbers["radius_rad"])
    alignment = _alignment(around, product, 0)
    if alignment is None:
        return np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.int64)
    rows, votes = _ranked(around, alignment, observation.tolerance_rad, product, most)
    return product["star"][rows].astype(np.intp), votes


def _aligned(
    observation: Observation, database: Database, choice: int, reference: int
) -> Candidates:
    """Return a reference star's candidates whose alignment star is as far as its neighbour."""
    product = database.products["grid"]
    around = surroundings(observation, reference, product.numbers["radius_rad"])
    alignment = _alignment(around, product, choice)
    if alignment is None:
        nothing = np.zeros((0, 2), dtype=np.intp)
        return Candidates(nothing, nothing)
    rows, _ = _ranked(around, alignment, observation.tolerance_rad, product, MOST_STARS)
    stars = np.stack([product["star"][rows], product["alignment_star"][rows]], axis=-1)
    u = database.directions[stars.astype(np.intp)]
    difference = separation(u[:, 0], u[:, 1]) - around.separation_rad[alignment]
    stars = stars[np.abs(difference) <= side_tolerance_rad(observation)].astype(np.intp)
    centroids = np.array([reference, around.centroids[alignment]])
    return Candidates(np.broadcast_to(centroids, stars.shape), stars)


def _alignment(around: Surroundings, product: ProductArrays, choice: int) -> int | None:
    """Return the nearest neighbour beyond the buffer, or the next nearest ones."""
    buffer_rad = product.numbers["buffer_rad"]
    first = int(np.searchsorted(around.separation_rad, buffer_rad, side="right"))
    return first + choice if first + choice < len(around) else None


def _ranked(
    around: Surroundings, alignment: int, tolerance_rad: float, product: ProductArrays, most: int
) -> tuple[Rows, NDArray[np.int64]]:
    """Return the product's rows of most votes, and the votes."""
    cells = _occupied(around, alignment, tolerance_rad, product)
    offsets = product["cell_offsets"]
    _, entry = rows_between(offsets[cells], offsets[cells + 1])
    votes = np.bincount(product["cell_rows"][entry], minlength=len(product["star"]))
    most = min(most, len(votes))
    rows = np.argpartition(-votes, most - 1)[:most]
    size = product["cells_offsets"][rows + 1] - product["cells_offsets"][rows]
    rows = rows[np.lexsort((rows, size, -votes[rows]))]
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
    # The alignment star is on the axis by definition, which may be an edge between cells: what
    # the tolerance touches beyond it is not meant.
    y[:, alignment] = 0.0
    side = int(product.numbers["cells_per_side"])
    return np.unique(cell_of(x, y, product.numbers["radius_rad"], side))
