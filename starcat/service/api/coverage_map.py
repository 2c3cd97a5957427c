"""Guide stars by field, as numbers and as a map whose fields say what they have.

The map is Mollweide's, drawn as SVG: plain elements with titles, no script and no style sheet, so
that it works wherever it is shown. Of a fine tiling neighbouring fields share a dot, which tells of
the one with the fewest stars.
"""

from __future__ import annotations

from functools import lru_cache
from html import escape

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field
from scipy.spatial import cKDTree

from starcat.geometry.sphere import radec_from_directions, saff_kuijlaars
from starcat.pipeline.estimate import Estimate
from starcat.pipeline.guide_stars import MIN_GUIDE_STARS
from starcat.report.sky_map import HALF_HEIGHT, HALF_WIDTH, project

Counts = NDArray[np.int64]

MOST_DOTS = 2500
"""Dots of a map; each takes some 75 bytes."""

MOST_FIELDS = 50_000
"""Fields that are listed one by one at the most."""

SCALE = 125.0
WIDTH, HEIGHT = round(2 * SCALE * HALF_WIDTH) + 16, round(2 * SCALE * HALF_HEIGHT) + 44

COLOURS = ("#26284f", "#2a5a93", "#2a91a1", "#46ab99", "#74c38a", "#acd87a", "#e8e673")
TOO_FEW = "#a3263a"


class CoverageMap(BaseModel):
    """Guide stars by field: lists of the same length, in the order of the tiling."""

    ra_deg: list[float] = Field(description="Right ascension of the boresight, degrees.")
    dec_deg: list[float] = Field(description="Declination, degrees.")
    stars: list[int] = Field(description="Guide stars in the field.")
    fields: int = Field(description="Fields of the tiling.")
    step: int = Field(description="1, or every how manyth field is listed of a tiling of many.")


def coverage_answer(found: Estimate) -> CoverageMap:
    """Return the guide stars of each field, or of some of very many."""
    count = found.fields.count
    step = -(-len(count) // MOST_FIELDS)
    ra_deg, dec_deg = radec_from_directions(found.fields.boresights[::step])
    return CoverageMap(
        ra_deg=np.round(ra_deg, 4).tolist(),
        dec_deg=np.round(dec_deg, 4).tolist(),
        stars=count[::step].tolist(),
        fields=len(count),
        step=step,
    )


def coverage_svg(found: Estimate) -> str:
    """Return the map of an estimate."""
    count = found.fields.count
    dots = min(len(count), MOST_DOTS)
    group = _groups(len(count), dots)
    # The first of a group after sorting by group, then by stars, is the poorest field of it.
    order = np.lexsort((count, group))
    _, first, size = np.unique(group[order], return_index=True, return_counts=True)
    shown = order[first]
    ra_deg, dec_deg = radec_from_directions(found.fields.boresights[shown])
    x, y = project(ra_deg, dec_deg)
    edges = _edges(count)
    colour = np.searchsorted(edges, count[shown], side="right")
    radius = 0.98 * SCALE * HALF_WIDTH * np.sqrt(2.0 / dots)
    parts = _head(found, count)
    places = zip(
        (WIDTH / 2 + SCALE * x).tolist(),
        (8 + SCALE * (HALF_HEIGHT - y)).tolist(),
        ra_deg.tolist(),
        dec_deg.tolist(),
        count[shown].tolist(),
        size.tolist(),
        strict=True,
    )
    drawn: list[list[str]] = [[] for _ in range(len(edges) + 1)]
    for k, (cx, cy, ra, dec, stars, of) in zip(colour.tolist(), places, strict=True):
        more = f", fewest of {of}" if of > 1 else ""
        drawn[k].append(
            f'<circle cx="{cx:.0f}" cy="{cy:.0f}" r="{radius:.1f}">'
            f"<title>RA {ra:.1f} Dec {dec:+.1f}: {stars}{more}</title></circle>"
        )
    # Where dots overlap, poor fields lie on top.
    for fill, circles in reversed(list(zip(_fills(len(drawn)), drawn, strict=True))):
        parts.append(f'<g fill="{fill}">{"".join(circles)}</g>')
    return "".join((*parts, *_legend(edges, int(count.max())), "</svg>\n"))


def _edges(count: Counts) -> Counts:
    """Return where the colours change: the first where a frame has enough stars."""
    most = int(np.quantile(count, 0.995, method="inverted_cdf"))
    least = max(MIN_GUIDE_STARS, int(count.min()))
    inner = np.linspace(least, max(most, least) + 1, len(COLOURS) + 1)[1:-1]
    return np.unique(np.concatenate([[MIN_GUIDE_STARS], np.ceil(inner).astype(np.int64)]))


def _fills(count: int) -> list[str]:
    picked = np.linspace(0, len(COLOURS) - 1, max(1, count - 1)).round().astype(int)
    return [TOO_FEW, *(COLOURS[k] for k in picked.tolist())]


def _head(found: Estimate, count: Counts) -> list[str]:
    stars = found.coverage.stars
    name = escape(f"{found.spec.name}-{found.spec.version}")
    told = (
        f"{found.cost.stars:,} guide stars; {len(count):,} fields have {stars.minimum} to "
        f"{stars.maximum}, {stars.median} in the middle. Mollweide's projection, ICRS; right "
        "ascension 0 is in the middle and grows to the left."
    )
    return [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" '
        f'aria-label="{name}: {told}" font-family="sans-serif" font-size="12">',
        f"<title>{name}: guide stars by field</title><desc>{told}</desc>",
        f'<ellipse cx="{WIDTH / 2:.0f}" cy="{8 + SCALE * HALF_HEIGHT:.0f}" '
        f'rx="{SCALE * HALF_WIDTH:.0f}" ry="{SCALE * HALF_HEIGHT:.0f}" fill="#8883"/>',
    ]


def _legend(edges: Counts, most: int) -> list[str]:
    lows = [0, *edges.tolist()]
    highs = [*(edge - 1 for edge in edges.tolist()), most]
    step, y = (WIDTH - 16) / len(lows), HEIGHT - 26
    parts = ['<g fill="currentColor">']
    for k, (low, high, fill) in enumerate(zip(lows, highs, _fills(len(lows)), strict=True)):
        text = f"{low} or more" if k + 1 == len(lows) else f"{low}–{high}"
        parts.append(
            f'<rect x="{8 + k * step:.0f}" y="{y}" width="{step - 4:.0f}" height="8" '
            f'fill="{fill}"/><text x="{8 + k * step:.0f}" y="{y + 21}">{text}</text>'
        )
    return [*parts, "</g>"]


@lru_cache(maxsize=8)
def _groups(fields: int, dots: int) -> Counts:
    """Return the dot that each field of a tiling belongs to."""
    if fields == dots:
        return np.arange(fields)
    _, nearest = cKDTree(saff_kuijlaars(dots)).query(saff_kuijlaars(fields))
    return np.asarray(nearest, dtype=np.int64)
