"""Several catalogs as one star table, with one row per star.

The merged table has all stars of the first catalog, and from each later catalog the stars that are
still missing. The counterpart of a star is rejected with the reason ``counterpart``; if several
records can be it, the likeliest is rejected (``ambiguous_counterpart``).

The other records near a star stay stars, and the rules of the selection handle them as close pairs,
except for two cases. A record whose light is part of the star's light, because the star's catalog
has one record for a pair, is rejected as a counterpart, too. The likeliest record is no counterpart
but a companion, if its place and its light both differ from the star's: both stay.

A star is identified by its catalog and its number there: two catalogs can have equal numbers. Every
value of a row is from its ``catalog``; magnitudes are converted to the band of the first catalog,
and ``mag_source`` states their origin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from starcat.arrays import Array, Mask
from starcat.catalog.bands.photometry import ERRORS_MAG, band_error
from starcat.catalog.bands.response import shipped, shipped_names
from starcat.catalog.ingest import CatalogPart, Ingested
from starcat.catalog.joins import MATCH_ARCSEC, with_code
from starcat.catalog.sensor_band import in_sensor_band
from starcat.catalog.stars.star_table import (
    STAR_KEY,
    add_nearest_neighbours,
    floats_of,
    reject_rows,
    sort_rejected,
    sort_rows,
    with_columns,
)
from starcat.catalog.stars.verdict import Quality, Reason
from starcat.database.products.crossmatch import (
    Crossmatch,
    Matches,
    crossmatch,
    log_position_densities,
    matched_rows,
)
from starcat.errors import ConfigError

Rows = NDArray[np.int64]

COMPANION_RANGE_MAG = 10.0
"""Companions differ from their star by any magnitude in a range as wide as this."""


def merged_catalog(
    read: Sequence[Ingested], options: Crossmatch, workers: int, *, neighbours: bool = True
) -> Ingested:
    """Merge several catalogs into one with one row per star; return a single one unchanged."""
    whole = reduce(partial(_joined, options=options), read)
    if len(read) == 1 or not neighbours:
        return whole
    return replace(whole, stars=add_nearest_neighbours(whole.stars, workers))


def _joined(whole: Ingested, read: Ingested, options: Crossmatch) -> Ingested:
    """Return a catalog with the missing stars added from another catalog."""
    records = _in_band(read, whole.band)
    matches = crossmatch(whole.stars, records, options)
    is_elsewhere = _is_elsewhere(matches, options)
    pairs = _judged(_Pairs.of(matches), is_elsewhere, whole, replace(read, stars=records), options)
    stars, added = _flagged(whole.stars, records, pairs)
    is_kept = np.ones(len(stars), dtype=bool)
    is_kept[pairs.star[pairs.is_replaced]] = False
    is_missing = np.ones(len(records), dtype=bool)
    is_missing[pairs.record[pairs.is_again & ~pairs.is_replaced]] = False
    rejected = [whole.rejected, read.rejected, _records_again(stars, records, pairs)]
    rejected.append(_stars_replaced(stars, records, pairs))
    tables = stars.filter(pa.array(is_kept)), added.filter(pa.array(is_missing))
    return replace(
        whole,
        stars=sort_rows(pa.concat_tables(tables), STAR_KEY).combine_chunks(),
        rejected=sort_rejected(pa.concat_tables(rejected).combine_chunks()),
        files=(*whole.files, *read.files),
        problems=(*whole.problems, *read.problems),
        notes=(*whole.notes, *read.notes),
        beyond_read_limit=whole.beyond_read_limit + read.beyond_read_limit,
        parts=(*(whole.parts or (CatalogPart.of(whole),)), CatalogPart.of(read)),
    )


def _in_band(read: Ingested, band: str) -> pa.Table:
    """Return the stars of a catalog with their magnitudes in a band."""
    if read.band == band or not len(read.stars):
        return read.stars
    if band not in shipped_names():
        raise ConfigError(
            f"the passband of {band!r} is unknown, so the magnitudes of "
            f"{read.source} in {read.band} cannot be converted to it",
            where="catalog.band",
            key="catalog.band",
            value=band,
            hint="choose a band that 'starcat bands' lists",
        )
    stars = in_sensor_band(read.stars, read.source, shipped(band)).stars
    mag_source = pc.binary_join_element_wise(read.source, stars["mag_source"], " ")
    return with_columns(stars, {"band": band, "mag_source": mag_source})


@dataclass(frozen=True)
class _Pairs:
    """The stars of a catalog and the records of another near them; arrays of shape (M,)."""

    star: Rows  # rows of the stars
    record: Rows  # rows of the records
    star_rank: Rows  # of the star among those near the record
    separation_arcsec: Array
    has_delta_mag: Mask  # whether both magnitudes are known
    is_named: Mask  # whether the record can be the counterpart of the star
    is_ambiguous: Mask
    # What the records are:
    is_again: Mask  # the star, or a part of its light
    is_part: Mask  # a part of the star's light
    is_companion: Mask  # a star next to it
    is_replaced: Mask  # the star, whose own record is dubious

    @classmethod
    def of(cls, matches: Matches) -> _Pairs:
        """Return the pairs of a cross-identification; nothing is judged yet."""
        table = matches.table
        nothing = np.zeros(len(table), dtype=bool)
        is_named = nothing.copy()
        is_named[matched_rows(table)] = True
        return cls(
            table["star"].to_numpy().astype(np.int64),
            matches.counterpart,
            table["star_rank"].to_numpy().astype(np.int64),
            floats_of(table, "separation_arcsec"),
            np.isfinite(floats_of(table, "delta_mag")),
            is_named,
            pc.equal(table["verdict"], "ambiguous").to_numpy(),
            *(nothing for _ in range(4)),
        )


def _judged(
    pairs: _Pairs, is_elsewhere: Mask, whole: Ingested, read: Ingested, options: Crossmatch
) -> _Pairs:
    """Decide what the records near each star are."""
    tables = whole.stars, read.stars
    doubted = [
        (table["quality_flags"].to_numpy() & int(Quality.DUBIOUS_POSITION)) > 0 for table in tables
    ]
    is_dubious = doubted[0][pairs.star], doubted[1][pairs.record]
    differs = is_elsewhere & ~is_dubious[0] & ~is_dubious[1]
    # The light of a variable says nothing, and its place is less certain than that of other stars.
    varies = [pc.fill_null(table["is_flagged_variable"], False).to_numpy() for table in tables]
    is_variable = varies[0][pairs.star] | varies[1][pairs.record]
    differs &= ~(is_variable & (pairs.separation_arcsec <= MATCH_ARCSEC))
    named = pairs.is_named & ~differs
    # A record can match two stars that its catalog does not resolve: the first counts.
    order = np.lexsort((pairs.star_rank, ~named, pairs.record))
    first = order[np.diff(pairs.record[order], prepend=-1) != 0]
    is_first = np.zeros(len(named), dtype=bool)
    is_first[first] = True
    is_counterpart = named & is_first
    errors = [
        _light_errors(*catalog) for catalog in zip(tables, (whole.source, read.source), strict=True)
    ]
    mags = [floats_of(table, "mag") for table in tables]
    is_part = _parts_of_light(pairs, named, mags, errors, options)
    return replace(
        pairs,
        is_again=is_counterpart | is_part,
        is_part=is_part,
        is_companion=pairs.is_named & differs,
        is_replaced=is_counterpart & is_dubious[0] & ~is_dubious[1],
    )


def _is_elsewhere(matches: Matches, options: Crossmatch) -> Mask:
    """Return whether the record is rather a companion: its place and its light differ.

    The separations of companions are distributed as those of counterparts with a wrong position
    (as many in every factor of the separation), so that the light decides between the two.
    """
    angle, error, delta_mag = (
        floats_of(matches.table, name)
        for name in ("separation_arcsec", "position_error_arcsec", "delta_mag")
    )
    normal, far = log_position_densities(angle, error, options.radius_arcsec, options.outlier_share)
    spread = options.colour_spread_mag
    off = (delta_mag - matches.expected_delta_mag) / spread
    alike = -0.5 * off**2 - np.log(spread * np.sqrt(2.0 * np.pi))
    with np.errstate(invalid="ignore"):
        companion = far - np.log(COMPANION_RANGE_MAG)
        return np.asarray(np.logaddexp(normal, far) + alike < companion)


def _light_errors(stars: pa.Table, source: str) -> Array:
    """Return the errors of magnitudes: stated, or usual for the band; infinite without either."""
    mag, stated = floats_of(stars, "mag"), floats_of(stars, "mag_error")
    band = stars["band"][0].as_py() if len(stars) else ""
    usual = band_error(band, mag, source) if band in ERRORS_MAG else np.full(len(mag), np.inf)
    return np.where(np.isfinite(stated), stated, usual)


def _parts_of_light(
    pairs: _Pairs, named: Mask, mags: Sequence[Array], errors: Sequence[Array], options: Crossmatch
) -> Mask:
    """Return the records whose light is part of the light of a star that has a counterpart.

    Such a star is a pair in one catalog and two records in the other one. A record is a part if
    the star's magnitude is likelier with its light than without, by the odds of ``ambiguous_odds``.
    """
    star_mag, record_mag = mags
    counterpart = dict(zip(pairs.star[named].tolist(), np.flatnonzero(named).tolist(), strict=True))
    taken = set(pairs.record[named].tolist())
    is_part = np.zeros(len(named), dtype=bool)
    rest = np.flatnonzero(~named & pairs.has_delta_mag)
    rest = rest[np.lexsort((pairs.record[rest], record_mag[pairs.record[rest]], pairs.star[rest]))]
    so_far: dict[int, float] = {}
    for pair in rest.tolist():
        star, record = int(pairs.star[pair]), int(pairs.record[pair])
        if star not in counterpart or record in taken:
            continue
        same = int(pairs.record[counterpart[star]])
        without = so_far.get(star, float(record_mag[same]))
        both = without - 2.5 * np.log10(1.0 + 10.0 ** (0.4 * (without - record_mag[record])))
        variance = errors[0][star] ** 2 + errors[1][same] ** 2
        gain = (star_mag[star] - without) ** 2 - (star_mag[star] - both) ** 2
        if gain > 2.0 * variance * np.log(options.ambiguous_odds):
            is_part[pair] = True
            so_far[star] = float(both)
            taken.add(record)
    return is_part


def _flagged(stars: pa.Table, records: pa.Table, pairs: _Pairs) -> tuple[pa.Table, pa.Table]:
    """Return both tables with the stars flagged as double that the other catalog shows as such."""
    if not (pairs.is_companion | pairs.is_part).any():
        return stars, records
    names = [table["catalog"][0].as_py() for table in (stars, records)]
    companions = np.flatnonzero(pairs.is_companion)
    codes = dict.fromkeys(pairs.star[companions].tolist(), f"{names[1]}=companion")
    codes |= dict.fromkeys(pairs.star[pairs.is_part].tolist(), f"{names[1]}=combined")
    its_codes = dict.fromkeys(pairs.record[companions].tolist(), f"{names[0]}=companion")
    return _with_double_codes(stars, codes), _with_double_codes(records, its_codes)


def _with_double_codes(stars: pa.Table, codes: dict[int, str]) -> pa.Table:
    if not codes:
        return stars
    rows = np.array(sorted(codes), dtype=np.int64)
    old_flags = stars["double_flag"].take(pa.array(rows)).to_pylist()
    new_flags = [
        with_code(code, codes[row]) for row, code in zip(rows.tolist(), old_flags, strict=True)
    ]
    is_changed = np.zeros(len(stars), dtype=bool)
    is_changed[rows] = True
    flags = pc.replace_with_mask(
        stars["double_flag"].combine_chunks(),
        pa.array(is_changed),
        pa.array(new_flags, pa.string()),
    )
    is_double = pc.fill_null(stars["is_flagged_double"], False).to_numpy() | is_changed
    return with_columns(stars, {"double_flag": flags, "is_flagged_double": is_double})


def _records_again(stars: pa.Table, records: pa.Table, pairs: _Pairs) -> pa.Table:
    """Return the records of stars that are there already, as rejected rows."""
    rows = np.flatnonzero(pairs.is_again & ~pairs.is_replaced)
    rows = rows[np.argsort(pairs.record[rows], kind="stable")]
    reasons = np.where(
        pairs.is_ambiguous[rows], Reason.ambiguous_counterpart.name, Reason.counterpart.name
    )
    return _as_counterparts(records, pairs.record, stars, pairs.star, rows, reasons, pairs)


def _stars_replaced(stars: pa.Table, records: pa.Table, pairs: _Pairs) -> pa.Table:
    """Return the dubious records of stars of which the other catalog has a better one."""
    rows = np.flatnonzero(pairs.is_replaced)
    reasons = np.full(len(rows), Reason.counterpart.name)
    return _as_counterparts(stars, pairs.star, records, pairs.record, rows, reasons, pairs)


def _as_counterparts(
    rejected: pa.Table,
    its_rows: Rows,
    others: pa.Table,
    other_rows: Rows,
    rows: Rows,
    reasons: NDArray[np.str_],
    pairs: _Pairs,
) -> pa.Table:
    again = rejected.take(pa.array(its_rows[rows])).combine_chunks()
    names = others["designation"].take(pa.array(other_rows[rows])).to_pylist()
    apart, parts = pairs.separation_arcsec[rows].tolist(), pairs.is_part[rows].tolist()
    detail = [
        f"{name}, {angle:.3f} arcsec" + (", whose light includes it" if is_part else "")
        for name, angle, is_part in zip(names, apart, parts, strict=True)
    ]
    return reject_rows(again, pa.array(reasons, pa.string()), pa.array(detail, pa.string()))
