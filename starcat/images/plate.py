"""The marks of a picture: the sky, rings and diamonds around spots, names, and a compass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array
from starcat.images.labels import place_labels
from starcat.images.stretch import stretch

if TYPE_CHECKING:
    from matplotlib.axes import Axes


SKY, STAR, LOST = "#0b1220", "#5ad1e6", "#ffb454"
"""Colours of the sky, of what is identified and of what is not."""
_BRIGHT, _FAINT, _LARGE_PT = "#f4fbfd", "#a9bcc7", 7.0
"""Colours of names, and the radius of a mark above which the first one is taken."""
LABEL_PT = 8.0
LETTER_PT = 0.62 * LABEL_PT
"""Size of names, and about the width of a letter."""
_MOST_LABELS = 60
_LABEL_GAP_PT = 4.0
_COMPASS_PT = 76.0
_GLOW = ((3.2, 0.06), (2.2, 0.10), (1.5, 0.18), (1.0, 1.0))
"""Layers of a spot: their sizes and opacities."""


@dataclass(frozen=True)
class Plate:
    """What is being drawn.

    Attributes
    ----------
    axes : matplotlib.axes.Axes
        Axes in pixels of the camera, y down.
    scale : float
        Points of the drawing per pixel.
    size : tuple of int
        Width and height of the camera, pixels.
    centroids : ndarray of float64, shape (N, 2)
        Middles of the marks, pixels.
    names : sequence of str or None, length N
        What each mark is; None where it is not known.
    radii : ndarray of float64, shape (N,)
        Radii of the marks, points.
    """

    axes: Axes
    scale: float
    size: tuple[int, int]
    centroids: Array
    names: Sequence[str | None]
    radii: Array

    @property
    def points(self) -> Array:
        """Middles of the marks from the top left corner, points."""
        return np.asarray(self.centroids * self.scale)

    @property
    def frame(self) -> tuple[float, float]:
        """Width and height of the sky, points."""
        return self.size[0] * self.scale, self.size[1] * self.scale


def mark_radii(count: int, mag: Array | None) -> Array:
    """Return the sizes of marks."""
    if mag is None or not np.isfinite(mag).any():
        return np.full(count, 6.0)
    brightest, faintest = np.nanmin(mag), np.nanmax(mag)
    part = (faintest - mag) / max(faintest - brightest, 1e-9)
    return np.asarray(5.0 + 5.0 * np.nan_to_num(part))


def draw_sky(plate: Plate, image: NDArray[Any] | None) -> None:
    """Draw the sky."""
    from matplotlib.colors import LinearSegmentedColormap

    width, height = plate.size
    if image is None:
        x, y = plate.centroids.T
        width_pt = np.sqrt(4.0 + 50.0 * (0.2 * plate.radii - 1.0) ** 1.5)
        for size, opacity in _GLOW:
            area = (size * width_pt) ** 2
            plate.axes.scatter(x, y, area, color="white", alpha=opacity, lw=0)
        return
    colours = LinearSegmentedColormap.from_list("sky", [SKY, "#8b97ad", "#ffffff"])
    extent = (0.0, float(width), float(height), 0.0)
    plate.axes.imshow(stretch(image), colours, vmin=0.0, vmax=1.0, extent=extent, aspect="auto")


def draw_marks(plate: Plate) -> None:
    """Draw a ring around what is identified, and a diamond around what is not."""
    is_star = np.array([name is not None for name in plate.names], dtype=bool)
    for chosen, marker, colour in ((is_star, "o", STAR), (~is_star, "D", LOST)):
        x, y = plate.centroids[chosen].T
        area = (2.0 * plate.radii[chosen]) ** 2 * (1.0 if marker == "o" else 0.5)
        plate.axes.scatter(x, y, area, marker=marker, facecolor="none", edgecolor=colour, lw=1.1)


def draw_compass(plate: Plate, compass: tuple[Array, Array] | None) -> Array:
    """Draw north and east in the corner with the fewest spots."""
    if compass is None:
        return np.empty((0, 4))
    width, height = plate.frame
    corners = [
        (x, y) for y in (height - _COMPASS_PT, 0.0) for x in (0.0, width - _COMPASS_PT)
    ]  # fmt: skip
    inside = [
        int(((plate.points >= corner) & (plate.points <= np.add(corner, _COMPASS_PT))).all(1).sum())
        for corner in corners
    ]
    corner = np.array(corners[int(np.argmin(inside))])
    middle = (corner + 0.5 * _COMPASS_PT) / plate.scale
    for name, direction in zip("NE", compass, strict=True):
        unit = np.asarray(direction, dtype=np.float64) / np.hypot(*direction) / plate.scale
        arrow = {"arrowstyle": "-|>", "color": "white", "lw": 1.2, "shrinkA": 0, "shrinkB": 0}
        tip, (x, y) = middle + 23.0 * unit, middle + 30.0 * unit
        plate.axes.annotate("", (tip[0], tip[1]), (middle[0], middle[1]), arrowprops=arrow)
        plate.axes.text(x, y, name, color="white", ha="center", va="center", weight="bold")
    return np.concatenate([corner, corner + _COMPASS_PT])[None]


def draw_names(plate: Plate, taken: Array) -> int:
    """Write the names that find room, those of the largest marks first."""
    from matplotlib.patheffects import withStroke

    widths = [LETTER_PT * len(name or "") + _LABEL_GAP_PT for name in plate.names]
    sizes = np.array([[width, 1.25 * LABEL_PT] for width in widths])
    order = np.argsort(-plate.radii, kind="stable")
    wanted = [int(spot) for spot in order if plate.names[spot]]
    places = place_labels(
        plate.points, plate.radii, sizes, wanted[:_MOST_LABELS], plate.frame, taken
    )
    halo = [withStroke(linewidth=2.0, foreground=SKY)]
    for spot, corner in places.items():
        x, y = (np.array(corner) + 0.5 * sizes[spot]) / plate.scale
        colour = _BRIGHT if plate.radii[spot] > _LARGE_PT else _FAINT
        plate.axes.text(
            x, y, str(plate.names[spot]), color=colour, size=LABEL_PT, ha="center",
            va="center", path_effects=halo, parse_math=False,
        )  # fmt: skip
    return len(wanted) - len(places)
