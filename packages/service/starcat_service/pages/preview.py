"""The expected result of a spec on the page *New database*: verdict, map, histogram, sizes."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from starcat.arrays import Array, Directions
from starcat.geometry import radec_from_directions, saff_kuijlaars
from starcat.pipeline import ENOUGH_STARS, MANY_FIELDS, STARS_A_FIELD, Estimate, EstimateFigures
from starcat.pipeline.report import (
    BLIND_SHARE,
    FIXED_BINS,
    Counts,
    Fields,
    Raster,
    SkyMap,
    nearest_raster,
    raster_png,
    sky_map,
)
from starcat.pipeline.simulation import wilson_interval
from starcat.pipeline.specs import BuildSpec
from starcat_service.estimates import ChildCatalogs
from starcat_service.pages.rendering import count_text

MAP_WIDTH = 720  # columns of the raster of a map: the width of a card of the page
MAX_BARS = 48
MAX_MAPPED = 50_000
"""Largest number of boresights for a map: the fields of more would be finer than its dots."""


@dataclass(frozen=True)
class Bar:
    """A bar of the histogram of stars in a field."""

    least: int  # stars of a field
    most: int
    fields: int
    colour: str  # class of their colour in the map


@dataclass(frozen=True)
class Verdict:
    """Whether a design is good enough, in words."""

    level: str  # "good", "warn" or "bad"
    words: str
    will_fail: bool = False  # whether the self-test of the build requires more


@dataclass(frozen=True)
class Preview:
    """The expected results of a spec."""

    estimate: Estimate
    figures: EstimateFigures
    verdict: Verdict
    files: list[tuple[str, int | None, int]]  # name, rows of a product, bytes; the largest first
    bars: list[Bar]
    map: SkyMap | None  # None: the tiling is too fine for a map
    picture: str  # the raster, as an address that contains it


def preview_of(estimate: Estimate, verdict: Verdict) -> Preview:
    """Return the data that the page shows of a spec."""
    figures, counts = estimate.figures, estimate.fields.count.astype(np.int64)
    ra_deg, dec_deg = radec_from_directions(estimate.fields.boresights)
    none = np.zeros_like(counts)
    fields = Fields(ra_deg, dec_deg, counts, none, none)
    is_mapped = len(counts) <= MAX_MAPPED
    return Preview(
        estimate,
        figures,
        verdict,
        _files(figures),
        _bars(counts),
        sky_map(fields, FIXED_BINS) if is_mapped else None,
        _picture(estimate.fields.boresights, counts, estimate.spec) if is_mapped else "",
    )


def _files(figures: EstimateFigures) -> list[tuple[str, int | None, int]]:
    fixed = {
        "stars": figures.guide_stars,
        "boresights": figures.fields.count,
        "rejected": sum(figures.rejected.values()),
    }
    rows = {f"{product}.parquet": count for product, count in {**figures.rows, **fixed}.items()}
    files = [(name, rows.get(name), size) for name, size in figures.files.items()]
    return sorted(files, key=lambda file: (-file[2], file[0]))


async def verdict_of(estimate: Estimate, catalogs: ChildCatalogs) -> Verdict:
    """Return whether nearly every field has the stars that it needs, and what to do if not."""
    fields, spec = estimate.figures.fields, estimate.spec
    blind, stars = 1.0 - fields.enough_share, fields.stars
    if blind > BLIND_SHARE:
        words = f"{_percent(blind)} of the sky is blind: a frame there has fewer than 4 guide stars"
        advice, test = await _advice(spec, catalogs), spec.self_test
        hits = round(fields.enough_share * test.frames)
        if wilson_interval(hits, test.frames)[1] >= test.min_identified:
            return Verdict("bad", f"{words}. {advice}")
        needed = _percent(test.min_identified)
        words += f", and the self-test of a build has to identify {needed} of all pointings"
        return Verdict("bad", f"{words}. {advice}", will_fail=True)
    if stars.one_percent < ENOUGH_STARS - 2:
        words = (
            f"Thin: 1 % of the fields have {stars.one_percent} guide stars or fewer, and a frame "
            "that misses some of them has no answer"
        )
        return Verdict("warn", f"{words}. {await _advice(spec, catalogs)}")
    words = f"Good: 99 % of the fields have {stars.one_percent} guide stars or more"
    if stars.median > MANY_FIELDS * STARS_A_FIELD:
        limit, _ = await catalogs.enough_limit(spec)
        words += (
            f". The median field has {count_text(stars.median)}, more than are needed: "
            f"{_band(spec)} {limit:.1f}, or a limit of stars per field, would do"
        )
    return Verdict("good", f"{words}.")


async def _advice(spec: BuildSpec, catalogs: ChildCatalogs) -> str:
    limit, deepest = await catalogs.enough_limit(spec)
    spec_limit = spec.selection.faint_limit_mag
    if limit > spec_limit + 0.04:
        ends = limit >= deepest - 0.1
        more = f", where the catalog ends, or take {_OTHERS}" if ends else ""
        return f"Set the faint limit to {_band(spec)} {limit:.1f}{more}."
    if spec_limit >= deepest - 0.1:
        return f"The catalog ends at {_band(spec)} {deepest:.1f}: take {_OTHERS}."
    return (
        f"{_band(spec)} {spec_limit:g} is faint enough: the other rules remove the stars. See "
        "below which of them does, or let limits be suggested."
    )


_OTHERS = "a deeper catalog or a wider field"


def _band(spec: BuildSpec) -> str:
    return spec.camera.response.name or spec.catalog.band or "magnitude"


def _percent(share: float) -> str:
    percent = 100.0 * share
    return f"{percent:.0f} %" if percent >= 9.95 else f"{percent:.2g} %"


@lru_cache(maxsize=4)
def tiling_of(count: int) -> tuple[Array, Array]:
    """Return right ascension and declination of the boresights of a tiling."""
    return radec_from_directions(saff_kuijlaars(count))


def _bars(counts: Counts) -> list[Bar]:
    least, most = int(counts.min()), int(counts.max())
    step = -(-(most - least + 1) // MAX_BARS)
    fields = np.bincount((counts - least) // step)
    bars = []
    for low, count in zip(range(least, most + 1, step), fields.tolist(), strict=True):
        colour = next(
            colour_bin.name for colour_bin in reversed(FIXED_BINS) if colour_bin.least <= low
        )
        bars.append(Bar(low, low + step - 1, count, colour))
    return bars


@lru_cache(maxsize=4)
def _nearest(count: int) -> Raster:
    return nearest_raster(saff_kuijlaars(count), MAP_WIDTH)


def _picture(boresights: Directions, counts: Counts, spec: BuildSpec) -> str:
    part = spec.selection.region.footprint
    of_sphere = part is None
    nearest = _nearest(len(counts)) if of_sphere else nearest_raster(boresights, MAP_WIDTH, part)
    raster = raster_png(nearest, counts, FIXED_BINS)
    return f"data:image/png;base64,{base64.b64encode(raster).decode()}"
