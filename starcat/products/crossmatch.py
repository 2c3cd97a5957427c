"""The product ``crossmatch``: counterparts of the guide stars in other catalogs.

A star table becomes moving stars, matches (`starcat.products.match_stars`) become rows, and rows
are checked against the stars that they belong to. The pipeline reads the catalogs
(`starcat.pipeline.counterparts`).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from pydantic import Field, model_validator

from starcat.arrays import Array
from starcat.geometry.sphere import directions_from_radec, separation, tangent_axes
from starcat.products.kind import Extent, ProductKind, ProductSection, SpecFacts
from starcat.products.match_figures import MovingStars
from starcat.products.match_stars import VERDICTS, Matches
from starcat.sections import CatalogName, Mag
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


def matched_rows(table: pa.Table) -> NDArray[np.intp]:
    """Return the rows that name the counterpart of a star, including ambiguous ones."""
    named = pc.is_in(table["verdict"], pa.array(["unique", "best", "ambiguous"]))
    return np.flatnonzero(named.to_numpy() & (table["rank"].to_numpy() == 1))


def counterparts_of(table: pa.Table, catalog: str) -> int:
    """Return how many stars have a counterpart in a catalog."""
    return len(matched_rows(table.filter(pc.equal(table["catalog"], catalog))))


class Crossmatch(ProductSection):
    """Counterparts of the guide stars in other catalogs."""

    enabled: bool = Field(False, description="whether the database has this product")
    catalogs: tuple[CatalogName, ...] = Field(
        (),
        strict=False,  # a list in TOML
        description="star catalogs to look for counterparts in",
        examples=[["hipparcos"]],
    )
    radius_arcsec: float = Field(
        10.0, ge=0.001, le=600.0, description="largest separation of a candidate"
    )
    position_error_arcsec: float | None = Field(
        None,
        ge=0.0001,
        le=60.0,
        description="standard deviation of the difference of two positions of a star, each axis; "
        "default: measured",
    )
    unknown_motion_mas_yr: float = Field(
        20.0,
        ge=0.0,
        le=10_000.0,
        description="standard deviation of the motion of a pair in which neither has one",
    )
    outlier_share: float = Field(
        0.02,
        ge=0.0,
        le=0.99,
        description="share of the stars that are off by more than their stated errors",
    )
    expected_delta_mag: Mag | None = Field(
        None, description="magnitude of the counterpart minus the star's; default: measured"
    )
    colour_spread_mag: float = Field(
        1.0, ge=0.01, le=30.0, description="standard deviation of that difference"
    )
    completeness: float | None = Field(
        None, ge=0.001, le=0.999, description="share of stars with a counterpart; default: measured"
    )
    ambiguous_odds: float = Field(
        10.0, ge=1.0, le=1e6, description="candidates that differ by no more are ambiguous"
    )
    min_probability: float = Field(
        0.5, ge=0.0, le=1.0, description="candidates that together have less are doubtful"
    )
    read_limit_mag: Mag | None = Field(
        None, description="fainter counterparts are counted while reading, not listed"
    )

    @model_validator(mode="after")
    def _has_catalogs(self) -> Crossmatch:
        if self.enabled and not self.catalogs:
            raise ValueError('no catalogs; name some, such as catalogs = ["hipparcos"]')
        return self

    @property
    def sources(self) -> tuple[str, ...]:
        """Names of the catalogs that counterparts are looked for in."""
        return self.catalogs if self.enabled else ()

    def check_agrees(self, facts: SpecFacts) -> None:
        """Check that the catalog of the stars is not among the catalogs."""
        if facts.catalog in self.catalogs:
            raise ValueError(
                f"products.crossmatch.catalogs: {facts.catalog} is the catalog of the stars "
                "themselves; name others"
            )


def counterpart_problems(table: pa.Table, stars: pa.Table) -> Iterator[str]:
    """Yield contradictions within the crossmatch product, and with the stars."""
    yield from _separation_problems(table, stars)
    yield from _rank_problems(table)
    unknown = set(pc.unique(table["verdict"]).to_pylist()) - set(VERDICTS)
    if unknown:
        yield f"verdict {', '.join(sorted(unknown))}; expected one of {', '.join(VERDICTS)}"


def _separation_problems(table: pa.Table, stars: pa.Table) -> Iterator[str]:
    own = stars.take(table["star"].combine_chunks())
    epoch = floats_of(table, "compared_jyear")
    # Move stars as the catalog itself does, not with the code that made the product.
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


KIND = ProductKind(
    name="crossmatch",
    section=Crossmatch,
    in_database=False,
    count=lambda inputs, wanted: Extent(float(len(inputs.directions) * len(wanted.catalogs))),
    cost=None,
    file_bytes=lambda extent, stars, wanted: 75.0 * extent.rows,
    problems=counterpart_problems,
    joined=(counterparts_of, "have a counterpart"),
)
