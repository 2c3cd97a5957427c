# SPDX-License-Identifier: MIT
"""The results of an orbit: counts and errors by leg as a table, and a drawing of the errors."""

from __future__ import annotations

import io
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from starcat_basilisk.scenario import CAMERA_FROM_BODY, Orbit
from starcat_basilisk.sky import Array

ARCSEC = np.degrees(1.0) * 3600.0
WRONG_PX = 3.0
"""An attitude is wrong if it moves a star anywhere in the field by more than this."""

_IDENTIFIED, _DROPPED, _BLINDED, _WITHHELD = 0, 1, 2, 10
# By `starcat_reason` of starcat.h.
_REASONS = ("none", "too few stars", "no pattern", "chance", "share", "scale", "steps")

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Row:
    """A leg of the orbit, or all of it."""

    name: str
    begin_min: float
    frames: int
    dropped: int
    blinded: int
    withheld: dict[str, int]
    identified: int
    wrong: int
    tracked_percent: float  # percentage of the identified frames
    stars_named: int
    stars_misnamed: int
    across_rms_arcsec: float
    across_max_arcsec: float
    about_rms_arcsec: float
    about_max_arcsec: float
    in_stated_noise: float  # squared errors over the stated covariance, per axis; 1 is right
    filter_max_arcsec: float  # largest error of the boresight that the filter estimates
    pointing_rms_arcsec: float  # error of the boresight after settling


@dataclass(frozen=True, eq=False)
class Flight:
    """Recorded data, one row per frame."""

    minutes: Array
    outcome: NDArray[np.int64]
    is_tracked: Mask
    is_moon_seen: Mask
    is_earth_seen: Mask
    streak_px: Array
    named: NDArray[np.int64]
    misnamed: NDArray[np.int64]
    error: Array  # star tracker, camera axes, arcsec; NaN without attitude; (N, 3)
    filter_error: Array  # filter, same axes and units
    chi_square: Array  # three degrees of freedom
    pointing: Array  # error of the true boresight, arcsec; NaN without control

    @property
    def is_identified(self) -> Mask:
        """Frames with an attitude."""
        return self.outcome == _IDENTIFIED


def flight_of(orbit: Orbit, records: Any) -> Flight:
    """Compare the recorded data with the truth."""
    frames, truth, known = records.frames, records.truth, records.known
    outcome = np.asarray(frames.outcome, dtype=np.int64)
    true_bodies = _matrices(np.asarray(truth.sigma_BN))
    is_known = np.asarray(known.timeTag) > 0.0
    error = _turns(_matrices(np.asarray(frames.sigma_BN)), true_bodies)
    spread = np.asarray(frames.covariance_B).reshape(-1, 3, 3)
    chi_square = np.full(len(outcome), np.nan)
    for n in np.flatnonzero(outcome == _IDENTIFIED):
        chi_square[n] = error[n] @ np.linalg.solve(spread[n], error[n])
    minutes = np.asarray(frames.timeTag) / 6e10
    filter_error = _turns(_matrices(np.asarray(known.sigma_BN)), true_bodies)
    return Flight(
        minutes,
        outcome,
        np.asarray(frames.tracked) == 1,
        np.asarray(frames.moonSeen) == 1,
        np.asarray(frames.earthSeen) == 1,
        np.asarray(frames.streak_px),
        np.asarray(frames.nNamed, dtype=np.int64),
        np.asarray(frames.nMisnamed, dtype=np.int64),
        np.where((outcome == _IDENTIFIED)[:, None], error @ CAMERA_FROM_BODY.T * ARCSEC, np.nan),
        np.where(is_known[:, None], filter_error @ CAMERA_FROM_BODY.T * ARCSEC, np.nan),
        chi_square,
        _pointing(orbit, minutes, true_bodies[:, 0], np.asarray(truth.r_BN_N)),
    )


def rows_of(orbit: Orbit, flight: Flight, scale_arcsec: float, corner_rad: float) -> list[Row]:
    """Return one row per leg that was flown, and one for all."""
    ends = [leg.begin_min for leg in orbit.legs[1:]] + [np.inf]
    rows = []
    for leg, end_min in zip(orbit.legs, ends, strict=True):
        inside = (flight.minutes >= leg.begin_min) & (flight.minutes < end_min)
        if inside.any():
            rows.append(_row(leg.name, leg.begin_min, flight, inside, scale_arcsec, corner_rad))
    everything = np.ones(len(flight.minutes), dtype=np.bool_)
    return [*rows, _row("the whole orbit", 0.0, flight, everything, scale_arcsec, corner_rad)]


