"""What is done to a picture before stars are looked for: dark frame, dead zones, colour mosaic.

Input are arrays of grey values of one size, output is another one.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve1d

from starcat.errors import ConfigError

_BINOMIAL = np.array([0.25, 0.5, 0.25])


def without_dark(image: NDArray[Any], dark: NDArray[Any]) -> NDArray[Any]:
    """Return an image without the dark current of its pixels."""
    _check_size(image, dark, "dark frame")
    return np.asarray(np.asarray(image, dtype=np.float64) - dark)


def without_dead_zones(image: NDArray[Any], mask: NDArray[Any]) -> NDArray[Any]:
    """Return an image in which dead pixels have no value."""
    _check_size(image, mask, "mask")
    is_dead = np.asarray(mask) != 0
    if is_dead.all():
        raise ConfigError("the mask leaves no pixel; expected zeros where stars are looked for")
    return np.asarray(np.where(is_dead, np.nan, image), dtype=np.float64)


def grey_of_mosaic(image: NDArray[Any]) -> NDArray[Any]:
    """Return the light of a mosaic of colour filters, at the mosaic's own resolution."""
    grey = np.asarray(image, dtype=np.float64)
    for axis in (0, 1):
        grey = convolve1d(grey, _BINOMIAL, axis=axis, mode="mirror")
    return np.asarray(grey)


def _check_size(image: NDArray[Any], other: NDArray[Any], what: str) -> None:
    if image.shape != other.shape:
        (height, width), (tall, wide) = image.shape, other.shape
        raise ConfigError(
            f"the {what} has {wide} x {tall} px, the image {width} x {height}; expected the same"
        )
