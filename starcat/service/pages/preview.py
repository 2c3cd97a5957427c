"""What a spec would give, as the page shows it: sizes, a histogram, and the map of the sky."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from starcat.geometry.sphere import radec_from_directions, saff_kuijlaars
from starcat.pipeline.estimate import Estimate
from starcat.report.sky_map import nearest_raster
from starcat.service.pages.sky import Bin, Fields, SkyMap, bins_of, coloured_png, sky_map

Counts = NDArray[np.int64]

MAP_WIDTH = 720
"""Columns of the raster of a map: what a card of the page is wide."""

MOST_BARS = 48
MOST_MAPPED = 50_000
"""Of more boresights than these no map is drawn: their fields would be finer than its dots."""

BAR_WIDTH, BAR_HEIGHT = 100.0, 30.0


@dataclass(frozen=True)
class File:
    """A file of a database.

    Attributes
    ----------
    name : str
        Of the file, or of the folder.
    bytes : int
        Its size.
    rows : int or None
        Records in it, where it is a product's.
    share : float
        Its size, over that of the largest.
    """

    name: str
    bytes: int
    rows: int | None
    share: float


@dataclass(frozen=True)
class Bar:
    """A bar of the histogram of stars in a field.

    Attributes
    ----------
    least, most : int
        Stars of a field.
    fields : int
        How many have so many.
    colour : str
        Class of the colour that the map has for them.
    x, width, y, height : float
        Where it stands, in a box of `BAR_WIDTH` and `BAR_HEIGHT`.
    """

    least: int
    most: int
    fields: int
    colour: str
    x: float
    width: float
    y: float
    height: float


@dataclass(frozen=True)
class Preview:
    """What a spec would give.

    Attributes
    ----------
    estimate : Estimate
        The figures.
    files : list of File
        The largest first.
    bars : list of Bar
        How many fields have how many stars.
    map : SkyMap or None
        What is drawn upon the raster; None where the tiling is too fine for a map.
    picture : str
        The raster, as an address that holds it.
    """

    estimate: Estimate
    files: list[File]
    bars: list[Bar]
    map: SkyMap | None
    picture: str


def preview_of(estimate: Estimate) -> Preview:
    """Return what the page shows of an estimate."""
    counts = estimate.fields.count.astype(np.int64)
    ra_deg, dec_deg = _tiling(len(counts))
    none = np.zeros_like(counts)
    fields = Fields(ra_deg, dec_deg, counts, none, none)
    bins = bins_of(fields)
    is_mapped = len(counts) <= MOST_MAPPED
    return Preview(
        estimate,
        _files(estimate),
        _bars(counts, bins),
        sky_map(fields) if is_mapped else None,
        _picture(counts, bins) if is_mapped else "",
    )


def tiling_content(count: int) -> dict[str, Any]:
    """Return where the fields of a tiling are."""
    ra_deg, dec_deg = _tiling(count)
    return {"ra_deg": np.round(ra_deg, 3).tolist(), "dec_deg": np.round(dec_deg, 3).tolist()}


@lru_cache(maxsize=4)
def _tiling(count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
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
def _nearest(count: int) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Return which dots of the raster are on the sky, and the field nearest to each of those."""
    raster = nearest_raster(saff_kuijlaars(count), np.arange(count), MAP_WIDTH)
    inside = ~np.isnan(raster)
    return inside, raster[inside].astype(np.int64)


def _picture(counts: Counts, bins: tuple[Bin, ...]) -> str:
    inside, nearest = _nearest(len(counts))
    raster = np.full(inside.shape, np.nan)
    raster[inside] = counts[nearest]
    return f"data:image/png;base64,{base64.b64encode(coloured_png(raster, bins)).decode()}"
