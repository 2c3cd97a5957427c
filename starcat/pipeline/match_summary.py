"""What a cross-identification found, in counts that parts add up to and in words for people."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Protocol

import numpy as np
import pyarrow as pa

from starcat.arrays import Array
from starcat.artifact.crossmatch_table import matched_stars
from starcat.products.crossmatch import VERDICTS, Matches
from starcat.products.match_figures import ARCSEC


@dataclass(frozen=True)
class Summary:
    """What a cross-identification of two catalogs found."""

    # stars, counterparts: rows of the two
    stars: int
    counterparts: int
    radius_arcsec: float  # largest separation of a candidate
    # matched, unmatched: stars with a counterpart, be it ambiguous, and all others
    matched: int
    unmatched: int
    verdicts: dict[str, int]  # stars by the verdict on their likeliest candidate
    no_candidate: int  # stars with none within the radius
    mutual: int  # stars that are their likeliest candidate's likeliest star
    # median_separation_arcsec, median_delta_mag: over the matched stars; None where there is none
    median_separation_arcsec: float | None
    median_delta_mag: float | None
    # position_error_arcsec, expected_delta_mag, completeness: the figures behind the odds, given or
    # measured
    position_error_arcsec: float
    expected_delta_mag: float
    completeness: float

    def as_dict(self) -> dict[str, Any]:
        """Return the summary as plain values."""
        return asdict(self)


@dataclass(frozen=True)
class Tally:
    """What was found of some stars."""

    rows: int  # candidates of all of them
    matched: int  # stars with a counterpart, be it ambiguous
    with_candidates: int  # stars with any candidate
    mutual: int  # stars that are their likeliest candidate's likeliest star
    verdicts: dict[str, int]  # stars by the verdict on their likeliest candidate

    @classmethod
    def of_none(cls) -> Tally:
        """Return the tally of no stars."""
        return cls(0, 0, 0, 0, {name: 0 for name in VERDICTS if name != "other"})

    def __add__(self, other: Tally) -> Tally:
        """Return what was found of both."""
        return Tally(
            self.rows + other.rows,
            self.matched + other.matched,
            self.with_candidates + other.with_candidates,
            self.mutual + other.mutual,
            {name: count + other.verdicts[name] for name, count in self.verdicts.items()},
        )


class MeasuredFigures(Protocol):
    """The figures behind the odds."""

    @property
    def position_error_rad(self) -> float:
        """Standard deviation of the difference of two positions, each axis."""

    @property
    def delta_mag(self) -> float:
        """Magnitude of the counterpart minus that of the star."""

    @property
    def completeness(self) -> float:
        """Share of the stars that have a counterpart."""


def tally_of(found: Matches, table: pa.Table) -> Tally:
    """Count what was found."""
    first = found.rank == 1
    return Tally(
        len(found.rank),
        len(matched_stars(table)),
        int(first.sum()),
        int((first & (found.star_rank == 1)).sum()),
        {name: found.count(name) for name in VERDICTS if name != "other"},
    )


def differences_of(found: Matches, table: pa.Table) -> tuple[Array, Array]:
    """Return by how much the matched stars and their counterparts differ."""
    rows = matched_stars(table)
    delta = found.delta_mag[rows]
    return found.separation_rad[rows] / ARCSEC, delta[~np.isnan(delta)]


def summary_of(
    tally: Tally,
    rows: tuple[int, int],
    radius_arcsec: float,
    figures: MeasuredFigures,
    median_separation_arcsec: float | None,
    median_delta_mag: float | None,
) -> Summary:
    """Return the summary of a tally of all stars."""
    stars, counterparts = rows
    return Summary(
        stars,
        counterparts,
        radius_arcsec,
        tally.matched,
        stars - tally.matched,
        tally.verdicts,
        stars - tally.with_candidates,
        tally.mutual,
        None if median_separation_arcsec is None else round(median_separation_arcsec, 6),
        None if median_delta_mag is None else round(median_delta_mag, 6),
        round(figures.position_error_rad / ARCSEC, 6),
        round(figures.delta_mag, 6),
        round(figures.completeness, 6),
    )
