"""The response of a sensor to stars of known magnitude: zero point, colour term, depth.

``measured = mag + zero point + offset of the frame + colour term x colour + noise``. Pure
functions of arrays with one row per sighting.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import binom

from starcat.arrays import Array, Mask, Rows

HUBER = 1.345  # larger deviations, in noises, lower the weight of a measurement
OF_A_BIN = 100  # smallest number of measurements in a bin of magnitude
MAX_BINS = 48
COMPLETE = 0.85  # stars are expected in a bin that sees this share of the best bins
COVERED = 1e-3  # frames that miss more stars than 99.9 % of all frames are ignored
MIN_COLOURS = 10  # stars of known colour that a colour term needs
MIN_STEPS, MAX_STEPS = 10, 50  # steps of the fit; each has new weights


@dataclass(frozen=True)
class Terms:
    """The terms of a sensor, fitted."""

    zero_point_mag: float
    zero_point_error_mag: float
    colour_term: float | None  # None if too few stars have a colour
    colour_term_error: float | None
    frame_offset_mag: Array  # offset of each frame from the zero point; 0 unless fitted

    def predicted(self, mag: Array, colour: Array, frame: Rows | None) -> Array:
        """Return the magnitudes that the sensor should measure, in frames or on average."""
        offset = 0.0 if frame is None else self.frame_offset_mag[frame]
        bent = 0.0 if self.colour_term is None else self.colour_term * colour
        return np.asarray(mag + self.zero_point_mag + bent + offset)


def fit_terms(
    difference: Array,
    colour: Array,
    frame: Rows,
    star: Rows,
    sigma: Array,
    *,
    frames: int,
    by_frame: bool,
) -> Terms:
    """Fit the terms to measured minus catalog magnitudes, by repeated weights (Huber 1964).

    Offsets of frames are hundreds of unknowns, but each is the mean of its frame once the colour
    term is known: means are taken out of both sides, and one unknown is left (Frisch and Waugh
    1933). Errors are computed from the scatter between stars, because the sightings of a star share
    its error. Stars without a colour are left out, unless nearly all have none.
    """
    is_known = np.isfinite(colour)
    has_colour = len(np.unique(colour[is_known])) >= MIN_COLOURS
    used = is_known if has_colour else np.ones(len(star), dtype=bool)
    y, frame, star, sigma = difference[used], frame[used], star[used], sigma[used]
    x = colour[used] if has_colour else np.zeros(len(y))
    group = frame if by_frame else np.zeros(len(frame), dtype=np.int64)
    weight, slope = sigma**-2.0, 0.0
    for step in range(MAX_STEPS):
        before = slope
        total = np.maximum(np.bincount(group, weight), 1e-300)
        x_mean = np.bincount(group, weight * x) / total
        y_mean = np.bincount(group, weight * y) / total
        x_centred, y_centred = x - x_mean[group], y - y_mean[group]
        square = float(weight @ x_centred**2)
        slope = float(weight @ (x_centred * y_centred)) / square if has_colour else 0.0
        residual = y_centred - slope * x_centred
        far = np.maximum(np.abs(residual) / (HUBER * sigma), 1.0)
        weight = sigma**-2.0 / far
        if step >= MIN_STEPS and abs(slope - before) < 1e-12:
            break
    offset = y_mean - slope * x_mean
    pull = weight * residual
    slope_pull = pull * x_centred / square if has_colour else np.zeros(len(x))
    if by_frame:
        seen = np.unique(group)
        zero_point = float(offset[seen].mean())
        error = float(offset[seen].std()) / np.sqrt(len(seen))
    else:
        zero_point = float(offset[0])
        error = _error(pull / weight.sum() - x_mean[0] * slope_pull, star)
    of_frame = np.zeros(frames)
    if by_frame:
        of_frame[seen] = offset[seen] - zero_point
    return Terms(
        zero_point,
        float(error),
        slope if has_colour else None,
        _error(slope_pull, star) if has_colour else None,
        of_frame,
    )


def _error(pull: Array, star: Rows) -> float:
    """Return the standard error of a sum of pulls that are independent from star to star."""
    return float(np.sqrt((np.bincount(star, pull) ** 2).sum()))


@dataclass(frozen=True)
class Depth:
    """The limiting magnitude of frames, and the probability that each sighting is seen."""

    limit_mag: float  # measured magnitude from which stars are missed; inf if none are
    chance: Array  # probability that each sighting is seen; NaN if it is not expected


def fit_depth(predicted: Array, is_seen: Mask, frame: Rows, is_trusted: Mask) -> Depth:
    """Find which sightings are expected, from how often stars of each brightness are seen.

    Stars near the limit and beyond are not expected. Neither are stars of frames that miss more
    than chance explains: the limb of the Earth or the baffle can hide a part of such frames.
    """
    used = np.flatnonzero(is_trusted)
    bins = int(np.clip(len(used) // OF_A_BIN, 1, MAX_BINS))
    order = used[np.argsort(predicted[used], kind="stable")]
    parts = np.array_split(order, bins)
    edges = np.array([predicted[part[0]] for part in parts[1:]])
    seen = np.array([is_seen[part].sum() for part in parts])
    size = np.array([len(part) for part in parts])
    usual = float(np.quantile(seen / size, 0.9))
    is_full = seen >= COMPLETE * usual * size
    limit = np.inf
    if not is_full[-1]:
        # The limit can lie in the faintest bin that is full.
        first = int(np.flatnonzero(is_full)[-1]) if is_full.any() else 0
        is_full[first:] = False
        limit = float(predicted[parts[first][0]])
    row = np.searchsorted(edges, predicted, side="right")
    chance = np.where(is_full[row], (seen / (size + 1.0))[row], np.nan)
    chance[_is_covered(chance, is_seen, frame)[frame]] = np.nan
    return Depth(limit, chance)


def _is_covered(chance: Array, is_seen: Mask, frame: Rows) -> Mask:
    """Return which frames see fewer of the expected stars than chance explains."""
    is_expected = np.isfinite(chance)
    count = np.bincount(frame[is_expected], minlength=frame.max() + 1)
    n_seen = np.bincount(frame[is_expected], is_seen[is_expected], minlength=len(count))
    mean = np.bincount(frame[is_expected], chance[is_expected], minlength=len(count)) / np.maximum(
        count, 1
    )
    return np.asarray((count > 0) & (binom.cdf(n_seen, count, mean) < COVERED))
