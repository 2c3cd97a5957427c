"""Planned attitudes and orbits: tables of columns, CSV files, and CCSDS AEM and OEM as text (KVN).

A table of attitudes has a column ``time`` (UTC; without it nothing is known of the Sun, the Moon
and the Earth) and either ``q_body_from_icrs``, or ``qx``, ``qy``, ``qz`` and ``qw``, or ``ra_deg``,
``dec_deg`` and ``roll_deg``. A table of an orbit has ``time``, ``x_km`` to ``z_km`` and ``vx_km_s``
to ``vz_km_s``, relative to the Earth in ICRS axes.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from starcat.arguments import columns_of, numbers_of, path_of, rows_of
from starcat.arrays import Array
from starcat.errors import AsWritten, ConfigError, count_of
from starcat.frames.sky.observer import Observer
from starcat.geometry.attitude import matrix_from_quaternion, matrix_from_radec_roll
from starcat.storage.regular_files import read_regular_file

MAX_ATTITUDES = 100_000
"""Rows of a table of attitudes or of an orbit."""

MAX_BYTES = 64 << 20
"""Largest size of a file of attitudes or of an orbit."""

QUATERNION = ("qx", "qy", "qz", "qw")
ANGLES = ("ra_deg", "dec_deg", "roll_deg")
STATE = ("x_km", "y_km", "z_km", "vx_km_s", "vy_km_s", "vz_km_s")

INERTIAL = ("ICRF", "GCRF", "EME2000", "J2000", "ICRS", "ICRF1", "ICRF2", "ICRF3")
"""Frames of CCSDS that are taken for ICRS; EME2000 differs by 0.02 arcsec."""

AHEAD_OF_UTC_S = {"UTC": 0.0, "GPS": 18.0, "TAI": 37.0, "TT": 69.184, "TDB": 69.184}
"""Time systems of CCSDS with the leap seconds since 2017."""


@dataclass(frozen=True, eq=False)
class PlannedAttitudes:
    """Attitudes in the order of their table."""

    matrices: Array  # camera from ICRS, shape (K, 3, 3)
    times: tuple[datetime, ...] | None = None  # UTC; None if not stated


@dataclass(frozen=True, eq=False)
class Orbit:
    """Positions and velocities at some times."""

    times: tuple[datetime, ...]  # UTC, ascending
    position_km: Array  # relative to the middle of the Earth, ICRS axes, shape (T, 3)
    velocity_km_s: Array

    def observers(self, times: Sequence[datetime]) -> list[Observer]:
        """Return the observers at times within the orbit; ConfigError for a time outside of it.

        Between two rows a cubic polynomial has their positions and velocities.
        """
        start = self.times[0]
        table_s = np.array([(time - start).total_seconds() for time in self.times])
        asked_s = np.array([(time - start).total_seconds() for time in times])
        outside = np.flatnonzero((asked_s < 0.0) | (asked_s > table_s[-1]))
        if len(outside):
            raise ConfigError(
                f"it is from {start:%Y-%m-%dT%H:%M:%S} to {self.times[-1]:%Y-%m-%dT%H:%M:%S} "
                f"UTC; expected one that holds {times[outside[0]]:%Y-%m-%dT%H:%M:%S}, the time of "
                f"attitude {outside[0] + 1}",
                parameter="orbit",
            )
        row = np.clip(
            np.searchsorted(table_s, asked_s, side="right") - 1, 0, max(0, len(table_s) - 2)
        )
        after = np.minimum(row + 1, len(table_s) - 1)
        step = np.maximum(table_s[after] - table_s[row], 1e-9)[:, None]
        s = (asked_s - table_s[row])[:, None] / step
        p, q = self.position_km[row], self.position_km[after]
        v, w = self.velocity_km_s[row] * step, self.velocity_km_s[after] * step
        a, b = 2.0 * (p - q) + v + w, 3.0 * (q - p) - 2.0 * v - w
        position = ((a * s + b) * s + v) * s + p
        velocity = ((3.0 * a * s + 2.0 * b) * s + v) / step
        return [_observer(*state) for state in zip(times, position, velocity, strict=True)]


def _observer(time: datetime, position_km: Array, velocity_km_s: Array) -> Observer:
    """Return the observer in an orbit at a time; ConfigError names the orbit and the time."""
    try:
        return Observer.at(time, position_km=position_km, velocity_km_s=velocity_km_s)
    except ConfigError as error:
        error.parameter = "orbit"
        error.value = AsWritten(f"{error.value} at {time:%Y-%m-%dT%H:%M:%S}")
        error.hint = error.advice[:1]  # the others are about the arguments of `Observer.at`
        raise


def attitudes_of(value: Any, alignment: Any = None) -> PlannedAttitudes:
    """Return the attitudes of a file, a table or quaternions, shape (K, 4).

    ``alignment`` is the quaternion that turns the frame of the attitudes into the camera's.
    """
    name, columns = _columns("attitudes", value, _aem, ("q_body_from_icrs",))
    if "q_body_from_icrs" in columns:
        q = rows_of("attitudes", columns["q_body_from_icrs"], 4, "K")
    elif set(QUATERNION) <= set(columns):
        q = np.column_stack([_numbers(name, columns, column) for column in QUATERNION])
    elif set(ANGLES) <= set(columns):
        angles = np.column_stack([_numbers(name, columns, column) for column in ANGLES])
        bad = np.flatnonzero(np.abs(angles[:, 1]) > 90.0)
        if len(bad):
            text = f"{name}: dec_deg is {angles[bad[0], 1]:g} in row {bad[0] + 1}"
            raise ConfigError(f"{text}; expected -90 to 90")
        return _aligned([matrix_from_radec_roll(*row) for row in angles], columns, name, alignment)
    else:
        raise ConfigError(
            f"has the columns {', '.join(columns)}; expected {', '.join(QUATERNION)} "
            f"(q_body_from_icrs, scalar last) or {', '.join(ANGLES)}, and time",
            where=name,
        )
    length = np.sqrt(np.sum(q * q, axis=1))
    bad = np.flatnonzero(~(np.abs(length - 1.0) < 0.01))
    if len(bad):
        raise ConfigError(
            f"the quaternion in row {bad[0] + 1} has the length {length[bad[0]]:.6g}; "
            "expected four numbers x, y, z, w of length 1",
            where=name,
        )
    return _aligned([matrix_from_quaternion(row) for row in q], columns, name, alignment)


def _aligned(
    matrices: list[Array], columns: Mapping[str, Any], name: str, alignment: Any
) -> PlannedAttitudes:
    _check_rows(name, len(matrices))
    turned = np.array(matrices)
    if alignment is not None:
        q = numbers_of("alignment", alignment, (4,))
        if q.shape != (4,) or not abs(float(np.sqrt(q @ q)) - 1.0) < 0.01:
            raise ConfigError(
                "expected a quaternion x, y, z, w of length 1",
                parameter="alignment",
                value=alignment,
            )
        turned = matrix_from_quaternion(q) @ turned
    times = _times(name, columns["time"]) if "time" in columns else None
    return PlannedAttitudes(turned, times)


def orbit_of(value: Any) -> Orbit:
    """Return the orbit of a file or a table."""
    name, columns = _columns("orbit", value, _oem)
    missing = [column for column in ("time", *STATE) if column not in columns]
    if missing:
        raise ConfigError(
            f"has no column {missing[0]}; expected time, {', '.join(STATE)}", where=name
        )
    times = _times(name, columns["time"])
    _check_rows(name, len(times))
    state = np.column_stack([_numbers(name, columns, column) for column in STATE])
    order = sorted(range(len(times)), key=times.__getitem__)
    return Orbit(tuple(times[k] for k in order), state[order, :3], state[order, 3:])


def _check_rows(name: str, count: int) -> None:
    if not 0 < count <= MAX_ATTITUDES:
        raise ConfigError(f"has {count:,} rows; expected 1 to {MAX_ATTITUDES:,}", where=name)


def _columns(
    argument: str,
    value: Any,
    of_ccsds: Callable[[str, list[str]], dict[str, Any]],
    default: Sequence[str] = (),
) -> tuple[str, dict[str, Any]]:
    """Return the name of a table in messages, and its columns."""
    columns = columns_of(value)
    if columns is not None:
        _check_lengths(argument, columns)
        return argument, columns
    if default and not isinstance(value, str | Path) and not hasattr(value, "__fspath__"):
        return argument, {default[0]: value}
    path = path_of(argument, value, "a path or a table")
    try:
        lines = read_regular_file(path, MAX_BYTES).decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise ConfigError(
            f"not a text file ({error}); expected CSV or CCSDS KVN", where=path
        ) from None
    first = next((line.strip() for line in lines if line.strip()), "")
    if first.startswith("CCSDS_"):
        return str(path), of_ccsds(str(path), lines)
    if first.startswith("<"):
        raise ConfigError("is XML", where=path, hint="write the CCSDS message as text (KVN)")
    rows = list(csv.reader(line for line in lines if line.strip() and not line.startswith("#")))
    names = [text.strip() for text in rows[0]] if rows else []
    for number, row in enumerate(rows[1:], 1):
        if len(row) != len(names):
            raise ConfigError(f"row {number} has {len(row)} fields, not {len(names)}", where=path)
    return str(path), {name: [row[k] for row in rows[1:]] for k, name in enumerate(names)}


def _check_lengths(argument: str, columns: Mapping[str, Any]) -> None:
    """Check that the columns of a table that are used are equally long."""
    used = ("time", "q_body_from_icrs", *QUATERNION, *ANGLES, *STATE)
    counts = {column: _length(columns[column]) for column in used if column in columns}
    if len(set(counts.values())) > 1:
        found = ", ".join(f"{column} has {count_of(n, 'row')}" for column, n in counts.items())
        raise ConfigError(f"{found}; expected columns of one length", parameter=argument)


def _length(column: Any) -> int:
    try:
        return 1 if isinstance(column, str) else len(column)
    except TypeError:  # a single value
        return 1


def _numbers(name: str, columns: Mapping[str, Any], column: str) -> Array:
    values = columns[column]
    if isinstance(values, list) and values and isinstance(values[0], str):
        for number, text in enumerate(values, 1):
            try:
                float(text)
            except ValueError:
                raise ConfigError(
                    f"{column} is {text!r} in row {number}; expected a number", where=name
                ) from None
        values = [float(text) for text in values]
    numbers = numbers_of(column, values, "(K,)")
    if not np.isfinite(numbers).all():
        row = int(np.flatnonzero(~np.isfinite(numbers))[0]) + 1
        raise ConfigError(f"{column} is not finite in row {row}; expected a number", where=name)
    return numbers


def _times(name: str, values: Any) -> tuple[datetime, ...]:
    times = []
    for number, value in enumerate(values, 1):
        try:
            times.append(Observer.at(_moment(value)).time)
        except ConfigError as error:
            raise ConfigError(f"row {number}: {error}", where=name) from error
    return tuple(times)


def _moment(value: Any) -> Any:
    """Return a time as `Observer.at` takes it: of numpy and Arrow, or with the day of a year."""
    if isinstance(value, np.datetime64):
        value = str(value.astype("datetime64[us]"))
    if isinstance(value, datetime) or hasattr(value, "isot"):
        return value
    text = str(value).strip()
    if len(text) > 8 and text[4:5] == "-" and text[8:9] == "T":  # 2027-032T10:00:00
        try:
            day = datetime.strptime(text[:8], "%Y-%j").date()
        except ValueError:
            return text
        text = f"{day}{text[8:]}"
    return text


def _blocks(name: str, lines: list[str]) -> Iterator[tuple[dict[str, str], list[list[str]]]]:
    """Yield the metadata and the rows of data of each segment of a CCSDS message."""
    meta: dict[str, str] = {}
    data: list[list[str]] = []
    is_data = False
    for raw in lines:
        line = raw.strip()
        key, equals, value = (part.strip() for part in line.partition("="))
        if line == "META_START":
            if data:
                yield meta, data
            meta, data, is_data = {}, [], False
        elif line in ("META_STOP", "DATA_START"):
            is_data = True
        elif line in ("DATA_STOP", "COVARIANCE_START"):
            is_data = False
        elif not line or line.startswith("COMMENT") or line == "COVARIANCE_STOP":
            continue
        elif equals:
            meta[key] = value
        elif is_data:
            data.append(line.split())
    if data:
        yield meta, data
    elif not meta:
        raise ConfigError("has no data; expected a CCSDS message with META_START", where=name)


def _ccsds_time(name: str, text: str, meta: Mapping[str, str]) -> datetime:
    system = meta.get("TIME_SYSTEM", "UTC")
    if system not in AHEAD_OF_UTC_S:
        systems = ", ".join(AHEAD_OF_UTC_S)
        raise ConfigError(f"TIME_SYSTEM is {system}; expected one of {systems}", where=name)
    (moment,) = _times(name, [text])
    return moment - timedelta(seconds=AHEAD_OF_UTC_S[system])


def _aem(name: str, lines: list[str]) -> dict[str, Any]:
    """Return the columns of an attitude ephemeris message, whose quaternions turn A into B."""
    times: list[datetime] = []
    q: list[list[float]] = []
    for meta, data in _blocks(name, lines):
        kind = meta.get("ATTITUDE_TYPE", "")
        if not kind.startswith("QUATERNION"):
            text = f"{name}: ATTITUDE_TYPE is {kind or 'missing'}; expected QUATERNION"
            raise ConfigError(text)
        a, b = meta.get("REF_FRAME_A", ""), meta.get("REF_FRAME_B", "")
        if (a in INERTIAL) == (b in INERTIAL):
            raise ConfigError(
                f"the frames are {a or 'missing'} and {b or 'missing'}; expected one of "
                f"{', '.join(INERTIAL[:4])} and the spacecraft's frame",
                where=name,
            )
        is_reversed = (b in INERTIAL) != (meta.get("ATTITUDE_DIR", "A2B") == "B2A")
        is_first = meta.get("QUATERNION_TYPE", "LAST") == "FIRST"
        for row in data:
            try:
                numbers = [float(text) for text in row[1:5]]
            except ValueError:
                numbers = []
            if len(numbers) != 4:
                text = f"{name}: found {' '.join(row)!r}; expected a time and four numbers"
                raise ConfigError(text)
            x, y, z, w = (*numbers[1:], numbers[0]) if is_first else numbers
            times.append(_ccsds_time(name, row[0], meta))
            q.append([-x, -y, -z, w] if is_reversed else [x, y, z, w])
    return {"time": times, "q_body_from_icrs": np.array(q).reshape(-1, 4)}


def _oem(name: str, lines: list[str]) -> dict[str, Any]:
    """Return the columns of an orbit ephemeris message."""
    times: list[datetime] = []
    rows: list[list[str]] = []
    for meta, data in _blocks(name, lines):
        frame, centre = meta.get("REF_FRAME", ""), meta.get("CENTER_NAME", "").upper()
        if frame not in INERTIAL or centre != "EARTH":
            raise ConfigError(
                f"REF_FRAME is {frame or 'missing'} and CENTER_NAME {centre or 'missing'}; "
                f"expected one of {', '.join(INERTIAL[:4])} and EARTH",
                where=name,
            )
        times += [_ccsds_time(name, row[0], meta) for row in data]
        rows += [row[1:7] for row in data]
    short = next((row for row in rows if len(row) != len(STATE)), None)
    if short is not None:
        raise ConfigError(f"found {' '.join(short)!r}; expected position and velocity", where=name)
    return {"time": times, **{column: [row[k] for row in rows] for k, column in enumerate(STATE)}}
