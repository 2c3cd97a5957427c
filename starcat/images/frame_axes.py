"""The marks of a picture: the sky, rings and diamonds around spots, names, and a compass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes


# Colours of the sky, of what is identified and of what is not.
SKY, STAR, LOST = "#0b1220", "#5ad1e6", "#ffb454"
# Colours of names, and the radius of a mark above which the first one is taken.
_BRIGHT, _FAINT, _LARGE_PT = "#f4fbfd", "#a9bcc7", 7.0
LABEL_PT = 8.0
LETTER_PT = 0.62 * LABEL_PT  # size of names, and about the width of a letter
_MAX_LABELS = 60
_LABEL_GAP_PT = 4.0
_COMPASS_PT = 76.0
# Layers of a spot: their sizes and opacities.
_GLOW = ((3.2, 0.06), (2.2, 0.10), (1.5, 0.18), (1.0, 1.0))


_LONG_SIDE_PX = 900
# Right, left, the four diagonals, above, below: the order of preference.
_DIRECTIONS = ((1, 0), (-1, 0), (1, -1), (1, 1), (-1, -1), (-1, 1), (0, -1), (0, 1))


@dataclass(frozen=True)
class FrameAxes:
    """The axes of a picture, in pixels of the camera with y down, and the marks on them."""

    axes: Axes
    scale: float  # points of the drawing per pixel
    size: tuple[int, int]  # width and height of the camera, pixels
    centroids: Array  # middles of the marks, (N, 2), pixels
    names: Sequence[str | None]  # None where it is not known what a mark is
    radii: Array  # of the marks, points

    @property
    def points(self) -> Array:
        """Middles of the marks from the top left corner, points."""
        return np.asarray(self.centroids * self.scale)

    @property
    def size_pt(self) -> tuple[float, float]:
        """Width and height of the sky, points."""
        return self.size[0] * self.scale, self.size[1] * self.scale


def mark_radii(count: int, mag: Array | None) -> Array:
    """Return the sizes of marks."""
    if mag is None or not np.isfinite(mag).any():
        return np.full(count, 6.0)
    brightest, faintest = np.nanmin(mag), np.nanmax(mag)
    part = (faintest - mag) / max(faintest - brightest, 1e-9)
    return np.asarray(5.0 + 5.0 * np.nan_to_num(part))


def draw_sky(frame: FrameAxes, image: NDArray[Any] | None) -> None:
    """Draw the sky."""
    from matplotlib.colors import LinearSegmentedColormap

    width, height = frame.size
    if image is None:
        x, y = frame.centroids.T
        width_pt = np.sqrt(4.0 + 50.0 * (0.2 * frame.radii - 1.0) ** 1.5)
        for size, opacity in _GLOW:
            area = (size * width_pt) ** 2
            frame.axes.scatter(x, y, area, color="white", alpha=opacity, lw=0)
        return
    colours = LinearSegmentedColormap.from_list("sky", [SKY, "#8b97ad", "#ffffff"])
    extent = (0.0, float(width), float(height), 0.0)
    frame.axes.imshow(stretch(image), colours, vmin=0.0, vmax=1.0, extent=extent, aspect="auto")


def draw_marks(frame: FrameAxes) -> None:
    """Draw a ring around what is identified, and a diamond around what is not."""
    is_star = np.array([name is not None for name in frame.names], dtype=bool)
    for chosen, marker, colour in ((is_star, "o", STAR), (~is_star, "D", LOST)):
        x, y = frame.centroids[chosen].T
        area = (2.0 * frame.radii[chosen]) ** 2 * (1.0 if marker == "o" else 0.5)
        frame.axes.scatter(x, y, area, marker=marker, facecolor="none", edgecolor=colour, lw=1.1)


def draw_compass(frame: FrameAxes, compass: tuple[Array, Array] | None) -> Array:
    """Draw north and east in the corner with the fewest spots."""
    if compass is None:
        return np.empty((0, 4))
    width, height = frame.size_pt
    corners = [
        (x, y) for y in (height - _COMPASS_PT, 0.0) for x in (0.0, width - _COMPASS_PT)
    ]  # fmt: skip
    inside = [
        int(((frame.points >= corner) & (frame.points <= np.add(corner, _COMPASS_PT))).all(1).sum())
        for corner in corners
    ]
    corner = np.array(corners[int(np.argmin(inside))])
    middle = (corner + 0.5 * _COMPASS_PT) / frame.scale
    for name, direction in zip("NE", compass, strict=True):
        unit = np.asarray(direction, dtype=np.float64) / np.hypot(*direction) / frame.scale
        arrow = {"arrowstyle": "-|>", "color": "white", "lw": 1.2, "shrinkA": 0, "shrinkB": 0}
        tip, (x, y) = middle + 23.0 * unit, middle + 30.0 * unit
        frame.axes.annotate("", (tip[0], tip[1]), (middle[0], middle[1]), arrowprops=arrow)
        frame.axes.text(x, y, name, color="white", ha="center", va="center", weight="bold")
    return np.concatenate([corner, corner + _COMPASS_PT])[None]


def draw_names(frame: FrameAxes, taken: Array) -> int:
    """Write the names that find room, those of the largest marks first."""
    from matplotlib.patheffects import withStroke

    widths = [LETTER_PT * len(name or "") + _LABEL_GAP_PT for name in frame.names]
    sizes = np.array([[width, 1.25 * LABEL_PT] for width in widths])
    order = np.argsort(-frame.radii, kind="stable")
    wanted = [int(spot) for spot in order if frame.names[spot]]
    places = place_labels(
        frame.points, frame.radii, sizes, wanted[:_MAX_LABELS], frame.size_pt, taken
    )
    halo = [withStroke(linewidth=2.0, foreground=SKY)]
    for spot, corner in places.items():
        x, y = (np.array(corner) + 0.5 * sizes[spot]) / frame.scale
        colour = _BRIGHT if frame.radii[spot] > _LARGE_PT else _FAINT
        frame.axes.text(
            x, y, str(frame.names[spot]), color=colour, size=LABEL_PT, ha="center",
            va="center", path_effects=halo, parse_math=False,
        )  # fmt: skip
    return len(wanted) - len(places)


def place_labels(
    centres: Array,
    radii: Array,
    sizes: Array,
    wanted: Sequence[int],
    frame: tuple[float, float],
    taken: Array,
) -> dict[int, tuple[float, float]]:
    """Place labels beside round marks, one after the other, each where it covers nothing.

    Examples
    --------
    >>> import numpy as np
    >>> two = np.array([[10.0, 50.0], [95.0, 50.0]])
    >>> place_labels(two, np.full(2, 3.0), np.full((2, 2), 8.0), [0, 1], (100.0, 100.0),
    ...              np.empty((0, 4)))
    {0: (15.0, 46.0), 1: (82.0, 46.0)}
    """
    marks = np.concatenate([centres - radii[:, None], centres + radii[:, None]], axis=1)
    blocked = np.concatenate([marks, taken])
    placed = {}
    for mark in wanted:
        others = np.delete(blocked, mark, axis=0)
        for direction in _DIRECTIONS:
            box = _box(centres[mark], float(radii[mark]), sizes[mark], direction)
            is_inside = min(box[0], box[1], frame[0] - box[2], frame[1] - box[3]) >= 0.0
            if is_inside and not _overlaps(box, others):
                placed[mark] = (float(box[0]), float(box[1]))
                blocked = np.concatenate([blocked, box[None]])
                break
    return placed


def _box(centre: Array, radius: float, size: Array, direction: tuple[int, int]) -> Array:
    """Return the label's box on one side of its mark."""
    step = np.array(direction, dtype=np.float64)
    gap = radius + 2.0 if 0 in direction else 0.8 * radius
    middle = centre + step * (gap + 0.5 * size)
    return np.concatenate([middle - 0.5 * size, middle + 0.5 * size])


