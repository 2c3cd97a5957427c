"""Which terms of a lens the frames support: every model is tried on frames that it has not seen.

The frames are left out in turn. A camera is made of the others; of the frames that were left
out only the attitudes are fitted, and the residuals of their stars tell how well the camera holds
where it was not made.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, stdtrit

from starcat.arrays import Array
from starcat.calibration.fit import (
    BEND,
    CENTRE,
    FOCAL,
    PARAMETERS,
    RADIAL,
    TANGENTIAL,
    Fit,
    Seen,
    camera_of,
    fit_camera,
    reduced_derivatives,
    turned_to,
)
from starcat.errors import ConfigError

FOLDS = 5  # groups of frames that are left out in turn; each frame is its own where there are fewer
FAR_PX = 1e6  # a bend of Huber's loss that nothing is beyond: least squares of all stars
NEAR = 1e-5  # accuracy of the fits that are compared
MIN_STARS = 4  # stars that a frame keeps at least

# A model loses to a better one if the difference is larger than this many standard errors: of many
# frames. Of five it is 1.9, of three 2.5.
SURE = 1.5

# The models that are compared: none to three radial terms, with and without a free principal
# point, with and without the tangential terms.
MODELS = tuple(
    (*FOCAL, *RADIAL[:radial], *centre, *tangential)
    for radial in range(4)
    for centre in ((), CENTRE)
    for tangential in ((), TANGENTIAL)
)

# The terms whose values and errors are reported whether they are supported or not.
COMPLETE = (*FOCAL, *CENTRE, *RADIAL[:2], *TANGENTIAL)


@dataclass(frozen=True)
class Trial:
    """How one model did on the frames that were left out.

    Attributes
    ----------
    free : tuple of str
        What the model fits.
    held_out_px : float
        Root mean square residual on each axis over the frames that were left out, of which their
        attitudes take up a part; inf for a model whose image folds back on the detector.
    worse_px2 : float
        Mean square residual on each axis less that of the best model.
    worse_error_px2 : float
        Standard error of that difference, from how it scatters between frames.
    is_chosen : bool
        Whether this is the model that the rule chooses.
    """

    free: tuple[str, ...]
    held_out_px: float
    worse_px2: float
    worse_error_px2: float
    is_chosen: bool


def choose_model(
    seen: Seen,
    values: Array,
    size_px: tuple[int, int],
    noise_px: float,
    models: Sequence[tuple[str, ...]] = MODELS,
) -> list[Trial]:
    """Compare models by the residuals of frames that they have not seen, and choose one."""
    kept = _without_strays(seen, values, noise_px)
    squares = np.array([_held_out(kept, values, free, size_px) for free in models])
    numbers, frames = 2 * len(kept), squares.shape[1]
    mean = squares.sum(axis=1) / numbers
    with np.errstate(invalid="ignore"):
        difference = squares - squares[int(mean.argmin())]
        worse = difference.sum(axis=1) / numbers
        error = difference.std(axis=1, ddof=1) * math.sqrt(frames) / numbers
    # A standard error of few frames is uncertain itself, which Student's distribution allows for.
    sure = float(stdtrit(frames - 1, ndtr(SURE)))
    tied = [k for k in range(len(models)) if worse[k] <= sure * error[k]]
    simplest = min(tied, key=lambda k: (*_complexity(models[k]), mean[k]), default=0)
    return [
        Trial(free, math.sqrt(mean[k]), float(worse[k]), float(error[k]), k == simplest)
        for k, free in enumerate(models)
    ]


def _complexity(free: tuple[str, ...]) -> tuple[int, bool]:
    """Return the number of terms, and whether there are tangential ones.

    In a narrow field these are nearly the same as a principal point, which every camera has.
    """
    return len(free), TANGENTIAL[0] in free


def chosen(trials: Sequence[Trial]) -> tuple[str, ...]:
    """Return the terms of the model that was chosen."""
    (free,) = (trial.free for trial in trials if trial.is_chosen)
    return free


def is_enough(seen: Seen) -> bool:
    """Return whether models can be compared: two frames, and more numbers than unknowns."""
    frames = len(seen.matrices)
    return frames > 1 and 4 * len(seen) > 3 * (3 * frames + len(COMPLETE))


def start_of(values: Array, free: Sequence[str], size_px: tuple[int, int]) -> Array:
    """Return the numbers that a model starts from."""
    start = np.zeros_like(values)
    start[0] = values[0]
    start[1:3] = values[1:3] if CENTRE[0] in free else 0.5 * np.array(size_px)
    for row, name in enumerate((*RADIAL, *TANGENTIAL), start=3):
        start[row] = values[row] if name in free else 0.0
    return start


def _without_strays(seen: Seen, values: Array, noise_px: float) -> Seen:
    """Return the stars that the complete model fits, so that all models are asked about the same.

    A frame with too few of them keeps all that it has.
    """
    fit = fit_camera(seen, values, COMPLETE, noise_px)
    near = (np.abs(fit.residual_px) <= BEND * fit.noise_px).all(axis=1)
    enough = np.bincount(seen.frame, near) >= MIN_STARS
    near |= ~enough[seen.frame]
    return Seen(seen.frame[near], seen.centroids_px[near], seen.icrs[near], fit.seen.matrices)


def _held_out(seen: Seen, values: Array, free: tuple[str, ...], size_px: tuple[int, int]) -> Array:
    """Return the sum of squares of each frame with a camera that was made without it."""
    count = len(seen.matrices)
    group = np.arange(count) % min(FOLDS, count)
    whole = fit_camera(seen, start_of(values, free, size_px), free, FAR_PX, passes=1, accuracy=NEAR)
    out = np.full(count, np.inf)
    for fold, fitted in enumerate(_without_each(whole, group)):
        try:
            camera_of(fitted, size_px)
        except ConfigError:
            return np.full(count, np.inf)
        left = whole.seen.of(group == fold)
        residual_px, _ = turned_to(left, fitted, FAR_PX)
        out[group == fold] = np.bincount(left.frame, (residual_px**2).sum(axis=1))
    return out


def _without_each(whole: Fit, group: NDArray[np.int64]) -> Iterator[Array]:
    """Return the cameras of all frames but those of one group, for each group.

    They are one step of Gauss and Newton from the camera of all frames: what is left is of the
    second order in that step.
    """
    rows = [PARAMETERS.index(name) for name in whole.free]
    everywhere = np.ones_like(whole.residual_px, dtype=bool)
    slope = reduced_derivatives(whole.seen, whole.values, rows, everywhere)
    size = np.linalg.norm(slope, axis=0)
    size[size == 0.0] = 1.0
    of_row = np.repeat(group[whole.seen.frame], 2)
    for fold in range(group.max() + 1):
        kept = of_row != fold
        step = np.linalg.lstsq(slope[kept] / size, whole.residual_px.ravel()[kept])[0]
        values = whole.values.copy()
        values[rows] += step / size
        yield values
