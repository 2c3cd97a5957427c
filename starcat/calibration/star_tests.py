"""Measurements of stars, one row each, to what is known of each star and how likely chance is.

A measurement is a residual on one axis (magnitude) or two (place on the sky).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.stats import chi2, sigmaclip

from starcat.arrays import Array, Mask, Rows

CLIP = 4.0  # deviations farther away, in their noise, are not counted in the noise
FAR = 4.0  # those in the scatter of a star count as so many noises at most: one proves nothing
OF_A_BIN = 100  # deviations of a bin of magnitude at the least
MAX_BINS = 12
HALF_OF_NORMAL = 0.6744897501960817  # half of normal deviations are smaller

_LOG10 = np.log(10.0)


@dataclass(frozen=True)
class StarNoise:
    """The noise of one measurement by the magnitude measured, and what stars differ by beside it.

    The latter are errors of the catalog and of the model of the sensor, which more sightings of a
    star do not average out.
    """

    mag: Array
    sigma: Array
    of_stars: float

    def at(self, mag: Array) -> Array:
        """Return the noise of one measurement at magnitudes."""
        return np.asarray(np.interp(mag, self.mag, self.sigma))


@dataclass(frozen=True)
class StarMeans:
    """What the measurements say of each star, a row each; NaN where it was not measured."""

    count: NDArray[np.int64]
    mean: Array  # shape (stars, axes)
    error: Array  # of the mean, each axis: with the star's own scatter if that is larger
    scatter: Array  # of one measurement, each axis; NaN for less than two
    # Common logarithms of the probabilities that chance makes mean and scatter as large; NaN
    # where the star has too few measurements.
    log_chance_mean: Array
    log_chance_scatter: Array


@dataclass(frozen=True)
class Measurements:
    """Residuals of stars."""

    left: Array  # shape (N, axes)
    mag: Array  # magnitude that the noise goes with
    star: Rows
    n_stars: int

    def of(self, rows: Mask) -> Measurements:
        """Return some of the measurements."""
        return Measurements(self.left[rows], self.mag[rows], self.star[rows], self.n_stars)

    def total(self, values: Array) -> Array:
        """Return the sum of values over the measurements of each star."""
        return np.asarray(np.bincount(self.star, values, self.n_stars), dtype=np.float64)

    @property
    def count(self) -> NDArray[np.int64]:
        """Measurements of each star."""
        return np.bincount(self.star, minlength=self.n_stars)

    @property
    def mean(self) -> Array:
        """Mean of each star; 0 where it has none."""
        count = np.maximum(self.count, 1)
        return np.column_stack([self.total(column) / count for column in self.left.T])

    def noise(self, least: float, min_count: int) -> StarNoise:
        """Return the noise, from how the measurements of each star differ."""
        of_star = self.count[self.star]
        factor = np.sqrt(of_star / np.maximum(of_star - 1.0, 1.0))
        within, where = (self.left - self.mean[self.star]) * factor[:, None], self.mag
        if np.count_nonzero(of_star > 1) >= OF_A_BIN:
            within, where = within[of_star > 1], where[of_star > 1]
        else:  # hardly any star was seen twice
            within = self.left
        bins = int(np.clip(len(within) // OF_A_BIN, 1, MAX_BINS))
        parts = np.array_split(np.argsort(where, kind="stable"), bins)
        sigma = [max(least, float(sigmaclip(within[part], CLIP, CLIP)[0].std())) for part in parts]
        middle = np.array([float(np.median(where[part])) for part in parts])
        noise, often = StarNoise(middle, np.array(sigma), 0.0), self.count >= min_count
        variance = self.total(noise.at(self.mag) ** 2)[often] / self.count[often] ** 2
        return StarNoise(noise.mag, noise.sigma, _beyond(self.mean[often], variance))

    def by_star(self, noise: StarNoise, further: Array, min_count: int) -> StarMeans:
        """Return what the measurements say of each star; ``further`` is an error of each mean."""
        axes, count, sigma = self.left.shape[1], self.count, noise.at(self.mag)
        some = np.maximum(count, 1)
        mean, is_tested = self.mean, count >= min_count
        away = self.left - mean[self.star]
        with np.errstate(invalid="ignore", divide="ignore"):
            scatter2 = self.total((away**2).sum(axis=1)) / (axes * (count - 1.0))
        noise2 = self.total(sigma**2) / some
        own = np.where(count > 1, np.maximum(np.nan_to_num(scatter2), noise2), noise2)
        error = np.sqrt(own / some + noise.of_stars**2 + further**2)
        # From a star's own median, which is not its mean, so that no degree of freedom is lost.
        far = np.sqrt(((self.left - self._medians()[self.star]) ** 2).sum(axis=1)) / sigma
        square = self.total(np.minimum(far, FAR) ** 2)
        with np.errstate(invalid="ignore", divide="ignore"):
            chance_mean = chi2.logsf((mean**2).sum(axis=1) / error**2, axes) / _LOG10
            chance_scatter = chi2.logsf(square, np.maximum(axes * count, 1)) / _LOG10
            scatter = np.where(count > 1, np.sqrt(scatter2), np.nan)
        return StarMeans(
            count,
            np.where(count[:, None] > 0, mean, np.nan),
            np.where(count > 0, error, np.nan),
            scatter,
            np.where(is_tested, chance_mean, np.nan),
            np.where(is_tested, chance_scatter, np.nan),
        )

    def _medians(self) -> Array:
        """Return the median of each star on each axis; 0 where it has none."""
        count = self.count
        first = np.cumsum(count) - count
        low, high = first + np.maximum(count - 1, 0) // 2, first + count // 2
        last, columns = len(self.star) - 1, []
        for column in self.left.T:
            ordered = column[np.lexsort((column, self.star))]
            middle = 0.5 * (ordered[np.minimum(low, last)] + ordered[np.minimum(high, last)])
            columns.append(np.where(count > 0, middle, 0.0))
        return np.column_stack(columns)


def _beyond(mean: Array, variance: Array) -> float:
    """Return the scatter that, added to the noise, puts half of the means where they should be.

    The median does not mind a few stars that are far off.
    """

    def excess(scatter: float) -> float:
        error = np.sqrt(variance + scatter**2)[:, None]
        return float(np.median(np.abs(mean) / error)) / HALF_OF_NORMAL - 1.0

    if not len(mean) or excess(0.0) <= 0.0:
        return 0.0
    return float(brentq(excess, 0.0, 10.0 * float(np.abs(mean).max()) + 1e-12))
