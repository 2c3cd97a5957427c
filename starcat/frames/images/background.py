"""The light above the background of a star image, and the noise of the background.

Input is a grey image, output is a `SkyLevels`. Background and noise vary slowly over the image, and
single hot pixels can be removed. This module does not decide which pixels belong to stars.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from starcat.arrays import Array, Mask
from starcat.database.products.blends import PIXEL_VARIANCE
from starcat.errors import ConfigError
from starcat.version import install_command

Grey = NDArray[np.float32]

SMALLEST_PX = 16  # narrowest image in which background and stars can be separated
_BOX_PX = 64
# Boxes of the background, tried in this order if there are clouds.
_BOXES_PX = (64, 32, 16)
_SAMPLE_PX, _SAMPLES = 48, 6
_EXCESS_SIGMA_PX = (1.0, 4.0)
# If the share of pixels at the black point is in this range, the others give the noise.
_CUT_SHARE = (0.2, 0.985)
_STAR_NOISE = 4.5
_FLAT_EXCESS = 0.3  # a smoothed image with less than this of the white noise is flat, not noisy
_MAX_EXCESS = 10.0
# Noise is white up to the first; the background has structure beyond the second.
_WHITE_EXCESS, _CLOUD_EXCESS = 1.3, 1.6
_HOT_NOISE = 4.0
# A hot pixel's neighbours have less than this part of the light that a star would give them.
_HOT_PART = 0.25
# The median of a star's 8 neighbours is more than this part of its brightest pixel, if its spot is
# wider than 0.6 px; the median of a hot pixel is not, even if some neighbours are hot too.
_HOT_MEDIAN_PART, _HOT_ROUNDS = 0.15, 3


@dataclass(frozen=True)
class SkyLevels:
    """An image and its background."""

    raw: Grey  # shape (height, width): grey values; 0 in pixels that are left out
    above: Grey  # shape (height, width): the same above the background
    noise: Grey  # shape (height, width): standard deviation of the background, grey values
    # shape (height, width): pixels left out, because their values are not finite
    mask: Mask
    # whether filtered pixels have more noise than filtered white noise: coarse digits, a
    # clipped background, JPEG, clouds
    is_rough: bool = False
    # whether there is next to no noise: compression turned it into steps
    is_flat: bool = False
    box_px: int = _BOX_PX  # side of the boxes in which the background was found
    # noise after smoothing by a pixel, over the noise of white noise smoothed alike
    excess: float = 1.0


def load_sep() -> Any:
    """Return the library that measures stars, Source Extractor's."""
    try:
        return importlib.import_module("sep")
    except ImportError as error:
        raise ConfigError(
            f"finding stars in an image needs the package sep ({error})",
            hint=install_command("images"),
        ) from error


def subtract_background(image: ArrayLike) -> SkyLevels:
    """Subtract the background of an image."""
    values = np.asarray(image)
    if values.ndim != 2 or min(values.shape) < SMALLEST_PX or values.dtype.kind not in "buif":
        raise ConfigError(
            f"image of shape {values.shape} and type {values.dtype}; expected grey values in two "
            f"dimensions, each of {SMALLEST_PX} px or more"
        )
    with np.errstate(over="ignore"):
        raw = np.ascontiguousarray(values, dtype=np.float32)
    mask = np.isfinite(raw)
    np.logical_not(mask, out=mask)
    if mask.all():
        raise ConfigError("the image has no finite value; expected grey values")
    if mask.any():
        raw = np.where(mask, np.float32(0.0), raw)
    return _leveled(raw, mask)


def unmasked(values: Grey, mask: Mask) -> Grey:
    """Return the values of the pixels that are not left out; the array itself if it has no other.

    An image of a large camera fills a large part of the memory of a request, so it is copied only
    if necessary.
    """
    return values[~mask] if mask.any() else values.reshape(-1)


