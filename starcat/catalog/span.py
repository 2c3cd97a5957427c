"""The years of a mission: the drift of stars from their positions, and the positions' errors.

A database has the positions of one epoch, the middle of its span. Until both ends a star moves by
its proper motion, during a year by its parallax, and the error of its motion adds uncertainty.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from starcat.arrays import Array
from starcat.catalog.stars.proper_motion import Motion, propagate_in_space
from starcat.catalog.stars.star_table import Columns, directions_of, floats_of, with_columns
from starcat.geometry.sphere import separation

_NAMED = 5  # number of listed stars, those with the largest drifts
_AXES = ("ra", "dec")


def with_span(stars: pa.Table, span_jyear: tuple[float, float]) -> pa.Table:
    """Return stars at the middle of a span with their errors at its ends and their drift."""
    begin, end = span_jyear
    errors = position_errors(stars, begin)
    columns: Columns = {
        "position_error_begin_arcsec": errors,
        "position_error_end_arcsec": errors if end == begin else position_errors(stars, end),
    }
    if end > begin:
        columns["drift_arcsec"] = drifts(stars, 0.5 * (end - begin))
    return with_columns(stars, columns)


def position_errors(stars: pa.Table, jyear: float) -> Array:
    """Return the standard error of each position at a given year, arcsec; NaN if it is unknown.

    At the central epoch position and motion are independent, so that their variances add up.
    """
    axes = []
    for axis in _AXES:
        years = jyear - floats_of(stars, f"{axis}_central_jyear")
        grown = np.nan_to_num(years * floats_of(stars, f"pm_{axis}_error_mas_yr"))
        axes.append(np.hypot(floats_of(stars, f"{axis}_error_mas"), grown))
    return np.fmax(*axes) / 1000.0


def drifts(stars: pa.Table, years: float) -> Array:
    """Return the largest drift of stars from their positions within ``years`` either way, arcsec.

    It is the sum of the larger motion to either end and the annual parallax; NaN if the motion of
    a star is unknown.
    """
    pm = [floats_of(stars, name) for name in ("pm_ra_cosdec_mas_yr", "pm_dec_mas_yr")]
    motion = Motion(floats_of(stars, "ra_deg"), floats_of(stars, "dec_deg"), *pm)
    parallax = floats_of(stars, "parallax_mas")
    velocity, epoch = floats_of(stars, "radial_velocity_km_s"), floats_of(stars, "epoch_jyear")
    here = directions_of(stars)
    ways = [
        separation(here, propagate_in_space(motion, parallax, velocity, epoch, epoch + elapsed)[1])
        for elapsed in (-years, years)
    ]
    annual = np.nan_to_num(np.fmax(parallax, 0.0)) / 1000.0
    return np.where(np.isnan(pm[0] + pm[1]), np.nan, np.degrees(np.fmax(*ways)) * 3600.0 + annual)


@dataclass(frozen=True)
class Validity:
    """The years for which a database is valid, and the stars that drift most."""

    begin_jyear: float
    end_jyear: float
    stars_without_motion: int  # their drift is unknown
    median_drift_arcsec: float  # median of guide stars with a known motion
    worst_1_percent_arcsec: float
    worst: tuple[dict[str, Any], ...]  # designation and drift of the stars that drift most
    reissued_worst_arcsec: float  # largest drift if a new release is made at the middle
    largest_error_arcsec: float | None  # standard error of positions at the worse end

    def __str__(self) -> str:
        """Return the facts in a sentence."""
        named = ", ".join(
            f"{star['designation']} {star['drift_arcsec']:.2f}" for star in self.worst
        )
        unknown = f"; {self.stars_without_motion:,} stars have no motion"
        return (
            f"positions hold from J{self.begin_jyear:g} to J{self.end_jyear:g}: the median star "
            f"drifts {self.median_drift_arcsec:.2f} arcsec from its place, the worst 1 % "
            f"{self.worst_1_percent_arcsec:.2f} or more ({named}); a release at the middle would "
            f"leave {self.reissued_worst_arcsec:.2f} at the most"
            + (unknown if self.stars_without_motion else "")
        )


def validity(stars: pa.Table, span_jyear: tuple[float, float]) -> Validity | None:
    """Return the validity of guide stars; None without a span, or if no motion is known."""
    begin, end = span_jyear
    drift = floats_of(stars, "drift_arcsec")
    rows = np.flatnonzero(~np.isnan(drift))
    if begin == end or not len(rows):
        return None
    worst = rows[np.lexsort((stars["star_id"].to_numpy()[rows], -drift[rows]))][:_NAMED]
    error = np.fmax(*(floats_of(stars, f"position_error_{at}_arcsec") for at in ("begin", "end")))
    return Validity(
        begin,
        end,
        len(stars) - len(rows),
        float(np.median(drift[rows])),
        float(np.quantile(drift[rows], 0.99)),
        tuple(
            {"designation": str(stars["designation"][int(row)]), "drift_arcsec": float(drift[row])}
            for row in worst
        ),
        float(np.nanmax(drifts(stars, 0.25 * (end - begin)))),
        None if np.isnan(error).all() else float(np.nanmax(error)),
    )
