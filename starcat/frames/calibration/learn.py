"""Learning from frames about stars and the sensor: which stars to distrust, and the response."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from pydantic import ValidationError
from scipy.optimize import brentq
from scipy.stats import binom, chi2, sigmaclip

from starcat.arguments import HasFolder, database_path, paths_of, whole_number
from starcat.arrays import Array, Mask, Rows
from starcat.catalog.stars.star_table import directions_of, floats_of
from starcat.database.manifest import manifest_digest
from starcat.database.reader import DatabaseFolder, open_database_folder
from starcat.errors import CalibrationError, ConfigError
from starcat.frames.calibration.answers import Sightings, SkyStars, read_answers
from starcat.frames.calibration.response import MIN_COLOURS, Depth, Terms, fit_depth, fit_terms
from starcat.pipeline.selection.rules.distrust import Observed
from starcat.pipeline.specs.keys import toml_value
from starcat.pipeline.specs.reading import read_spec, spec_of_database
from starcat.resources import PathLike
from starcat.sections import version_numbers
from starcat.storage.atomic import file_sha256
from starcat.storage.toml_files import content_of_toml, text_of_toml, what_is_wrong

CLIP = 4.0  # larger deviations, in units of their noise, are not counted in the noise
FAR = 4.0  # largest deviation in the scatter of a star, in noises: one outlier proves nothing
OF_A_BIN = 100  # smallest number of deviations in a bin of magnitude
MAX_BINS = 12
HALF_OF_NORMAL = 0.6744897501960817  # half of normal deviations are smaller

_LOG10 = np.log(10.0)


@dataclass(frozen=True)
class StarNoise:
    """The noise of one measurement by the measured magnitude, and the further scatter of stars.

    The further scatter is due to errors of the catalog and of the model of the sensor, which more
    sightings of a star do not average out.
    """

    mag: Array
    sigma: Array
    of_stars: float

    def at(self, mag: Array) -> Array:
        """Return the noise of one measurement at magnitudes."""
        return np.asarray(np.interp(mag, self.mag, self.sigma))


@dataclass(frozen=True)
class StarMeans:
    """Statistics of the measurements, one row per star; NaN if the star was not measured."""

    count: NDArray[np.int64]
    mean: Array  # shape (stars, axes)
    error: Array  # error of the mean, each axis: with the star's own scatter if that is larger
    scatter: Array  # scatter of one measurement, each axis; NaN for less than two
    # Common logarithms of the probabilities that chance makes mean and scatter as large; NaN
    # for a star with too few measurements.
    log_chance_mean: Array
    log_chance_scatter: Array


@dataclass(frozen=True)
class Measurements:
    """Residuals of stars."""

    residual: Array  # shape (N, axes)
    mag: Array  # magnitude by which the noise is looked up
    star: Rows
    n_stars: int

    def of(self, rows: Mask) -> Measurements:
        """Return some of the measurements."""
        return Measurements(self.residual[rows], self.mag[rows], self.star[rows], self.n_stars)

    def total(self, values: Array) -> Array:
        """Return the sum of values over the measurements of each star."""
        return np.asarray(np.bincount(self.star, values, self.n_stars), dtype=np.float64)

    @property
    def count(self) -> NDArray[np.int64]:
        """Measurements of each star."""
        return np.bincount(self.star, minlength=self.n_stars)

    @property
    def mean(self) -> Array:
        """Mean of each star; 0 without measurements."""
        count = np.maximum(self.count, 1)
        return np.column_stack([self.total(column) / count for column in self.residual.T])

    def noise(self, least: float, min_count: int) -> StarNoise:
        """Return the noise, from the differences of the measurements of each star."""
        of_star = self.count[self.star]
        factor = np.sqrt(of_star / np.maximum(of_star - 1.0, 1.0))
        within, where = (self.residual - self.mean[self.star]) * factor[:, None], self.mag
        if np.count_nonzero(of_star > 1) >= OF_A_BIN:
            within, where = within[of_star > 1], where[of_star > 1]
        else:  # hardly any star was seen twice
            within = self.residual
        bins = int(np.clip(len(within) // OF_A_BIN, 1, MAX_BINS))
        parts = np.array_split(np.argsort(where, kind="stable"), bins)
        sigma = [max(least, float(sigmaclip(within[part], CLIP, CLIP)[0].std())) for part in parts]
        middle = np.array([float(np.median(where[part])) for part in parts])
        noise, often = StarNoise(middle, np.array(sigma), 0.0), self.count >= min_count
        variance = self.total(noise.at(self.mag) ** 2)[often] / self.count[often] ** 2
        return StarNoise(noise.mag, noise.sigma, _beyond(self.mean[often], variance))

    def by_star(self, noise: StarNoise, further: Array, min_count: int) -> StarMeans:
        """Return the statistics of each star; ``further`` is a further error of each mean."""
        axes, count, sigma = self.residual.shape[1], self.count, noise.at(self.mag)
        some = np.maximum(count, 1)
        mean, is_tested = self.mean, count >= min_count
        away = self.residual - mean[self.star]
        with np.errstate(invalid="ignore", divide="ignore"):
            scatter2 = self.total((away**2).sum(axis=1)) / (axes * (count - 1.0))
        noise2 = self.total(sigma**2) / some
        variance = np.where(count > 1, np.maximum(np.nan_to_num(scatter2), noise2), noise2)
        error = np.sqrt(variance / some + noise.of_stars**2 + further**2)
        # From a star's own median, which is not its mean, so that no degree of freedom is lost.
        far = np.sqrt(((self.residual - self._medians()[self.star]) ** 2).sum(axis=1)) / sigma
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
        """Return the median of each star on each axis; 0 without measurements."""
        count = self.count
        first = np.cumsum(count) - count
        low, high = first + np.maximum(count - 1, 0) // 2, first + count // 2
        last, columns = len(self.star) - 1, []
        for column in self.residual.T:
            ordered = column[np.lexsort((column, self.star))]
            middle = 0.5 * (ordered[np.minimum(low, last)] + ordered[np.minimum(high, last)])
            columns.append(np.where(count > 0, middle, 0.0))
        return np.column_stack(columns)


def _beyond(mean: Array, variance: Array) -> float:
    """Return the scatter that, added to the noise, gives the means their expected median size.

    A few stars that are far off do not change the median.
    """

    def excess(scatter: float) -> float:
        error = np.sqrt(variance + scatter**2)[:, None]
        return float(np.median(np.abs(mean) / error)) / HALF_OF_NORMAL - 1.0

    if not len(mean) or excess(0.0) <= 0.0:
        return 0.0
    return float(brentq(excess, 0.0, 10.0 * float(np.abs(mean).max()) + 1e-12))


FAMILY = 1e-3
"""Probability that chance alone makes any star of a database distrusted."""

MIN_FRAMES = 3
"""Smallest number of frames from which a star is judged."""

MIN_STARS = 20
"""Smallest number of stars with a magnitude from which anything is learnt."""

TESTS = ("brightness", "variable", "moved", "double", "missing")

CLEAR = 3.0
"""The mean of a star is unbiased if it is brighter than the limit of the frames by this many
standard deviations."""

MIN_ROUNDS, MAX_ROUNDS = 3, 8
FIRST_NOISE_MAG = 0.3  # noise until it is measured
MIN_MAG, MIN_ARCSEC = 1e-3, 1e-2  # smallest noise that is assumed
MIN_LOG = -300.0  # logarithm of a probability; smaller ones underflow


@dataclass(frozen=True)
class StarRecords:
    """Records of each star; arrays with one row per star of the database, NaN if unknown."""

    n_seen: NDArray[np.int64]  # frames in which it was identified
    n_expected: NDArray[np.int64]  # frames that are deep enough to show it
    n_missed: NDArray[np.int64]  # expected frames in which it was not identified
    observed_mag: Array  # mean of the measured magnitudes, offsets of frames taken out
    mag_residual: Array  # ``observed_mag`` minus what the terms predict
    mag_error: Array  # standard error of the residual
    mag_scatter: Array  # scatter of one measurement
    offset_arcsec: Array  # seen minus database, east and north; shape (stars, 2)
    offset_error_arcsec: Array  # standard error of the offset on each axis
    offset_scatter_arcsec: Array  # scatter of one measurement, on each axis
    # Common logarithms of the probabilities that chance deviates as far, by `TESTS`; NaN if not
    # tested; shape (stars, tests).
    log_chance: Array


@dataclass(frozen=True)
class Distrusted:
    """A star to distrust, and the evidence."""

    row: int
    verdict: str  # ``too_faint``, ``too_bright``, ``variable``, ``moved``, ``double``, ``missing``
    also: tuple[str, ...]  # further verdicts, the surest first
    log_chance: float  # common logarithm of the probability that chance deviates as far


@dataclass(frozen=True)
class Lesson:
    """The results of learning: the response of the sensor and the records of its stars."""

    terms: Terms
    mag_noise: StarNoise
    offset_noise: StarNoise
    limit_mag: float  # measured magnitude from which stars are missed; inf if none are
    records: StarRecords
    distrusted: tuple[Distrusted, ...]  # by row
    n_judged: int  # stars that were tested
    n_tests: int
    n_sightings: int  # sightings with a magnitude


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

    With ``by_frame`` every frame has its own offset, for example if exposures differ.
    ``colour_term`` is the term that the magnitudes of the database already include; it affects
    stars of unknown colour.
    """
    n_stars = len(np.unique(sightings.star[np.isfinite(sightings.mag)]))
    if n_stars < MIN_STARS:
        raise CalibrationError(
            f"{n_stars} stars of {n_frames} identified frames have a measured magnitude; at least "
            f"{MIN_STARS} are needed",
            hint="Give more frames, with magnitudes",
        )
    is_trusted = np.ones(len(stars), dtype=bool)
    lesson = None
    for number in range(MAX_ROUNDS):
        before = lesson
        lesson = _Round(
            sightings, stars, n_frames, is_trusted, by_frame, min_frames, colour_term
        ).judged(before)
        flagged = np.zeros(len(stars), dtype=bool)
        flagged[[star.row for star in lesson.distrusted]] = True
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
        """Return the next lesson, given the previous one."""
        seen, trusted = self.seen, self.is_trusted[self.seen.star]
        use, terms = self._fitted(before)
        expected_mag = self._expected(terms)
        depth = fit_depth(expected_mag, seen.is_seen, seen.frame, trusted)
        count = len(self.stars)
        light = Measurements(
            (seen.mag - expected_mag)[use, None], expected_mag[use], seen.star[use], count
        )
        is_seen = seen.is_seen
        offsets = Measurements(
            seen.offset_arcsec[is_seen], expected_mag[is_seen], seen.star[is_seen], count
        )
        mag_noise = light.of(trusted[use]).noise(MIN_MAG, self.min_frames)
        offset_noise = offsets.of(trusted[is_seen]).noise(MIN_ARCSEC, self.min_frames)
        brightness = light.by_star(mag_noise, self._unsure_mag(terms), self.min_frames)
        position = offsets.by_star(offset_noise, np.zeros(count), self.min_frames)
        records = self._records(terms, depth, brightness, position)
        distrusted, tests = _distrusted(records)
        judged = int(np.isfinite(records.log_chance).any(axis=1).sum())
        measured = int(np.isfinite(seen.mag).sum())
        return Lesson(
            terms, mag_noise, offset_noise, depth.limit_mag, records, distrusted, judged, tests,
            measured,
        )  # fmt: skip

    def _fitted(self, before: Lesson | None) -> tuple[Mask, Terms]:
        """Return the unbiased magnitudes, and the terms fitted to them for trusted stars."""
        seen = self.seen
        measured, sigma = np.isfinite(seen.mag), np.full(len(seen), FIRST_NOISE_MAG)
        use = measured
        if before is not None:
            expected_mag = self._expected(before.terms)
            sigma = np.hypot(before.mag_noise.at(expected_mag), before.mag_noise.of_stars)
            use = measured & (expected_mag < before.limit_mag - CLEAR * sigma)
        # If frames are so shallow that hardly a star of known colour is left, use all magnitudes.
        has_colour = np.isfinite(self.stars.colour)
        is_enough = has_colour[np.unique(seen.star[use])].sum() >= MIN_COLOURS
        rows = (use if is_enough or not has_colour.any() else measured) & self.is_trusted[seen.star]
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
        """The colours; the middle one for a star without a colour."""
        colour = self.stars.colour
        colours = colour[np.isfinite(colour)]
        return np.where(np.isnan(colour), np.median(colours) if len(colours) else 0.0, colour)

    def _unsure_mag(self, terms: Terms) -> Array:
        """Return the magnitude error of each star from an unknown colour."""
        spread = abs(self.applied + (terms.colour_term or 0.0)) * float(np.std(self._colour))
        return np.where(np.isnan(self.stars.colour), spread, 0.0)

    def _records(
        self, terms: Terms, depth: Depth, brightness: StarMeans, position: StarMeans
    ) -> StarRecords:
        seen, count = self.seen, len(self.stars)
        is_expected = np.isfinite(depth.chance)
        expected = np.bincount(seen.star[is_expected], minlength=count)
        n_seen = np.bincount(seen.star[is_expected], seen.is_seen[is_expected], minlength=count)
        chance = np.bincount(seen.star[is_expected], depth.chance[is_expected], minlength=count)
        missing = binom.logcdf(n_seen, expected, chance / np.maximum(expected, 1)) / np.log(10.0)
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
            n_missed=expected - n_seen.astype(np.int64),
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
    distrusted = []
    for row in np.flatnonzero((log_chance <= limit).any(axis=1)).tolist():
        order = np.argsort(log_chance[row], kind="stable")
        names = [TESTS[k] for k in order.tolist() if log_chance[row, k] <= limit]
        fainter = records.mag_residual[row] > 0.0
        words = ["too_faint" if fainter else "too_bright"] if "brightness" in names else []
        verdicts = [words[0] if name == "brightness" else name for name in names]
        distrusted.append(
            Distrusted(row, verdicts[0], tuple(verdicts[1:]), float(log_chance[row, order[0]]))
        )
    return tuple(distrusted), tests


