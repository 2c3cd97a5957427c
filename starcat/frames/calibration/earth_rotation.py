"""Attitude errors of a camera that stands still, with the turning Earth as the truth.

The sky turns over a camera that is fixed to the ground by 15.041 arcsec per second about the pole,
and nothing else moves. With that turn removed all attitudes should agree, and their differences are
their errors: no other star tracker, no table and no mark on the ground is needed. Aberration is
removed too; refraction is the same in all frames, as they look through the same air. A clock error
that all times share drops out.

If the camera was moved between frames, the frames of each direction form a set of their own.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import erfa
import numpy as np
from scipy.spatial.transform import Rotation

from starcat.arrays import Array
from starcat.errors import CalibrationError, ConfigError, FileMissing, SourceError
from starcat.frames.calibration.calibrate import Calibration
from starcat.frames.calibration.files import names_of_files
from starcat.frames.calibration.fit import turn_derivatives
from starcat.frames.images.image_file import KNOWS_TIME, time_in_file
from starcat.frames.sky.observer import Observer
from starcat.geometry.attitude import solve_wahba_svd
from starcat.results import in_record
from starcat.storage.regular_files import read_regular_file

EARTH_RATE_ARCSEC_S = 15.041067  # turn of the Earth against the stars (IERS Conventions 2010)
MAX_BYTES = 64 << 20  # largest size of the table of times
_MOVED_DEG = 0.5  # a camera that turned farther than this was moved
_ARCSEC = np.degrees(1.0) * 3600.0
# Two components are within this sum of squares as often as one is within three errors: 99.73 %.
_THREE_SIGMA = 11.83


@dataclass(frozen=True)
class TurnedFrame:
    """One frame against the mean of its set."""

    name: str
    time: str  # middle of the exposure, UTC
    set_number: int  # from 1
    error_arcsec: tuple[float, float, float]  # rotation about x, y and z of the camera
    sigma_arcsec: tuple[float, float, float]  # expected from the noise of the centroids
    clock_s: float  # change of its time with which it agrees best
    # Mean square, in expected errors, of the two components that no change of the time explains.
    chi2: float


@dataclass(frozen=True)
class EarthRotation:
    """Differences between attitudes of a fixed camera, with the turn of the Earth removed.

    Sets of a single frame have no differences and are left out. ``rms_arcsec`` is about x, y and z
    of the camera. Errors of the times only affect the component about the axis of the Earth, which
    ``chi2``, the mean of the frames' values, leaves out: it is about 1 if the errors are as large
    as the noise of the centroids predicts. ``rate_arcsec_s`` is the turn measured from the frames.
    """

    frames: tuple[TurnedFrame, ...]
    n_sets: int
    rms_arcsec: tuple[float, float, float]
    expected_arcsec: tuple[float, float, float]
    about_pole_arcsec: float
    chi2: float
    rate_arcsec_s: float
    rate_error_arcsec_s: float

    @property
    @in_record(key="within_three_sigma")
    def within(self) -> int:
        """Frames that are within three expected errors, whatever the errors of their times."""
        return sum(2.0 * frame.chi2 <= _THREE_SIGMA for frame in self.frames)


def times_of_frames(paths: Sequence[Path], table: Path | None) -> dict[str, datetime]:
    """Return the time of each frame by its name: of a table, or of the pictures themselves."""
    if table is not None:
        return _times_of_table(table)
    names = zip(names_of_files(paths), paths, strict=True)
    times = {name: time_in_file(path) for name, path in names if path.suffix.lower() in KNOWS_TIME}
    stated = {name: time for name, time in times.items() if time is not None}
    if not stated:
        raise ConfigError(
            "no frame has its time in it (EXIF DateTimeOriginal, FITS DATE-OBS)",
            hint="give {times} with a CSV file of the columns frame and time",
        )
    return stated


def _times_of_table(path: Path) -> dict[str, datetime]:
    try:
        text = read_regular_file(path, MAX_BYTES).decode("utf-8-sig")
        rows = list(csv.DictReader(io.StringIO(text, newline="")))
    except FileMissing as error:
        raise FileMissing(str(error), hint="give a CSV file with frame and time") from error
    except SourceError as error:
        raise ConfigError(f"{error}; expected a CSV file with frame and time") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(f"cannot be read ({error})", where=path) from error
    if not rows or not {"frame", "time"} <= rows[0].keys():
        raise ConfigError(
            "expected a header with frame and time, and one line per frame", where=path
        )
    times = {}
    for number, row in enumerate(rows, start=2):
        try:
            time = datetime.fromisoformat(row["time"].strip())
        except (AttributeError, ValueError):
            raise ConfigError(
                f"line {number}: time is {row['time']!r}; expected UTC such as "
                "2026-11-22T10:00:00.25",
                where=path,
            ) from None
        times[row["frame"]] = time.replace(tzinfo=UTC) if time.tzinfo is None else time
    return times


def earth_rotation(calibration: Calibration, times: Mapping[str, datetime]) -> EarthRotation:
    """Compare the attitudes of calibrated frames with the turn of the Earth."""
    names = [frame.name for frame in calibration.frames if frame.status == "identified"]
    timed = sorted((times[name], k, name) for k, name in enumerate(names) if name in times)
    if len(timed) < 2:
        raise CalibrationError(
            f"{len(timed)} of {len(names)} identified frames have a time; expected two or more: "
            "give times by the name of the frame (for a picture, its name without the suffix)"
        )
    fixed = np.stack([_on_earth(calibration, k, time) for time, k, _ in timed])
    sets = _sets(fixed)
    kept = [rows for rows in sets if len(rows) > 1]
    if not kept:
        raise CalibrationError(
            f"the camera looked elsewhere in each of {len(timed)} frames; expected two or more "
            f"that agree to {_MOVED_DEG:g} deg when the turn of the Earth is taken out"
        )
    return _compared(calibration, timed, fixed, kept)


def _on_earth(calibration: Calibration, number: int, time: datetime) -> Array:
    """Return the attitude of a frame against the ground: body = matrix @ ground."""
    fit, observer = calibration.fit, Observer.at(time)
    rows = fit.seen.frame == number
    body = calibration.camera.directions_from_pixels(fit.seen.still_px(fit.values)[rows])
    matrix = solve_wahba_svd(body, observer.apparent(fit.seen.icrs[rows]))
    jd = 2440587.5, time.timestamp() / 86_400.0  # UTC for UT1: the difference is the same in all
    ground = erfa.c2t06a(*observer.tt_jd, *jd, 0.0, 0.0)
    return np.asarray(matrix @ ground.T)


def _sets(fixed: Array) -> list[list[int]]:
    """Return the rows of successive attitudes that differ only by their errors."""
    sets: list[list[int]] = [[0]]
    for row in range(1, len(fixed)):
        turn = Rotation.from_matrix(fixed[row] @ fixed[row - 1].T).magnitude()
        if np.degrees(turn) > _MOVED_DEG:
            sets.append([])
        sets[-1].append(row)
    return sets


def _compared(
    calibration: Calibration, timed: list[tuple[datetime, int, str]], fixed: Array, sets: list[Any]
) -> EarthRotation:
    frames, errors, sigmas, poles, since = [], [], [], [], []
    for number, rows in enumerate(sets, start=1):
        mean = Rotation.from_matrix(fixed[rows]).mean().as_matrix()
        error = Rotation.from_matrix(fixed[rows] @ mean.T).as_rotvec() * _ARCSEC
        seconds = np.array([timed[row][0].timestamp() for row in rows])
        poles.append(error @ mean[:, 2])
        since.append(seconds - seconds.mean())
        errors.append(error)
        for row, row_error in zip(rows, error, strict=True):
            # The error of each of n frames moves their mean by 1/n of itself.
            covariance = (1.0 - 1.0 / len(rows)) * _covariance(calibration, timed[row][1])
            sigmas.append(np.sqrt(np.diag(covariance)))
            frames.append(_frame(timed[row], number, row_error, covariance, mean[:, 2]))
    error, pole, dt = (np.concatenate(part) for part in (errors, poles, since))
    free = len(error) - len(sets)
    slope = float(pole @ dt / (dt @ dt)) if dt.any() else 0.0
    spread = float(np.sqrt(np.sum((pole - slope * dt) ** 2) / max(free - 1, 1)))
    return EarthRotation(
        tuple(frames),
        len(sets),
        _xyz(np.sqrt((error**2).sum(axis=0) / free)),
        _xyz(np.sqrt((np.array(sigmas) ** 2).sum(axis=0) / free)),
        float(np.sqrt(pole @ pole / free)),
        float(np.mean([frame.chi2 for frame in frames])),
        EARTH_RATE_ARCSEC_S - slope,
        spread / float(np.sqrt(dt @ dt)) if dt.any() else float("inf"),
    )


def _frame(
    timed: tuple[datetime, int, str], number: int, error: Array, covariance: Array, pole: Array
) -> TurnedFrame:
    time, _, name = timed
    weight = np.linalg.inv(covariance)
    turn = float(pole @ weight @ error / (pole @ weight @ pole))
    rest = error - turn * pole
    utc = time.astimezone(UTC).isoformat().replace("+00:00", "Z")
    return TurnedFrame(
        name,
        utc,
        number,
        _xyz(error),
        _xyz(np.sqrt(np.diag(covariance))),
        -turn / EARTH_RATE_ARCSEC_S,
        0.5 * float(rest @ weight @ rest),
    )


def _xyz(values: Array) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z


def _covariance(calibration: Calibration, number: int) -> Array:
    """Return the covariance of an attitude about x, y and z of the camera, square arcseconds."""
    fit = calibration.fit
    rows = fit.seen.frame == number
    body = fit.seen.icrs[rows] @ fit.seen.matrices[number].T
    slope = turn_derivatives(fit.values, body).reshape(-1, 3)
    return np.asarray(np.linalg.inv(slope.T @ slope) * (fit.noise_px * _ARCSEC) ** 2)
