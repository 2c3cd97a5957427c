"""Curves of an evaluation: rate against noise, with intervals and the papers' values."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

from starcat.pipeline.report import STYLE, headline
from starcat.storage import own_style, write_figure
from starcat_lab.report.tables import Line, groups_of, method_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("#2c6e9e", "#d1495b", "#3f8f5b", "#8a5fa8", "#c98a1b", "#4fb0ae", "#7a5230", "#5b6770")
"""Colours of the curves, in the order of `series_order`."""

MARKERS = "osD^vP*X"


def curves(content: Mapping[str, Any]) -> Iterator[tuple[str, str, list[Line]]]:
    """Yield the groups of rows that are curves."""
    for number, (group, lines) in enumerate(groups_of(content["rows"]).items(), start=1):
        points = [line for line in lines if line["x"] is not None]
        if len({line["x"] for line in points}) > 1:
            words = re.sub(r"[^a-z0-9]+", "_", group.lower()).strip("_")
            yield f"{content['name']}_{number:02d}_{words}", group, points


def series_of(line: Line) -> str:
    """Return the curve to which a row belongs."""
    return str(line["label"]).rpartition(", ")[0] or method_of(line)


def series_order(content: Mapping[str, Any]) -> list[str]:
    """Return all curves of an evaluation: each keeps its colour in all plots."""
    return list(dict.fromkeys(series_of(x) for _, _, lines in curves(content) for x in lines))


def draw_rates(title: str, lines: Sequence[Line], series: Sequence[str]) -> Figure:
    """Draw rates against an abscissa."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    frames = sorted({line["frames"] for line in lines})
    several = f"{frames[0]:,}" + (f" to {frames[-1]:,}" if len(frames) > 1 else "")
    places = _places({line["x"] for line in lines})
    with own_style(STYLE):
        figure = Figure(figsize=(7.2, 4.0))
        below = f"{several} frames a point; bars: 95 % interval (Wilson)"
        headline(figure, title[:1].upper() + title[1:], below)
        axes = figure.add_axes((0.105, 0.13, 0.595, 0.69))
        axes.grid(axis="y", color="#e3e7ea")
        handles = _draw_curves(axes, lines, series, places)
        handles += _draw_ceiling(axes, lines, places)
        is_even = all(position == x for x, position in places.items())
        if not is_even:
            axes.set_xticks(list(places.values()), [f"{x:g}" for x in places])
        label = (lines[0]["axis"] or title) + ("" if is_even else " (not to scale)")
        axes.set(xlabel=label, ylabel="identified, percent", ylim=_limits(lines))
        axes.yaxis.set_major_locator(MaxNLocator(nbins=7, steps=[1, 2, 5, 10]))
        corner: dict[str, Any] = {"loc": "upper left", "bbox_to_anchor": (1.02, 1.02)}
        axes.legend(handles=handles, frameon=False, handlelength=1.6, **corner)
    return figure


def _places(x: Iterable[float]) -> dict[float, float]:
    """Return positions of abscissae: evenly spaced if some lie ten times closer than others."""
    values = sorted(x)
    gaps = [upper - lower for lower, upper in pairwise(values)]
    is_crowded = max(gaps) > 10.0 * min(gaps)
    return {value: float(k) if is_crowded else value for k, value in enumerate(values)}


def _draw_curves(
    axes: Axes, lines: Sequence[Line], series: Sequence[str], places: Mapping[float, float]
) -> list[Any]:
    shown = list(dict.fromkeys(series_of(line) for line in lines))
    width = max(places.values()) - min(places.values())
    handles = []
    for number, name in enumerate(shown):
        points = [line for line in lines if series_of(line) == name]
        # The bars are side by side, so that none hides another.
        aside = 0.007 * width * (number - 0.5 * (len(shown) - 1))
        moved = {x: position + aside for x, position in places.items()}
        handles += _draw_curve(axes, points, series.index(name), moved)
    return handles


def _draw_ceiling(axes: Axes, lines: Sequence[Line], places: Mapping[float, float]) -> list[Any]:
    """Draw the ceiling: the mean of all rows of a place, which may differ by their frames."""
    shares: dict[float, list[float]] = {}
    for line in lines:
        shares.setdefault(line["x"], []).append(line["ceiling"]["percent"])
    y = [sum(shares[x]) / len(shares[x]) for x in places]
    style: dict[str, Any] = {"color": "#8a959d", "lw": 1.1, "ls": (0, (4, 3)), "zorder": 1.5}
    return axes.plot(list(places.values()), y, label="4 guide stars or more", **style)


def _draw_curve(
    axes: Axes, lines: Sequence[Line], number: int, places: Mapping[float, float]
) -> list[Any]:
    """Draw a curve and the paper's points; return what the legend shows."""
    colour, marker = COLOURS[number % len(COLOURS)], MARKERS[number % len(MARKERS)]
    name = series_of(lines[0])
    points = sorted(lines, key=lambda line: float(line["x"]))
    x = [places[line["x"]] for line in points]
    y = [line["by_rule"]["percent"] for line in points]
    down = [line["by_rule"]["percent"] - line["by_rule"]["low_percent"] for line in points]
    up = [line["by_rule"]["high_percent"] - line["by_rule"]["percent"] for line in points]
    curve = axes.errorbar(
        x, y, yerr=(down, up), color=colour, marker=marker, ms=4.5, lw=1.5, elinewidth=1.1,
        capsize=2.5, label=fill(name, 24),
    )  # fmt: skip
    printed = [
        (at, line["published_percent"])
        for at, line in zip(x, points, strict=True)
        if line["published_percent"] is not None
    ]
    if not printed:
        return [curve]
    points_drawn = axes.plot(
        *zip(*printed, strict=True), ls=(0, (1, 2)), lw=1.0, color=colour, marker=marker,
        ms=8.5, mfc="none", mew=1.2, label=fill(f"{name}: paper", 24),
    )  # fmt: skip
    return [curve, *points_drawn]


def _limits(lines: Sequence[Line]) -> tuple[float, float]:
    """Return a range that holds all points, up to a little over 100."""
    printed = [line["published_percent"] for line in lines if line["published_percent"] is not None]
    lowest = min(*(line["by_rule"]["low_percent"] for line in lines), 100.0, *printed)
    low = max(0.0, lowest - 0.08 * (100.0 - lowest))
    return low, 100.0 + 0.03 * (100.0 - low)


def save_small_svg(figure: Figure, path: Path) -> None:
    """Write a drawing as an SVG file whose letters are text: a sixth of the bytes."""
    with own_style({**STYLE, "svg.fonttype": "none"}):
        write_figure(figure, path)
