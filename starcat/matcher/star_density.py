"""How many stars of a database the frames of a camera have: too few cannot be identified."""

from __future__ import annotations

import math
from dataclasses import replace

from starcat.geometry.camera import Camera
from starcat.matcher.chance import MIN_STARS
from starcat.matcher.database import MatcherDatabase
from starcat.matcher.refusal import Reason, Refusal
from starcat.matcher.star_cells import stars_in_cap

SAMPLE = 200
"""Number of stars about which other stars are counted."""

FEW_STARS = MIN_STARS - 1
"""With fewer stars in a frame on average, most frames cannot be identified."""

_OF_SEARCHES: tuple[Reason, ...] = ("no_candidate", "chance", "share_of_frame", "time", "steps")


def mean_stars(database: MatcherDatabase, camera: Camera) -> float:
    """Return how many stars of a database a frame of a camera has on average.

    The stars are counted about stars of the database, so that it may be of a part of the sky.
    """
    across, down = camera.width_px, camera.height_px
    radius_rad = math.atan(math.sqrt(across * down / math.pi) / camera.focal_length_px)
    return database.cached(_mean_stars, radius_rad)


def _mean_stars(database: MatcherDatabase, radius_rad: float) -> float:
    axes = database.directions[:: max(1, len(database.mag) // SAMPLE)]
    others = sum(len(stars_in_cap(database, axis, radius_rad)) - 1 for axis in axes)
    return others / max(1, len(axes))


def with_few_stars(why: Refusal, database: MatcherDatabase, camera: Camera) -> Refusal:
    """Return why a frame was not identified; that its field has too few stars comes first."""
    if why.reason not in _OF_SEARCHES:
        return why
    count = mean_stars(database, camera)
    if count >= FEW_STARS:
        return why
    return replace(
        why, reason="few_guide_stars", mean_stars=count, searched_fov_deg=camera.fov_x_deg
    )
