"""How an image is shown: grey values from the noise to the brightest stars at one glance."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array

_LONG_SIDE_PX = 900


def stretch(image: NDArray[Any]) -> Array:
    """Return an image as it is shown."""
    values = _brightest(np.where(np.isfinite(image), image, np.nan).astype(np.float64))
    finite = values[np.isfinite(values)]
    if not finite.size:
        return np.zeros(values.shape)
    middle = float(np.median(finite))
    noise = 1.4826 * float(np.median(np.abs(finite - middle)))
    # An image without noise still has a black point and a white one.
    noise = max(noise, 1e-6 * float(np.abs(finite).max()), 1e-300)
    top = max(float(np.quantile(finite, 0.9998)), middle + 50.0 * noise)
    low, unit = middle - 0.5 * noise, 8.0 * noise
    shown = np.arcsinh((np.nan_to_num(values, nan=low) - low) / unit)
    return np.asarray(np.clip(shown / np.arcsinh((top - low) / unit), 0.0, 1.0))


def _brightest(values: Array) -> Array:
    """Return the brightest of each block of pixels, blocks of one pixel if the image is small."""
    step = max(max(values.shape) // _LONG_SIDE_PX, 1)
    rows, columns = (-(-length // step) for length in values.shape)
    padded = np.full((rows * step, columns * step), np.nan)
    padded[: values.shape[0], : values.shape[1]] = values
    blocks = padded.reshape(rows, step, columns, step)
    return np.asarray(np.fmax.reduce(np.fmax.reduce(blocks, axis=3), axis=1))
