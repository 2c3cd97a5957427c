"""Stars that moved while the shutter was open: streaks, measured at their middles.

A camera that turns at a steady rate draws every star as a bar, and the middle of the bar is where
the star was at the middle of the exposure: that is the time of the centroids. The length and the
direction of the bars are measured on the bright ones; a filter of their shape finds the others.
The bars of one frame are assumed to be parallel and of one length, as they are if the camera
turns about an axis across its boresight.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, map_coordinates
from scipy.signal import fftconvolve
from scipy.special import erf

from starcat.arrays import Array
from starcat.database.products.blends import PIXEL_VARIANCE
from starcat.frames.images.background import SkyLevels
from starcat.frames.images.spots import noise_at

_FEWEST, _MOST = 5, 30
_LONG = 2.5  # length over width from which a spot is long, by standard deviations along its axes
_ALIGNED = 0.9  # length of the mean of unit vectors with twice the angle: 1 if all are parallel
_NARROWEST_PX = 0.6
_REACH_SIGMA = 4.0
_BRIGHTEST = 12  # bars that the length and the width are measured on
_ROUNDS = 4  # a faint bar is found in pieces, and measured farther out in each round
_WIDEST_PX, _ACROSS_PX = 5.0, 15
_OF_LONGEST = 0.5  # bars shorter than this part of the longest ones are pieces of bars


@dataclass(frozen=True)
class Streak:
    """The bar that a star draws."""

    dx_px: float  # one end minus the other, to the right; which end is first is not known
    dy_px: float
    psf_sigma_px: float  # standard deviation of the spot that was drawn along the bar

    @property
    def length_px(self) -> float:
        """From end to end."""
        return float(np.hypot(self.dx_px, self.dy_px))

    def profile(self) -> Array:
        """Return a bar of light 1 in the middle of an image of odd sides."""
        half = 0.5 * np.abs([self.dx_px, self.dy_px]) + _REACH_SIGMA * self.psf_sigma_px
        x, y = (np.arange(-side, side + 1) for side in np.ceil(half).astype(int))
        along = (x * self.dx_px + y[:, None] * self.dy_px) / self.length_px
        across = (x * self.dy_px - y[:, None] * self.dx_px) / self.length_px
        wide = np.sqrt(2.0) * self.psf_sigma_px
        ends = erf((along + 0.5 * self.length_px) / wide) - erf(
            (along - 0.5 * self.length_px) / wide
        )
        bar = ends * np.exp(-((across / wide) ** 2))
        return np.asarray(bar / bar.sum())

    def filtered(self, levels: SkyLevels) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the light of a bar whose middle is a pixel, for every pixel, and its noise."""
        bar = self.profile()
        size = float((bar**2).sum())
        light = fftconvolve(levels.above, bar, mode="same") / size
        noise = levels.noise * np.float32(levels.excess / np.sqrt(size))
        return light.astype(np.float32), noise

    def sigma_px(self, flux: Array, noise: Array, gain_e_per_adu: float) -> Array:
        """Return the standard error of middles, the same along and across: the mean of both.

        It holds for the best fit of a bar much longer than wide: along it only the ends count.
        """
        length, spot = max(self.length_px, self.psf_sigma_px), self.psf_sigma_px
        bright = np.where(flux > 0.0, flux, np.nan)
        of_sky = 2.0 * np.pi * (length * spot) ** 2 + 4.0 * np.sqrt(np.pi) * length * spot**3
        of_photons = np.sqrt(np.pi / 3.0) * length * spot + 16.0 / np.sqrt(108.0) * spot**2
        variance = of_sky * (noise / bright) ** 2 + of_photons / (bright * gain_e_per_adu)
        return np.asarray(np.nan_to_num(np.sqrt(0.5 * variance), nan=np.inf))


def streak_of(detections: NDArray[Any], shape: tuple[int, int]) -> Streak | None:
    """Return the bar that the bright spots of an image are; None if they are round."""
    bright = detections[np.argsort(-detections["flux"], kind="stable")[:_MOST]]
    if len(bright) < _FEWEST:
        return None
    long, wide = bright["a"].astype(np.float64), bright["b"].astype(np.float64)
    is_long = long > _LONG * np.maximum(wide, 0.3)
    if is_long.mean() <= 0.5:
        return None
    turned = np.exp(2j * bright["theta"][is_long].astype(np.float64))
    if abs(turned.mean()) < _ALIGNED:
        return None
    angle = 0.5 * float(np.angle(turned.mean()))
    # The variance of a bar along itself is a twelfth of its length squared.
    lengths = np.sqrt(12.0 * (long**2 - wide**2)[is_long])
    inside = _is_inside(bright[is_long], shape)
    whole = inside & (lengths > _OF_LONGEST * np.quantile(lengths, 0.9))
    length = float(np.median(lengths[whole] if whole.any() else lengths))
    # sep measures what it has smoothed with a Gaussian of 1 px.
    variance = float(np.median(wide[is_long])) ** 2 - 1.0 - PIXEL_VARIANCE
    sigma = float(np.sqrt(max(variance, _NARROWEST_PX**2)))
    return Streak(length * np.cos(angle), length * np.sin(angle), sigma)


