"""What a spec would give, as the page shows it: sizes, a histogram, and the map of the sky."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from starcat.arrays import Array
from starcat.geometry.sphere import radec_from_directions, saff_kuijlaars
from starcat.pipeline.estimate import Estimate
from starcat.report.coverage_map import (
    Bin,
    Counts,
    Fields,
    SkyMap,
    bins_of,
    nearest_raster,
    raster_png,
    sky_map,
)

MAP_WIDTH = 720
"""Columns of the raster of a map: what a card of the page is wide."""

MOST_BARS = 48
MOST_MAPPED = 50_000
"""Of more boresights than these no map is drawn: their fields would be finer than its dots."""

BAR_WIDTH, BAR_HEIGHT = 100.0, 30.0


@dataclass(frozen=True)
class File:
    """A file of a database, or the folder of the report."""

    name: str
    bytes: int
    rows: int | None  # None: it is no product's
    share: float  # its size, over that of the largest


@dataclass(frozen=True)
class Bar:
    """A bar of the histogram of stars in a field, in a box of `BAR_WIDTH` and `BAR_HEIGHT`."""

    least: int  # stars of a field
    most: int
    fields: int
    colour: str  # class of the colour that the map has for them
    x: float
    width: float
    y: float
    height: float


@dataclass(frozen=True)
class Preview:
    """What a spec would give."""

    estimate: Estimate
    files: list[File]  # the largest first
    bars: list[Bar]
    map: SkyMap | None  # None: the tiling is too fine for a map
    picture: str  # the raster, as an address that holds it


def preview_of(estimate: Estimate) -> Preview:
    """Return what the page shows of an estimate."""
    counts = estimate.fields.count.astype(np.int64)
    ra_deg, dec_deg = _tiling(len(counts))
    none = np.zeros_like(counts)
    fields = Fields(ra_deg, dec_deg, counts, none, none)
    bins = bins_of(counts)
    is_mapped = len(counts) <= MOST_MAPPED
    return Preview(
        estimate,
        _files(estimate),
        _bars(counts, bins),
        sky_map(fields) if is_mapped else None,
        _picture(counts) if is_mapped else "",
    )


def tiling_content(count: int) -> dict[str, Any]:
    """Return where the fields of a tiling are."""
    ra_deg, dec_deg = _tiling(count)
    return {"ra_deg": np.round(ra_deg, 3).tolist(), "dec_deg": np.round(dec_deg, 3).tolist()}


@lru_cache(maxsize=4)
def _tiling(count: int) -> tuple[Array, Array]:
    return radec_from_directions(saff_kuijlaars(count))


def _files(estimate: Estimate) -> list[File]:
    rows = {
        **estimate.cost.rows,
        "stars": estimate.cost.stars,
        "boresights": estimate.cost.fields,
        "rejected": sum(estimate.rejected.values()),
    }
    largest = max(estimate.cost.files.values(), default=1) or 1
    found = [
        File(name, count, rows.get(name.removesuffix(".parquet")), count / largest)
        for name, count in estimate.cost.files.items()
    ]
    return sorted(found, key=lambda file: (-file.bytes, file.name))


def _bars(counts: Counts, bins: tuple[Bin, ...]) -> list[Bar]:
    least, most = int(counts.min()), int(counts.max())
    step = -(-(most - least + 1) // MOST_BARS)
    fields = np.bincount((counts - least) // step)
    width, tallest = BAR_WIDTH / len(fields), int(fields.max())
    bars = []
    for k, count in enumerate(fields.tolist()):
        low = least + k * step
        colour = next((one.name for one in reversed(bins) if one.least <= low), bins[0].name)
        height = BAR_HEIGHT * count / tallest
        bars.append(
            Bar(
                low,
                low + step - 1,
                count,
                colour,
                round(k * width, 3),
                round(0.86 * width, 3),
                round(BAR_HEIGHT - height, 3),
                round(height, 3),
            )
        )
    return bars


@lru_cache(maxsize=4)
def _nearest(count: int) -> Array:
    return nearest_raster(saff_kuijlaars(count), np.arange(count), MAP_WIDTH)


def _picture(counts: Counts) -> str:
    raster = raster_png(_nearest(len(counts)), counts)
    return f"data:image/png;base64,{base64.b64encode(raster).decode()}"
