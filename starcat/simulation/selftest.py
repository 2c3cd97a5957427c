"""The self-test: a database identifies fields simulated from its own stars, or it is no good."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np

from starcat.geometry.attitude import matrix_from_quaternion
from starcat.matcher.chance import MIN_STARS
from starcat.matcher.matcher import Matcher
from starcat.matcher.result import MatchResult
from starcat.progress import Progress, no_progress
from starcat.simulation.simulate import Frame, Noise, simulate_frames

NOISE_MAG = 0.2
"""Standard deviation of a magnitude that a camera measures of a star, unless a spec says another:
the colour of a star alone makes so much of a difference between two bands."""

HARD = {"drop_probability": 0.1, "false_stars": 3}
"""What the harder half of the self-test adds to the noise of the spec."""


@dataclass(frozen=True)
class Rates:
    """How a number of frames fared."""

    # Which frames: ``clean`` or ``hard``, and ``, no magnitudes`` where none were given.
    name: str
    # What they suffered.
    noise_px: float
    drop_probability: float
    # The same.
    false_stars: int
    # Standard deviation of the magnitudes; None where none were given.
    noise_mag: float | None
    # All, and those with at least 4 stars.
    frames: int
    identifiable: int
    # Identified rightly; answered with a wrong star or attitude.
    identified: int
    wrong: int
    # Median over the identified frames; 0 where there are none.
    median_residual_arcsec: float
    # Stars in each of the identifiable frames that were not identified rightly.
    missed: tuple[int, ...] = ()

    @property
    def identified_share(self) -> float:
        """Identified over identifiable; 0 where no frame can be."""
        return self.identified / self.identifiable if self.identifiable else 0.0

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's interval of 95 % of that share; 0 to 1 where no frame can be identified."""
        return wilson_interval(self.identified, self.identifiable)

    def as_dict(self) -> dict[str, Any]:
        """Return the rates as the report holds them."""
        content = asdict(self)
        del content["missed"]
        least, most = (round(end, 6) for end in self.interval)
        return {
            **content,
            "identified_share": round(self.identified_share, 6),
            "least_share": least,
            "most_share": most,
        }


def rates_of(content: Mapping[str, Any]) -> Rates:
    """Return the rates that a report tells."""
    names = [field.name for field in fields(Rates) if field.name in content]
    return Rates(**{name: content[name] for name in names})


def self_test(
    matcher: Matcher,
    frames: int,
    noise_px: float,
    seed: int,
    progress: Progress = no_progress,
    *,
    noise_mag: float = NOISE_MAG,
    without_magnitudes: int | None = None,
) -> tuple[Rates, ...]:
    """Identify simulated fields with the database that they were simulated from."""
    kinds = {"clean": Noise(noise_px), "hard": Noise(noise_px, **HARD)}  # type: ignore[arg-type]
    bare = frames if without_magnitudes is None else min(frames, without_magnitudes)
    with_mag, without = [], []
    for step, (name, noise) in enumerate(kinds.items()):
        counts = _Count(name, noise, noise_mag), _Count(f"{name}, no magnitudes", noise, None)
        simulated = simulate_frames(
            matcher.database.directions,
            matcher.database.camera,
            frames,
            replace(noise, noise_mag=noise_mag),
            seed,
            matcher.database.mag,
        )
        for number, frame in enumerate(simulated):
            counts[0].add(frame, matcher)
            if number < bare:
                counts[1].add(frame, matcher)
            progress("self-test", step * frames + number + 1, 2 * frames)
        with_mag.append(counts[0].rates())
        without.append(counts[1].rates())
    return (*with_mag, *without)


class _Count:
    """Frames of one kind, counted one by one."""

    def __init__(self, name: str, noise: Noise, noise_mag: float | None) -> None:
        self._name, self._noise, self._noise_mag = name, noise, noise_mag
        self._frames = self._identifiable = self._identified = self._wrong = 0
        self._residuals: list[float] = []
        self._missed: list[int] = []

    def add(self, frame: Frame, matcher: Matcher) -> None:
        """Identify a frame and count how it fared."""
        magnitudes = None if self._noise_mag is None else frame.mag
        result = matcher.identify(frame.centroids_px, magnitudes=magnitudes)
        is_identifiable = frame.n_stars >= MIN_STARS
        is_right = False
        if result.status == "identified":
            is_right = answers_rightly(result, frame, matcher)
            self._residuals.append(result.residual_arcsec)
            self._wrong += not is_right
        self._frames += 1
        self._identifiable += is_identifiable
        self._identified += is_identifiable and is_right
        if is_identifiable and not is_right:
            self._missed.append(frame.n_stars)

    def rates(self) -> Rates:
        """Return what was counted."""
        return Rates(
            self._name,
            self._noise.noise_px,
            self._noise.drop_probability,
            self._noise.false_stars,
            self._noise_mag,
            self._frames,
            self._identifiable,
            self._identified,
            self._wrong,
            round(float(np.median(self._residuals)), 6) if self._residuals else 0.0,
            tuple(self._missed),
        )


def answers_rightly(result: MatchResult, frame: Frame, matcher: Matcher) -> bool:
    """Return whether an answer is right."""
    camera, database = matcher.database.camera, matcher.database
    star = frame.star_index[frame.star_index >= 0]
    q = result.q_body_from_icrs
    truth = camera.pixels_from_directions(database.directions[star] @ frame.matrix.T)
    found = camera.pixels_from_directions(database.directions[star] @ matrix_from_quaternion(q).T)
    return bool(np.all(np.hypot(*(truth - found).T) <= matcher.tolerance_px))


Z95 = 1.959963984540054
"""Standard deviations of a two-sided interval of 95 %."""


def wilson_interval(hits: int, count: int) -> tuple[float, float]:
    """Return Wilson's interval of 95 % of a share.

    References
    ----------
    Wilson 1927, Journal of the American Statistical Association 22, 209.

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
