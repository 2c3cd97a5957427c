"""Plots of a report, as PNG and SVG: the same bytes whatever the machine is set to.

Every function takes numbers and returns a drawing; nothing here computes coverage. A drawing
uses matplotlib's own defaults and font, never the user's settings.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from starcat.arrays import Array, Directions
from starcat.database.products.coverage import Coverage, CoverageSummary
from starcat.database.products.evenness import Evenness
from starcat.geometry.sphere import radec_from_directions
from starcat.pipeline.report.coverage_map import (
    HALF_HEIGHT,
    HALF_WIDTH,
    MERIDIANS_DEG,
    Raster,
    galactic_equator,
    parallels,
    project_sky,
)
from starcat.storage.figures import figure_bytes, own_style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colorbar import Colorbar
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

STYLE: dict[Any, Any] = {
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "path.simplify": True,
}
_DPI = 100
_BLUE, _GREY, _RED = "#2c6e9e", "#b9c4cc", "#d1495b"
_DARK = """
@media (prefers-color-scheme: dark) {
  svg { fill: #dbe3e9; }
  path[style*="fill: #ffffff"] { fill: #14181b !important; }
  [style*="fill: #555"] { fill: #a3b0ba !important; }
  [style*="fill: #2c6e9e"] { fill: #4f9fd6 !important; }
  [style*="fill: #b9c4cc"] { fill: #5b6770 !important; }
  [style*="stroke: #2c6e9e"] { stroke: #4f9fd6 !important; }
  [style*="stroke: #000000"], [style*="stroke: #333333"] { stroke: #a3b0ba !important; }
  [style*="stroke: #e3e7ea"] { stroke: #2f383f !important; }
}
"""
"""Colours of a drawing if the reader's system is dark; the file is the same for all."""
MAG_BIN = 0.5
"""Width of a bin of magnitudes."""
MAP_PIXELS = 720
"""Width of the rasters in maps."""
_COLOURS = 24


def draw_map(title: str, coverage: Coverage, summary: CoverageSummary, nearest: Raster) -> Figure:
    """Draw the number of stars in each field over the whole sky.

    ``nearest`` is the `nearest_raster` of the boresights.
    """
    from matplotlib import colormaps

    raster = np.where(nearest >= 0, coverage.stars[nearest], np.nan)
    least = summary.stars.minimum
    most = max(int(np.quantile(coverage.stars, 0.995, method="inverted_cdf")), least + 1)
    colours = colormaps["viridis"].resampled(min(most - least + 1, _COLOURS))
    with own_style(STYLE):
        figure, image = _sky(
            (f"{title}: guide stars in the field", _map_legend(summary)),
            (raster, colours, least - 0.5, most + 0.5),
            (summary.worst_ra_deg, summary.worst_dec_deg),
        )
        bar = _bar(figure, image, summary.stars.maximum > most)
        bar.ax.xaxis.set_major_locator(_whole_ticks())
        bar.set_label("guide stars in the field of the nearest boresight")
    return figure


def draw_error_map(
    title: str, boresights: Directions, evenness: Evenness, nearest: Raster
) -> Figure:
    """Draw the error across the boresight that the stars of each field allow over the whole sky.

    ``nearest`` is the `nearest_raster` of the boresights.
    """
    from matplotlib import colormaps

    errors, spread = evenness.across, evenness.spreads["across"]
    finite = errors[np.isfinite(errors)]
    least, most = np.quantile(finite, [0.0, 0.995]) if len(finite) else (0.0, 1.0)
    most = max(most, 1.001 * least)
    # Few colours, and yellow where the error is small; red has no attitude.
    colours = colormaps["viridis_r"].resampled(_COLOURS).with_extremes(bad=_RED)
    raster = np.where((nearest >= 0) & np.isfinite(errors[nearest]), errors[nearest], np.nan)
    ra_deg, dec_deg = radec_from_directions(boresights[int(np.argmax(errors))])
    worst = f"{spread.worst:.1f} arcsec" if np.isfinite(spread.worst) else "no attitude (red)"
    legend = (
        f"{len(errors):,} fields. Ring: the worst, {worst}, at RA {ra_deg:.1f}°, Dec "
        f"{dec_deg:+.1f}°. Dashed: galactic equator."
    )
    with own_style(STYLE):
        figure, image = _sky(
            (f"{title}: attitude error that the stars of the field allow", legend),
            (raster, colours, float(least), float(most)),
            (float(ra_deg), float(dec_deg)),
        )
        bar = _bar(figure, image, bool(len(finite)) and float(finite.max()) > most)
        bar.set_label("error across the boresight, arcsec for 1 px of centroid noise")
    return figure


def _sky(
    words: tuple[str, str],
    drawn: tuple[Array, Colormap, float, float],
    ring_deg: tuple[float, float],
) -> tuple[Figure, AxesImage]:
    """Draw title and legend, a raster with its colours and their ends, and a ring somewhere."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Ellipse

    figure = Figure(figsize=(8.4, 5.2))
    headline(figure, *words)
    axes = figure.add_axes((0.05, 0.17, 0.92, 0.7))
    edge = Ellipse((0, 0), 2 * HALF_WIDTH, 2 * HALF_HEIGHT, fill=False, color="#333", lw=1)
    axes.add_patch(edge)
    extent = (-HALF_WIDTH, HALF_WIDTH, -HALF_HEIGHT, HALF_HEIGHT)
    raster, colours, least, most = drawn
    image = axes.imshow(
        raster, colours, vmin=least, vmax=most, extent=extent, interpolation="nearest"
    )
    image.set_clip_path(edge)
    _graticule(axes)
    axes.plot(*_cut(*project_sky(*galactic_equator())), color="white", lw=1.0, ls=(0, (4, 3)))
    x, y = project_sky(*ring_deg)
    for colour, width in (("white", 4.2), (_RED, 2.2)):
        axes.plot(x, y, "o", ms=11, mfc="none", mec=colour, mew=width)
    axes.set(xlim=(-3.02, 2.88), ylim=(-1.46, 1.46), aspect="equal")
    axes.set_axis_off()
    return figure, image


def _bar(figure: Figure, image: AxesImage, is_cut: bool) -> Colorbar:
    bar_axes = figure.add_axes((0.27, 0.1, 0.48, 0.025))
    extend = "max" if is_cut else "neither"
    return figure.colorbar(image, cax=bar_axes, orientation="horizontal", extend=extend)


def _map_legend(summary: CoverageSummary) -> str:
    position = f"RA {summary.worst_ra_deg:.1f}°, Dec {summary.worst_dec_deg:+.1f}°"
    return (
        f"{summary.fields:,} fields. Ring: the fewest stars, {summary.stars.minimum}, at "
        f"{position}. Dashed: galactic equator."
    )


def headline(figure: Figure, title: str, below: str) -> None:
    """Write title and legend at fixed positions: nothing has to be measured."""
    height = figure.get_figheight()
    figure.text(0.03, 1.0 - 0.3 / height, title, fontsize=11)
    figure.text(0.03, 1.0 - 0.52 / height, below, color="#555")


def _graticule(axes: Axes) -> None:
    line: dict[str, Any] = {"color": "white", "lw": 0.5, "alpha": 0.55}
    dec = np.linspace(-90.0, 90.0, 91)
    for ra in MERIDIANS_DEG:
        x, y = project_sky(np.full(91, ra), dec)
        axes.plot(x, y, **line)
        # The label is on the side of the meridian that the galactic equator does not cross.
        axes.text(float(x[45]) - 0.03, 0.03, f"{ra}°", color="white", ha="right", size=8)
    for end, height, label in parallels():
        axes.plot([-end, end], [height, height], **line)
        axes.text(-1.03 * end - 0.02, 1.03 * height, label, ha="right", va="center", size=8)


def _cut(x: Array, y: Array) -> tuple[Array, Array]:
    """Break a line where it leaves the map at one side and comes back at the other."""
    jumps = np.flatnonzero(np.abs(np.diff(x)) > 0.5 * HALF_WIDTH) + 1
    return np.insert(x, jumps, np.nan), np.insert(y, jumps, np.nan)


def _chart(title: str, below: str) -> tuple[Figure, Axes]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.2, 4.0))
    headline(figure, title, below)
    axes = figure.add_axes((0.12, 0.13, 0.85, 0.69))
    axes.grid(axis="y", color="#e3e7ea")
    return figure, axes


def draw_histogram(title: str, summary: CoverageSummary) -> Figure:
    """Draw how many fields hold how many stars."""
    width = -(-len(summary.histogram) // 100)
    padded = np.append(summary.histogram, np.zeros(-len(summary.histogram) % width, dtype=int))
    fields = padded.reshape(-1, width).sum(axis=1)
    marks = {
        "fewest": summary.stars.minimum,
        "1 %": summary.stars.one_percent,
        "median": summary.stars.median,
    }
    with own_style(STYLE):
        figure, axes = _chart(f"{title}: guide stars per field", f"{summary.fields:,} fields")
        edges = np.arange(len(fields)) * width - 0.5
        axes.bar(edges, fields, width * 0.92, align="edge", color=_BLUE)
        top = float(fields.max())
        # Each mark ends at its own label, below the label of the previous mark.
        for step, (name, value) in enumerate(marks.items()):
            height = top * (1.22 - 0.08 * step)
            axes.vlines(value, 0.0, height, color=_RED, lw=1.2)
            axes.text(value, height, f" {name}: {value}", color=_RED, va="top")
        axes.set_ylim(0.0, 1.25 * top)
        several = f" ({width} a bar)" if width > 1 else ""
        axes.set(xlabel=f"guide stars in the field{several}", ylabel="fields of the tiling")
        axes.xaxis.set_major_locator(_whole_ticks())
        axes.yaxis.set_major_locator(_whole_ticks())
    return figure


def draw_magnitudes(title: str, band: str, counts: Mapping[str, Any]) -> Figure:
    """Draw how many stars of each magnitude were read and how many were kept."""
    from_mag, to_mag = np.asarray(counts["from_mag"]), np.asarray(counts["to_mag"])
    kept = np.asarray(counts["guide_stars"])
    read = kept + np.asarray(counts["rejected"])
    with own_style(STYLE):
        below = f"{kept.sum():,} guide stars of {read.sum():,} records with a magnitude"
        figure, axes = _chart(f"{title}: guide stars by magnitude", below)
        width = to_mag - from_mag
        axes.bar(from_mag, read, width, align="edge", color=_GREY, label="records read")
        axes.bar(from_mag, kept, 0.86 * width, align="edge", color=_BLUE, label="guide stars")
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter("{x:,.0f}")
        axes.minorticks_off()
        axes.set_ylim(0.7, 2.0 * max(10, int(read.max(initial=1))))
        axes.set(xlabel=f"magnitude ({band})", ylabel=f"stars per {MAG_BIN:g} mag")
        axes.legend(loc="upper left", frameon=False)
    return figure


def _whole_ticks() -> Any:
    from matplotlib.ticker import MaxNLocator

    return MaxNLocator(nbins=9, steps=[1, 2, 5, 10], integer=True)


def save_plot(figure: Figure, folder: Path, name: str) -> None:
    """Write a drawing as PNG, and as SVG that is dark if the reader's system is dark."""
    with own_style(STYLE):
        pixels = figure_bytes(figure, ".png", _DPI)
        drawn = figure_bytes(figure, ".svg").decode()
    (folder / f"{name}.png").write_bytes(pixels)
    text = drawn.replace("</style>", f"{_DARK}</style>", 1)
    (folder / f"{name}.svg").write_text(text, encoding="utf-8")