@dataclass(frozen=True)
class Learnt:
    """A lesson, its inputs, and the section of the spec of a patch release.

    Attributes
    ----------
    lesson : Lesson
        Terms of the sensor with their errors, and ``distrusted``, the stars to distrust.
    stars : SkyStars
        The stars of the database.
    n_frames, n_identified : int
        Numbers of frames that were read, and that were identified.
    colour_bands : str or None
        Bands of the colour, such as ``BP-RP``; None if the database has no colours.
    observed : Observed
        The section ``[selection.observed]``.
    """

    lesson: Lesson
    stars: SkyStars
    n_frames: int
    n_identified: int
    colour_bands: str | None
    observed: Observed

    def __repr__(self) -> str:
        terms = self.lesson.terms
        return (
            f"<Learnt {self.stars.name}: {self.n_identified} of {self.n_frames} frames, zero point "
            f"{terms.zero_point_mag:+.3f} mag, colour term {terms.colour_term or 0.0:+.3f}, "
            f"{len(self.lesson.distrusted)} stars to distrust>"
        )

    @property
    def toml(self) -> str:
        """The section of the spec, with the evidence as comments."""
        return observed_toml(self)

    @property
    def table(self) -> pa.Table:
        """The records of the stars that the frames should show, one row per star."""
        return star_table(self)

    def evidence(self, star: Distrusted) -> str:
        """Return why a star is distrusted.

        Parameters
        ----------
        star : Distrusted
            One of ``lesson.distrusted``.

        Returns
        -------
        str
            The evidence in words.
        """
        texts = [
            _evidence(self.lesson, star.row, verdict) for verdict in (star.verdict, *star.also)
        ]
        return "; ".join(texts)

    def name_of(self, star: Distrusted) -> str:
        """Return the name of a star.

        Parameters
        ----------
        star : Distrusted
            One of ``lesson.distrusted``.

        Returns
        -------
        str
            The designation, or the number if the star has no designation.
        """
        name = " ".join(self.stars.designation[star.row].split())
        return name or str(self.stars.star_id[star.row])


