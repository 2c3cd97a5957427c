"""The self-test: a usable database must identify fields simulated from its own stars."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple

import numpy as np

from starcat.arrays import Array
from starcat.geometry.attitude import matrix_from_quaternion
from starcat.geometry.footprint import Footprint
from starcat.matcher.chance import MIN_STARS
from starcat.matcher.matcher import Matcher
from starcat.matcher.result import MatchResult
from starcat.pipeline.simulation.simulate import Noise, SimulatedFrame, simulate_frames
from starcat.progress import Progress, no_progress
from starcat.results import in_record, to_dict

NOISE_MAG = 0.2
"""Standard deviation of a measured magnitude, unless a spec sets another: the colour of a star
alone makes a difference of this size between two bands."""

HARD = {"drop_probability": 0.1, "false_stars": 3}
"""Additions of the harder half of the self-test to the noise of the spec."""


@dataclass(frozen=True)
class Rates:
    """Results of a number of frames."""

    name: str  # kind of frames: ``clean`` or ``hard``, and ``, no magnitudes`` without them
    noise_px: float  # noise of the frames, with the next two
    drop_probability: float
    false_stars: int
    noise_mag: float | None  # standard deviation of the magnitudes; None without magnitudes
    frames: int
    identifiable: int  # frames with at least 4 stars
    identified: int  # frames that were identified correctly
    wrong: int  # answered with a wrong star or attitude
    # Median over the identified frames, to 0.01 arcsec; 0 if there are none. The stars of the C
    # matcher are rounded to 5e-5 arcsec: its residuals differ from those of numpy by some 1e-6.
    median_residual_arcsec: float
    # Stars in each of the identifiable frames that were not identified correctly.
    missed: tuple[int, ...] = field(default=(), repr=False)

    @property
    @in_record(decimals=6)
    def identified_share(self) -> float:
        """Share of all pointings that are identified; 0 if none was tried."""
        return self.identified / self.frames if self.frames else 0.0

    @property
    @in_record(decimals=6)
    def share_of_identifiable(self) -> float:
        """Share of the frames with at least 4 stars that are identified; 0 if there are none."""
        return self.identified / self.identifiable if self.identifiable else 0.0

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's interval of 95 % of the share of all pointings."""
        return wilson_interval(self.identified, self.frames)

    @property
    @in_record(decimals=6)
    def least_share(self) -> float:
        """Lower end of `interval`."""
        return self.interval[0]

    @property
    @in_record(decimals=6)
    def most_share(self) -> float:
        """Upper end of `interval`."""
        return self.interval[1]

    def as_dict(self) -> dict[str, Any]:
        """Return the rates as the report holds them."""
        return to_dict(self)


def rates_of(content: Mapping[str, Any]) -> Rates:
    """Return the rates that a report contains."""
    values = {f.name: content[f.name] for f in fields(Rates) if f.name in content}
    return Rates(**{"noise_mag": None, **values})  # version 0.1.0 gave no magnitudes


def self_test(
    matcher: Matcher,
    frames: int,
    noise_px: float,
    seed: int,
    progress: Progress = no_progress,
    *,
    noise_mag: float = NOISE_MAG,
    without_magnitudes: int | None = None,
    part: Footprint | None = None,
) -> tuple[Rates, ...]:
    """Identify simulated fields with the database that they were simulated from.

    ``part`` is the part of the sphere that the database is for; default: all of it.
    """
    matcher = matcher.for_many_frames()
    kinds = {"clean": Noise(noise_px), "hard": Noise(noise_px, **HARD)}  # type: ignore[arg-type]
    bare = frames if without_magnitudes is None else min(frames, without_magnitudes)
    with_mag, without = [], []
    for step, (name, noise) in enumerate(kinds.items()):
        simulated = simulate_frames(
            matcher.database.directions,
            matcher.database.camera,
            frames,
            replace(noise, noise_mag=noise_mag),
            seed,
            matcher.database.mag,
            part,
        )
        outcomes: list[_Outcome] = []
        bare_outcomes: list[_Outcome] = []
        for number, frame in enumerate(simulated):
            outcomes.append(_outcome(matcher, frame, frame.mag))
            if number < bare:
                bare_outcomes.append(_outcome(matcher, frame, None))
            progress("self-test", step * frames + number + 1, 2 * frames)
        with_mag.append(_rates(name, noise, noise_mag, outcomes))
        without.append(_rates(f"{name}, no magnitudes", noise, None, bare_outcomes))
    return (*with_mag, *without)


class _Outcome(NamedTuple):
    """The result of one frame."""

    n_stars: int
    is_right: bool
    residual_arcsec: float | None  # None if it was not identified


def _outcome(matcher: Matcher, frame: SimulatedFrame, mag: Array | None) -> _Outcome:
    result = matcher.identify(frame.centroids_px, mag=mag)
    if not result.ok:
        return _Outcome(frame.n_stars, is_right=False, residual_arcsec=None)
    return _Outcome(frame.n_stars, answers_rightly(result, frame, matcher), result.residual_arcsec)


def _rates(name: str, noise: Noise, noise_mag: float | None, outcomes: list[_Outcome]) -> Rates:
    identifiable = [outcome for outcome in outcomes if outcome.n_stars >= MIN_STARS]
    missed = tuple(outcome.n_stars for outcome in identifiable if not outcome.is_right)
    residuals = [
        outcome.residual_arcsec for outcome in outcomes if outcome.residual_arcsec is not None
    ]
    return Rates(
        name,
        noise.noise_px,
        noise.drop_probability,
        noise.false_stars,
        noise_mag,
        frames=len(outcomes),
        identifiable=len(identifiable),
        identified=len(identifiable) - len(missed),
        wrong=len(residuals) - sum(outcome.is_right for outcome in outcomes),
        median_residual_arcsec=round(float(np.median(residuals)), 2) if residuals else 0.0,
        missed=missed,
    )


def answers_rightly(result: MatchResult, frame: SimulatedFrame, matcher: Matcher) -> bool:
    """Return whether an answer puts each star within the tolerance of its true pixel."""
    camera, database = matcher.database.camera, matcher.database
    star = frame.star_index[frame.star_index >= 0]
    q = result.q_body_from_icrs
    truth = camera.pixels_from_directions(database.directions[star] @ frame.matrix.T)
    solved = camera.pixels_from_directions(database.directions[star] @ matrix_from_quaternion(q).T)
    return bool(np.all(np.hypot(*(truth - solved).T) <= matcher.settings.tolerance_px))


Z95 = 1.959963984540054
"""Standard deviations of a two-sided interval of 95 %."""


def wilson_interval(hits: int, count: int) -> tuple[float, float]:
    """Return Wilson's interval of 95 % of a share (1927, J. Am. Stat. Assoc. 22, 209).

    Examples
    --------
    >>> [round(end, 3) for end in wilson_interval(88, 100)]
    [0.802, 0.93]
    """
    if not count:
        return 0.0, 1.0
    p, n, z2 = hits / count, count, Z95 * Z95
    middle = (p + 0.5 * z2 / n) / (1.0 + z2 / n)
    half = Z95 / (1.0 + z2 / n) * (p * (1.0 - p) / n + 0.25 * z2 / (n * n)) ** 0.5
    return max(0.0, middle - half), min(1.0, middle + half)
