"""What stands above the background of a star image, and the noise that it stands in.

Input is a grey image, output is a `Levels`. Background and noise vary slowly over the image, and
single hot pixels can be taken out. What is a star is not decided here.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import erf

from starcat.errors import ConfigError
from starcat.version import install_command

Grey = NDArray[np.float32]

SMALLEST_PX = 16
"""Narrowest image in which a background can be told from stars."""
PIXEL_VARIANCE = 1.0 / 12.0
"""What a square pixel adds to the variance of a spot, and rounding to whole numbers to noise."""
_BOX_PX = 64
_HOT_NOISE = 4.0
_HOT_PART = 0.25
"""A hot pixel's neighbours have less than this part of the light that a star would give them."""


@dataclass(frozen=True)
class Levels:
    """An image and its background.

    Attributes
    ----------
    raw : ndarray of float32, shape (height, width)
        Grey values; 0 where they are left out.
    above : ndarray of float32, shape (height, width)
        The same above the background.
    noise : ndarray of float32, shape (height, width)
        Standard deviation of the background, grey values.
    mask : ndarray of bool, shape (height, width)
        Pixels left out, because their values are not finite.
    """

    raw: Grey
    above: Grey
    noise: Grey
    mask: NDArray[np.bool_]


def load_sep() -> Any:
    """Return the library that measures stars, Source Extractor's.

    Returns
    -------
    module
        ``sep``.

    Raises
    ------
    ConfigError
        If it is not installed.
    """
    try:
        return importlib.import_module("sep")
    except ImportError as error:
        raise ConfigError(
            f"finding stars in an image needs the package sep ({error}); "
            f"{install_command('images')}"
        ) from error


def subtract_background(image: ArrayLike) -> Levels:
    """Take the background off an image.

    Parameters
    ----------
    image : array_like, shape (height, width)
        Grey values.

    Returns
    -------
    Levels
        The background is the mode of boxes of 64 px, smoothed over three by three boxes and
        joined by splines.

    Raises
    ------
    ConfigError
        If sep is not installed, or the image is not 2-D, too small or without a finite value.
    """
    sep = load_sep()
    values = np.asarray(image)
    if values.ndim != 2 or min(values.shape) < SMALLEST_PX or values.dtype.kind not in "buif":
        raise ConfigError(
            f"image of shape {values.shape} and type {values.dtype}; expected grey values in two "
            f"dimensions, each of {SMALLEST_PX} px or more"
        )
    with np.errstate(over="ignore"):
        raw = np.array(values, dtype=np.float32, order="C")
    mask = ~np.isfinite(raw)
    if mask.all():
        raise ConfigError("the image has no finite value; expected grey values")
    raw[mask] = 0.0
    height, width = raw.shape
    box = {"bw": min(_BOX_PX, width), "bh": min(_BOX_PX, height)}
    background = sep.Background(raw, mask=mask, **box)
    above = raw - background.back(dtype=np.float32)
    above[mask] = 0.0
    noise = np.maximum(background.rms(dtype=np.float32), _least_noise(raw[~mask]))
    return Levels(raw, above, noise, mask)


def _least_noise(values: Grey) -> np.float32:
    """Return the least noise there can be: a clipped background seems to have none at all."""
    rounded = bool((values == np.rint(values)).all())
    lowest, highest = float(values.min()), float(values.max())
    digits = 1e-6 * max(abs(lowest), abs(highest))
    return np.float32(max(rounded * PIXEL_VARIANCE**0.5, 1e-5 * (highest - lowest), digits))


def repair_hot_pixels(levels: Levels, psf_sigma_px: float) -> Levels:
    """Replace single bright pixels by the mean of their neighbours.

    Parameters
    ----------
    levels : Levels
        An image above its background.
    psf_sigma_px : float
        Standard deviation of a star's spot: a pixel is hot if its neighbours have less than a
        quarter of the light that they would have beside the middle of a star.

    Returns
    -------
    Levels
        The same levels with another ``above``; ``raw`` stays.
    """
    centre, square = (erf(half / (np.sqrt(2.0) * psf_sigma_px)) ** 2 for half in (0.5, 1.5))
    y, x = np.nonzero(levels.above > _HOT_NOISE * levels.noise)
    around = pixels_around(levels.above, x, y).astype(np.float64)
    pixel = around[:, 1, 1]
    neighbours = around.sum(axis=(1, 2)) - pixel
    hot = neighbours < _HOT_PART * (square / centre - 1.0) * pixel
    above = levels.above.copy()
    above[y[hot], x[hot]] = neighbours[hot] / 8.0
    return replace(levels, above=above)


def pixels_around(image: Grey, x: NDArray[np.int64], y: NDArray[np.int64]) -> Grey:
    """Return the 3 by 3 pixels around places of an image.

    Parameters
    ----------
    image : ndarray of float32, shape (height, width)
        Grey values.
    x, y : ndarray of int64, shape (N,)
        Columns and rows.

    Returns
    -------
    ndarray of float32, shape (N, 3, 3)
        0 outside of the image.
    """
    steps = np.arange(3)
    return np.asarray(np.pad(image, 1)[y[:, None, None] + steps[:, None], x[:, None, None] + steps])