def _different_digests(files: Sequence[Path]) -> tuple[str, ...]:
    """Return the SHA-256 of each file; ConfigError if two have the same content."""
    files_by_digest: dict[str, Path] = {}
    for path in files:
        digest = file_sha256(path)
        if digest in files_by_digest:
            raise ConfigError(
                f"has the same content as {files_by_digest[digest]}",
                where=path,
                hint="give it once, so that each frame counts once",
            )
        files_by_digest[digest] = path
    return tuple(files_by_digest)


def learn(
    database: HasFolder | PathLike,
    results: PathLike | Sequence[PathLike],
    *,
    by_frame: bool = False,
    min_frames: int = MIN_FRAMES,
) -> Learnt:
    """Learn zero point, colour term and the stars to distrust from identified frames.

    Parameters
    ----------
    database : Database, str or path-like
        The database with which the frames were identified, or its folder ``<name>-<version>``.
    results : path or sequence of paths
        Files with the output of ``starcat identify --ndjson``.
    by_frame : bool
        Whether to fit a magnitude offset for each frame, for example if exposures differ.
    min_frames : int
        Smallest number of frames from which a star is judged.

    Returns
    -------
    Learnt
        ``observed`` is the section for the spec of a patch release; ``toml`` is the same with the
        evidence as comments; ``table`` has the measurements of each star.

    Raises
    ------
    ConfigError, ProductError
        If a file cannot be read, or belongs to another database.
    CalibrationError
        If too few stars were identified.
    """
    opened = open_database_folder(database_path("database", database))
    files = paths_of("results", results)
    stars, bands = sky_stars(opened)
    answers = read_answers(files, stars)
    digests = _different_digests(files)
    count = len(answers.names)
    before = spec_of_database(opened).selection.observed
    lesson = learn_from_frames(
        answers.sightings,
        stars,
        count,
        by_frame=by_frame,
        min_frames=whole_number("min_frames", min_frames, 1),
        colour_term=before.colour_term,
    )
    terms = lesson.terms
    colours = stars.colour[np.isfinite(stars.colour)]
    rejected = {stars.number_of(star.row) for star in lesson.distrusted}
    # mag can include the colour term of an earlier lesson; the section is about the catalog's mag.
    slope = before.colour_term + (terms.colour_term or 0.0)
    zero_point_mag = terms.zero_point_mag - before.colour_term * before.reference_colour_mag
    reference = before.reference_colour_mag
    if not before.colour_term:
        reference = float(np.median(colours)) if len(colours) and slope else 0.0
    content = {
        "zero_point_mag": round(zero_point_mag, 5),
        "colour_term": round(slope, 5),
        "colour_bands": bands if slope else None,
        "reference_colour_mag": round(reference, 4),
        "reject": tuple(sorted(rejected | set(before.reject), key=_by_number)),
        "frames": count,
        "database": stars.name,
        "manifest_sha256": manifest_digest(opened.manifest),
        "results_sha256": digests,
    }
    try:
        observed = Observed.model_validate(content)
    except ValidationError as error:
        raise what_is_wrong(error, "learnt", Observed, "section") from error
    return Learnt(lesson, stars, answers.n_frames, count, bands, observed)


