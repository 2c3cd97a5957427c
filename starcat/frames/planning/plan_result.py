"""The plan of a star sensor: its conditions, and what it sees at each attitude."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array, Mask, Pixels, Rows
from starcat.errors import ConfigError
from starcat.frames.planning.attitudes import PlannedAttitudes
from starcat.frames.planning.choice import STAGES, Choice, StageOfLimits, choose_best
from starcat.frames.planning.options import PLANNED
from starcat.frames.sky.bodies import RADII_KM
from starcat.geometry.attitude import quaternion_from_matrix, radec_roll_from_matrix
from starcat.geometry.camera import Camera
from starcat.matcher.database import MatcherDatabase
from starcat.matcher.options import checked_option
from starcat.results import to_dict


@dataclass(frozen=True)
class Expected:
    """The expected properties of the sensor, and the requirements on the plan.

    Attributes
    ----------
    noise_px, noise_mag : float
        Standard deviations of a centroid on each axis, and of a magnitude.
    limit_mag : float or None
        Fainter measured magnitudes are not detected; None if all guide stars are.
    drop_probability : float
        Probability that a star is missing for other reasons.
    false_stars : int
        Centroids of each frame that are not stars.
    window_arcsec, lookalike_mag : float
        Radius of the window in which a star is looked for, and the largest difference of the
        magnitude of a star that can be taken for it.
    keep_out_deg : mapping of str to float
        Smallest angles from the boresight: to the limb of the Earth, to the middle of other bodies.
    min_acquisition : float
        Smallest probability of acquisition that is not a gap.
    max_false_match_probability : float
        As of `Matcher`.
    """

    noise_px: float
    noise_mag: float
    limit_mag: float | None
    drop_probability: float
    false_stars: int
    window_arcsec: float
    lookalike_mag: float
    keep_out_deg: Mapping[str, float]
    min_acquisition: float
    max_false_match_probability: float

    def __post_init__(self) -> None:
        for name, declared in PLANNED.items():
            if declared.is_number:
                checked_option(name, getattr(self, name), PLANNED)
        for name, angle in self.keep_out_deg.items():
            if name not in RADII_KM or not 0.0 <= angle <= 180.0:
                raise ConfigError(
                    f"{name} has {angle:g}; expected one of {', '.join(RADII_KM)} "
                    "with an angle of 0 to 180 deg",
                    parameter="keep_out_deg",
                )


@dataclass(frozen=True, eq=False)
class PlannedStars:
    """Stars that are expected in frames, one row per star and attitude, arrays of shape (P,)."""

    attitude: Rows  # row of the attitude, ascending; by brightness in each
    star_index: NDArray[np.int64]  # row of the database
    px: Pixels  # shape (P, 2)
    detection: Array  # probability to be detected


@dataclass(frozen=True)
class Gap:
    """Consecutive attitudes, the last included, at which the sensor cannot be used."""

    first: int
    last: int
    start: str | None  # UTC
    end: str | None
    reasons: tuple[str, ...]  # ``acquisition``, or the bodies that are within their keep-out angle


@dataclass(frozen=True, eq=False)
class Plan:
    """What a sensor will see at K attitudes.

    Attributes
    ----------
    error_arcsec : ndarray of float64, shape (K, 3)
        Standard deviations of the attitude about x, y and z of the camera; infinite if the stars
        determine no attitude.
    acquisition : ndarray of float64, shape (K,)
        Probability that the frame is identified without a prior attitude, by a matcher with this
        ``noise_px``.
    stars_expected : ndarray of float64, shape (K,)
        Mean number of detected guide stars.
    angles_deg : mapping of str to ndarray of float64, shape (K,)
        Angles from the boresight to the bodies of the solar system: to the limb of the Earth (with
        an orbit), to the middles of the others. Empty without times.
    bodies : tuple of tuple of dict
        The Sun, the Moon and planets in each frame: name, x_px, y_px, mag.
    stars : PlannedStars
        The stars of all frames; `stars_of` returns the stars of one frame with all their values.
    """

    database: MatcherDatabase
    camera: Camera
    expected: Expected
    attitudes: PlannedAttitudes
    error_arcsec: Array
    acquisition: Array
    stars_expected: Array
    angles_deg: Mapping[str, Array]
    bodies: tuple[tuple[dict[str, Any], ...], ...]
    stars: PlannedStars
    # For each star of the database: number of look-alikes, and the values of its blend from the
    # build, NaN if the spec states no window.
    lookalikes: NDArray[np.int64]
    contamination: Array
    centroid_offset_px: Array

    def __len__(self) -> int:
        return len(self.acquisition)

    def __repr__(self) -> str:
        usable = int(self.is_usable.sum())
        return f"<Plan {self.database.name}: {len(self):,} attitudes, {usable:,} usable>"

    @cached_property
    def violated(self) -> dict[str, Mask]:
        """Bodies that are within their keep-out angle, each with a mask of shape (K,)."""
        asked = self.expected.keep_out_deg
        return {name: self.angles_deg[name] < angle for name, angle in asked.items()}

    @property
    def is_usable(self) -> Mask:
        """Attitudes with the required acquisition and no body too near, shape (K,)."""
        near = np.zeros(len(self), dtype=bool)
        for mask in self.violated.values():
            near |= mask
        return np.asarray((self.acquisition >= self.expected.min_acquisition) & ~near)

    @cached_property
    def gaps(self) -> tuple[Gap, ...]:
        """The attitudes that are not usable; consecutive ones form one gap."""
        edges = np.flatnonzero(np.diff(np.concatenate([[True], self.is_usable, [True]])))
        gaps = []
        for first, end in edges.reshape(-1, 2).tolist():
            rows = slice(first, end)
            reasons = [name for name, mask in self.violated.items() if mask[rows].any()]
            if (self.acquisition[rows] < self.expected.min_acquisition).any():
                reasons.insert(0, "acquisition")
            times = self.time(first), self.time(end - 1)
            gaps.append(Gap(first, end - 1, *times, tuple(reasons)))
        return tuple(gaps)

    def time(self, row: int) -> str | None:
        """Return the time of an attitude, UTC in ISO 8601; None without times."""
        times = self.attitudes.times
        return None if times is None else times[row].isoformat().replace("+00:00", "Z")

    def stars_of(self, row: int) -> list[dict[str, Any]]:
        """Return the guide stars expected at an attitude, the brightest first.

        Parameters
        ----------
        row : int
            Number of the attitude, from 0.

        Returns
        -------
        list of dict
            One per star: its name, magnitude, pixels, and probability of detection.
        """
        rows = slice(*np.searchsorted(self.stars.attitude, [row, row + 1]).tolist())
        index = self.stars.star_index[rows]
        columns = {
            "star": [name.decode() for name in self.database.designation[index].tolist()],
            "mag": self.database.mag[index].tolist(),
            "x_px": self.stars.px[rows, 0].tolist(),
            "y_px": self.stars.px[rows, 1].tolist(),
            "detection_probability": self.stars.detection[rows].tolist(),
            "lookalikes": self.lookalikes[index].tolist(),
            "contamination": _or_none(self.contamination[index]),
            "centroid_offset_px": _or_none(self.centroid_offset_px[index]),
        }
        rows_of_cells = zip(*columns.values(), strict=True)
        return [dict(zip(columns, cells, strict=True)) for cells in rows_of_cells]

    def attitude(self, row: int) -> dict[str, Any]:
        """Return all values of an attitude except its stars, as plain values.

        Parameters
        ----------
        row : int
            Number of the attitude, from 0.

        Returns
        -------
        dict
            The same keys as an attitude of ``starcat plan --json``.
        """
        matrix = self.attitudes.matrices[row]
        ra_deg, dec_deg, roll_deg = radec_roll_from_matrix(matrix)
        return {
            "time": self.time(row),
            "q_body_from_icrs": quaternion_from_matrix(matrix).tolist(),
            "boresight_ra_deg": ra_deg,
            "boresight_dec_deg": dec_deg,
            "roll_deg": roll_deg,
            "stars_expected": float(self.stars_expected[row]),
            "error_arcsec": _or_none(self.error_arcsec[row]),
            "acquisition_probability": float(self.acquisition[row]),
            "angles_deg": {name: float(angle[row]) for name, angle in self.angles_deg.items()},
            "keep_out_violated": [name for name, mask in self.violated.items() if mask[row]],
            "bodies_in_frame": list(self.bodies[row]),
        }

    @property
    def summary(self) -> dict[str, Any]:
        """The whole plan in a few numbers."""
        errors = self.error_arcsec[np.isfinite(self.error_arcsec[:, 0])]
        return {
            "attitudes": len(self),
            "usable": int(self.is_usable.sum()),
            "mean_acquisition_probability": float(self.acquisition.mean()),
            "least_acquisition_probability": float(self.acquisition.min()),
            "median_stars_expected": float(np.median(self.stars_expected)),
            "median_error_arcsec": np.median(errors, axis=0).tolist() if len(errors) else None,
            "gaps": len(self.gaps),
        }

    def to_dict(self) -> dict[str, Any]:
        """Return the plan as plain values, which JSON can hold."""
        rows = range(len(self))
        return to_dict(
            {
                "database": self.database.name,
                "camera": self.camera.in_words,
                "expected": self.expected,
                "summary": self.summary,
                "gaps": self.gaps,
                "attitudes": [{**self.attitude(row), "stars": self.stars_of(row)} for row in rows],
            }
        )

    def best(self, count: int, row: int = 0, stages: Sequence[StageOfLimits] = STAGES) -> Choice:
        """Choose guide stars of one attitude in stages of limits, as `choose_best`.

        Parameters
        ----------
        count : int
            Number of stars to choose.
        row : int, default 0
            Number of the attitude.
        stages : sequence of StageOfLimits
            Limits, the strictest first.

        Returns
        -------
        Choice
            The chosen stars with their stages, and the limit that every other star does not meet.
        """
        if not 0 <= row < len(self):
            raise ConfigError(
                f"expected an attitude of the plan, 0 to {len(self) - 1}",
                parameter="row",
                value=row,
            )
        return choose_best(self.stars_of(row), self.camera, count, stages)


def _or_none(values: Array) -> list[float | None]:
    return [value if math.isfinite(value) else None for value in values.tolist()]
