"""The drawing of what a calibration leaves: residuals over the detector and with the radius."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from starcat.arrays import Array
from starcat.calibration.calibrate import Calibration
from starcat.images.figure_file import check_kind, own_style, write_figure
from starcat.report.plots import STYLE, headline

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_BLUE, _GREY, _RED = "#2c6e9e", "#b9c4cc", "#d1495b"
_LONG_ARROW = 0.06
"""Length of an arrow of three standard deviations, in widths of the detector."""
_BINS = 8


def draw_residuals(calibration: Calibration, path: Path) -> None:
    """Draw the residuals of a calibration."""
    check_kind(path)
    with own_style(STYLE):
        write_figure(_figure(calibration), path)


def _figure(calibration: Calibration) -> Figure:
    from matplotlib.figure import Figure

    fit = calibration.fit
    figure = Figure(figsize=(11.0, 4.9))
    below = (
        f"{len(fit.seen):,} stars of {calibration.n_identified} frames; standard deviation "
        f"{fit.noise_px:.3f} px on each axis; fitted: {', '.join(fit.free)}"
    )
    headline(figure, f"Residuals: {calibration.camera.in_words}", below)
    _draw_arrows(figure.add_axes((0.055, 0.11, 0.5, 0.73)), calibration)
    along, across = _polar(calibration)
    for axes, residual_px, name in (
        (figure.add_axes((0.635, 0.53, 0.35, 0.31)), along, "outwards, px"),
        (figure.add_axes((0.635, 0.11, 0.35, 0.31)), across, "sideways, px"),
    ):
        _draw_profile(axes, calibration, residual_px, name)
    return figure


def _draw_arrows(axes: Axes, calibration: Calibration) -> None:
    fit, camera = calibration.fit, calibration.camera
    enlarged = _LONG_ARROW * camera.width_px / (3.0 * fit.noise_px)
    x, y = (fit.seen.centroids_px - fit.residual_px).T
    dx, dy = (fit.residual_px * enlarged).T
    stray = np.hypot(*fit.residual_px.T) > 4.5 * fit.noise_px
    for which, colour in ((~stray, _BLUE), (stray, _RED)):
        # Strays point where they were seen, but no farther than the eye can use.
        longest = 2.0 * _LONG_ARROW * camera.width_px
        size = np.minimum(1.0, longest / np.maximum(np.hypot(dx, dy), 1e-9))[which]
        axes.quiver(
            x[which], y[which], dx[which] * size, dy[which] * size, color=colour,
            angles="xy", scale_units="xy", scale=1.0, width=0.0022, headwidth=4.0,
        )  # fmt: skip
    axes.plot(*camera.principal_point_px, "+", color=_RED, ms=12, mew=1.4)
    axes.set(xlim=(0, camera.width_px), ylim=(camera.height_px, 0), aspect="equal")
    axes.set(xlabel=f"x, px (arrows {enlarged:.0f} times enlarged; cross: principal point)")
    axes.set(ylabel="y, px")


def _polar(calibration: Calibration) -> tuple[Array, Array]:
    """Return the residuals along and across the radius from the principal point."""
    fit = calibration.fit
    away = fit.seen.centroids_px - calibration.camera.principal_point_px
    unit = away / np.maximum(np.hypot(*away.T), 1e-9)[:, None]
    along = np.einsum("ij,ij->i", unit, fit.residual_px)
    return along, unit[:, 0] * fit.residual_px[:, 1] - unit[:, 1] * fit.residual_px[:, 0]


def _draw_profile(axes: Axes, calibration: Calibration, residual_px: Array, name: str) -> None:
    """Draw residuals against the radius, and their means in bins of as many stars."""
    fit = calibration.fit
    radius = np.hypot(*(fit.seen.centroids_px - calibration.camera.principal_point_px).T)
    limit = 4.5 * fit.noise_px
    axes.axhline(0.0, color="#333", lw=0.8)
    axes.plot(radius, residual_px, ".", color=_GREY, ms=3)
    inside = np.abs(residual_px) <= limit
    order = np.flatnonzero(inside)[np.argsort(radius[inside])]
    for stars in np.array_split(order, min(_BINS, max(1, len(order) // 5))):
        error = residual_px[stars].std() / np.sqrt(len(stars))
        axes.errorbar(
            radius[stars].mean(), residual_px[stars].mean(), error, fmt="o", color=_BLUE, ms=4,
            capsize=2,
        )  # fmt: skip
    axes.set(ylim=(-limit, limit), ylabel=name, xlim=(0, None))
    axes.set_xlabel("distance from the principal point, px")
