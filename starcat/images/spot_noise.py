"""How well a centroid is known: the standard error that noise leaves, in closed form.

Stars are Gaussian spots. Two noises move their centroids: that of the background, the same in
every pixel, and that of a star's own photons. What else moves them (a spot that is no Gaussian, a
neighbour, a full well) is not in these errors.
"""

from __future__ import annotations

import math

import numpy as np

from starcat.arrays import Array, Pixels
from starcat.images.background import SkyLevels, unmasked
from starcat.matcher.result import MatchResult

CREDIBLE_CHI_SQUARE = (0.5, 2.0)
"""Reduced chi-squares of an answer between which the noise of its spots is taken as its weights."""

MIN_DEPTH = 2.0
"""Standard deviations from a sky that was not clipped down to its darkest pixel, at least."""


def centroid_sigma_px(
    flux: Array, noise: Array, sigma_px: float, gain_e_per_adu: float, window_px: float
) -> Array:
    """Return the standard errors of windowed centroids on each axis; infinite where not known.

    That is without light, or with a gain that is NaN.

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


def noise_at(levels: SkyLevels, centroids_px: Pixels) -> Array:
    """Return the noise of a pixel around each spot; larger where noise is not white."""
    height, width = levels.noise.shape
    x, y = np.clip(np.nan_to_num(centroids_px).astype(np.int64), 0, (width - 1, height - 1)).T
    return np.asarray(levels.noise[y, x] * levels.excess, dtype=np.float64)


def electrons_per_step(levels: SkyLevels) -> float:
    """Judge the gain of a camera from the noise of the sky, as if its photons were all noise.

    The black point is taken to be the darkest pixel. Read noise makes the gain seem smaller than
    it is, and the errors of bright stars larger. NaN where the sky was clipped, so that no pixel
    is darker than it by `MIN_DEPTH` of its noise.
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
    """Return the answer to an image, weighted by the noise of its spots where that is their error.

    In a lens that is not calibrated it is not all of it, and in a picture whose sky was clipped it
    is not known: there all spots weigh the same.
    """
    if not result.ok:
        return result
    weighted = result.with_noise(sigma_px)
    low, high = CREDIBLE_CHI_SQUARE
    return weighted if low <= weighted.reduced_chi_square <= high else result
