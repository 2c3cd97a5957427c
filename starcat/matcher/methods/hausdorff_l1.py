"""The baseline of S1: planar point sets under the averaged Hausdorff distance, L1 norm.

The centroids around a reference star are compared, as points of its tangent plane, with the
neighbours of every star, product ``hausdorff_l2``. Points turn and stretch with the image, so
the camera has to be upright, with a roll of 0, and of the nominal scale. The ratios of
`hausdorff_l2` do not have these two limits.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from starcat.arrays import Array, Rows
from starcat.geometry.sphere import radec_from_directions, tangent_axes
from starcat.matcher.database import Database
from starcat.matcher.methods.candidates import Candidates
from starcat.matcher.methods.consensus import neighbour_candidates
from starcat.matcher.methods.reference import by_reference, references, surroundings
from starcat.matcher.methods.reference_sets import lowest, means_of_minima
from starcat.matcher.methods.triangle_order import TriangleOrder
from starcat.matcher.observation import Observation

PRODUCTS = ("hausdorff_l2",)

STARS = 30
"""Number of the best stars of a reference star that become candidates."""

LIMIT_PX = 12.0
"""Mean L1 distance up to which the bare method accepts its best star, pixels."""

_UP = np.array([0.0, -1.0, 0.0])


def candidates(
    observation: Observation, database: Database, selection: TriangleOrder
) -> Iterator[Candidates]:
    """Propose what a reference star and two of its neighbours are, if the roll is 0.

    Parameters
    ----------
    observation : Observation
        The frame.
    database : Database
        With the product ``hausdorff_l2``.
    selection : TriangleOrder
        Without effect: no triangles are chosen.

    Yields
    ------
    Candidates
        Three stars each; the reference star nearest to the centre of the frame first.

    References
    ----------
    Wang et al. 2020 (S1), whose baseline it is.
    """
    product = database.products["hausdorff_l2"]

    def propose(reference: int) -> Candidates:
        stars, _ = rank_stars(observation, database, reference, count=STARS)
        return neighbour_candidates(reference, stars[stars >= 0], product, observation, database)

    yield from by_reference(observation, propose)


def rank_stars(
    observation: Observation, database: Database, reference: int | None = None, *, count: int
) -> tuple[Rows, Array]:
    """Rank the stars for a reference star.

    Parameters
    ----------
    observation : Observation
        The frame.
    database : Database
        With the product ``hausdorff_l2``.
    reference : int, optional
        Row of the observation; the nearest to the centre of the frame by default.
    count : int
        Number of stars to return.

    Returns
    -------
    stars : ndarray of int, shape (count,)
        Rows of the database's stars, the best first; -1 where there are no more.
    scores : ndarray of float64, shape (count,)
        Mean over the centroids around the reference star, within the radius of the reference
        sets, of the smallest L1 distance to a neighbour of the star, in units of the focal
        length; ``inf`` where there are no more.

    Notes
    -----
    The image's up is taken for north at the reference star. That is exact in its centre;
    elsewhere the meridians converge, the more the nearer to a pole. Every centroid is compared
    with the neighbours of all stars, so the time grows with the product of the two numbers.

    References
    ----------
    Wang et al. 2020 (S1), eq. 6; Dubuisson and Jain 1994, "A modified Hausdorff distance for
    object matching", whose directed distance is averaged.
    """
    product = database.products["hausdorff_l2"]
    reference = int(references(observation)[0]) if reference is None else reference
    rows = surroundings(observation, reference, product.numbers["radius_rad"]).centroids
    x, y = _observed_points(observation, reference, rows)
    star_x, star_y = database.derived(_neighbour_points)
    distances = (
        np.abs(star_x - one_x) + np.abs(star_y - one_y) for one_x, one_y in zip(x, y, strict=True)
    )
    scores = means_of_minima(distances, product["star_offsets"])
    stars, best = lowest(scores[None, :], count)
    return stars[0], best[0]


def identify_bare(observation: Observation, database: Database, limit_px: float = LIMIT_PX) -> int:
    """Name the reference star nearest to the centre of the frame, as the baseline does.

    Parameters
    ----------
    observation : Observation
        The frame.
    database : Database
        With the product ``hausdorff_l2``.
    limit_px : float, default `LIMIT_PX`
        Mean L1 distance that is still accepted, pixels.

    Returns
    -------
    int
        Row of the star; -1 where the best star is farther than that, or there is none.

    Notes
    -----
    On frames of 6 and of 12 deg of SAO stars with 0.5 px of noise the right star is 1 px away
    upright, 11 px at 1.5 deg of roll, 15 px at 2 deg and 21 px at a scale of 1.05: the
    default fails where S1, which states no limit, sees its baseline fail. Without a limit the
    right star stays the best one for most frames up to 8 deg of roll or a scale of 1.1.
    """
    stars, scores = rank_stars(observation, database, count=1)
    return int(stars[0]) if scores[0] * observation.camera.focal_length_px <= limit_px else -1


def _observed_points(observation: Observation, reference: int, rows: Rows) -> tuple[Array, Array]:
    """Return centroids on the tangent plane at one of them: to the left and up."""
    u, body = observation.body[reference], observation.body[rows]
    up = _UP - (_UP @ u) * u
    up /= np.sqrt(up @ up)
    depth = body @ u
    return body @ np.cross(up, u) / depth, body @ up / depth


def _neighbour_points(database: Database) -> tuple[Array, Array]:
    """Return all neighbours on the tangent planes at their stars: to the east and north."""
    product = database.products["hausdorff_l2"]
    star = product["star"]
    u = database.directions[product["neighbour"]]
    east, north = tangent_axes(*radec_from_directions(database.directions))
    depth = np.einsum("ij,ij->i", u, database.directions[star])
    x, y = (np.einsum("ij,ij->i", u, axis[star]) / depth for axis in (east, north))
    return x, y
