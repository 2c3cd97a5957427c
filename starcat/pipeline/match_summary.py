"""What a cross-identification found: counts that parts add up to, medians of many files."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from starcat.arrays import Array
from starcat.artifact.other_catalogs import matched_stars
from starcat.products.crossmatch import VERDICTS, Matches
from starcat.products.match_figures import ARCSEC, Figures
from starcat.products.match_odds import Odds
from starcat.storage.atomic import whole_file


@dataclass(frozen=True)
class Summary:
    """What a cross-identification of two catalogs found."""

    stars: int
    counterparts: int
    radius_arcsec: float  # largest separation of a candidate
    matched: int  # stars with a counterpart, be it ambiguous
    unmatched: int  # all others
    verdicts: dict[str, int]  # stars by the verdict on their likeliest candidate
    no_candidate: int  # stars with none within the radius
    mutual: int  # stars that are their likeliest candidate's likeliest star
    median_separation_arcsec: float | None  # over the matched stars; None where there is none
    median_delta_mag: float | None
    # The figures behind the odds, given or measured:
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
    figures: Figures | Odds,
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


def write_numbers(values: Array, path: Path) -> None:
    """Write numbers to a file that `median_of` reads."""
    with whole_file(path) as partial:
        partial.write_bytes(np.ascontiguousarray(values, dtype="<f8").tobytes())


def median_of(paths: Sequence[Path]) -> tuple[int, float | None]:
    """Return how many numbers files have, and the median of all, which need not fit in memory."""
    count = sum(path.stat().st_size for path in paths) // 8
    if not count:
        return 0, None
    middle = [(count - 1) // 2, count // 2]
    with tempfile.TemporaryFile(dir=paths[0].parent) as all_of_them:
        for path in paths:
            with path.open("rb") as some:
                shutil.copyfileobj(some, all_of_them)
        all_of_them.flush()
        numbers = np.memmap(all_of_them, dtype="<f8", mode="r+")
        numbers.partition(middle)
        lower, upper = numbers[middle].tolist()
    return count, (lower + upper) / 2.0
