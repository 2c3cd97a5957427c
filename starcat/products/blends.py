"""Blends: where a centroid settles when other stars are in its window, and with how much light.

Input are neighbours around stars as offsets and ratios of light, output are the offset of the
windowed centroid and the light of its aperture, for Gaussian spots. The widths are those of our
own centroiding (`starcat.images.centroiding`), which takes them from here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from starcat.arrays import Array, Mask, Rows

PIXEL_VARIANCE = 1.0 / 12.0
"""What a square pixel adds to the variance of a spot, and rounding to whole numbers to noise."""

NARROWEST_WINDOW_PX = 1.0
"""A narrower window follows the pixel grid (docs/decisions.md)."""

APERTURE_SIGMA = 2.0
"""Radius of the circle that brightness is measured in, standard deviations of the spot."""

_REACH = 6.0  # of a star 10 mag brighter at so many widths a thousandth of a width is left
_STEP = 1e-6  # widths; a shorter step is the last one
_MOST_STEPS = 200  # only two equal stars that are just one spot need more


_PARTED = (2.75, 0.61)
"""Two equal stars are found apart from so many widths of a smoothed spot on, and from so many more
for each magnitude that one is fainter: measured of our own detection (docs/algorithms.md)."""


@dataclass(frozen=True)
class Widths:
    """Standard deviations of a spot and of the window around it; all in pixels or in an angle."""

    spot: float  # of the spot as the pixels show it
    window: float  # of the Gaussian that weights the pixels of a centroid
    smoothed: float  # of the spot in the filtered image that stars are found in

    @property
    def both(self) -> float:
        """Standard deviation of a spot seen through the window."""
        return float(np.hypot(self.spot, self.window))

    @property
    def reach(self) -> float:
        """How far a star may be to count."""
        return _REACH * self.both

    def times(self, scale: float) -> Widths:
        """Return the same widths in another unit."""
        return Widths(self.spot * scale, self.window * scale, self.smoothed * scale)


def widths_px(psf_sigma_px: float, window_px: float | None = None) -> Widths:
    """Return the widths for a spot that pixels sample; the window is that of our centroiding.

    >>> widths_px(1.0).window == widths_px(1.0).spot, widths_px(0.5).window
    (True, 1.0)
    """
    spot = float(np.sqrt(psf_sigma_px**2 + PIXEL_VARIANCE))
    window = max(spot, NARROWEST_WINDOW_PX) if window_px is None else window_px
    return Widths(spot, window, float(np.hypot(spot, psf_sigma_px)))


@dataclass(frozen=True)
class Blends:
    """What neighbours do to the spots of N stars."""

    offset: Array  # shape (N, 2): of the centroid from the star, in the unit of the widths
    brightening: Array  # shape (N,): light in the aperture over that of the star alone
    contamination: Array  # shape (N,): share of the light in the aperture that is of other stars
    is_lost: (
        Mask  # shape (N,): not found beside a brighter star, so that its centroid is that one's
    )


def blends(
    count: int, star: Rows, offset: Array, light: Array, is_brighter: Mask, widths: Widths
) -> Blends:
    """Return where the centroids of stars settle among their neighbours.

    A Gaussian spot at ``d`` from the middle of a Gaussian window has there the moment
    ``f d exp(-d^2 / 2 (s^2 + w^2))``, but for a factor that is the same for all spots. The
    centroid is where the moments of the star and its neighbours add up to nothing: at a maximum
    of the image smoothed by the window. It is looked for uphill from the star itself, or from the
    brightest neighbour that it is not told apart from, by steps to the mean of the places weighted
    by ``f exp(...)``. The aperture's share of a spot is that of the noncentral chi-squared
    distribution.

    Parameters
    ----------
    count : int
        Number of stars, N.
    star : ndarray of int64, shape (M,)
        The star of each neighbour, 0 to N - 1.
    offset : ndarray of float64, shape (M, 2)
        Place of each neighbour from its star, in the unit of ``widths``.
    light : ndarray of float64, shape (M,)
        Light of each neighbour over that of its star.
    is_brighter : ndarray of bool, shape (M,)
        Whether the neighbour is the brighter of the two; of equal stars one is.
    widths : Widths
        Of the spots and of the window.

    References
    ----------
    Fukunaga and Hostetler 1975, IEEE Transactions on Information Theory 21 (1), 32-40.
    """
    start, is_lost = _starts(count, star, offset, light, is_brighter, widths)
    star, offset, light = _with_the_stars(count, star, offset, light)
    centroid = _settled(start, star, offset, light, widths.both)
    apart = np.sum(((offset - centroid[star]) / widths.spot) ** 2, axis=1)
    alone = -np.expm1(-0.5 * APERTURE_SIGMA**2)
    part = light * scipy.special.chndtr(APERTURE_SIGMA**2, 2.0, apart) / alone
    total = np.bincount(star, part, count).astype(np.float64)  # whole numbers of no stars
    own = part[:count]  # the stars themselves are first
    return Blends(centroid, total, 1.0 - own / total, is_lost)


def _starts(
    count: int, star: Rows, offset: Array, light: Array, is_brighter: Mask, widths: Widths
) -> tuple[Array, Mask]:
    """Return where the centroiding of each star begins, and whether that is at another star."""
    start, is_lost = np.zeros((count, 2)), np.zeros(count, dtype=bool)
    equal, for_each_mag = _PARTED
    rows = np.flatnonzero(is_brighter)
    limit = equal + for_each_mag * 2.5 * np.log10(np.maximum(light[rows], 1.0))
    rows = rows[np.hypot(*offset[rows].T) < limit * widths.smoothed]
    rows = rows[np.argsort(light[rows], kind="stable")]  # the brightest is last, and stays
    start[star[rows]], is_lost[star[rows]] = offset[rows], True
    return start, is_lost


def _with_the_stars(
    count: int, star: Rows, offset: Array, light: Array
) -> tuple[NDArray[np.int64], Array, Array]:
    own = np.arange(count)
    return (
        np.concatenate([own, star]),
        np.concatenate([np.zeros((count, 2)), offset]),
        np.concatenate([np.ones(count), light]),
    )


def _settled(start: Array, star: Rows, offset: Array, light: Array, width: float) -> Array:
    """Return where steps uphill end."""
    count, centroid = len(start), start.copy()
    moving = np.bincount(star, minlength=count) > 1
    rows = np.arange(len(star))
    for _ in range(_MOST_STEPS):
        rows, now = rows[moving[star[rows]]], np.flatnonzero(moving)
        of, place = star[rows], offset[rows]
        apart = np.sum(((place - centroid[of]) / width) ** 2, axis=1)
        weight = light[rows] * np.exp(-0.5 * apart)
        moment = [np.bincount(of, weight * place[:, axis], count) for axis in (0, 1)]
        mean = np.stack(moment, axis=1)[now] / np.bincount(of, weight, count)[now, None]
        moving[now] = np.hypot(*(mean - centroid[now]).T) > _STEP * width
        centroid[now] = mean
    return centroid
