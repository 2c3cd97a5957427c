"""What a database holds of other catalogs: counterparts, and where motions are from.

A star table becomes moving stars, matches become rows of the ``crossmatch`` schema, and the rows of
both products are checked against the stars that they belong to.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from starcat.arrays import Array
from starcat.geometry.sphere import directions_from_radec, separation, tangent_axes
from starcat.products.crossmatch import VERDICTS, Matches
from starcat.products.match_figures import MovingStars
from starcat.stars.proper_motion import MAS, Motion, propagate_directions
from starcat.stars.star_table import floats_of
from starcat.storage.schema import product_schema

NEEDED = (
    *("star_id", "catalog", "designation", "ra_deg", "dec_deg", "epoch_jyear"),
    *("pm_ra_cosdec_mas_yr", "pm_dec_mas_yr", "mag", "band"),
)
"""Columns of a star table that a cross-identification reads."""

SEPARATION_TOLERANCE_ARCSEC = 1e-6
"""Two ways to move a star a century differ by less (docs/algorithms.md, Positions)."""

PROBABILITY_TOLERANCE = 1e-9
"""The probabilities of a star's candidates may add up to 1 and a few roundings."""


def moving_stars(table: pa.Table) -> MovingStars:
    """Return the stars of a table as moving stars."""
    ra_deg, dec_deg = floats_of(table, "ra_deg"), floats_of(table, "dec_deg")
    pm_ra, pm_dec = floats_of(table, "pm_ra_cosdec_mas_yr"), floats_of(table, "pm_dec_mas_yr")
    known = ~(np.isnan(pm_ra) | np.isnan(pm_dec))
    east, north = tangent_axes(ra_deg, dec_deg)
    east *= np.where(known, pm_ra * MAS, 0.0)[:, None]
    north *= np.where(known, pm_dec * MAS, 0.0)[:, None]
    east += north
    return MovingStars(
        directions_from_radec(ra_deg, dec_deg),
        east,
        known,
        floats_of(table, "epoch_jyear"),
        floats_of(table, "mag"),
    )


def table_from_matches(found: Matches, counterparts: pa.Table) -> pa.Table:
    """Return matches as rows of the crossmatch product."""
    other = counterparts.select(NEEDED).take(pa.array(found.counterpart)).combine_chunks()
    columns = {
        **{name: other[name] for name in NEEDED if name != "star_id"},
        "star": found.star,
        "rank": found.rank,
        "counterpart_id": other["star_id"],
        "compared_jyear": found.epoch_jyear,
        "separation_arcsec": np.degrees(found.separation_rad) * 3600.0,
        "delta_mag": pa.array(found.delta_mag, mask=np.isnan(found.delta_mag)),
        "position_error_arcsec": np.degrees(found.odds.error_rad) * 3600.0,
        "n_candidates": found.n_candidates,
        "n_stars": found.n_stars,
        "star_rank": found.star_rank,
        "log10_likelihood_ratio": found.odds.log_ratio / np.log(10.0),
        "probability": found.odds.probability,
        "verdict": pa.array(np.array(VERDICTS, dtype=object)[found.verdict], pa.string()),
    }
    schema = product_schema("crossmatch").arrow_schema
    arrays = [_as_type(columns[field.name], field.type) for field in schema]
    return pa.Table.from_arrays(arrays, schema=schema)


def _as_type(
    values: pa.Array | pa.ChunkedArray | NDArray[np.generic], kind: pa.DataType
) -> pa.Array | pa.ChunkedArray:
    """Return values as a column; a number that does not fit raises."""
    if not isinstance(values, pa.Array | pa.ChunkedArray):
        values = pa.array(values)
    return values if values.type == kind else values.cast(kind)


def matched_stars(table: pa.Table) -> NDArray[np.intp]:
    """Return the rows that name the counterpart of a star, be it ambiguous."""
    named = pc.is_in(table["verdict"], pa.array(["unique", "best", "ambiguous"]))
    return np.flatnonzero(named.to_numpy() & (table["rank"].to_numpy() == 1))


def counterparts_of(table: pa.Table, catalog: str) -> int:
    """Return how many stars have a counterpart in a catalog."""
    return len(matched_stars(table.filter(pc.equal(table["catalog"], catalog))))


def counterpart_problems(table: pa.Table, stars: pa.Table) -> Iterator[str]:
    """Yield where the crossmatch product contradicts itself or the stars."""
    yield from _separation_problems(table, stars)
    yield from _rank_problems(table)
    unknown = set(pc.unique(table["verdict"]).to_pylist()) - set(VERDICTS)
    if unknown:
        yield f"verdict {', '.join(sorted(unknown))}; expected one of {', '.join(VERDICTS)}"


def _separation_problems(table: pa.Table, stars: pa.Table) -> Iterator[str]:
    own = stars.take(table["star"].combine_chunks())
    epoch = floats_of(table, "compared_jyear")
    # By the catalog's own way of moving stars, not by that which made the product.
    angle = separation(_moved_to(own, epoch), _moved_to(table, epoch))
    off = np.abs(np.degrees(angle) * 3600.0 - floats_of(table, "separation_arcsec"))
    for row in np.flatnonzero(~(off <= SEPARATION_TOLERANCE_ARCSEC))[:1]:
        yield f"separation_arcsec of row {row} is not that of its star and its counterpart"
    expected = floats_of(table, "mag") - floats_of(own, "mag")
    delta = floats_of(table, "delta_mag")
    same = (expected == delta) | (np.isnan(expected) & np.isnan(delta))
    for row in np.flatnonzero(~same)[:1]:
        yield f"delta_mag of row {row} is not that of its star and its counterpart"