def sky_stars(database: DatabaseFolder) -> tuple[SkyStars, str | None]:
    """Return the stars of a database, and the bands of their colours that most stars have."""
    table, manifest = database.stars, database.manifest
    colour, bands = floats_of(table, "colour_mag"), None
    counts = pc.value_counts(table["colour_bands"].drop_null()).to_pylist()
    if counts:
        bands = str(min(counts, key=lambda entry: (-entry["counts"], entry["values"]))["values"])
        is_other = pc.fill_null(pc.not_equal(table["colour_bands"], bands), True)
        colour[is_other.to_numpy()] = np.nan
    stars = SkyStars(
        f"{manifest['name']}-{manifest['version']}",
        table["star_id"].to_numpy(),
        tuple(name or "" for name in table["designation"].to_pylist()),
        directions_of(table),
        floats_of(table, "mag"),
        colour,
        tuple(table["catalog"].to_pylist()),
    )
    return stars, bands


def _by_number(named: int | str) -> tuple[int, str]:
    """Return the key that sorts numbers, and numbers with their catalog."""
    return int(str(named).split()[-1]), str(named)


def _evidence(lesson: Lesson, row: int, verdict: str) -> str:
    records = lesson.records
    frames = f"in {records.n_seen[row]} frames"
    if verdict in ("too_faint", "too_bright"):
        word = verdict.removeprefix("too_")
        off, error = abs(records.mag_residual[row]), records.mag_error[row]
        return f"{off:.2f} +- {error:.2f} mag too {word} {frames}"
    if verdict == "variable":
        usual = float(np.median(lesson.mag_noise.sigma))
        scatter = records.mag_scatter[row]
        return f"its magnitude scatters by {scatter:.2f} mag, others' by {usual:.2f}, {frames}"
    if verdict == "moved":
        east, north = records.offset_arcsec[row]
        angle = math.degrees(math.atan2(east, north)) % 360.0
        error = records.offset_error_arcsec[row]
        return (
            f"{math.hypot(east, north):.1f} +- {error:.1f} arcsec away, position angle "
            f"{angle:.0f} deg, {frames}"
        )
    if verdict == "double":
        usual = float(np.median(lesson.offset_noise.sigma))
        scatter = records.offset_scatter_arcsec[row]
        return (
            f"its place scatters by {scatter:.1f} arcsec on an axis, others' by {usual:.1f}, "
            f"{frames}"
        )
    return (
        f"missed in {records.n_missed[row]} of {records.n_expected[row]} frames that should show it"
    )


