"""How wide the stars of an image are: from many spots, most of which may be something else.

Input are an image above its background and places of light in it, output is one number, the
standard deviation of a star's spot before the pixels sample it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from starcat.arrays import Array, Mask
from starcat.images.background import SkyLevels, pixels_around

SIGMA_RANGE_PX = (0.3, 5.0)  # narrowest and widest spot that is looked for
_STEP = 1.15
_HALF_PX = 16  # a star is looked at this far to each side
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
    """Return each spot's light through Gaussians without mean, over the norm of those."""
    scores = np.empty(windows.shape)
    for number, sigma in enumerate(widths):
        half = np.minimum(np.ceil(windows[number]), _HALF_PX)
        size = int(half.max())
        reach = np.arange(-size, size + 1)
        inner = slice(_HALF_PX - size, _HALF_PX + size + 1)
        inside = (np.abs(reach) <= half[:, None]).astype(np.float64)
        edges = np.arange(-size, size + 2) - 0.5
        across, down = (
            inside * np.diff(0.5 * erf((edges - shift[:, axis, None]) / (np.sqrt(2) * sigma)))
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
    # Not of logarithms: clouds are wide, and no width of theirs is as frequent as a star's.
    near = np.abs(np.log(sigma / _densest(np.sort(sigma)))) < np.log(1.35)
    # Of two or three widths that differ none is near their mode.
    return float(np.clip(np.median(sigma[near] if near.any() else sigma), *SIGMA_RANGE_PX))


def _densest(values: Array) -> float:
    """Return the half-sample mode of sorted values."""
    while len(values) > 3:
        half = (len(values) + 1) // 2
        spans = values[half - 1 :] - values[: len(values) - half + 1]
        first = int(spans.argmin())
        values = values[first : first + half]
    return float(np.median(values))
