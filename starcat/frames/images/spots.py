"""Spots of an image: their noise, and their width."""

from __future__ import annotations

import math

import numpy as np
import scipy
from numpy.typing import NDArray

from starcat.arrays import Array, Mask, Pixels
from starcat.database.products.blends import PIXEL_VARIANCE
from starcat.frames.images.background import SkyLevels, pixels_around, unmasked
from starcat.matcher.result import MatchResult

CREDIBLE_CHI_SQUARE = (0.5, 2.0)
"""Range of an answer's reduced chi-square in which the noise of its spots gives their weights."""

_BORDER_STEPS = 12  # of Newton's method, for spots of which a tenth is in the image
_FARTHEST_OUTSIDE = -4.0  # middle of a spot outside of the image, in its widths

MIN_DEPTH = 2.0
"""Smallest depth of the darkest pixel below a sky that was not clipped, standard deviations."""


def centroid_sigma_px(
    flux: Array, noise: Array, sigma_px: float, gain_e_per_adu: float, window_px: float
) -> Array:
    """Return the standard errors of windowed centroids on each axis; infinite where not known.

    An error is not known without light, or with a gain that is NaN.

    ``flux`` is the light of each spot and ``noise`` the standard deviation of a pixel of its
    background, both in steps of the image; the spot as the pixels show it and the window are
    Gaussians of ``sigma_px`` and ``window_px``. With a window as wide as the spot the errors are
    sqrt(8 pi) s^2 noise / flux for the background, the least that there can be, and
    4/3 s / sqrt(electrons) for the photons, added in squares.
    """
    spot, window = sigma_px**2, window_px**2
    # A centroid is where the windowed first moment is zero. That moment falls by `slope` times
    # the light a pixel; its variance is the noise through the squared window.
    slope = (window / (window + spot)) ** 2
    bright = np.where(flux > 0.0, flux, np.nan)
    of_sky = 0.5 * np.pi * window**2 * (noise / bright) ** 2
    of_photons = (window / (window + 2.0 * spot)) ** 2 * spot / (bright * gain_e_per_adu)
    return np.asarray(np.nan_to_num(np.sqrt(of_sky + of_photons) / slope, nan=np.inf))


def undo_border(
    depth_px: Array, psf_sigma_px: float, window_px: float
) -> tuple[Array, Array, Array]:
    """Return where spots are that the border of the image cuts, along an axis.

    ``depth_px`` are the distances of windowed centroids from the border. The spot, before pixels
    sample it, and the window are Gaussians, so their product is one, too; pixels widen the window.
    The centroid is the mean of the part of the product that is in the image, and lies farther
    inside than the spot. Returns the distances of the spots from the border (0 if they would be
    outside), how many times larger their errors are than those of centroids, and the share of the
    light that is in the image.

    >>> depth_px, growth, share = undo_border(np.array([1.113, 9.0]), 1.2, 1.234)
    >>> depth_px.round(2).tolist(), growth.round(1).tolist(), share.round(2).tolist()
    ([0.63, 9.0], [2.1, 1.0], [0.7, 1.0])
    """
    spot, window = psf_sigma_px**2, window_px**2 + PIXEL_VARIANCE
    width = np.sqrt(spot * window / (spot + window))
    mean = np.maximum(depth_px, 0.0) / width  # of the part in the image, in widths
    middle = mean.copy()  # of the whole product, from which the mean is `pull` away
    for _ in range(_BORDER_STEPS):
        pull = np.exp(-0.5 * middle**2 - scipy.special.log_ndtr(middle)) / np.sqrt(2.0 * np.pi)
        slope = 1.0 - pull * (middle + pull)
        middle = np.clip(middle - (middle + pull - mean) / slope, _FARTHEST_OUTSIDE, mean)
    depth = (middle * width * (spot + window) - depth_px * spot) / window
    growth = ((spot + window) / slope - spot) / window
    depth = np.where(depth_px > 0.0, np.maximum(depth, 0.0), depth_px)
    return depth, growth, scipy.special.ndtr(depth / psf_sigma_px)


def noise_at(levels: SkyLevels, centroids_px: Pixels) -> Array:
    """Return the noise of a pixel around each spot; larger where noise is not white."""
    height, width = levels.noise.shape
    x, y = np.clip(np.nan_to_num(centroids_px).astype(np.int64), 0, (width - 1, height - 1)).T
    return np.asarray(levels.noise[y, x] * levels.excess, dtype=np.float64)


