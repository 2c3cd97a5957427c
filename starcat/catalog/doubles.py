"""Double stars from a separate source, joined to a star table.

The Washington Double Star Catalog has one record per pair of stars. Its file of Hipparcos stars
identifies them by HIP number, without magnitudes; the whole catalog by the position of the first
star. A pair counts if the sensor cannot resolve it.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from starcat.arrays import Array, Directions, Mask
from starcat.catalog.joins import Keys, numbers_in, read_records, texts_of, with_code
from starcat.catalog.readers.records import ParsedRecords
from starcat.catalog.source_files import FileFacts
from starcat.catalog.stars.star_table import floats_of, with_columns
from starcat.catalog.stars.verdict import Reason
from starcat.geometry.sphere import directions_from_radec
from starcat.progress import Progress, no_progress

WDS_COLUMNS = {
    "wds_hip": ("hip", "wds", "sep"),
    "wds": (
        "wds",
        "obs_first",
        "sep_first",
        "sep_last",
        "mag_first",
        "mag_second",
        "notes",
        "place",
    ),
}

SAME_PAIR_ARCSEC = 1.0
"""Two separations that differ by less belong to one pair, observed in different years."""

UNRESOLVED_ARCSEC = 5.0
"""A pair without magnitudes counts only if it is closer. Of such pairs of naked-eye stars 78 %
differ by 3 mag or less. The star catalog itself contains wider companions of this brightness."""

_POSITION = re.compile(r"(\d\d)(\d\d)(\d\d\.?\d*)([+-])(\d\d)(\d\d)(\d\d\.?\d*)")
_DUBIOUS = b"X"


@dataclass(frozen=True)
class PairTable:
    """Pairs of stars with the keys of their first stars, arrays of shape (M,)."""

    source: str
    files: tuple[FileFacts, ...]
    kept: int  # records that could be used
    rejected: dict[str, int]  # unusable records, by reason
    separation_arcsec: Array
    delta_mag: Array  # magnitude of the second star minus the first; NaN if unknown
    name: NDArray[np.object_]  # the source's name of the system
    keys: Keys
    role = "doubles"  # name in the manifest


def read_wds(paths: Sequence[Path], progress: Progress = no_progress) -> PairTable:
    """Read the Washington Double Star Catalog."""
    read = read_records("wds", paths, WDS_COLUMNS, progress)
    systems = [_BY_LAYOUT[part.layout](part) for part in read.parts]
    hip, separation, delta, is_dubious = (
        np.concatenate([getattr(system, name) for system in systems])
        for name in ("hip", "separation_arcsec", "delta_mag", "is_dubious")
    )
    places = np.concatenate([system.places for system in systems])
    unknown = np.isnan(separation) | ((hip == 0) & np.isnan(places).any(axis=1))
    kept = ~(is_dubious | unknown)
    names = np.array([name for system in systems for name in system.names], dtype=object)
    counts = {
        Reason.deleted.name: int(np.count_nonzero(is_dubious)),
        Reason.no_position.name: int(np.count_nonzero(unknown & ~is_dubious)),
    }
    return PairTable(
        "wds",
        read.files,
        int(np.count_nonzero(kept)),
        read.rejected(**counts),
        separation[kept],
        delta[kept],
        names[kept],
        Keys({"hip_number": hip[kept]}, places[kept]),
    )


@dataclass(frozen=True)
class _Systems:
    """The records of a block, arrays of shape (N,)."""

    hip: NDArray[np.int64]  # 0 if unknown
    places: Directions  # position of the first star at J2000; NaN if unknown
    separation_arcsec: Array  # NaN if it was not measured
    delta_mag: Array
    is_dubious: Mask
    names: list[str]


def _by_hip(part: ParsedRecords) -> _Systems:
    nothing = np.full(len(part), np.nan)
    separation = np.where(part["sep"] >= 0.0, part["sep"], np.nan)
    places = np.stack([nothing] * 3, axis=1)
    is_dubious = np.zeros(len(part), dtype=bool)
    return _Systems(
        part.integers("hip"), places, separation, nothing, is_dubious, texts_of(part["wds"])
    )


def _by_place(part: ParsedRecords) -> _Systems:
    first, last = (numbers_in(texts_of(part[f"sep_{when}"])) for when in ("first", "last"))
    separation = np.where(last >= 0.0, last, np.where(first >= 0.0, first, np.nan))
    mags = [numbers_in(texts_of(part[f"mag_{which}"]), "mag") for which in ("first", "second")]
    is_dubious = np.char.find(part["notes"], _DUBIOUS) >= 0
    radec = np.array([_radec(text) for text in texts_of(part["place"])]).reshape(-1, 2)
    hip = np.zeros(len(part), dtype=np.int64)
    delta = mags[1] - mags[0]
    places = directions_from_radec(*radec.T)
    return _Systems(hip, places, separation, delta, is_dubious, texts_of(part["wds"]))


_BY_LAYOUT = {"wds_hip": _by_hip, "wds": _by_place}


def _radec(text: str) -> tuple[float, float]:
    """Return the degrees of a position such as 000006.64+752859.8; NaN for any other text."""
    match = _POSITION.fullmatch(text)
    if match is None:
        return np.nan, np.nan
    hours, minutes, seconds, sign, degrees, arcmin, arcsec = match.groups()
    ra_deg = 15.0 * (int(hours) + int(minutes) / 60.0 + float(seconds) / 3600.0)
    dec_deg = int(degrees) + int(arcmin) / 60.0 + float(arcsec) / 3600.0
    if ra_deg > 360.0 or dec_deg > 90.0:
        return np.nan, np.nan
    return ra_deg, -dec_deg if sign == "-" else dec_deg


def join_pairs(
    stars: pa.Table, table: PairTable, min_separation_deg: float
) -> tuple[pa.Table, int]:
    """Flag the stars that are in a pair too close for the sensor to resolve.

    If a star is in several pairs, it gets the separation and magnitude difference of the pair with
    the smallest difference; an unknown difference counts as 0, and of equal pairs the closest is
    used. The pair in the star's own catalog is one of them. Wide pairs without magnitudes are not.
    """
    own_apart = floats_of(stars, "companion_separation_arcsec")
    own_delta = floats_of(stars, "companion_delta_mag")
    apart, delta = own_apart.copy(), own_delta.copy()
    code = np.array(stars["double_flag"].to_pylist(), dtype=object)
    flagged = np.array(stars["is_flagged_double"])
    limit = 3600.0 * min_separation_deg
    star, row = (np.concatenate(rows) for rows in zip(*table.keys.match(stars), strict=True))
    their_apart, their_delta = table.separation_arcsec[row], table.delta_mag[row]
    # The star's own catalog can have the magnitudes of the same pair.
    is_own = ~(np.abs(own_apart[star] - their_apart) > SAME_PAIR_ARCSEC)
    their_delta = np.where(np.isnan(their_delta) & is_own, own_delta[star], their_delta)
    close = their_apart <= np.where(np.isnan(their_delta), min(limit, UNRESOLVED_ARCSEC), limit)
    star, row = star[close], row[close]
    their_apart, their_delta = their_apart[close], their_delta[close]
    counts = flagged & (own_apart <= limit)
    best = np.where(counts, np.nan_to_num(own_delta), np.inf)
    order = np.lexsort((their_apart, np.nan_to_num(their_delta), star))
    for s, r, a, d in zip(
        *(values[order] for values in (star, row, their_apart, their_delta)), strict=True
    ):
        code[s] = with_code(code[s], f"{table.source}:{table.name[r]}")
        if np.nan_to_num(d) < best[s]:
            best[s], apart[s], delta[s] = np.nan_to_num(d), a, d
    flagged[star] = True
    columns = {
        "companion_separation_arcsec": apart,
        "companion_delta_mag": delta,
        "double_flag": pa.array(code, pa.string()),
        "is_flagged_double": flagged,
    }
    return with_columns(stars, columns), len(np.unique(star))