def _overlaps(box: Array, others: Array) -> bool:
    apart = (others[:, :2] >= box[2:]).any(axis=1) | (others[:, 2:] <= box[:2]).any(axis=1)
    return not apart.all()


def stretch(image: NDArray[Any]) -> Array:
    """Return an image as it is shown."""
    values = _brightest(image)
    finite = values[np.isfinite(values)]
    if not finite.size:
        return np.zeros(values.shape)
    middle = float(np.median(finite))
    noise = 1.4826 * float(np.median(np.abs(finite - middle)))
    # An image without noise still has a black point and a white one.
    noise = max(noise, 1e-6 * float(np.abs(finite).max()), 1e-300)
    top = max(float(np.quantile(finite, 0.9998)), middle + 50.0 * noise)
    low, unit = middle - 0.5 * noise, 8.0 * noise
    shown = np.arcsinh((np.nan_to_num(values, nan=low) - low) / unit)
    return np.asarray(np.clip(shown / np.arcsinh((top - low) / unit), 0.0, 1.0))


def _brightest(image: NDArray[Any]) -> Array:
    """Return the brightest of each block of pixels, blocks of one pixel if the image is small.

    Values that are not finite do not count; a block without others is NaN. The blocks are made row
    by row: all of a large image as float64 is more than a request has room for.
    """
    height, width = image.shape
    step = max(max(height, width) // _LONG_SIDE_PX, 1)
    tops, lefts = range(0, height, step), np.arange(0, width, step)
    brightest = np.empty((len(tops), len(lefts)))
    for row, top in enumerate(tops):
        values = image[top : top + step].astype(np.float64)
        values[~np.isfinite(values)] = np.nan
        brightest[row] = np.fmax.reduceat(np.fmax.reduce(values, axis=0), lefts)
    return brightest