def electrons_per_step(levels: SkyLevels) -> float:
    """Judge the gain of a camera from the noise of the sky, as if its photons were all noise.

    The black point is taken to be the darkest pixel. Read noise makes the gain seem smaller than
    it is, and the errors of bright stars larger. NaN if the sky was clipped, so that no pixel is
    darker than it by `MIN_DEPTH` of its noise.
    """
    background = unmasked(levels.raw - levels.above, levels.mask)
    sky = float(np.median(background, overwrite_input=True))
    del background
    depth = sky - float(unmasked(levels.raw, levels.mask).min())
    noise = float(np.median(levels.noise))
    if not noise:
        return 1.0
    return depth / noise**2 if depth >= MIN_DEPTH * noise else math.nan


def weighed(result: MatchResult, sigma_px: Array) -> MatchResult:
    """Return the answer to an image, weighted by the noise of its spots if that is their error.

    An uncalibrated lens adds further errors, and in a picture with a clipped sky the noise is not
    known: then all spots have the same weight.
    """
    if not result.ok:
        return result
    weighted = result.with_noise(sigma_px)
    low, high = CREDIBLE_CHI_SQUARE
    return weighted if low <= weighted.reduced_chi_square <= high else result


SIGMA_RANGE_PX = (0.3, 5.0)  # narrowest and widest spot that can be found
_STEP = 1.15
_HALF_PX = 16  # pixels on each side of a star that are used
_REACH_SIGMA = 4.0
_MAX_SPOTS = 150
_SPOTS_AT_ONCE = 2000  # noise can have tens of thousands, each of which takes 9 kB or more
# A spot narrower than this is a hot pixel with its neighbour, if there is another explanation.
_SHARP_PX = 0.45
_CLEAR_SNR, _SHARP_SNR = 15.0, 12.0
_FEW = 5
# In a flat image spots count that have this share of the signal of the tenth brightest.
_BRIGHT, _BRIGHT_SHARE = 10, 0.1


def best_widths(levels: SkyLevels, places: Array) -> tuple[Array, Array]:
    """Return the Gaussian under which each spot stands out most."""
    if not len(places):
        return np.empty(0), np.empty(0)
    low, high = SIGMA_RANGE_PX
    steps = int(np.ceil(np.log(high / low) / np.log(_STEP)))
    widths = np.asarray(low * _STEP ** np.arange(steps + 1), dtype=np.float64)
    corner = np.floor(places + 0.5).astype(np.int64)
    patches, shift = _patches(levels.above, corner), places - corner
    # Scores in windows of different sizes do not compare to a tenth: the second round has one
    # window for all widths, which the first has chosen.
    windows = np.broadcast_to(_REACH_SIGMA * widths[:, None], (len(widths), len(places)))
    rough = widths[_scores(patches, shift, widths, windows).argmax(axis=0)]
    scores = _scores(patches, shift, widths, np.broadcast_to(_REACH_SIGMA * rough, windows.shape))
    best = scores.argmax(axis=0)
    height, width = levels.noise.shape
    x, y = np.clip(corner, 0, (width - 1, height - 1)).T
    return _between(np.log(widths), scores, best), scores.max(axis=0) / levels.noise[y, x]


def is_sharp(levels: SkyLevels, places: Array, sigma: float) -> Mask:
    """Return which spots are too narrow for the light of a star, beyond their noise."""
    sharp = np.zeros(len(places), dtype=np.bool_)
    for first in range(0, len(places), _SPOTS_AT_ONCE):
        some = slice(first, first + _SPOTS_AT_ONCE)
        sharp[some] = _are_sharp(levels, places[some], sigma)
    return sharp


def _are_sharp(levels: SkyLevels, places: Array, sigma: float) -> Mask:
    corner = np.floor(places + 0.5).astype(np.int64)
    widths = sigma * np.array([0.5, 1.0])
    windows = np.full((2, len(places)), _REACH_SIGMA * sigma)
    scores = _scores(_patches(levels.above, corner), places - corner, widths, windows)
    height, width = levels.noise.shape
    x, y = np.clip(corner, 0, (width - 1, height - 1)).T
    clear = scores[0] > _SHARP_SNR * levels.noise[y, x]
    return np.asarray((scores[0] > scores[1]) & clear)


