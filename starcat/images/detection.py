"""Where light stands out of an image: places that may be stars, by a filter of a star's shape.

Input is an image above its background, output is sep's table of objects. What is a star and where
exactly it stands is not decided here.
"""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve1d

from starcat.arrays import Array, Mask
from starcat.errors import ConfigError
from starcat.images.background import Levels, load_sep

_log = logging.getLogger(__name__)

# Pixels above the threshold that sep is given room for: so many, and this part of the image.
_ROOM, _ROOM_SHARE = 300_000, 0.3
_MOST_PARTS = 4096  # parts that sep may divide an object into: a Moon with its glow has thousands
# The threshold is raised by this factor, so many times, where the room does not do.
_RAISE, _TRIES = 1.5, 4
_FEWEST, _MOST = 5, 30
_LONG = 2.5  # length over width from which a spot is long, by standard deviations along its axes
_ALIGNED = 0.9  # length of the mean of unit vectors with twice the angle: 1 if all are parallel


def detect(levels: Levels, sigma: float, threshold: float) -> NDArray[Any]:
    """Return what stands out after smoothing with a star's shape.

    Where noise is white, its part that is left by the filter is known. Where it is not
    (`Levels.is_rough`: coarse digits, a clipped background, JPEG, clouds), the noise is measured
    in the filtered image.
    """
    reach = np.arange(-int(np.ceil(2.5 * sigma)), int(np.ceil(2.5 * sigma)) + 1)
    profile = np.exp(-0.5 * (reach / sigma) ** 2)
    profile /= profile.sum()
    kernel: Array | None = np.outer(profile, profile)
    image, noise, least = levels.above, levels.noise, threshold * float((profile**2).sum())
    if levels.is_rough:
        image, noise = _filtered(levels, profile)
        least, kernel = threshold, None
    for attempt in range(_TRIES):
        try:
            return _extract(image, least * _RAISE**attempt, noise, levels.mask, kernel)
        except Exception as error:  # sep raises nothing more special when a buffer is full
            _log.info("at %.3g sigma: %s", threshold * _RAISE**attempt, error)
    raise ConfigError(
        f"the image has too much in it to tell stars from the sky: even at "
        f"{threshold * _RAISE ** (_TRIES - 1):.1f} times the noise too many pixels stand out; "
        "check that it is a star image, state how wide a star is (--psf-sigma-px 1.5) or raise "
        f"the threshold further (--threshold {np.ceil(threshold * _RAISE**_TRIES):.0f})"
    )


def _extract(
    image: NDArray[np.float32],
    least: float,
    noise: NDArray[np.float32],
    mask: Mask,
    kernel: Array | None,
) -> NDArray[Any]:
    """Call sep.

    Filter "conv" with the threshold in units of the smoothed noise, and no cleaning: sep's
    matched filter followed by its cleaning loses real stars (docs/decisions.md).
    """
    sep = load_sep()
    before = sep.get_extract_pixstack(), sep.get_sub_object_limit()
    sep.set_extract_pixstack(_ROOM + int(_ROOM_SHARE * image.size))
    sep.set_sub_object_limit(_MOST_PARTS)
    try:
        return np.asarray(
            sep.extract(
                image, least, err=noise, mask=mask, minarea=1, clean=False,
                filter_kernel=kernel, filter_type="conv",
            )
        )  # fmt: skip
    finally:
        sep.set_extract_pixstack(before[0])
        sep.set_sub_object_limit(before[1])


def _filtered(levels: Levels, profile: Array) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the filtered image above its own background, and its own noise."""
    image = convolve1d(levels.above, profile, axis=0, mode="nearest")
    image = convolve1d(image, profile, axis=1, mode="nearest")
    box = {"bw": min(levels.box_px, image.shape[1]), "bh": min(levels.box_px, image.shape[0])}
    background = load_sep().Background(image, mask=levels.mask, **box)
    known = levels.noise * np.float32((profile**2).sum())
    noise = np.maximum(background.rms(dtype=np.float32), known)
    return image - background.back(dtype=np.float32), noise


def trail_px(found: NDArray[Any]) -> float | None:
    """Return the length of trails."""
    bright = found[np.argsort(-found["flux"], kind="stable")[:_MOST]]
    if len(bright) < _FEWEST:
        return None
    long, wide = bright["a"].astype(np.float64), bright["b"].astype(np.float64)
    is_long = long > _LONG * np.maximum(wide, 0.3)
    if is_long.mean() <= 0.5:
        return None
    if abs(np.exp(2j * bright["theta"][is_long].astype(np.float64)).mean()) < _ALIGNED:
        return None
    # The variance of a bar along itself is a twelfth of its length squared.
    return float(np.median(np.sqrt(12.0 * (long**2 - wide**2)[is_long])))