def observed_toml(learnt: Learnt) -> str:
    """Return the section of a spec that a patch release is built from, with the evidence."""
    observed, lesson = learnt.observed, learnt.lesson
    terms = lesson.terms
    lines = [
        f"# Learnt from {learnt.n_identified} identified frames of {learnt.n_frames} with the "
        f"database {observed.database}.",
        f"# Zero point {terms.zero_point_mag:+.4f} +- {terms.zero_point_error_mag:.4f} mag.",
    ]
    if terms.colour_term is not None:
        lines.append(
            f"# Colour term {terms.colour_term:+.4f} +- {terms.colour_term_error:.4f} "
            f"({learnt.colour_bands}) beside what the database has."
        )
    lines += [
        f"# Of {lesson.n_judged} stars these are distrusted; the probability that chance alone "
        f"puts any star into this list is {FAMILY:g}.",
        "[selection.observed]",
    ]
    distrusted = {learnt.stars.number_of(star.row): star for star in lesson.distrusted}
    for name, value in observed.model_dump(mode="json").items():
        if name != "reject":
            lines += [] if value in (None, []) else [f"{name} = {toml_value(value)}"]
            continue
        lines.append("reject = [")
        for number in value:
            star = distrusted.get(number)
            why = "distrusted before"
            if star is not None:
                why = f"{learnt.name_of(star)}: {star.verdict}, {learnt.evidence(star)}"
            lines.append(f"    {toml_value(number)},  # {why}")
        lines.append("]")
    return "\n".join(lines) + "\n"


