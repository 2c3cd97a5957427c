"""Blends: where a centroid settles when other stars are in its window, and with how much light.

The input is the neighbours of stars, as offsets and ratios of light. The output is the offset of
the centroid and the light that is measured with it, for Gaussian spots. The centroid is computed in
a Gaussian window or as the centre of mass of a box of pixels. The widths of the window are defined
here and used by our own centroiding (`starcat.frames.images.centroiding`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from starcat.arrays import Array, Mask, Rows

PIXEL_VARIANCE = 1.0 / 12.0
"""Variance that a square pixel adds to a spot, and that rounding to whole numbers adds to noise."""

NARROWEST_WINDOW_PX = 1.0
"""A narrower window follows the pixel grid (docs/decisions.md)."""

APERTURE_SIGMA = 2.0
"""Radius of the circle that brightness is measured in, standard deviations of the spot."""

_REACH = 6.0  # widths; a star 10 mag brighter at this distance moves a spot by 0.001 widths
_STEP = 1e-6  # widths; a shorter step is the last one
_MAX_STEPS = 200  # only two equal stars that barely merge into a single spot need more


_PHASES = np.array([-0.4, -0.2, 0.0, 0.2, 0.4])
"""Places of a peak in its pixel, in pixels from the middle, that a box is averaged over."""

_PARTED = (2.75, 0.61)
"""Smallest distance at which two equal stars are detected as two, in widths of a smoothed spot, and
its growth per magnitude of difference: measured with our own detection (docs/algorithms.md)."""


@dataclass(frozen=True)
class Widths:
    """Standard deviations of a spot and of the window around it; all in pixels or in an angle."""

    spot: float  # the spot as the pixels show it
    window: float  # the Gaussian that weights the pixels of a centroid
    smoothed: float  # the spot in the filtered image in which stars are detected
    pixel: float = 1.0  # side of a pixel
    box_px: int | None = None  # pixels on a side of a box; None for the Gaussian window

    @property
    def both(self) -> float:
        """Standard deviation of a spot seen through the window."""
        return float(np.hypot(self.spot, self.window))

    @property
    def reach(self) -> float:
        """Largest distance of a star that is taken into account."""
        if self.box_px is not None:
            return _REACH * self.spot + 0.75 * (self.box_px + 1) * self.pixel
        return _REACH * self.both

    def times(self, scale: float) -> Widths:
        """Return the same widths in another unit."""
        return replace(
            self, spot=self.spot * scale, window=self.window * scale,
            smoothed=self.smoothed * scale, pixel=self.pixel * scale,
        )  # fmt: skip


def widths_px(
    psf_sigma_px: float, window_px: float | None = None, box_px: int | None = None
) -> Widths:
    """Return the widths for a spot that pixels sample, with the window of our centroiding.

    With ``box_px`` the centroid is the centre of mass in a box of that many pixels on a side.

    >>> widths_px(1.0).window == widths_px(1.0).spot, widths_px(0.5).window
    (True, 1.0)
    """
    spot = float(np.sqrt(psf_sigma_px**2 + PIXEL_VARIANCE))
    window = max(spot, NARROWEST_WINDOW_PX) if window_px is None else window_px
    return Widths(spot, window, float(np.hypot(spot, psf_sigma_px)), 1.0, box_px)


@dataclass(frozen=True)
class Blends:
    """The effect of neighbours on the spots of N stars."""

    offset: Array  # shape (N, 2): centroid minus star, in the unit of the widths
    # shape (N,): light in the aperture, or in the box, over the light of the star alone
    brightening: Array
    contamination: Array  # shape (N,): share of that light that other stars contribute
    is_lost: Mask  # shape (N,): not detected next to a brighter star, whose centroid it gets


def blends(
    count: int, star: Rows, offset: Array, light: Array, is_brighter: Mask, widths: Widths
) -> Blends:
    """Return where the centroids of stars settle among their neighbours.

    A Gaussian spot at ``d`` from the middle of a Gaussian window has there the moment
    ``f d exp(-d^2 / 2 (s^2 + w^2))``, up to a factor that is the same for all spots. At the
    centroid the moments of the star and its neighbours add up to zero: it is a maximum of the image
    smoothed by the window. The search goes uphill from the star itself, or from the brightest
    neighbour that it is not separated from, by steps to the mean of the places weighted by
    ``f exp(...)``. The aperture's share of a spot follows from the noncentral chi-squared
    distribution.

    With a box, `Widths.box_px`, the centroid is the centre of mass of the pixels in a box around
    the brightest pixel. This pixel contains the star's own maximum of light, or the maximum of the
    brightest neighbour that the star is not separated from. The place of that maximum in its pixel
    is not known: all places in the pixel are averaged.

    Parameters
    ----------
    count : int
        Number of stars, N.
    star : ndarray of int64, shape (M,)
        The star of each neighbour, 0 to N - 1.
    offset : ndarray of float64, shape (M, 2)
        Place of each neighbour from its star, in the unit of ``widths``.
    light : ndarray of float64, shape (M,)
        Light of each neighbour over the light of its star.
    is_brighter : ndarray of bool, shape (M,)
        Whether the neighbour is the brighter of the two; for equal stars, one of them is.
    widths : Widths
        Widths of the spots and of the window.

    References
    ----------
    Fukunaga and Hostetler 1975, IEEE Transactions on Information Theory 21 (1), 32-40.
    """
    start, is_lost = _starts(count, star, offset, light, is_brighter, widths)
    star, offset, light = _with_the_stars(count, star, offset, light)
    if widths.box_px is not None:
        return _boxed(_settled(start, star, offset, light, widths.spot), star, offset, light,
                      widths, is_lost)  # fmt: skip
    centroid = _settled(start, star, offset, light, widths.both)
    apart = np.sum(((offset - centroid[star]) / widths.spot) ** 2, axis=1)
    alone = -np.expm1(-0.5 * APERTURE_SIGMA**2)
    part = light * scipy.special.chndtr(APERTURE_SIGMA**2, 2.0, apart) / alone
    total = np.bincount(star, part, count).astype(np.float64)  # whole numbers of no stars
    star_part = part[:count]  # the stars themselves are first
    return Blends(centroid, total, 1.0 - star_part / total, is_lost)


def _boxed(
    peak: Array, star: Rows, offset: Array, light: Array, widths: Widths, is_lost: Mask
) -> Blends:
    """Return centres of mass in boxes around the pixels of peaks; the stars are the first rows."""
    count = len(peak)
    away = (offset - peak[star]) / widths.pixel
    nowhere = np.zeros((1, 2))
    (along, across), _ = _in_pixels(nowhere, nowhere, widths)
    own_light = float(np.mean(along) * np.mean(across))
    parts, moments = _in_pixels(away, _brightest_pixel(star, away, light, widths)[star], widths)
    moved, total, of_star = np.zeros((count, 2)), np.zeros(count), np.zeros(count)
    for i, j in np.ndindex(len(_PHASES), len(_PHASES)):
        seen = light * parts[0][i] * parts[1][j]
        whole = np.bincount(star, seen, count)
        for axis, weight in enumerate((moments[0][i] * parts[1][j], parts[0][i] * moments[1][j])):
            moved[:, axis] += np.bincount(star, light * weight, count) / whole
        total += whole
        of_star += seen[:count]
    cells = len(_PHASES) ** 2
    centroid = peak + moved / cells * widths.pixel
    return Blends(centroid, total / cells / own_light, 1.0 - of_star / total, is_lost)


def _brightest_pixel(star: Rows, away: Array, light: Array, widths: Widths) -> Array:
    """Return where the middle of the brightest pixel is on average, in pixels from the peak.

    A peak that falls off more slowly on one side is brightest in that side's pixel more often: the
    middles lie between two places one pixel apart where the light is the same. One step of Newton
    from half a pixel on both sides finds them.
    """
    spot_px = widths.spot / widths.pixel
    middle = np.zeros((int(star.max(initial=-1)) + 1, 2))
    for axis in (0, 1):
        heights, slopes = [], []
        for side in (-0.5, 0.5):
            beside = away.copy()
            beside[:, axis] -= side
            bright = light * np.exp(-0.5 * np.sum((beside / spot_px) ** 2, axis=1))
            heights.append(np.bincount(star, bright))
            slopes.append(np.bincount(star, bright * beside[:, axis]) / spot_px**2)
        curved = slopes[1] - slopes[0]
        step = np.where(curved < 0.0, (heights[0] - heights[1]) / np.minimum(curved, -1e-300), 0.0)
        middle[:, axis] = np.clip(step, -0.5, 0.5)
    return middle


def _in_pixels(away: Array, middle: Array, widths: Widths) -> tuple[Array, Array]:
    """Return parts of light in a box and their first moments about the peak, shape (2, P, M).

    The axes are x and y, the place of the box, and the star, whose distance from the peak is in
    pixels. The boxes are around pixels whose middles are spread over a pixel about ``middle``.
    """
    box_px = widths.box_px or 1
    spot_px = widths.spot / widths.pixel
    sigma = float(np.sqrt(max(spot_px**2 - PIXEL_VARIANCE, 1e-4)))
    edges = np.arange(box_px + 1) - 0.5 * box_px
    parts = np.zeros((2, len(_PHASES), len(away)))
    moments = np.zeros_like(parts)
    for phase, shift in enumerate(_PHASES):
        centre = middle + shift
        below = scipy.special.ndtr((edges[:, None, None] + centre - away) / sigma)
        part = np.diff(below, axis=0)
        whole = part.sum(axis=0)
        parts[:, phase] = whole.T
        moments[:, phase] = (np.tensordot(edges[:-1] + 0.5, part, axes=1) + centre * whole).T
    return parts, moments


def _starts(
    count: int, star: Rows, offset: Array, light: Array, is_brighter: Mask, widths: Widths
) -> tuple[Array, Mask]:
    """Return the start of the centroiding of each star, and whether that is another star."""
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
    stars = np.arange(count)
    return (
        np.concatenate([stars, star]),
        np.concatenate([np.zeros((count, 2)), offset]),
        np.concatenate([np.ones(count), light]),
    )


def _settled(start: Array, star: Rows, offset: Array, light: Array, width: float) -> Array:
    """Return the places where steps uphill end."""
    count, centroid = len(start), start.copy()
    moving = np.bincount(star, minlength=count) > 1
    rows = np.arange(len(star))
    for _ in range(_MAX_STEPS):
        rows, now = rows[moving[star[rows]]], np.flatnonzero(moving)
        of, position = star[rows], offset[rows]
        apart = np.sum(((position - centroid[of]) / width) ** 2, axis=1)
        weight = light[rows] * np.exp(-0.5 * apart)
        moment = [np.bincount(of, weight * position[:, axis], count) for axis in (0, 1)]
        mean = np.stack(moment, axis=1)[now] / np.bincount(of, weight, count)[now, None]
        moving[now] = np.hypot(*(mean - centroid[now]).T) > _STEP * width
        centroid[now] = mean
    return centroid
