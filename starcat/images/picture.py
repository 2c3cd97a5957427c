"""A picture of one frame: the image or its spots, which of them are which stars, where north is.

Drawn with matplotlib's own defaults and font, never the user's settings: the same input gives
the same bytes. Nothing is identified here.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array
from starcat.errors import ConfigError, OutputError, reason
from starcat.geometry.attitude import radec_roll_from_matrix
from starcat.images.overlay import Overlay, draw_overlay
from starcat.images.plate import (
    SKY,
    Plate,
    draw_compass,
    draw_marks,
    draw_names,
    draw_sky,
    mark_radii,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",  # comes with matplotlib
    "font.size": 9.0,
    "svg.hashsalt": "starcat",
}
_DPI = 100
_LONG_SIDE_IN = 9.0
_LEFT_IN, _BOTTOM_IN, _RIGHT_IN, _TOP_IN = 0.6, 0.85, 0.3, 0.8


def draw_identified(
    path: Path,
    image: NDArray[Any] | None,
    camera_size: tuple[int, int],
    centroids_px: Array,
    names: Sequence[str | None],
    title: str,
    *,
    mag: Array | None = None,
    below: str = "",
    compass: tuple[Array, Array] | None = None,
    overlay: Overlay | None = None,
) -> None:
    """Draw which spots of a frame are which stars."""
    if path.suffix.lower() not in (".png", ".svg"):
        raise ConfigError(f"{path}: a picture is .png or .svg")
    _check(image, camera_size, centroids_px, names, mag)
    with _own_style():
        figure, axes, scale = _canvas(camera_size, title, below)
        plate = Plate(axes, scale, camera_size, centroids_px, names, mark_radii(len(names), mag))
        draw_sky(plate, image)
        written = draw_overlay(plate, overlay or Overlay())
        draw_marks(plate)
        taken = draw_compass(plate, compass)
        left_out = draw_names(plate, np.vstack([taken, written]))
        _draw_legend(figure, names, left_out)
        _write(figure, path)


def compass_from_matrix(matrix: Array) -> tuple[Array, Array]:
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


def _check(
    image: NDArray[Any] | None,
    camera_size: tuple[int, int],
    centroids_px: Array,
    names: Sequence[str | None],
    mag: Array | None,
) -> None:
    count = len(names)
    if centroids_px.shape != (count, 2) or (mag is not None and mag.shape != (count,)):
        raise ValueError(
            f"{count} names, centroids_px of shape {centroids_px.shape}, mag of shape "
            f"{None if mag is None else mag.shape}; expected one of each for every spot"
        )
    if image is not None and image.shape != camera_size[::-1]:
        raise ValueError(f"image of shape {image.shape} from a camera of {camera_size} px")


@contextmanager
def _own_style() -> Iterator[None]:
    """Draw with matplotlib's defaults and the style above, then put everything back."""
    import matplotlib

    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_STYLE)
        yield


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


def _draw_legend(figure: Figure, names: Sequence[str | None], left_out: int) -> None:
    from matplotlib.lines import Line2D

    stars = sum(name is not None for name in names)
    ring: dict[str, Any] = {"ls": "none", "mfc": "none", "mew": 1.3}
    handles = [
        Line2D([], [], marker="o", mec="#1a9db8", ms=9, label=f"identified: {stars}", **ring),
        Line2D(
            [], [], marker="D", mec="#e08a1e", ms=6, label=f"not identified: {len(names) - stars}",
            **ring,
        ),
    ]  # fmt: skip
    place = (_LEFT_IN / figure.get_figwidth(), 0.08 / figure.get_figheight())
    figure.legend(handles=handles, loc="lower left", bbox_to_anchor=place, ncols=2,
                  frameon=False, borderaxespad=0.0, handletextpad=0.3)  # fmt: skip
    if left_out:
        note = f"{left_out} more names have no room" if left_out > 1 else "1 name has no room"
        right = 1.0 - _RIGHT_IN / figure.get_figwidth()
        figure.text(right, 0.16 / figure.get_figheight(), note, color="#777", ha="right", size=8)


def _write(figure: Figure, path: Path) -> None:
    """Write the file, without a date or a version in it."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    buffer = io.BytesIO()
    if path.suffix.lower() == ".png":
        FigureCanvasAgg(figure).print_figure(buffer, dpi=_DPI, metadata={"Software": None})
    else:
        nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        FigureCanvasSVG(figure).print_figure(buffer, metadata=nothing)
    try:
        path.write_bytes(buffer.getvalue())
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({reason(error)})", path=path) from error