def _scores(patches: Array, shift: Array, widths: Array, windows: Array) -> Array:
    """Return how well each spot resembles spots of several widths.

    A score is the sum of a spot's light times a Gaussian of the width, from which its mean is
    subtracted, over the norm of that Gaussian.
    """
    scores = np.empty(windows.shape)
    for number, sigma in enumerate(widths):
        half = np.minimum(np.ceil(windows[number]), _HALF_PX)
        size = int(half.max())
        reach = np.arange(-size, size + 1)
        inner = slice(_HALF_PX - size, _HALF_PX + size + 1)
        inside = (np.abs(reach) <= half[:, None]).astype(np.float64)
        edges = np.arange(-size, size + 2) - 0.5
        across, down = (
            inside * np.diff(scipy.special.ndtr((edges - shift[:, axis, None]) / sigma))
            for axis in (0, 1)
        )
        cut = patches[:, inner, inner]
        total = across.sum(axis=1) * down.sum(axis=1)
        part = total / (2.0 * half + 1.0) ** 2
        norm = (across**2).sum(axis=1) * (down**2).sum(axis=1) - total * part
        signal = _through(cut, across, down) - part * _through(cut, inside, inside)
        scores[number] = signal / np.sqrt(norm)
    return scores


def _through(patches: Array, across: Array, down: Array) -> Array:
    """Return the light of each patch through a filter of columns and one of rows."""
    return np.asarray(((patches @ across[:, :, None])[:, :, 0] * down).sum(axis=1))


def _between(steps: Array, scores: Array, best: NDArray[np.intp]) -> Array:
    """Return where the parabola through the best score and its neighbours is highest."""
    middle = np.clip(best, 1, len(steps) - 2)
    spot = np.arange(scores.shape[1])
    before, at, after = (scores[middle + step, spot] for step in (-1, 0, 1))
    bend = before - 2.0 * at + after
    with np.errstate(divide="ignore", invalid="ignore"):
        shift = np.where(bend < 0.0, 0.5 * (before - after) / bend, 0.0)
    shift = np.where(best == middle, np.clip(shift, -0.5, 0.5), best - middle)
    return np.asarray(np.exp(steps[middle] + shift * np.log(_STEP)))


def _patches(above: NDArray[np.float32], corner: NDArray[np.int64]) -> Array:
    """Return the square around each place; 0 outside of the image."""
    x, y = corner.T
    return pixels_around(above, x, y, _HALF_PX).astype(np.float64)


def sigma_of_stars(levels: SkyLevels, places: Array, peak: Array) -> float:
    """Return the width of an image's stars."""
    order = np.argsort(-peak, kind="stable")[: 2 * _MAX_SPOTS]
    if not len(order):
        return 1.0
    sigma, snr = best_widths(levels, places[order])
    least = _CLEAR_SNR
    if levels.is_flat:  # its noise is not known, but steps are faint beside stars
        least = max(least, _BRIGHT_SHARE * float(np.sort(snr)[-_BRIGHT:][0]))
    clear = snr > least
    if clear.sum() >= _FEW:
        sigma = sigma[clear]
    sound = sigma < 0.99 * SIGMA_RANGE_PX[1]
    if sound.sum() >= _FEW:
        sigma = sigma[sound]
    if not (sigma > _SHARP_PX).any():
        return _SHARP_PX
    sigma = sigma[sigma > _SHARP_PX]
    sigma = sigma[:_MAX_SPOTS]
    # The mode is of widths, not of their logarithms: clouds have wide spots of all widths, while
    # stars have one width.
    near = np.abs(np.log(sigma / _densest(np.sort(sigma)))) < np.log(1.35)
    # Two or three spots of different widths have no width in common: then their median counts.
    return float(np.clip(np.median(sigma[near] if near.any() else sigma), *SIGMA_RANGE_PX))


def _densest(values: Array) -> float:
    """Return the half-sample mode of sorted values."""
    while len(values) > 3:
        half = (len(values) + 1) // 2
        spans = values[half - 1 :] - values[: len(values) - half + 1]
        first = int(spans.argmin())
        values = values[first : first + half]
    return float(np.median(values))
