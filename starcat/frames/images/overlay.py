"""Pictures with their stars, centroids and coordinates drawn into them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array, Mask, Matrix, Pixels
from starcat.frames.sky.names import constellation_lines, named_stars
from starcat.geometry.camera import Camera
from starcat.geometry.sphere import directions_from_radec, radec_from_directions, separation

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from starcat.frames.sky.in_time import BodyInFrame

# Colours of the sky, of identified spots, of spots at the place of a star, and of other spots.
SKY, STAR, PLACED, LOST = "#0b1220", "#5ad1e6", "#a5d98a", "#ffb454"
# Colours of names, and the radius of a mark above which the first one is taken.
_BRIGHT, _FAINT, _LARGE_PT = "#f4fbfd", "#a9bcc7", 7.0
LABEL_PT = 8.0
LETTER_PT = 0.62 * LABEL_PT  # size of names, and about the width of a letter
_MAX_LABELS = 60
_LABEL_GAP_PT = 4.0
_COMPASS_PT = 76.0
_SHADES = 32  # of a picture between black and white
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
    names: Sequence[str | None]  # name of each mark; None if it is not identified
    radii: Array  # radii of the marks, points
    # Whether a name is of the star at the place of a mark that is not identified.
    is_placed: Mask | None = None

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


def draw_sky(frame: FrameAxes, image: NDArray[Any] | None, *, is_scaled_later: bool) -> None:
    """Draw the sky; an image that is scaled when it is shown, as in SVG, keeps its pixels."""
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
    # The noise of a picture hides the steps between so few shades, and they halve its file.
    shown = np.round(stretch(image) * _SHADES) / _SHADES
    frame.axes.imshow(
        shown, colours, vmin=0.0, vmax=1.0, extent=extent, aspect="auto",
        interpolation="none" if is_scaled_later else None,
    )  # fmt: skip


def draw_marks(frame: FrameAxes) -> None:
    """Draw a ring around spots with a name, and a diamond around other spots."""
    is_star = np.array([name is not None for name in frame.names], dtype=bool)
    placed = np.zeros(len(is_star), dtype=bool) if frame.is_placed is None else frame.is_placed
    marks = [(is_star & ~placed, "o", STAR), (~is_star, "D", LOST)]
    if placed.any():
        marks.append((placed, "o", PLACED))
    for mask, marker, colour in marks:
        x, y = frame.centroids[mask].T
        area = (2.0 * frame.radii[mask]) ** 2 * (1.0 if marker == "o" else 0.5)
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
    """Write as many names as fit, starting with the largest marks."""
    from matplotlib.patheffects import withStroke

    widths = [LETTER_PT * len(name or "") + _LABEL_GAP_PT for name in frame.names]
    sizes = np.array([[width, 1.25 * LABEL_PT] for width in widths])
    order = np.argsort(-frame.radii, kind="stable")
    named = [int(spot) for spot in order if frame.names[spot]]
    places = place_labels(
        frame.points, frame.radii, sizes, named[:_MAX_LABELS], frame.size_pt, taken
    )
    halo = [withStroke(linewidth=2.0, foreground=SKY)]
    for spot, corner in places.items():
        x, y = (np.array(corner) + 0.5 * sizes[spot]) / frame.scale
        colour = _BRIGHT if frame.radii[spot] > _LARGE_PT else _FAINT
        frame.axes.text(
            x, y, str(frame.names[spot]), color=colour, size=LABEL_PT, ha="center",
            va="center", path_effects=halo, parse_math=False,
        )  # fmt: skip
    return len(named) - len(places)


def place_labels(
    centres: Array,
    radii: Array,
    sizes: Array,
    labelled: Sequence[int],
    frame: tuple[float, float],
    taken: Array,
) -> dict[int, tuple[float, float]]:
    """Place labels next to round marks, in order, each at a place where it covers nothing.

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
    for mark in labelled:
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

    Values that are not finite are ignored; a block without finite values is NaN. The blocks are
    made row by row, because a whole large image as float64 exceeds the memory of a request.
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


GRID, LINES, PLANET = "#3d6b86", "#8f86c9", "#ffe08a"
_STEPS_DEG = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 15.0, 30.0, 45.0)
_POINTS = 181
_INTERVALS = 5  # intended number of intervals of the grid across the frame


@dataclass(frozen=True)
class Overlay:
    """Lines and planets in pixels."""

    # label of a line of the grid, and its points, shape (P, 2); NaN outside of the image
    grid: tuple[tuple[str, Array], ...] = ()
    figures: tuple[Array, ...] = ()  # shape (P, 2): lines of constellations
    bodies: tuple[BodyInFrame, ...] = ()  # planets, the Sun and the Moon


def overlay_from_attitude(
    matrix: Matrix, camera: Camera, epoch_jyear: float, bodies: tuple[BodyInFrame, ...] = ()
) -> Overlay:
    """Return the lines and planets of a frame, which are drawn behind its stars."""
    return Overlay(_grid(matrix, camera), _figures(matrix, camera, epoch_jyear), bodies)


def draw_overlay(frame: FrameAxes, overlay: Overlay) -> Array:
    """Draw lines and planets."""
    taken: list[list[float]] = []
    for name, points in overlay.grid:
        frame.axes.plot(*points.T, color=GRID, lw=0.6, alpha=0.75, zorder=0.5)
        taken += _write_at_edge(frame, name, points, taken)
    for points in overlay.figures:
        frame.axes.plot(*points.T, color=LINES, lw=1.1, alpha=0.75, zorder=0.6)
    for body in overlay.bodies:
        taken.append(_draw_body(frame, body))
    return np.array(taken).reshape(-1, 4)


