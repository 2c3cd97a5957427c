"""A picture of one frame: the image or its centroids, with the names of stars and the compass.

The same input gives the same bytes. Nothing is identified here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from starcat.arguments import path_of
from starcat.arrays import Array, Matrix, Pixels
from starcat.errors import ConfigError
from starcat.frames.images.overlay import (
    SKY,
    FrameAxes,
    Overlay,
    draw_compass,
    draw_marks,
    draw_names,
    draw_overlay,
    draw_sky,
    mark_radii,
    overlay_from_attitude,
)
from starcat.frames.sky.names import common_names, named_stars
from starcat.geometry.attitude import matrix_from_quaternion, radec_roll_from_matrix
from starcat.geometry.camera import Camera
from starcat.matcher.centroids import MeasuredFrame
from starcat.matcher.database import MatcherDatabase
from starcat.matcher.result import MatchResult
from starcat.matcher.stars import ARCSEC
from starcat.resources import PathLike
from starcat.storage.figures import check_kind, own_style, write_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from starcat.frames.sky.in_time import SkyInTime

_LONG_SIDE_IN = 9.0
_LEFT_IN, _BOTTOM_IN, _RIGHT_IN, _TOP_IN = 0.6, 0.85, 0.3, 0.8


def draw_result(
    result: MatchResult, output: PathLike | None, image: ArrayLike | None, name: str
) -> Figure:
    """Draw the frame of a result, as `MatchResult.plot` describes it."""
    frame, database = result.frame, result.database
    if frame is None or database is None:
        raise ConfigError("this MatchResult does not hold the frame that was asked about")
    camera = result.camera or frame.camera
    pixels = None if image is None else np.asarray(image)
    if pixels is not None and pixels.shape != (camera.height_px, camera.width_px):
        raise ConfigError(
            f"its shape is {pixels.shape}; expected {camera.height_px} rows of "
            f"{camera.width_px} pixels, as the camera has",
            parameter="image",
        )
    path = None if output is None else path_of("output", output)
    named = MeasuredFrame(name, frame.centroids_px, frame.mag)
    return draw(path, named, pixels, result, database, camera)


def draw(
    path: Path | None,
    frame: MeasuredFrame,
    image: NDArray[Any] | None,
    result: MatchResult,
    database: MatcherDatabase,
    camera: Camera,
    sky: SkyInTime | None = None,
) -> Figure:
    """Draw a frame with its stars circled and named, and write the picture if there is a path."""
    name = f"{frame.name}: " if frame.name else ""
    title, below = f"{name}{result.status.replace('_', ' ')}", database.name
    compass = overlay = None
    labels = _labels(result, database, sky)
    places: dict[int, str] = {}
    if result.status == "identified":
        title = (
            f"{name}RA {result.boresight_ra_deg:.4f}, "
            f"Dec {result.boresight_dec_deg:+.4f}, roll {result.roll_deg:.3f} deg"
        )
        below = (
            f"{result.n_matched} of {len(result.star_index)} centroids are stars of "
            f"{database.name}, residual {result.residual_arcsec:.1f} arcsec"
        )
        matrix = matrix_from_quaternion(result.q_body_from_icrs)
        compass = compass_from_matrix(matrix)
        bodies = () if sky is None else sky.bodies
        overlay = overlay_from_attitude(matrix, camera, database.epoch_jyear, bodies)
        places = names_by_place(
            frame.centroids_px, labels, matrix, camera, database, result.residual_arcsec
        )
    return draw_identified(
        path,
        image,
        (camera.width_px, camera.height_px),
        frame.centroids_px,
        labels,
        title,
        places=places,
        mag=frame.mag,
        below=below,
        compass=compass,
        overlay=overlay,
    )


def _labels(
    result: MatchResult, database: MatcherDatabase, sky: SkyInTime | None
) -> list[str | None]:
    """Return the common names of stars, or the catalog's own name if there is no other.

    The spot of a planet has an empty name: it is identified, and its name is drawn separately.
    """
    rows = np.flatnonzero(result.star_index >= 0)
    stars = result.star_index[rows]
    designations = [name.decode() for name in database.designation[stars].tolist()]
    common = common_names(
        designations, database.directions[stars], database.mag[stars], database.epoch_jyear
    )
    labels: list[str | None] = [None] * len(result.star_index)
    for row, name, other in zip(rows.tolist(), common, designations, strict=True):
        labels[row] = name or picture_name(other)
    for body in () if sky is None else sky.bodies:
        if body.row is not None:
            labels[body.row] = ""
    return labels


RESIDUALS = 3.0
"""Largest distance of a centroid from a star of the list of names, in residuals of the answer."""


def names_by_place(
    centroids_px: Pixels,
    labels: Sequence[str | None],
    matrix: Matrix,
    camera: Camera,
    database: MatcherDatabase,
    residual_arcsec: float,
) -> dict[int, str]:
    """Return the names of bright stars that are not guide stars, by the rows of their centroids.

    A double, for example, is not a guide star, and can be the brightest star of the frame. Only
    stars as bright as guide stars are named, because fainter ones lie near any centroid by chance.
    """
    stars = named_stars()
    directions = stars.at(database.epoch_jyear)
    cosine = np.cos(min(camera.radius_rad, 0.5 * np.pi))
    rows = np.flatnonzero((directions @ matrix[2] > cosine) & (stars.mag <= database.mag.max()))
    rows = rows[np.argsort(stars.mag[rows], kind="stable")]
    rows = rows[[stars.labels[row] not in labels for row in rows]]
    reach_px = max(1.0, RESIDUALS * residual_arcsec / ARCSEC * camera.focal_length_px)
    free = np.array([n for n, label in enumerate(labels) if label is None], dtype=np.intp)
    names: dict[int, str] = {}
    for row, at_px in zip(
        rows, camera.pixels_from_directions(directions[rows] @ matrix.T), strict=True
    ):
        distance_px = np.hypot(*(centroids_px[free] - at_px).T)
        if not len(free) or not np.nanmin(distance_px, initial=np.inf) <= reach_px:
            continue
        nearest = int(np.nanargmin(distance_px))
        names[int(free[nearest])] = stars.labels[row]
        free = np.delete(free, nearest)
    return names


def picture_name(designation: str) -> str:
    """Return a designation that fits beside a star.

    Examples
    --------
    >>> picture_name("Gaia DR3 3221269181884277504"), picture_name("SAO 308")
    ('Gaia …84277504', 'SAO 308')
    """
    words = designation.split() or [""]
    if len(words[-1]) <= 12:
        return designation
    return f"{words[0]} …{words[-1][-8:]}"


def draw_identified(
    path: Path | None,
    image: NDArray[Any] | None,
    camera_size: tuple[int, int],
    centroids_px: Pixels,
    names: Sequence[str | None],
    title: str,
    *,
    places: Mapping[int, str] | None = None,
    mag: Array | None = None,
    below: str = "",
    compass: tuple[Array, Array] | None = None,
    overlay: Overlay | None = None,
) -> Figure:
    """Draw which centroids of a frame are which stars; write the picture if there is a path.

    ``places`` has the names of centroids that are not identified and lie at the place of a star.
    """
    check_kind(path, "picture")
    places = places or {}
    shown = [places.get(row, name) for row, name in enumerate(names)]
    is_placed = np.isin(np.arange(len(names)), list(places))
    with own_style():
        figure, axes, scale = _canvas(camera_size, title, below)
        radii = mark_radii(len(names), mag)
        frame = FrameAxes(axes, scale, camera_size, centroids_px, shown, radii, is_placed)
        draw_sky(frame, image, is_scaled_later=path is not None and path.suffix.lower() == ".svg")
        written = draw_overlay(frame, overlay or Overlay())
        draw_marks(frame)
        taken = draw_compass(frame, compass)
        left_out = draw_names(frame, np.vstack([taken, written]))
        _draw_legend(figure, names, len(places), left_out)
        if path is not None:
            write_figure(figure, path)
    return figure


def compass_from_matrix(matrix: Matrix) -> tuple[Array, Array]:
    """Return where north and east are in the middle of a frame.

    Examples
    --------
    >>> from starcat.geometry.attitude import matrix_from_radec_roll
    >>> north, east = compass_from_matrix(matrix_from_radec_roll(80.0, -5.0, 0.0))
    >>> (np.round(north) + 0.0).tolist(), (np.round(east) + 0.0).tolist()
    ([0.0, -1.0], [-1.0, 0.0])
    """
    roll = np.radians(radec_roll_from_matrix(matrix)[2])
    north = np.array([-np.sin(roll), -np.cos(roll)])
    return north, np.array([north[1], -north[0]])


def _canvas(camera_size: tuple[int, int], title: str, below: str) -> tuple[Figure, Axes, float]:
    """Return figure, axes in pixels, and points per pixel."""
    from matplotlib.figure import Figure

    width, height = camera_size
    inch = _LONG_SIDE_IN / max(width, height)
    wide = max(width * inch + _LEFT_IN + _RIGHT_IN, 6.5)
    high = height * inch + _BOTTOM_IN + _TOP_IN
    figure = Figure(figsize=(wide, high))
    figure.text(_LEFT_IN / wide, 1.0 - 0.36 / high, title, fontsize=13, parse_math=False)
    figure.text(_LEFT_IN / wide, 1.0 - 0.62 / high, below, color="#555", parse_math=False)
    axes = figure.add_axes(
        (_LEFT_IN / wide, _BOTTOM_IN / high, width * inch / wide, height * inch / high)
    )
    axes.set(xlim=(0, width), ylim=(height, 0), facecolor=SKY)
    axes.set_xlabel("x (px)", color="#777", size=8, loc="right", labelpad=1)
    axes.set_ylabel("y (px)", color="#777", size=8, loc="bottom", labelpad=1)
    axes.tick_params(length=3, color="#aaa", labelcolor="#777", labelsize=8)
    axes.spines[:].set_visible(False)
    return figure, axes, inch * 72.0


def _draw_legend(figure: Figure, names: Sequence[str | None], placed: int, left_out: int) -> None:
    from matplotlib.lines import Line2D

    stars = sum(name is not None for name in names)
    ring: dict[str, Any] = {"ls": "none", "mfc": "none", "mew": 1.3}
    kinds = [("o", "#1a9db8", 9, f"identified: {stars}")]
    if placed:
        kinds.append(("o", "#5f9e3f", 9, f"named by place: {placed}"))
    kinds.append(("D", "#e08a1e", 6, f"not identified: {len(names) - stars - placed}"))
    handles = [
        Line2D([], [], marker=marker, mec=colour, ms=size, label=label, **ring)
        for marker, colour, size, label in kinds
    ]
    anchor = (_LEFT_IN / figure.get_figwidth(), 0.08 / figure.get_figheight())
    figure.legend(handles=handles, loc="lower left", bbox_to_anchor=anchor, ncols=3,
                  frameon=False, borderaxespad=0.0, handletextpad=0.3)  # fmt: skip
    if left_out:
        note = f"{left_out} more names have no room" if left_out > 1 else "1 name has no room"
        right = 1.0 - _RIGHT_IN / figure.get_figwidth()
        figure.text(right, 0.16 / figure.get_figheight(), note, color="#777", ha="right", size=8)
