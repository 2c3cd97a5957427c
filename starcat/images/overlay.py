"""What lies behind the stars of a picture: a grid, the lines of constellations, planets.

The grid is of right ascension and declination, ICRS. All is in pixels of the camera, by an
attitude. A line that leaves the frame is cut where it is drawn.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from starcat.arrays import Array, Matrix, Pixels
from starcat.geometry.camera import Camera
from starcat.geometry.sphere import directions_from_radec, radec_from_directions, separation
from starcat.images.frame_axes import LABEL_PT, LETTER_PT, SKY, FrameAxes
from starcat.sky.names import constellation_lines, named_stars

if TYPE_CHECKING:
    from starcat.sky.in_time import BodyInFrame


GRID, LINES, PLANET = "#3d6b86", "#8f86c9", "#ffe08a"
_STEPS_DEG = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 15.0, 30.0, 45.0)
_POINTS = 181
_INTERVALS = 5  # wanted number of intervals of the grid across the frame


@dataclass(frozen=True)
class Overlay:
    """Lines and planets in pixels."""

    # shape (P, 2): what a line of the grid is called, and its points; NaN where there is no image
    grid: tuple[tuple[str, Array], ...] = ()
    figures: tuple[Array, ...] = ()  # shape (P, 2): lines of constellations
    bodies: tuple[BodyInFrame, ...] = ()  # planets, the Sun and the Moon


def overlay_from_attitude(
    matrix: Matrix, camera: Camera, epoch_jyear: float, bodies: tuple[BodyInFrame, ...] = ()
) -> Overlay:
    """Return what lies behind the stars of a frame."""
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