def _grid(matrix: Matrix, camera: Camera) -> tuple[tuple[str, Array], ...]:
    step_deg, reach_deg = _step(camera), float(np.degrees(camera.radius_rad))
    _, dec = radec_from_directions(matrix[2])
    lowest, highest = float(dec) - reach_deg, float(dec) + reach_deg
    lines = []
    for number in range(int(np.ceil(lowest / step_deg)), int(highest / step_deg) + 1):
        at_deg = number * step_deg
        if abs(at_deg) < 90.0:
            ra = np.linspace(0.0, 360.0, 16 * _POINTS)
            name = f"{at_deg:+.4g}°"
            lines.append((name, directions_from_radec(ra, np.full(len(ra), at_deg))))
    wide_deg = step_deg / max(np.cos(np.radians(min(abs(float(dec)), 89.0))), 0.02)
    ra_step = next((step for step in _STEPS_DEG if step >= 0.99 * wide_deg), 45.0)
    for number in range(round(360.0 / ra_step)):
        line = np.linspace(max(lowest, -90.0), min(highest, 90.0), _POINTS)
        at_deg = number * ra_step
        lines.append((f"{at_deg:.4g}°", directions_from_radec(np.full(_POINTS, at_deg), line)))
    return tuple(
        (name, points)
        for name, u in lines
        if len(points := _on_detector(camera.pixels_from_directions(u @ matrix.T), camera))
    )


def _step(camera: Camera) -> float:
    """Return the step of a grid that has about five intervals across the frame."""
    most = 1.25 * min(camera.fov_x_deg, camera.fov_y_deg) / _INTERVALS
    return max((step for step in _STEPS_DEG if step <= most), default=_STEPS_DEG[0])


def _figures(matrix: Matrix, camera: Camera, epoch_jyear: float) -> tuple[Array, ...]:
    stars = named_stars()
    places, seen = stars.at(epoch_jyear), []
    for hips in constellation_lines():
        ends = places[stars.rows_of(hips)]
        for start, end in pairwise(ends):
            between = _great_circle(start, end)
            if separation(between, matrix[2]).min() > camera.radius_rad * 1.1:
                continue
            points = camera.pixels_from_directions(between @ matrix.T)
            if len(points := _on_detector(points, camera)):
                seen.append(points)
    return tuple(seen)


def _great_circle(start: Array, end: Array) -> Array:
    part = np.linspace(0.0, 1.0, 41)[:, None]
    chord = (1.0 - part) * start + part * end
    return np.asarray(chord / np.sqrt(np.einsum("ij,ij->i", chord, chord))[:, None])


def _on_detector(points: Pixels, camera: Camera) -> Array:
    """Return the points on the detector with those next to them, NaN for the others between."""
    inside = camera.contains(points)
    near = inside.copy()
    near[1:] |= inside[:-1]
    near[:-1] |= inside[1:]
    if not near.any():
        return np.empty((0, 2))
    kept = np.flatnonzero(near)
    return np.asarray(np.where(near[:, None], points, np.nan)[kept[0] : kept[-1] + 1])


def _write_at_edge(
    frame: FrameAxes, name: str, points: Pixels, taken: list[list[float]]
) -> list[list[float]]:
    """Write the name of a line of the grid at the edge of the frame, unless another is there."""
    size = np.array(frame.size, dtype=np.float64)
    to_edge = np.minimum(points, size - points).min(axis=1)
    inside = np.flatnonzero(to_edge >= 0.0)
    if not len(inside):
        return []
    x, y = points[inside[np.argmin(to_edge[inside])]] * frame.scale
    half_width, half_height = 0.5 * LETTER_PT * len(name) + 2.0, 0.6 * LABEL_PT
    width, height = frame.size_pt
    x = float(np.clip(x, half_width, width - half_width))
    y = float(np.clip(y, half_height, height - half_height))
    box = [x - half_width, y - half_height, x + half_width, y + half_height]
    if any(
        box[0] < right and left < box[2] and box[1] < bottom and top < box[3]
        for left, top, right, bottom in taken
    ):
        return []
    frame.axes.text(
        x / frame.scale, y / frame.scale, name, color="#7fb2cf", size=0.8 * LABEL_PT,
        ha="center", va="center", zorder=2.5, parse_math=False,
    )  # fmt: skip
    return [box]


def _draw_body(frame: FrameAxes, body: BodyInFrame) -> list[float]:
    """Draw a planet as a square around its place, with its name; return the name's box."""
    from matplotlib.patheffects import withStroke

    x, y, name = body.x_px * frame.scale, body.y_px * frame.scale, body.name
    width = LETTER_PT * len(name)
    frame.axes.scatter([body.x_px], [body.y_px], 160.0, marker="s", facecolor="none",
                       edgecolor=PLANET, lw=1.3, zorder=3.0)  # fmt: skip
    side = 1.0 if x + 11.0 + width < frame.size_pt[0] else -1.0
    middle = x + side * (11.0 + 0.5 * width)
    frame.axes.text(
        middle / frame.scale, body.y_px, name, color=PLANET, size=1.1 * LABEL_PT, ha="center",
        va="center", zorder=3.0, parse_math=False,
        path_effects=[withStroke(linewidth=2.0, foreground=SKY)],
    )  # fmt: skip
    return [middle - 0.5 * width, y - 0.7 * LABEL_PT, middle + 0.5 * width, y + 0.7 * LABEL_PT]