def refined(levels: SkyLevels, streak: Streak, places: Array) -> Streak:
    """Return the common bar of the brightest bars of an image, measured at the ends and across."""
    for _ in range(_ROUNDS):
        spans, acrosses = _profiles(levels, streak, places[:_BRIGHTEST])
        lengths = [length for length in map(_length, spans) if length > 0.0]
        if not lengths:
            break
        length, before = float(np.median(lengths)), streak.length_px
        sigma = _width(np.asarray(acrosses).sum(axis=0))
        scale = length / before
        streak = replace(
            streak, dx_px=streak.dx_px * scale, dy_px=streak.dy_px * scale, psf_sigma_px=sigma
        )
        if abs(scale - 1.0) < 0.02:
            break
    return streak


def _profiles(levels: SkyLevels, streak: Streak, places: Array) -> tuple[Array, Array]:
    """Return the light along bars, two lengths to each side, and across their middles."""
    unit = np.array([streak.dx_px, streak.dy_px]) / streak.length_px
    reach = int(np.ceil(2.0 * streak.length_px))
    along, across = np.arange(-reach, reach + 1), np.arange(-_ACROSS_PX, _ACROSS_PX + 1)
    x = places[:, 0, None, None] + along * unit[0] - across[:, None] * unit[1]
    y = places[:, 1, None, None] + along * unit[1] + across[:, None] * unit[0]
    light = map_coordinates(levels.above, [y, x], order=1, mode="constant")
    narrow = np.abs(across) <= np.ceil(2.0 * streak.psf_sigma_px)
    middle = np.abs(along) <= max(0.25 * streak.length_px, 1.0)
    return light[:, narrow].sum(axis=1), light[:, :, middle].sum(axis=2)


def _length(light: Array) -> float:
    """Return the distance up to which light stays above half of its middle value; 0 if no end."""
    smooth = gaussian_filter1d(light, 2.0)
    half = len(light) // 2
    level = 0.5 * float(np.median(smooth[half - half // 8 : half + half // 8 + 1]))
    below = np.flatnonzero(smooth < level)
    lower, upper = below[below < half], below[below > half]
    if level <= 0.0 or not len(lower) or not len(upper):
        return 0.0
    first, last = int(lower[-1]), int(upper[0])
    start = first + (level - smooth[first]) / (smooth[first + 1] - smooth[first])
    end = last - (level - smooth[last]) / (smooth[last - 1] - smooth[last])
    return float(end - start)


def _width(light: Array) -> float:
    """Return the Gaussian under which a profile stands out most."""
    reach = np.arange(-_ACROSS_PX, _ACROSS_PX + 1)
    widths = np.geomspace(_NARROWEST_PX, _WIDEST_PX, 30)
    bells = np.exp(-0.5 * (reach / widths[:, None]) ** 2)
    bells -= bells.mean(axis=1, keepdims=True)
    bells /= np.linalg.norm(bells, axis=1, keepdims=True)
    # Pixels, and reading between them, have widened it by a little.
    seen = float(widths[(bells @ light).argmax()])
    return float(np.sqrt(max(seen**2 - 3.0 * PIXEL_VARIANCE, _NARROWEST_PX**2)))


def _is_inside(detections: NDArray[Any], shape: tuple[int, int]) -> NDArray[np.bool_]:
    height, width = shape
    inside = (detections["xmin"] > 0) & (detections["ymin"] > 0)
    return np.asarray(inside & (detections["xmax"] < width - 1) & (detections["ymax"] < height - 1))


def measured_streaks(
    levels: SkyLevels,
    filtered: NDArray[np.float32],
    detections: NDArray[Any],
    streak: Streak,
    gain_e_per_adu: float,
) -> tuple[Array, Array, Array]:
    """Return middles, light and standard errors of the bars that lie whole in an image."""
    height, width = filtered.shape
    x, y = detections["xpeak"].astype(np.int64), detections["ypeak"].astype(np.int64)
    margin = 0.5 * np.abs([streak.dx_px, streak.dy_px]) + 1.0
    whole = (x >= margin[0]) & (x < width - margin[0]) & (y >= margin[1]) & (y < height - margin[1])
    x, y = x[whole], y[whole]
    steps = np.arange(-1, 2)
    peak = filtered[y[:, None, None] + steps[:, None], x[:, None, None] + steps]
    # Across, a bar is Gaussian, and its logarithm the parabola that is looked for.
    tops = np.log(np.maximum(peak.astype(np.float64), 1e-6 * peak[:, 1:2, 1:2]))
    middles = np.column_stack([x, y]) + _top_of_parabola(tops) + 0.5
    flux = filtered[y, x].astype(np.float64)
    return middles, flux, streak.sigma_px(flux, noise_at(levels, middles), gain_e_per_adu)


def _top_of_parabola(around: Array) -> Array:
    """Return where the parabola through 3 by 3 pixels is highest, from the middle one."""
    dx = 0.5 * (around[:, :, 2] - around[:, :, 0]).mean(axis=1)
    dy = 0.5 * (around[:, 2, :] - around[:, 0, :]).mean(axis=1)
    dxx = (around[:, :, 2] - 2.0 * around[:, :, 1] + around[:, :, 0]).mean(axis=1)
    dyy = (around[:, 2, :] - 2.0 * around[:, 1, :] + around[:, 0, :]).mean(axis=1)
    dxy = 0.25 * (around[:, 2, 2] - around[:, 2, 0] - around[:, 0, 2] + around[:, 0, 0])
    bend = dxx * dyy - dxy**2
    with np.errstate(divide="ignore", invalid="ignore"):
        shift = np.stack([dxy * dy - dyy * dx, dxy * dx - dxx * dy], axis=1) / bend[:, None]
    good = (dxx < 0.0) & (bend > 0.0)
    return np.asarray(np.where(good[:, None], np.clip(shift, -1.0, 1.0), 0.0))
