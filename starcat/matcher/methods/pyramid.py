"""Identification by pyramids (Mortari et al. 2004): a triangle confirmed by a fourth star.

The triangles of stars that an observed triangle may be are found by star pairs; a further
centroid has to be a star whose separations from all three agree. The method needs the product
``pairs``.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from starcat.arrays import Rows
from starcat.geometry.sphere import separation
from starcat.matcher.budget import LOOKUP
from starcat.matcher.database import Database
from starcat.matcher.methods.candidates import Candidates
from starcat.matcher.methods.pairs import directed_pairs, side_tolerance_rad, triangles_of_stars
from starcat.matcher.methods.triangle_order import TriangleOrder, select_triangles
from starcat.matcher.observation import Observation

PRODUCTS = ("pairs",)


def candidates(
    observation: Observation, database: Database, selection: TriangleOrder
) -> Iterator[Candidates]:
    """Propose the pyramids of stars that observed pyramids may be.

    Parameters
    ----------
    observation : Observation
        The frame.
    database : Database
        With the product ``pairs``.
    selection : TriangleOrder
        Order and limits of the observed triangles.

    Yields
    ------
    Candidates
        Four stars each.

    References
    ----------
    Mortari, Samaan, Bruccoleri and Junkins 2004, "The pyramid star identification technique",
    Navigation 51, 171.
    """
    for triangle in select_triangles(observation, selection):
        observation.budget.spend(LOOKUP)
        stars = triangles_of_stars(triangle, observation, database)
        if not len(stars):
            continue
        for apex in np.setdiff1d(np.arange(len(observation)), triangle):
            found = _with_apex(stars, triangle, int(apex), observation, database)
            if len(found):
                centroids = np.append(triangle, apex)
                yield Candidates(np.broadcast_to(centroids, found.shape), found)
                break


def _with_apex(
    stars: Rows, triangle: Rows, apex: int, observation: Observation, database: Database
) -> Rows:
    """Return the triangles that some star makes a pyramid of, with that star."""
    wanted, tolerance_rad = (
        observation.separation_rad[triangle, apex],
        side_tolerance_rad(observation),
    )
    first, fourth = directed_pairs(database, float(wanted[0]), tolerance_rad)
    row, pair = np.nonzero(stars[:, :1] == first)
    u = database.directions
    fits = np.ones(len(row), dtype=bool)
    for corner in (1, 2):
        apart = separation(u[stars[row, corner]], u[fourth[pair]])
        fits &= np.abs(apart - wanted[corner]) <= tolerance_rad
    return np.column_stack([stars[row[fits]], fourth[pair[fits]]])
