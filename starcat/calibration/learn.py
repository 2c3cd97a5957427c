"""What flew comes back: the terms of a sensor, and the stars to distrust, of identified frames.

Every star that was seen often enough is tested for its mean brightness, the scatter of its
brightness, its place, the scatter of its place, and how often it was missed. A star is distrusted
where one of them is so far off that in all tests of all stars together chance does that once in
`FAMILY`. The distrusted ones are left out and the rest is fitted again, until they are the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binom

from starcat.arrays import Array, Mask
from starcat.calibration.answers import Sightings, SkyStars
from starcat.calibration.response import MIN_COLOURS, Depth, Terms, fit_depth, fit_terms
from starcat.calibration.star_tests import Measurements, StarMeans, StarNoise
from starcat.errors import CalibrationError

FAMILY = 1e-3
"""Probability that chance alone makes any star of a database distrusted."""

MIN_FRAMES = 3
"""Fewest frames that a star is judged from."""

MIN_STARS = 20
"""Fewest stars with a magnitude that anything is learnt from."""

TESTS = ("brightness", "variable", "moved", "double", "missing")

CLEAR = 3.0
"""Noises that a star is brighter than the limit of the frames, for its mean to be fair."""

MIN_ROUNDS, MAX_ROUNDS = 3, 8
FIRST_NOISE_MAG = 0.3  # until it is known
MIN_MAG, MIN_ARCSEC = 1e-3, 1e-2  # noise is not taken to be smaller
MIN_LOG = -300.0  # of a probability; smaller ones are no longer numbers


@dataclass(frozen=True)
class StarRecords:
    """What was seen of each star; arrays with a row for each of the database, NaN where unknown."""

    n_seen: NDArray[np.int64]  # frames in which it was identified
    n_expected: NDArray[np.int64]  # frames that are deep enough to show it
    n_missed: NDArray[np.int64]  # those of them in which it was not identified
    observed_mag: Array  # mean of the measured magnitudes, offsets of frames taken out
    mag_residual: Array  # this minus what the terms predict
    mag_error: Array  # standard error of it
    mag_scatter: Array  # of one measurement
    offset_arcsec: Array  # seen minus database, east and north; shape (stars, 2)
    offset_error_arcsec: Array  # standard error of it on each axis
    offset_scatter_arcsec: Array  # of one measurement, on each axis
    # Common logarithms of the probabilities that chance goes as far, by `TESTS`; NaN where not
    # tested; shape (stars, tests).
    log_chance: Array


@dataclass(frozen=True)
class Distrusted:
    """A star to distrust, and the evidence."""

    row: int
    verdict: str  # ``too_faint``, ``too_bright``, ``variable``, ``moved``, ``double``, ``missing``
    also: tuple[str, ...]  # further verdicts, the surest first
    log_chance: float  # common logarithm of the probability that chance goes as far


@dataclass(frozen=True)
class Lesson:
    """What identified frames say about their sensor and their stars."""

    terms: Terms
    mag_noise: StarNoise
    offset_noise: StarNoise
    limit_mag: float  # measured magnitude from which stars are missed; inf where none are
    records: StarRecords
    distrusted: tuple[Distrusted, ...]  # by row
    n_judged: int  # stars that were tested
    n_tests: int
    n_sightings: int  # with a magnitude


def learn_from_frames(
    sightings: Sightings,
    stars: SkyStars,
    n_frames: int,
    *,
    by_frame: bool = False,
    min_frames: int = MIN_FRAMES,
    colour_term: float = 0.0,
) -> Lesson:
    """Fit the terms of the sensor and judge the stars.

    With ``by_frame`` every frame has an offset of its own, as where exposures differ.
    ``colour_term`` is what the magnitudes of the database have already; it bears on stars of
    unknown colour.
    """
    found = len(np.unique(sightings.star[np.isfinite(sightings.mag)]))
    if found < MIN_STARS:
        raise CalibrationError(
            f"{found} stars of {n_frames} identified frames have a measured magnitude; at least "
            f"{MIN_STARS} are needed. Give more frames, with magnitudes"
        )
    is_trusted = np.ones(len(stars), dtype=bool)
    lesson = None
    for number in range(MAX_ROUNDS):
        before = lesson
        lesson = _Round(
            sightings, stars, n_frames, is_trusted, by_frame, min_frames, colour_term
        ).judged(before)
        flagged = np.zeros(len(stars), dtype=bool)
        flagged[[one.row for one in lesson.distrusted]] = True
        if number >= MIN_ROUNDS and (flagged == ~is_trusted).all():
            break
        is_trusted = ~flagged
    assert lesson is not None
    return lesson


@dataclass(frozen=True)
class _Round:
    """One fit to the stars that are trusted, after which all are judged."""

    seen: Sightings
    stars: SkyStars
    n_frames: int
    is_trusted: Mask
    by_frame: bool
    min_frames: int
    applied: float  # colour term that the magnitudes have

    def judged(self, before: Lesson | None) -> Lesson:
        """Return what is learnt with what was learnt before."""
        seen, trusted = self.seen, self.is_trusted[self.seen.star]
        use, terms = self._fitted(before)
        expected_mag = self._expected(terms)
        depth = fit_depth(expected_mag, seen.is_seen, seen.frame, trusted)
        count = len(self.stars)
        light = Measurements(
            (seen.mag - expected_mag)[use, None], expected_mag[use], seen.star[use], count
        )
        there = seen.is_seen
        place = Measurements(
            seen.offset_arcsec[there], expected_mag[there], seen.star[there], count
        )
        mag_noise = light.of(trusted[use]).noise(MIN_MAG, self.min_frames)
        offset_noise = place.of(trusted[there]).noise(MIN_ARCSEC, self.min_frames)
        brightness = light.by_star(mag_noise, self._unsure_mag(terms), self.min_frames)
        position = place.by_star(offset_noise, np.zeros(count), self.min_frames)
        records = self._records(terms, depth, brightness, position)
        distrusted, tests = _distrusted(records)
        judged = int(np.isfinite(records.log_chance).any(axis=1).sum())
        measured = int(np.isfinite(seen.mag).sum())
        return Lesson(
            terms, mag_noise, offset_noise, depth.limit_mag, records, distrusted, judged, tests,
            measured,
        )  # fmt: skip

    def _fitted(self, before: Lesson | None) -> tuple[Mask, Terms]:
        """Return the magnitudes that are fair, and the terms fitted to those of trusted stars."""
        seen = self.seen
        measured, sigma = np.isfinite(seen.mag), np.full(len(seen), FIRST_NOISE_MAG)
        use = measured
        if before is not None:
            expected_mag = self._expected(before.terms)
            sigma = np.hypot(before.mag_noise.at(expected_mag), before.mag_noise.of_stars)
            use = measured & (expected_mag < before.limit_mag - CLEAR * sigma)
        # Where frames are so shallow that hardly a star of known colour is left, all have to do.
        known = np.isfinite(self.stars.colour)
        is_enough = known[np.unique(seen.star[use])].sum() >= MIN_COLOURS
        rows = (use if is_enough or not known.any() else measured) & self.is_trusted[seen.star]
        star = seen.star[rows]
        terms = fit_terms(
            seen.mag[rows] - self.stars.mag[star],
            self.stars.colour[star],
            seen.frame[rows],
            star,
            sigma[rows],
            frames=self.n_frames,
            by_frame=self.by_frame,
        )
        return use, terms

    def _expected(self, terms: Terms) -> Array:
        """Return the magnitude that each star of each frame should have."""
        star = self.seen.star
        return terms.predicted(self.stars.mag[star], self._colour[star], self.seen.frame)

    @property
    def _colour(self) -> Array:
        """The colours, the middle one where a star has none."""
        colour = self.stars.colour
        known = colour[np.isfinite(colour)]
        return np.where(np.isnan(colour), np.median(known) if len(known) else 0.0, colour)

    def _unsure_mag(self, terms: Terms) -> Array:
        """Return how far an unknown colour may put the magnitude of each star."""
        spread = abs(self.applied + (terms.colour_term or 0.0)) * float(np.std(self._colour))
        return np.where(np.isnan(self.stars.colour), spread, 0.0)

    def _records(
        self, terms: Terms, depth: Depth, brightness: StarMeans, position: StarMeans
    ) -> StarRecords:
        seen, count = self.seen, len(self.stars)
        some = np.isfinite(depth.chance)
        expected = np.bincount(seen.star[some], minlength=count)
        found = np.bincount(seen.star[some], seen.is_seen[some], minlength=count)
        chance = np.bincount(seen.star[some], depth.chance[some], minlength=count)
        missing = binom.logcdf(found, expected, chance / np.maximum(expected, 1)) / np.log(10.0)
        tests = (
            brightness.log_chance_mean,
            brightness.log_chance_scatter,
            position.log_chance_mean,
            position.log_chance_scatter,
            np.where(expected >= self.min_frames, missing, np.nan),
        )
        usual = terms.predicted(self.stars.mag, self._colour, None)
        return StarRecords(
            n_seen=position.count,
            n_expected=expected,
            n_missed=expected - found.astype(np.int64),
            observed_mag=usual + brightness.mean[:, 0],
            mag_residual=brightness.mean[:, 0],
            mag_error=brightness.error,
            mag_scatter=brightness.scatter,
            offset_arcsec=position.mean,
            offset_error_arcsec=position.error,
            offset_scatter_arcsec=position.scatter,
            log_chance=np.maximum(np.column_stack(tests), MIN_LOG),
        )


def _distrusted(records: StarRecords) -> tuple[tuple[Distrusted, ...], int]:
    """Return the stars that chance does not explain, and the number of tests."""
    log_chance = records.log_chance
    tests = int(np.isfinite(log_chance).sum())
    limit = np.log10(FAMILY / max(tests, 1))
    found = []
    for row in np.flatnonzero((log_chance <= limit).any(axis=1)).tolist():
        order = np.argsort(log_chance[row], kind="stable")
        names = [TESTS[k] for k in order.tolist() if log_chance[row, k] <= limit]
        fainter = records.mag_residual[row] > 0.0
        words = ["too_faint" if fainter else "too_bright"] if "brightness" in names else []
        verdicts = [words[0] if name == "brightness" else name for name in names]
        found.append(
            Distrusted(row, verdicts[0], tuple(verdicts[1:]), float(log_chance[row, order[0]]))
        )
    return tuple(found), tests