def _leveled(raw: Grey, mask: Mask) -> SkyLevels:
    """Return levels with boxes as large as the structure of the background allows."""
    least = _least_noise(unmasked(raw, mask))
    levels = _in_boxes(raw, raw, mask, least, _BOX_PX)
    excess = _excess(levels)
    if max(excess) < _FLAT_EXCESS:
        # Compression removed the noise and left steps that are not light.
        noise = np.maximum(levels.noise, _step(unmasked(raw, mask)))
        return replace(levels, noise=noise, is_flat=True)
    if max(excess) < _WHITE_EXCESS:
        return levels  # white noise, as far as a few boxes show
    # The mode of coarse digits is a digit; after smoothing, the mode is near the mean.
    smooth = scipy.ndimage.gaussian_filter(raw, 1.0, mode="nearest", truncate=3.0)
    for box in _BOXES_PX:
        del levels  # before the next ones take the same memory again
        levels = _in_boxes(raw, smooth, mask, least, box)
        fine, coarse = _excess(levels)
        if coarse < _CLOUD_EXCESS * fine:
            break
    return replace(levels, is_rough=True, excess=float(np.clip(fine, 1.0, _MAX_EXCESS)))


def _in_boxes(raw: Grey, shown: Grey, mask: Mask, least: np.float32, box: int) -> SkyLevels:
    height, width = raw.shape
    sep = load_sep()
    background = sep.Background(shown, mask=mask, bw=min(box, width), bh=min(box, height))
    above = background.back(dtype=np.float32)
    np.subtract(raw, above, out=above)
    above[mask] = 0.0
    noise = background.rms(dtype=np.float32)
    if shown is not raw:
        noise *= np.float32(np.sqrt(4.0 * np.pi) * 1.0)  # as before the smoothing of white noise
    np.maximum(noise, least, out=noise)
    return SkyLevels(raw, above, noise, mask, box_px=box)


def _excess(levels: SkyLevels) -> tuple[float, float]:
    """Return the noise of smoothed pixels over the noise of smoothed white noise, for two widths.

    A sample of boxes represents the image, and of them the boxes with less noise. Stars are left
    out; if nothing else is left, the noise is infinite.
    """
    boxes = _sample(levels)
    fine, coarse = _EXCESS_SIGMA_PX
    smooth = _smooth_boxes(boxes, fine)
    star = scipy.ndimage.maximum_filter(np.abs(smooth), (1, 9, 9)) > _STAR_NOISE * _white(fine)
    sky = star.mean(axis=(1, 2)) < 0.5
    if not sky.any():
        return 1.0, np.inf
    smoother = _smooth_boxes(np.where(star, 0.0, boxes), coarse)
    return (
        float(np.quantile(_spread(smooth, star)[sky], 0.25)) / _white(fine),
        float(np.quantile(_spread(smoother, star)[sky], 0.25)) / _white(coarse),
    )


def _white(sigma: float) -> float:
    return float(1.0 / (np.sqrt(4.0 * np.pi) * sigma))


def _smooth_boxes(boxes: NDArray[Any], sigma: float) -> NDArray[np.float32]:
    smooth = scipy.ndimage.gaussian_filter(boxes, (0.0, sigma, sigma), mode="reflect", truncate=3.0)
    return np.asarray(smooth, dtype=np.float32)


def _spread(boxes: NDArray[np.float32], left_out: Mask) -> Array:
    return np.asarray(np.ma.masked_array(boxes, left_out).std(axis=(1, 2)).filled(np.inf))


def _sample(levels: SkyLevels) -> NDArray[np.float32]:
    """Return squares from all over the image, in units of the noise."""
    height, width = levels.raw.shape
    side = min(_SAMPLE_PX, height, width)
    tops, lefts = (
        np.unique(np.linspace(0, length - side, _SAMPLES).astype(np.int64))
        for length in (height, width)
    )
    return np.stack(
        [
            levels.above[top : top + side, left : left + side]
            / levels.noise[top : top + side, left : left + side]
            for top in tops
            for left in lefts
        ]
    )


def _least_noise(values: Grey) -> np.float32:
    """Return the least noise there can be: a clipped background seems to have none at all."""
    lowest, highest = float(values.min()), float(values.max())
    digits = 1e-6 * max(abs(lowest), abs(highest))
    steps = float(_step(values)) * PIXEL_VARIANCE**0.5
    return np.float32(max(steps, 1e-5 * (highest - lowest), digits, _noise_above_black(values)))