def _moved_to(table: pa.Table, epoch: Array) -> Array:
    names = ("ra_deg", "dec_deg", "pm_ra_cosdec_mas_yr", "pm_dec_mas_yr")
    motion = Motion(*(floats_of(table, name) for name in names))
    return propagate_directions(motion, epoch - floats_of(table, "epoch_jyear"))[1]


def _rank_problems(table: pa.Table) -> Iterator[str]:
    """Yield where ranks and counts of a star's candidates do not fit its rows."""
    star, catalog = table["star"].to_numpy(), table["catalog"].to_numpy()
    begins = np.diff(star, prepend=-1) != 0
    begins[1:] |= catalog[1:] != catalog[:-1]
    first = np.flatnonzero(begins)
    size = np.diff(np.append(first, len(star)))
    ranks = np.arange(len(star)) - np.repeat(first, size) + 1
    for row in np.flatnonzero(table["rank"].to_numpy() != ranks)[:1]:
        yield f"rank of row {row} is not {ranks[row]}, its place among its star's candidates"
    for row in np.flatnonzero(table["n_candidates"].to_numpy() != np.repeat(size, size))[:1]:
        yield f"n_candidates of row {row} is not the number of its star's rows"
    probability = table["probability"].to_numpy()
    wrong = ~((probability >= 0.0) & (probability <= 1.0))
    if len(first):
        whole = np.repeat(np.add.reduceat(probability, first), size)
        wrong |= ~(whole <= 1.0 + PROBABILITY_TOLERANCE)
    for row in np.flatnonzero(wrong)[:1]:
        yield f"probability of row {row}: the candidates of a star share at most 1"


JOINED, OWN_MOTION, NO_CANDIDATE, NO_MOTION = "joined", "own_motion", "no_candidate", "no_motion"

OUTCOMES = (JOINED, OWN_MOTION, NO_CANDIDATE, "ambiguous", "taken", "doubtful", NO_MOTION)
"""What may be said of a star in the product ``motions``; the schema says what each means."""

WAY_TOLERANCE_ARCSEC = 1e-6
"""The way between two directions and the way at a speed differ by less."""


def motion_problems(table: pa.Table, stars: pa.Table) -> Iterator[str]:
    """Yield where the product ``motions`` contradicts itself or the stars."""
    if not np.array_equal(table["star"].to_numpy(), np.arange(len(stars))):
        yield f"star: not the rows 0 to {len(stars) - 1} of the stars, each once"
        return
    unknown = set(pc.unique(table["outcome"]).to_pylist()) - set(OUTCOMES)
    if unknown:
        yield f"outcome {', '.join(sorted(unknown))}; expected one of {', '.join(OUTCOMES)}"
    pm = ("pm_ra_cosdec_mas_yr", "pm_dec_mas_yr")
    moves = ~(np.isnan(floats_of(stars, pm[0])) | np.isnan(floats_of(stars, pm[1])))
    named = pc.is_in(table["outcome"], pa.array([JOINED, OWN_MOTION])).to_numpy()
    for row in np.flatnonzero(moves != named)[:1]:
        has = "has a" if moves[row] else "has no"
        yield f"outcome of row {row} is {table['outcome'][int(row)]}, but the star {has} motion"
    joined = pc.equal(table["outcome"], JOINED).to_numpy()
    # A straight line at constant speed: after the angle a the motion is cos(a)^2 of the first.
    years = floats_of(stars, "epoch_jyear") - floats_of(table, "from_jyear")
    motion = np.hypot(floats_of(stars, pm[0]), floats_of(stars, pm[1])) * MAS
    way = np.degrees(0.5 * np.arcsin(np.minimum(2.0 * motion * np.abs(years), 1.0))) * 3600.0
    told = floats_of(table, "moved_arcsec")
    right = np.where(joined, np.abs(way - told) <= WAY_TOLERANCE_ARCSEC, np.isnan(told))
    for row in np.flatnonzero(~right)[:1]:
        yield f"moved_arcsec of row {row} is not the way that its star has gone"


def joined_of(table: pa.Table, catalog: str) -> int:
    """Return how many stars have their motion from a catalog."""
    rows = pc.and_(pc.equal(table["outcome"], JOINED), pc.equal(table["catalog"], catalog))
    return int(pc.sum(rows).as_py() or 0)


COUNTS: dict[str, tuple[Callable[[pa.Table, str], int], str]] = {
    "motions": (joined_of, "have their motion from it"),
    "crossmatch": (counterparts_of, "have a counterpart"),
}
"""What counts the stars that a product has from a catalog, and what these stars have."""


def joined_problems(product: str, table: pa.Table, source: Mapping[str, Any]) -> Iterator[str]:
    """Yield where the manifest's count of a catalog is not that of the product."""
    count_of, have = COUNTS[product]
    found, joined = count_of(table, source["source"]), source.get("joined")
    if found != joined:
        yield f"{source['source']}: {joined} stars {have}, but the product {product} holds {found}"
