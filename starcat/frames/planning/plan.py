"""Plans: the guide stars that a sensor will see at many attitudes, and the resulting accuracy."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from starcat.arrays import Array, Mask, Pixels, Rows
from starcat.catalog.stars.star_table import directions_of, floats_of
from starcat.database.reader import DatabaseFolder, open_artifact
from starcat.errors import ConfigError
from starcat.frames.planning.acquisition import acquisition_probability, expected_errors_arcsec
from starcat.frames.planning.attitudes import Orbit, PlannedAttitudes, attitudes_of, orbit_of
from starcat.frames.planning.choice import STAGES, Choice, StageOfLimits, choose_best
from starcat.frames.planning.options import PLANNED, PlanOptions
from starcat.frames.sky.bodies import RADII_KM, bodies_seen
from starcat.frames.sky.in_time import FAINTER_MAG, earth_limb_angle_deg
from starcat.frames.sky.observer import Observer, aberrated
from starcat.geometry.attitude import quaternion_from_matrix, radec_roll_from_matrix
from starcat.geometry.camera import Camera
from starcat.geometry.sphere import chord_from_separation, directions_from_radec, separation
from starcat.matcher.database import Database, open_database
from starcat.matcher.options import checked_option
from starcat.matcher.settings import NOISE_DEVIATIONS, REACH
from starcat.matcher.stars import ARCSEC
from starcat.pipeline.specs.reading import spec_of_database
from starcat.results import to_dict

BLOCK = 2000
"""Number of attitudes that are planned at once."""

MIN_DETECTION = 0.001
"""Stars that are less likely to be detected are not listed."""

NEAREST_RAD = np.radians(0.01)
"""Margin of the search for stars, which aberration displaces by 0.006 deg."""


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

    database: Database
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


def plan_attitudes(
    folder: Path,
    attitudes: Any,
    *,
    orbit: Any = None,
    alignment: Any = None,
    camera: Camera | None = None,
    keep_out_deg: Mapping[str, float] | None = None,
    **stated: Any,
) -> Plan:
    """Return what a sensor with a database will see at attitudes, as `starcat.plan`."""
    artifact, database = open_artifact(folder), open_database(folder)
    eye, test = camera or database.camera, spec_of_database(artifact).self_test
    options = PlanOptions(**stated)
    expected = Expected(
        test.noise_px if options.noise_px is None else options.noise_px,
        test.noise_mag if options.noise_mag is None else options.noise_mag,
        options.limit_mag,
        options.drop_probability,
        options.false_stars,
        20.0 * eye.pixel_arcsec if options.window_arcsec is None else options.window_arcsec,
        options.lookalike_mag,
        dict(keep_out_deg or {}),
        options.min_acquisition,
        options.max_false_match_probability,
    )
    planned = attitudes_of(attitudes, alignment)
    observers = _observers(planned, None if orbit is None else orbit_of(orbit))
    angles, bodies, hidden = _surroundings(planned, observers, eye, database)
    for name in expected.keep_out_deg:
        if name not in angles:
            needed = "attitudes with a time" if observers is None else "an orbit"
            raise ConfigError(
                f"the angle of {name} needs {needed}",
                parameter="keep_out_deg",
                hint=() if observers is None else "give it with {orbit}",
            )
    blocks = [
        _planned_block(database, planned, observers, hidden, eye, expected, bodies, first)
        for first in range(0, len(planned.matrices), BLOCK)
    ]

    def joined(name: str) -> Any:
        return np.concatenate([getattr(block, name) for block in blocks])

    contamination, offset_px = _blends(artifact, database, eye)
    return Plan(
        database,
        eye,
        expected,
        planned,
        joined("error_arcsec"),
        joined("acquisition"),
        joined("stars_expected"),
        angles,
        bodies,
        PlannedStars(*(joined(name) for name in PlannedStars.__dataclass_fields__)),
        _lookalikes(artifact, database, expected),
        contamination,
        offset_px,
    )


def _observers(planned: PlannedAttitudes, orbit: Orbit | None) -> list[Observer] | None:
    if planned.times is None:
        if orbit is not None:
            raise ConfigError(
                "orbit is given, but the attitudes have no time", hint="add a column time"
            )
        return None
    if orbit is not None:
        return orbit.observers(planned.times)
    return [Observer.at(time) for time in planned.times]


@dataclass(frozen=True)
class _Disc:
    """A disc that hides stars."""

    direction: Array
    radius_rad: float


_Bodies = tuple[tuple[dict[str, Any], ...], ...]


def _surroundings(
    planned: PlannedAttitudes, observers: list[Observer] | None, camera: Camera, database: Database
) -> tuple[dict[str, Array], _Bodies, list[list[_Disc]]]:
    """Return angles of bodies, bodies in the frames, and discs that hide stars, by attitude."""
    if observers is None:
        count = len(planned.matrices)
        return {}, ((),) * count, [[] for _ in range(count)]
    faintest = float(database.mag.max()) + FAINTER_MAG
    angles, in_frame, hidden = [], [], []
    for observer, matrix in zip(observers, planned.matrices, strict=True):
        seen = bodies_seen(observer)
        angle = np.degrees(separation(seen.directions, matrix[2]))
        px = camera.pixels_from_directions(seen.directions @ matrix.T)
        inside = camera.contains(px) & (seen.mag <= faintest)
        if observer.is_placed:
            limb = earth_limb_angle_deg(matrix[2], observer)
            angle[seen.row("Earth")] = limb
            inside[seen.row("Earth")] = False
        angles.append(angle)
        in_frame.append(
            tuple(
                {
                    "name": seen.names[k],
                    "x_px": float(px[k, 0]),
                    "y_px": float(px[k, 1]),
                    "mag": float(seen.mag[k]),
                }
                for k in np.flatnonzero(inside)
            )
        )
        large = np.flatnonzero(seen.radius_rad > 0.1 / camera.focal_length_px)
        discs = zip(seen.directions[large], seen.radius_rad[large].tolist(), strict=True)
        hidden.append([_Disc(*disc) for disc in discs])
    return dict(zip(seen.names, np.array(angles).T, strict=True)), tuple(in_frame), hidden


@dataclass(frozen=True, eq=False)
class _Block(PlannedStars):
    """The stars of some attitudes, and the resulting accuracy and acquisition."""

    error_arcsec: Array
    acquisition: Array
    stars_expected: Array


def _planned_block(
    database: Database,
    planned: PlannedAttitudes,
    observers: list[Observer] | None,
    hidden: list[list[_Disc]],
    camera: Camera,
    expected: Expected,
    bodies: _Bodies,
    first: int,
) -> _Block:
    """Return what is planned for `BLOCK` attitudes from the first one on."""
    matrices = planned.matrices[first : first + BLOCK]
    count = len(matrices)
    margin_px = REACH * NOISE_DEVIATIONS * expected.noise_px
    reach = camera.radius_rad + NEAREST_RAD + margin_px / camera.focal_length_px
    tree = scipy.spatial.cKDTree(matrices[:, 2])
    of_stars = scipy.spatial.cKDTree(database.directions)
    near = tree.sparse_distance_matrix(
        of_stars, chord_from_separation(min(reach, np.pi)), output_type="ndarray"
    )
    order = np.lexsort((near["j"], database.mag[near["j"]], near["i"]))
    group, star = near["i"][order].astype(np.int64), near["j"][order].astype(np.int64)
    u = database.directions[star]
    if observers is not None:
        velocity = np.array(
            [observer.velocity_km_s for observer in observers[first : first + count]]
        )
        u = aberrated(u, velocity[group])
    body = np.einsum("pij,pj->pi", matrices[group], u)
    px = camera.pixels_from_directions(body)
    around = np.abs(px - camera.middle_px) <= camera.middle_px + margin_px
    in_frame = np.bincount(group[around.all(axis=1)], minlength=count)
    detection = _detection(database.mag[star], expected)
    for row, discs in enumerate(hidden[first : first + count]):
        rows = slice(*np.searchsorted(group, [row, row + 1]))
        for disc in discs:
            detection[rows][separation(u[rows], disc.direction) < disc.radius_rad] = 0.0
    kept = camera.contains(px) & (detection >= MIN_DETECTION)
    body, px, detection = body[kept], px[kept], detection[kept]
    group, star = group[kept], star[kept]
    false = np.array([len(seen) for seen in bodies[first : first + count]])
    noise_px = expected.noise_px
    acquisition = acquisition_probability(
        body, detection, group, in_frame, false + expected.false_stars, camera, noise_px,
        expected.max_false_match_probability,
    )  # fmt: skip
    return _Block(
        group + first,
        star,
        px,
        detection,
        expected_errors_arcsec(body, px, detection, group, count, camera, noise_px),
        acquisition,
        np.bincount(group, detection, count).astype(np.float64),
    )


def _detection(mag: Array, expected: Expected) -> Array:
    """Return the probability of stars to be detected."""
    seen = np.full(len(mag), 1.0 - expected.drop_probability)
    if expected.limit_mag is None:
        return seen
    if expected.noise_mag == 0.0:
        return seen * (mag <= expected.limit_mag)
    return np.asarray(seen * scipy.special.ndtr((expected.limit_mag - mag) / expected.noise_mag))


def _lookalikes(
    artifact: DatabaseFolder, database: Database, expected: Expected
) -> NDArray[np.int64]:
    """Count the records of the catalog that can be taken for each star, rejected ones included."""
    directions, mags = [database.directions], [database.mag]
    if "rejected" in artifact.products:
        rejected = artifact.table("rejected")
        mag = floats_of(rejected, "mag")
        ra_deg, dec_deg = (floats_of(rejected, name) for name in ("ra_deg", "dec_deg"))
        bright = mag <= float(database.mag.max()) + expected.lookalike_mag
        bright &= np.isfinite(ra_deg + dec_deg)
        directions.append(directions_from_radec(ra_deg[bright], dec_deg[bright]))
        mags.append(mag[bright])
    u, mag = np.concatenate(directions), np.concatenate(mags)
    radius = chord_from_separation(expected.window_arcsec / ARCSEC)
    stars, others = scipy.spatial.cKDTree(database.directions), scipy.spatial.cKDTree(u)
    near = stars.sparse_distance_matrix(others, radius, output_type="ndarray")
    alike = np.abs(database.mag[near["i"]] - mag[near["j"]]) <= expected.lookalike_mag
    alike &= near["i"] != near["j"]
    return np.bincount(near["i"][alike], minlength=len(database.mag)).astype(np.int64)


def _blends(artifact: DatabaseFolder, database: Database, camera: Camera) -> tuple[Array, Array]:
    """Return the contamination and the centroid offset, px, of each star from the build."""
    table = artifact.stars
    # The stars of an onboard image are in another order, and numbers of two catalogs can be equal.
    _, nearest = scipy.spatial.cKDTree(directions_of(table)).query(database.directions)
    rows = np.asarray(nearest, dtype=np.int64)
    columns = []
    for name in ("contamination", "centroid_offset_arcsec"):
        is_there = name in table.column_names
        columns.append(floats_of(table, name)[rows] if is_there else np.full(len(rows), np.nan))
    return columns[0], columns[1] / camera.pixel_arcsec