_OBSERVED = re.compile(
    r"^\[selection\.observed\].*?(?=\n(?:#[^\n]*\n|\n)*\[|\Z)", re.MULTILINE | re.DOTALL
)


def patch_toml(learnt: Learnt, path: Path) -> str:
    """Return the spec of a patch release: a spec with the next version and the new section.

    Comments of the spec stay. The section of an earlier patch release is replaced.
    """
    spec = read_spec(path)
    if f"{spec.name}-{spec.version}" != learnt.stars.name:
        raise ConfigError(
            f"the spec of {spec.name}-{spec.version}, and the frames were identified with "
            f"{learnt.stars.name}",
            where=path,
            hint="give the spec of that database",
        )
    major, minor, patch = version_numbers(spec.version)
    raised = f"{major}.{minor}.{patch + 1}"
    text = text_of_toml(path, "no such spec")
    stated = rf"^(version\s*=\s*[\"']){re.escape(spec.version)}(?=[\"'])"
    text = re.sub(stated, rf"\g<1>{raised}", text, count=1, flags=re.MULTILINE)
    text = f"{_OBSERVED.sub('', text).rstrip()}\n\n{observed_toml(learnt)}"
    content = content_of_toml(text, str(path))
    if (content.get("version"), content.get("name")) != (raised, spec.name):
        raise ConfigError(f'expected a line version = "{spec.version}" of its own', where=path)
    return text


