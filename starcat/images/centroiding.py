"""Spots of light in an image: found above the background and measured with sub-pixel accuracy.

Input is one grey image, output are centroids and brightness, brightest first. Background,
detection, windowed centroids and apertures are those of sep, Source Extractor as a library,
which the extra ``images`` brings. Trails are detected and refused; blooming is not handled.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from starcat.arrays import Array, Mask, Pixels
from starcat.errors import ConfigError
from starcat.images.background import (
    PIXEL_VARIANCE,
    Levels,
    load_sep,
    pixels_around,
    repair_hot_pixels,
    subtract_background,
)
from starcat.images.detection import detect, trail_px
from starcat.images.spot_width import SIGMA_RANGE_PX, is_sharp, sigma_of_stars

_NARROWEST_WINDOW_PX = 1.0  # a narrower window follows the pixel grid (docs/decisions.md)
_APERTURE_SIGMA = 2.0
# A plateau: pixels that differ by no more than read noise, and by half a per cent.
_PLATEAU_NOISE, _PLATEAU_DEPTH, _PLATEAU_PIXELS = 6.0, 0.005, 3


@dataclass(frozen=True)
class Spots:
    """What was found in one image, brightest first."""

    # shape (N, 2): pixels (x right, y down, origin at the outer corner of the top-left pixel)
    centroids_px: Pixels
    flux: Array  # shape (N,): light above the background, in the units of the image
    mag: Array  # shape (N,): instrumental magnitude, -2.5 log10 flux: its zero point is unknown
    psf_sigma_px: float  # standard deviation of a star's spot before the pixels sample it

    def __len__(self) -> int:
        """Return the number of spots."""
        return len(self.flux)


def find_spots(
    image: ArrayLike,
    *,
    threshold_sigma: float = 5.0,
    psf_sigma_px: float | None = None,
    most_spots: int | None = None,
) -> Spots:
    """Find the spots of an image and measure them.

    Bertin and Arnouts 1996, A&AS 117, 393. Barbary 2016, JOSS 1 (6), 58.
    """
    given = {"threshold_sigma": threshold_sigma, "psf_sigma_px": psf_sigma_px}
    for name, value in {**given, "most_spots": most_spots}.items():
        if value is not None and not 0.0 < value < np.inf:
            text = f"{name} is {value}; expected a positive number"
            raise ConfigError(text, key=name, value=value)
    levels = subtract_background(image)
    sigma = psf_sigma_px
    if sigma is None:
        levels = repair_hot_pixels(levels, SIGMA_RANGE_PX[0])
        first = detect(levels, 1.0, threshold_sigma)
        first = first[~_is_saturated(levels, first)]
        _refuse_trails(first)
        sigma = sigma_of_stars(levels, np.stack([first["x"], first["y"]], axis=1), first["peak"])
    levels = repair_hot_pixels(levels, sigma)
    found = detect(levels, float(sigma), threshold_sigma)
    if psf_sigma_px is None:
        places = np.stack([found["x"], found["y"]], axis=1)
        found = found[~is_sharp(levels, places, float(sigma))]
    return _measured(levels, found, float(sigma), most_spots)


def _refuse_trails(found: NDArray[Any]) -> None:
    length = trail_px(found)
    if length is not None:
        raise ConfigError(
            f"the stars are trails of {length:.0f} px in one direction, whose ends are not known "
            "to a pixel; expose shorter or follow the sky, or state the width of a star "
            "(--psf-sigma-px 1.5) to measure the middles all the same"
        )


def _measured(levels: Levels, found: NDArray[Any], sigma: float, most: int | None) -> Spots:
    seen = float(np.sqrt(sigma**2 + PIXEL_VARIANCE))
    centroids = _windowed(levels, found, max(seen, _NARROWEST_WINDOW_PX))
    x, y = (centroids - 0.5).T
    radius = _APERTURE_SIGMA * seen
    part, _, _ = load_sep().sum_circle(levels.above, x, y, radius, mask=levels.mask, subpix=0)
    flux = part / (1.0 - np.exp(-0.5 * _APERTURE_SIGMA**2))
    order = brightest_first(flux, centroids)[: np.count_nonzero(flux > 0.0)][:most]
    return Spots(centroids[order], flux[order], -2.5 * np.log10(flux[order]), sigma)


def brightest_first(flux: Array, centroids_px: Pixels) -> NDArray[np.int64]:
    """Return the order of spots."""
    return np.lexsort((centroids_px[:, 1], centroids_px[:, 0], -flux))


def _is_saturated(levels: Levels, found: NDArray[Any]) -> Mask:
    """Return which spots have a plateau at the image's maximum."""
    around = pixels_around(levels.raw, found["xpeak"], found["ypeak"])
    read_noise = _PLATEAU_NOISE * float(np.median(levels.noise))
    depth = min(read_noise, _PLATEAU_DEPTH * float(levels.above.max()))
    at_limit = around >= float(levels.raw[~levels.mask].max()) - depth
    return np.asarray(at_limit.sum(axis=(1, 2)) >= _PLATEAU_PIXELS)


def _windowed(levels: Levels, found: NDArray[Any], window: float) -> Array:
    """Return windowed centroids; barycentres where a window drifts to the spot beside it."""
    start = np.stack([found["x"], found["y"]], axis=1)
    x, y, _ = load_sep().winpos(levels.above, *start.T, window, mask=levels.mask, subpix=0)
    centroids = np.stack([x, y], axis=1)
    is_blended = (found["flag"] & load_sep().OBJ_MERGED) > 0
    drifts = is_blended & (np.hypot(*(centroids - start).T) > 0.5 * window)
    # sep counts from the centre of the first pixel.
    return np.asarray(np.where(drifts[:, None], start, centroids) + 0.5, dtype=np.float64)
