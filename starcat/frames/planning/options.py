"""The options of a plan, each declared once, as `starcat.matcher.options` does for identification.

Python, the checks and the command line are made from this declaration. The noises and the bound on
false matches have the ranges of simulated frames and of the matcher.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from starcat.matcher.options import OPTIONS, SIMULATED, Option, option, options_of


def _like(other: Option, default: Any, description: str) -> Any:
    """Declare an option with the range of another one."""
    return option(default, description, other.low, other.high)


_CHANCE = OPTIONS["max_false_match_probability"]


@dataclass(frozen=True, kw_only=True)
class PlanOptions:
    """What is expected of the sensor and of its stars."""

    noise_px: float | None = _like(
        OPTIONS["noise_px"], None, "Noise of a centroid, each axis; default: the spec's."
    )
    noise_mag: float | None = _like(
        SIMULATED["noise_mag"], None, "Noise of a magnitude; default: the spec's."
    )
    limit_mag: float | None = option(None, "Fainter stars are not detected; default: all are.")
    drop_probability: float = _like(
        SIMULATED["drop_probability"], 0.0, SIMULATED["drop_probability"].description
    )
    false_stars: int = option(0, "Centroids per frame that are not stars.", 0, 10_000)
    window_arcsec: float | None = option(
        None, "Radius of an acquisition window; default: 20 px.", 0, 36_000
    )
    lookalike_mag: float = option(
        1.0, "A star in the window whose magnitude differs by less can be taken for another.", 0, 30
    )
    min_acquisition: float = option(0.9, "A lower probability of acquisition is a gap.", 0, 1)
    max_false_match_probability: float = _like(_CHANCE, _CHANCE.default, _CHANCE.description)


PLANNED = options_of(PlanOptions)
"""Options of a plan, by the name of the parameter."""