def star_table(learnt: Learnt) -> pa.Table:
    """Return the records of the stars that the frames should show, one row per star."""
    records, stars = learnt.lesson.records, learnt.stars
    verdict = {star.row: star.verdict for star in learnt.lesson.distrusted}
    rows = np.flatnonzero((records.n_seen > 0) | (records.n_expected > 0))
    numbers = {
        "mag": stars.mag,
        "colour_mag": stars.colour,
        "observed_mag": records.observed_mag,
        "residual_mag": records.mag_residual,
        "residual_error_mag": records.mag_error,
        "scatter_mag": records.mag_scatter,
        "east_arcsec": records.offset_arcsec[:, 0],
        "north_arcsec": records.offset_arcsec[:, 1],
        "offset_error_arcsec": records.offset_error_arcsec,
        "scatter_arcsec": records.offset_scatter_arcsec,
    }
    columns: dict[str, Any] = {
        "star_id": stars.star_id[rows],
        "designation": [stars.designation[row] or None for row in rows.tolist()],
        "verdict": pa.array([verdict.get(row) for row in rows.tolist()], pa.string()),
        "frames_seen": records.n_seen[rows],
        "frames_expected": records.n_expected[rows],
        "frames_missed": records.n_missed[rows],
    }
    columns |= {name: pa.array(values[rows], from_pandas=True) for name, values in numbers.items()}
    return pa.table(columns)


def _colour_stars(learnt: Learnt) -> int:
    """Return how many stars have a measured magnitude and a colour."""
    measured = np.isfinite(learnt.lesson.records.observed_mag)
    return int(np.count_nonzero(measured & np.isfinite(learnt.stars.colour)))


def content_of(learnt: Learnt) -> dict[str, Any]:
    """Return a lesson with its inputs as values for JSON."""
    lesson, terms = learnt.lesson, learnt.lesson.terms
    limit = lesson.limit_mag
    return {
        "database": learnt.stars.name,
        "frames": learnt.n_frames,
        "identified": learnt.n_identified,
        "measured_magnitudes": lesson.n_sightings,
        "zero_point_mag": terms.zero_point_mag,
        "zero_point_error_mag": terms.zero_point_error_mag,
        "colour_bands": learnt.colour_bands,
        "colour_term": terms.colour_term,
        "colour_term_error": terms.colour_term_error,
        "colour_stars": _colour_stars(learnt),
        "limit_mag": limit if math.isfinite(limit) else None,
        "noise_mag": float(np.median(lesson.mag_noise.sigma)),
        "star_scatter_mag": lesson.mag_noise.of_stars,
        "noise_arcsec": float(np.median(lesson.offset_noise.sigma)),
        "star_scatter_arcsec": lesson.offset_noise.of_stars,
        "judged": lesson.n_judged,
        "chance": FAMILY,
        "distrusted": [
            {
                "star_id": str(learnt.stars.star_id[star.row]),
                "star": learnt.name_of(star),
                "verdict": star.verdict,
                "also": list(star.also),
                "evidence": learnt.evidence(star),
                "log10_chance": star.log_chance,
            }
            for star in lesson.distrusted
        ],
        "observed": learnt.observed.model_dump(mode="json"),
        "stars": [
            {**row, "star_id": str(row["star_id"])} for row in star_table(learnt).to_pylist()
        ],
    }
