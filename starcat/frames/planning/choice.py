"""The choice of guide stars for one attitude: stages of limits, and why other stars are left out.

Each stage has limits that are looser than those of the previous one. Stars that meet the limits of
a stage are taken in the order of brightness until there are enough, as proseco does for Chandra.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from starcat.errors import ConfigError
from starcat.geometry.camera import Camera


@dataclass(frozen=True)
class StageOfLimits:
    """The limits of one stage; ends are included.

    Attributes
    ----------
    min_detection : float
        Probability to be detected.
    max_contamination : float
        Fraction of the light from other stars, if it is known.
    max_offset_px : float
        Shift of the centroid by other stars, if it is known.
    max_lookalikes : float
        Stars of similar brightness in the window.
    min_edge_px : float
        Distance from the edge of the detector.
    min_apart_fraction : float
        Distance from the stars that are already chosen, over the width of the detector.
    """

    min_detection: float
    max_contamination: float
    max_offset_px: float
    max_lookalikes: float
    min_edge_px: float
    min_apart_fraction: float


STAGES = (
    StageOfLimits(0.99, 0.02, 0.05, 0, 20.0, 0.10),
    StageOfLimits(0.95, 0.05, 0.10, 0, 10.0, 0.05),
    StageOfLimits(0.80, 0.20, 0.25, 2, 5.0, 0.02),
    StageOfLimits(0.50, 0.50, 1.00, np.inf, 0.0, 0.0),
)


@dataclass(frozen=True)
class Choice:
    """The stars that are taken, with the stage of each, and the others, with the reason of each."""

    stages: tuple[StageOfLimits, ...]
    taken: tuple[Mapping[str, Any], ...]  # each with ``stage``, from 1
    left: tuple[Mapping[str, Any], ...]  # each with ``reason``


def choose_best(
    stars: Sequence[Mapping[str, Any]],
    camera: Camera,
    count: int,
    stages: Sequence[StageOfLimits] = STAGES,
) -> Choice:
    """Choose guide stars of one attitude.

    Parameters
    ----------
    stars : sequence of mapping
        As `Plan.stars_of` returns them, the brightest first.
    camera : Camera
    count : int
        Number of stars to take; fewer are taken if not as many meet the limits.
    stages : sequence of StageOfLimits
        Limits, the strictest first.

    Returns
    -------
    Choice
        Every star is in it once.
    """
    if isinstance(count, bool) or not 0 < count <= 1000:
        raise ConfigError("expected 1 to 1000 stars", parameter="count", value=count)
    taken: list[dict[str, Any]] = []
    waiting = list(stars)
    for number, stage in enumerate(stages, 1):
        still = []
        for star in waiting:
            if len(taken) < count and not broken_limit(star, stage, taken, camera):
                taken.append({**star, "stage": number})
            else:
                still.append(star)
        waiting = still
    others = []
    for star in waiting:
        broken = broken_limit(star, stages[-1], taken if len(taken) < count else [], camera)
        if not broken:
            first = broken_limit(star, stages[0], taken, camera)
            broken = f"stage 1: {first}" if first else f"{count} brighter stars were taken"
        others.append({**star, "reason": broken})
    return Choice(tuple(stages), tuple(taken), tuple(others))


def broken_limit(
    star: Mapping[str, Any],
    stage: StageOfLimits,
    taken: Sequence[Mapping[str, Any]],
    camera: Camera,
) -> str:
    """Return which limit of a stage a star does not meet, with its value; empty if it meets all."""
    x, y = star["x_px"], star["y_px"]
    edge = min(x, y, camera.width_px - x, camera.height_px - y)
    apart = stage.min_apart_fraction * camera.width_px
    limits = (
        ("detection", star["detection_probability"], stage.min_detection, 1.0),
        ("contamination", star["contamination"] or 0.0, stage.max_contamination, -1.0),
        ("offset px", star["centroid_offset_px"] or 0.0, stage.max_offset_px, -1.0),
        ("look-alikes", star["lookalikes"], stage.max_lookalikes, -1.0),
        ("edge px", edge, stage.min_edge_px, 1.0),
    )
    for name, value, limit, sign in limits:
        if sign * (value - limit) < 0.0:
            return f"{name} {value:.3g}, limit {limit:g}"
    for other in taken:
        distance = float(np.hypot(x - other["x_px"], y - other["y_px"]))
        if distance < apart:
            return f"{distance:.0f} px from {other['star']}, limit {apart:.0f}"
    return ""