def _row(
    name: str, begin_min: float, flight: Flight, part: Mask, scale_arcsec: float, corner_rad: float
) -> Row:
    outcome, error = flight.outcome[part], flight.error[part]
    across = np.hypot(error[:, 0], error[:, 1])
    moved_px = (across + np.abs(error[:, 2]) * np.tan(corner_rad)) / scale_arcsec
    identified = int((outcome == _IDENTIFIED).sum())
    numbers = np.unique(outcome[outcome > _WITHHELD])
    off = flight.filter_error[part]
    return Row(
        name,
        begin_min,
        len(outcome),
        int((outcome == _DROPPED).sum()),
        int((outcome == _BLINDED).sum()),
        {_REASONS[n - _WITHHELD]: int((outcome == n).sum()) for n in numbers},
        identified,
        int((moved_px > WRONG_PX).sum()),
        100.0 * float((flight.is_tracked[part] & (outcome == _IDENTIFIED)).sum()) / identified
        if identified
        else 0.0,
        int(flight.named[part].sum()),
        int(flight.misnamed[part].sum()),
        _rms(error[:, :2]),
        _largest(across),
        _rms(error[:, 2]),
        _largest(np.abs(error[:, 2])),
        float(np.nanmean(flight.chi_square[part])) / 3.0 if identified else float("nan"),
        _largest(np.hypot(off[:, 0], off[:, 1])),
        _rms(flight.pointing[part]),
    )


def table_of(rows: list[Row]) -> str:
    """Return the rows as a table of Markdown."""
    heads = (
        "leg", "from min", "what", "frames", "dropped", "withheld", "identified", "wrong",
        "tracked %", "across rms, max", "about rms, max", "filter max", "pointing rms",
    )  # fmt: skip
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    for number, row in enumerate(rows, start=1):
        is_leg = number < len(rows)
        cells = (
            str(number) if is_leg else "",
            f"{row.begin_min:.0f}" if is_leg else "",
            row.name,
            f"{row.frames:,}",
            f"{row.dropped:,}",
            f"{sum(row.withheld.values()) + row.blinded:,}",
            f"{row.identified:,}",
            f"{row.wrong}",
            f"{row.tracked_percent:.1f}",
            f"{row.across_rms_arcsec:.1f}, {row.across_max_arcsec:.0f}",
            f"{row.about_rms_arcsec:.0f}, {row.about_max_arcsec:.0f}",
            f"{row.filter_max_arcsec:.0f}",
            "" if np.isnan(row.pointing_rms_arcsec) else f"{row.pointing_rms_arcsec:.1f}",
        )
        lines.append("| " + " | ".join(cells) + " |")
    whole = rows[-1]
    reasons = ", ".join(f"{name} {count:,}" for name, count in whole.withheld.items())
    lines += [
        "",
        f"Errors in arcsec. Withheld: {reasons or 'none'}; blinded by the Sun: {whole.blinded:,}.",
        f"Stars named: {whole.stars_named:,}, of them wrongly: {whole.stars_misnamed}. Squared "
        f"errors in the stated covariance: {whole.in_stated_noise:.2f} an axis.",
    ]
    return "\n".join(lines) + "\n"


def content_of(rows: list[Row]) -> list[dict[str, Any]]:
    """Return the rows as values for JSON."""
    return [
        {
            key: None if isinstance(value, float) and np.isnan(value) else value
            for key, value in asdict(row).items()
        }
        for row in rows
    ]


def drawing_of(orbit: Orbit, flight: Flight) -> bytes:
    """Draw the errors against time as SVG; the same flight gives the same bytes."""
    import matplotlib as mpl
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(
            {"font.size": 8.0, "svg.fonttype": "none", "svg.hashsalt": "starcat",
             "axes.spines.top": False, "axes.spines.right": False}
        )  # fmt: skip
        figure = Figure(figsize=(7.2, 5.4))
        _draw(figure, orbit, flight)
        buffer = io.BytesIO()
        nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        FigureCanvasSVG(figure).print_figure(buffer, metadata=nothing)
    return buffer.getvalue()


_SLOT_MIN = 0.25
_SMEARED_PX = 3.0
_TICKS_ARCSEC = (1, 3, 10, 30, 100, 300)
_PANELS = (("across the boresight", (0, 1)), ("about the boresight", (2,)))
_BARS = (
    ("no frames", "#333333"),
    ("withheld", "#d1495b"),
    ("Moon", "#c98a1b"),
    ("Earth", "#3f8f5b"),
    ("smear", "#8a5fa8"),
)


