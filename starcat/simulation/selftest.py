"""The self-test: a database identifies fields simulated from its own stars, or it is no good."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from starcat.geometry.attitude import matrix_from_quaternion
from starcat.matcher.chance import MIN_STARS
from starcat.matcher.matcher import Matcher
from starcat.matcher.result import MatchResult
from starcat.progress import Progress, no_progress
from starcat.simulation.simulate import Frame, Noise, simulate_frames

HARD = {"drop_probability": 0.1, "false_stars": 3}
"""What the harder half of the self-test adds to the noise of the spec."""


@dataclass(frozen=True)
class Rates:
    """How a number of frames fared.

    Attributes
    ----------
    name : str
        Which frames: ``clean`` or ``hard``.
    noise_px, drop_probability : float
        What they suffered.
    false_stars : int
        The same.
    frames, identifiable : int
        All, and those with at least 4 stars.
    identified, wrong : int
        Identified rightly; answered with a wrong star or attitude.
    median_residual_arcsec : float
        Median over the identified frames; 0 where there are none.
    """

    name: str
    noise_px: float
    drop_probability: float
    false_stars: int
    frames: int
    identifiable: int
    identified: int
    wrong: int
    median_residual_arcsec: float

    @property
    def identified_share(self) -> float:
        """Identified over identifiable; 0 where no frame can be."""
        return self.identified / self.identifiable if self.identifiable else 0.0

    def as_dict(self) -> dict[str, Any]:
        """Return the rates as the report holds them.

        Returns
        -------
        dict
            Plain values.
        """
        return {**asdict(self), "identified_share": round(self.identified_share, 6)}


def self_test(
    matcher: Matcher, frames: int, noise_px: float, seed: int, progress: Progress = no_progress
) -> tuple[Rates, Rates]:
    """Identify simulated fields with the database that they were simulated from.

    Parameters
    ----------
    matcher : Matcher
        The matcher, with the database open.
    frames : int
        Fields of each kind.
    noise_px : float
        Standard deviation of a centroid, each axis.
    seed : int
        Seed of the attitudes and the noise.
    progress : Progress
        Called with ("self-test", frames done, frames in all).

    Returns
    -------
    clean, hard : Rates
        Rates with noise only, and with stars missing and false ones beside it.
    """
    kinds = {"clean": Noise(noise_px), "hard": Noise(noise_px, **HARD)}  # type: ignore[arg-type]
    made = []
    for step, (name, noise) in enumerate(kinds.items()):
        simulated = simulate_frames(
            matcher.database.directions, matcher.database.camera, frames, noise, seed
        )
        done = step * frames
        made.append(_rates(matcher, name, noise, simulated, progress, done, 2 * frames))
    return made[0], made[1]


def _rates(
    matcher: Matcher,
    name: str,
    noise: Noise,
    frames: Iterable[Frame],
    progress: Progress,
    done: int,
    total: int,
) -> Rates:
    count = identifiable = right = wrong = 0
    residuals = []
    for frame in frames:
        result = matcher.identify(frame.centroids_px)
        count += 1
        identifiable += frame.n_stars >= MIN_STARS
        if result.status == "identified":
            is_right = answers_rightly(result, frame, matcher)
            right += is_right
            wrong += not is_right
            residuals.append(result.residual_arcsec)
        progress("self-test", done + count, total)
    return Rates(
        name,
        noise.noise_px,
        noise.drop_probability,
        noise.false_stars,
        count,
        identifiable,
        right,
        wrong,
        round(float(np.median(residuals)), 6) if residuals else 0.0,
    )


def answers_rightly(result: MatchResult, frame: Frame, matcher: Matcher) -> bool:
    """Return whether an answer is right.

    Parameters
    ----------
    result : MatchResult
        The answer to the frame, which is identified.
    frame : Frame
        The truth.
    matcher : Matcher
        The matcher, whose camera and tolerance say how near is near.

    Returns
    -------
    bool
        True if the attitude puts every star that is in the frame within the tolerance of its
        true place. A false spot that lies on a star's place may carry that star's name.
    """
    camera, database = matcher.database.camera, matcher.database
    star = frame.star_index[frame.star_index >= 0]
    q = result.q_body_from_icrs
    truth = camera.pixels_from_directions(database.directions[star] @ frame.matrix.T)
    found = camera.pixels_from_directions(database.directions[star] @ matrix_from_quaternion(q).T)
    return bool(np.all(np.hypot(*(truth - found).T) <= matcher.tolerance_px))
