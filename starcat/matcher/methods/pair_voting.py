"""Pair voting: every pair of centroids as a base, from which all others are looked up.

Methods that compare neighbourhoods need a star whose neighbours are mostly in the frame and mostly
guide stars. Where a camera misses stars and sees others, few fields have one. Here two centroids
are laid upon every two stars that are as far apart, and the other centroids are looked up in the
sky. A field of four known stars is found like this, whatever is missing and whatever else is seen.
It takes ten times as long as a neighbourhood, and so comes last.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from starcat.arrays import Array, Rows
from starcat.geometry.sphere import separation
from starcat.matcher.database import Database
from starcat.matcher.observation import Candidates, Observation
from starcat.matcher.settings import LOOKUP
from starcat.matcher.star_cells import cells_for

LEAST_OTHERS = 2
"""Centroids beside the base that have to be near a star: four in all, as an answer needs."""

REACH = 3.0
"""Largest distance of another centroid from its star, in units of the tolerance. It is larger than
that of an agreement, as two stars leave more of an error in an attitude."""

MOST_PLACES = 2**20
"""Largest number of places in the sky that a frame is looked up at: some tenths of a second."""


def bases(observation: Observation, database: Database) -> Iterator[Candidates]:
    """Propose what two centroids and a third one are, a batch for each pair of the frame.

    At least one further centroid is near a star then. The pairs are those up to the radius of the
    product ``neighbours``, of the first centroids of the observation first: these are the brightest
    ones where magnitudes are known.
    """
    order, apart_rad = database.cached(_by_separation)
    if not len(order):
        return
    tolerance_rad = observation.side_tolerance_rad
    second, first = np.tril_indices(len(observation), -1)
    separation_rad = observation.separation_rad[first, second]
    low = np.searchsorted(apart_rad, separation_rad - tolerance_rad, side="left")
    high = np.searchsorted(apart_rad, separation_rad + tolerance_rad, side="right")
    places = np.cumsum(high - low) * max(0, len(observation) - 2)
    for one, other, begin, end in zip(
        *(ends[places <= MOST_PLACES].tolist() for ends in (first, second, low, high)), strict=True
    ):
        observation.budget.spend(LOOKUP + end - begin)
        found = _on_base(one, other, order[begin:end], observation, database)
        if len(found):
            yield found


def _on_base(
    one: int, other: int, rows: Rows, observation: Observation, database: Database
) -> Candidates:
    """Return which pairs of stars put enough of the other centroids near a star, with a third."""
    product = database.products["neighbours"]
    stars = np.stack([product["star"][rows], product["neighbour"][rows]], axis=-1).astype(np.intp)
    others = np.delete(np.arange(len(observation)), [one, other])
    seen = observation.body[others] @ _axes(observation.body[one], observation.body[other]).T
    icrs = seen @ _axes(*np.moveaxis(database.directions[stars], 1, 0))
    reach_rad = REACH * observation.tolerance_rad
    near = cells_for(database, reach_rad).has_star(icrs.reshape(-1, 3), reach_rad)
    near = near.reshape(len(rows), len(others))
    row, third = np.nonzero(near & (near.sum(axis=1) >= LEAST_OTHERS)[:, None])
    star = (icrs[row, third] @ database.directions.T).argmax(axis=1)
    ends = np.broadcast_to([one, other], (len(row), 2))
    found = Candidates(np.column_stack([ends, others[third]]), np.column_stack([stars[row], star]))
    u = database.directions[found.stars]
    error = (
        separation(u[:, :2], u[:, 2:]) - observation.separation_rad[found.centroids[:, 2:], ends]
    )
    return found[np.all(np.abs(error) <= observation.side_tolerance_rad, axis=1)]


def _axes(one: Array, other: Array) -> Array:
    """Return axes that go with two directions: their middle, across it, across both.

    Laying the axes of two pairs upon each other is the attitude of least squares.
    """
    middle, across = one + other, np.cross(one, other)
    middle /= np.sqrt(np.einsum("...i,...i->...", middle, middle))[..., None]
    across /= np.sqrt(np.einsum("...i,...i->...", across, across))[..., None]
    return np.stack([middle, np.cross(across, middle), across], axis=-2)


def _by_separation(database: Database) -> tuple[Rows, Array]:
    """Return the rows of the product by separation, and the separations in this order."""
    apart_rad = np.asarray(database.products["neighbours"]["separation_rad"])
    order = np.argsort(apart_rad, kind="stable")
    return order, apart_rad[order]