def _step(values: Grey) -> np.float32:
    """Return the step of whole numbers, 0 of others; it is found in some of the values."""
    some = np.unique(values[:: max(values.size // 50_000, 1)])
    if not (some == np.rint(some)).all():
        return np.float32(0.0)
    return np.float32(np.diff(some).min() if len(some) > 1 else 1.0)


def _noise_above_black(values: Grey) -> float:
    """Return the noise of a background that lies mostly below the black point; else 0.

    The share of values that are cut, and the share above one other value, give the standard
    deviation of a Gaussian. If hardly any of the noise is left, the rest can be stars.
    """
    black = float(values.min())
    cut = float((values == black).mean())
    if not _CUT_SHARE[0] < cut < _CUT_SHARE[1]:
        return 0.0
    above_black = values[values > black]
    value = np.quantile(above_black, 0.6, method="lower")
    beyond = (1.0 - cut) * float((above_black > value).mean())
    if not beyond:
        return 0.0
    return float((value - black) / (scipy.special.ndtri(1.0 - beyond) - scipy.special.ndtri(cut)))


def repair_hot_pixels(levels: SkyLevels, psf_sigma_px: float) -> SkyLevels:
    """Replace single bright pixels by the mean of their neighbours."""
    centre, square = (
        scipy.special.erf(half / (np.sqrt(2.0) * psf_sigma_px)) ** 2 for half in (0.5, 1.5)
    )
    y, x = _bright_pixels(levels)
    around = pixels_around(levels.above, x, y).astype(np.float64)
    pixel = around[:, 1, 1]
    neighbours = around.sum(axis=(1, 2)) - pixel
    hot = neighbours < _HOT_PART * (square / centre - 1.0) * pixel
    if not hot.any():
        return levels
    above = levels.above.copy()
    above[y[hot], x[hot]] = neighbours[hot] / 8.0
    return replace(levels, above=above)


def mask_hot_pixels(levels: SkyLevels) -> SkyLevels:
    """Replace bright pixels among dark ones by the median of those, clusters of them included.

    Many hot pixels look like noise, so the background is measured again without them. Stars whose
    light falls on one pixel are lost: use this only for images that have no answer otherwise.
    """
    for _ in range(_HOT_ROUNDS):
        y, x = _bright_pixels(levels)
        around = pixels_around(levels.above, x, y).reshape(-1, 9)
        neighbours = np.median(np.delete(around, 4, axis=1), axis=1)
        hot = neighbours < _HOT_MEDIAN_PART * around[:, 4]
        raw, mask = levels.raw.copy(), levels.mask
        raw[y[hot], x[hot]] += neighbours[hot] - around[hot, 4]
        del levels  # before the next ones take the same memory again
        levels = _leveled(raw, mask)
    return levels


def _bright_pixels(levels: SkyLevels) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return rows and columns of the pixels that can be hot, found row by row to save memory."""
    is_bright = np.empty(levels.above.shape, dtype=np.bool_)
    for above, noise, row in zip(levels.above, levels.noise, is_bright, strict=True):
        np.greater(above, _HOT_NOISE * noise, out=row)
    y, x = np.nonzero(is_bright)
    return y, x


def pixels_around(
    image: Grey, x: NDArray[np.int64], y: NDArray[np.int64], reach_px: int = 1
) -> Grey:
    """Return the square of pixels around each place of an image, 3 by 3 by default.

    Pixels outside of the image are 0. The image is not padded for them: that would copy it.
    """
    height, width = image.shape
    steps = np.arange(-reach_px, reach_px + 1)
    rows, columns = y[:, None] + steps, x[:, None] + steps
    is_row, is_column = (rows >= 0) & (rows < height), (columns >= 0) & (columns < width)
    rows, columns = np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)
    around = np.asarray(image[rows[:, :, None], columns[:, None, :]])
    around[~(is_row[:, :, None] & is_column[:, None, :])] = 0.0
    return around