def _draw(figure: Any, orbit: Orbit, flight: Flight) -> None:
    slots = np.floor(flight.minutes / _SLOT_MIN).astype(np.int64)
    middle = (np.arange(slots[-1] + 1) + 0.5) * _SLOT_MIN
    figure.text(0.03, 0.965, "Attitude error against truth over one orbit", fontsize=11)
    figure.text(
        0.03, 0.932,
        f"largest of every {60 * _SLOT_MIN:.0f} s: star tracker (dots), and the filter that the "
        "control uses (line); numbers: legs of the table", color="#555",
    )  # fmt: skip
    for number, (name, axes_of_error) in enumerate(_PANELS):
        axes = figure.add_axes((0.12, 0.62 - 0.29 * number, 0.86, 0.265))
        for values, look in (
            (flight.error, {"ls": "", "marker": "o", "ms": 1.6, "color": "#2c6e9e"}),
            (flight.filter_error, {"lw": 0.9, "color": "#d1495b"}),
        ):
            size = np.sqrt((values[:, axes_of_error] ** 2).sum(axis=1))
            axes.plot(middle, _largest_of_slots(size, slots), **look)
        axes.set_yscale("log")
        axes.set_yticks(_TICKS_ARCSEC, [str(tick) for tick in _TICKS_ARCSEC])
        axes.set_yticks([], minor=True)
        axes.set_ylim(1.0, 500.0)
        axes.tick_params(labelbottom=False)
        axes.set_ylabel(f"{name}\narcsec")
        _mark_legs(axes, orbit, middle[-1], with_names=number == 0)
    axes = figure.add_axes((0.12, 0.09, 0.86, 0.21))
    states = (
        flight.outcome == _DROPPED,
        flight.outcome > _DROPPED,
        flight.is_moon_seen,
        flight.is_earth_seen,
        flight.streak_px > _SMEARED_PX,
    )
    for line, ((_, colour), state) in enumerate(zip(_BARS, states, strict=True)):
        share = np.bincount(slots, state) / np.bincount(slots)
        shown = np.where(share >= 0.5, -line, np.nan)
        axes.plot(middle, shown, lw=6, solid_capstyle="butt", color=colour)
    axes.set_yticks(range(0, -len(_BARS), -1), [name for name, _ in _BARS])
    axes.set_ylim(0.6 - len(_BARS), 0.6)
    axes.set_xlabel("minutes")
    _mark_legs(axes, orbit, middle[-1], with_names=False)


def _mark_legs(axes: Any, orbit: Orbit, last_min: float, *, with_names: bool) -> None:
    axes.set_xlim(0.0, last_min)
    for number, leg in enumerate(orbit.legs):
        if leg.begin_min < last_min:
            axes.axvline(leg.begin_min, color="#b9c4cc", lw=0.7, zorder=0)
            if with_names:
                at = (leg.begin_min, 1.01)
                axes.text(*at, f" {number + 1}", color="#555", transform=axes.get_xaxis_transform())


def _largest_of_slots(values: Array, slots: NDArray[np.int64]) -> Array:
    largest = np.full(slots[-1] + 1, -1.0)
    np.maximum.at(largest, slots, np.nan_to_num(values, nan=-1.0))
    return np.where(largest > 0.0, largest, np.nan)


def _pointing(orbit: Orbit, minutes: Array, boresights: Array, places: Array) -> Array:
    """Return the angle between boresight and target; NaN before it has settled there."""
    off = np.full(len(minutes), np.nan)
    ends = [leg.begin_min for leg in orbit.legs[1:]] + [np.inf]
    for leg, end_min in zip(orbit.legs, ends, strict=True):
        settled = (minutes >= leg.begin_min + leg.settled_min) & (minutes < end_min)
        wanted = places / np.linalg.norm(places, axis=1)[:, None]
        if leg.direction is not None:
            wanted = np.broadcast_to(leg.direction, wanted.shape)
        if leg.is_controlled:
            away = np.linalg.norm(np.cross(boresights, wanted), axis=1) * ARCSEC
            off = np.where(settled, away, off)
    return off


def _matrices(mrp: Array) -> Array:
    """Return body-from-inertial matrices from MRPs; shape (N, 3, 3)."""
    x, y, z = mrp.T
    zero = np.zeros(len(mrp))
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    square = (mrp**2).sum(axis=1)[:, None, None]
    return np.eye(3) + (8.0 * cross @ cross - 4.0 * (1.0 - square) * cross) / (1.0 + square) ** 2


def _turns(measured: Array, true: Array) -> Array:
    """Return the small rotations, radians about the body's axes, from one attitude to the other."""
    left = measured @ true.transpose(0, 2, 1)
    pairs = ((1, 2), (2, 0), (0, 1))
    return 0.5 * np.stack([left[:, i, j] - left[:, j, i] for i, j in pairs], axis=1)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.nanmean(values**2))) if np.isfinite(values).any() else float("nan")


def _largest(values: Array) -> float:
    return float(np.nanmax(values)) if np.isfinite(values).any() else float("nan")
