"""The matcher: centroids in, identified stars and attitude out.

A method proposes which centroids are which stars; every proposal goes through the same
verification, and only an agreement that chance does not explain is an answer. The readable
reference is in numpy. If possible, the C library answers, with the same stars.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from starcat.arguments import HasFolder, check_type, database_path, whole_number
from starcat.database.onboard.layout import FEATURES
from starcat.database.onboard.reading import is_image
from starcat.errors import ConfigError
from starcat.geometry.camera import WIDEST_FOV_DEG, Camera
from starcat.geometry.distortion import checked_number
from starcat.matcher.batch import BatchResult, no_answers
from starcat.matcher.blind import checked_fields, identify_blind
from starcat.matcher.brightest import MAX_CENTROIDS, brightest_of, brightest_of_frames
from starcat.matcher.c_engine import CEngine, Search, c_engine, is_compiled
from starcat.matcher.centroids import MeasuredFrame
from starcat.matcher.database import MatcherDatabase, open_database, open_image, products_in
from starcat.matcher.methods.table import best_method, method_named
from starcat.matcher.numpy_engine import solve
from starcat.matcher.observation import (
    Frame,
    FrameLike,
    as_arrays,
    as_frames,
    copied,
    frame_of_table,
    remarks_of,
)
from starcat.matcher.options import checked_option
from starcat.matcher.other_fields import explained
from starcat.matcher.prior import BoresightPrior, Prior, PriorLike, prior_of
from starcat.matcher.result import MatchResult
from starcat.matcher.second_attitude import rows_of_second_pattern, with_second_attitude
from starcat.matcher.settings import SCALE_FREE, Settings, check_scale_free, has_default_search

MAX_CAMERAS = 16
"""Cameras that a matcher keeps ready for the C library."""


@dataclass(frozen=True, repr=False, init=False)
class Matcher:
    """A database, a method and the limits of an identification: centroids in, attitude out.

    Open one with `Matcher.open`. `identify` takes arrays, frames and tables;
    `starcat.identify_file` identifies the frame of a file.

    Attributes
    ----------
    database : MatcherDatabase
        The stars and the products that the method needs.
    settings : Settings
        The method and the limits. Single ``options`` replace fields of the settings.
    """

    database: MatcherDatabase
    settings: Settings

    def __init__(self, database: MatcherDatabase, settings: Settings | None = None, **options: Any):
        check_type(
            "database", database, MatcherDatabase,
            "the database of a matcher; open one with starcat.Matcher.open",
        )  # fmt: skip
        check_type("settings", settings or Settings(), Settings, "starcat.Settings")
        settings = Settings(**options) if settings is None else replace(settings, **options)
        object.__setattr__(self, "database", database)
        object.__setattr__(self, "settings", settings)
        method_named(settings.method)
        if database.image is not None and settings.engine == "numpy":
            text = "it needs a database; an onboard image has no products"
            raise ConfigError(text, parameter="engine", value=settings.engine)
        if settings.engine == "c" and self._c_engine is None:
            raise ConfigError(self._without_c(), parameter="engine", value="c")

    def __repr__(self) -> str:
        settings = self.settings
        return (
            f"<Matcher {settings.method} on {self.database.name}: {len(self.database.mag):,} "
            f"stars, tolerance {settings.tolerance_px:g} px, chance "
            f"{settings.max_false_match_probability:g}>"
        )

    @classmethod
    def open(
        cls,
        database: HasFolder | str | os.PathLike[str],
        method: str | None = None,
        *,
        verify: bool = True,
        **options: Any,
    ) -> Self:
        """Open a database, or an onboard image with the C library, as in flight.

        Parameters
        ----------
        database : Database, str or path-like
            What ``starcat.open`` returns, the folder of a database, or an image as
            `starcat export --to onboard` writes it.
        method : str, optional
            A key of `METHODS`; the best that the products allow by default. An image has its own.
        verify : bool, default True
            Whether to compare the SHA-256 of ``database.h5`` with the manifest's, which finds
            any change since the build: about 2 ms for each MB of the file. The manifest itself
            is trusted, and a ``database.h5`` without one is not compared; `starcat.verify`
            checks everything. With False only types, lengths, ranges and references are checked.
            An onboard image has checksums of its own, which are always checked.
        **options
            Fields of `Settings`, such as ``tolerance_px`` or ``noise_px``.

        Returns
        -------
        Matcher
            Ready to identify.

        Raises
        ------
        ConfigError
            If there is no such method or engine, or a number is out of range.
        ProductError, SchemaVersionError
            If the database cannot be read, or lacks a product that the method needs.
        """
        path = database_path("database", database)
        if is_image(path):
            opened = open_image(path)
            method_name = opened.image.method if opened.image else ""
            if options.get("engine", "auto") == "auto":
                options["engine"] = "c"
        else:
            products = products_in(path)
            method_name = best_method(products) if method is None else method
            entry = method_named(method_name)
            usable = (name for name in entry.optional if name in products)
            opened = open_database(path, (*entry.products, *usable), verify=verify)
        return cls(opened, method=method_name, **options)

    def with_settings(self, **options: Any) -> Matcher:
        """Return a matcher of the same database with other settings.

        Parameters
        ----------
        **options
            Fields of `Settings`, such as ``max_steps``; the other fields stay.

        Returns
        -------
        Matcher
            Another matcher; this one stays as it is.

        Raises
        ------
        ConfigError
            If a number is out of range, or the engine cannot be used.
        """
        return Matcher(self.database, self.settings, **options)

    def for_many_frames(self) -> Matcher:
        """Return the matcher that identifies many frames soonest.

        Returns
        -------
        Matcher
            In C, if that is possible, also where making the image that C reads takes longer than
            a frame in numpy; this matcher if an engine is chosen already.
        """
        settings = self.settings
        if settings.engine != "auto" or not has_default_search(settings):
            return self
        if c_engine(self.database, settings.method) is None:
            return self
        return self.with_settings(engine="c")

    def identify(
        self,
        centroids_px: FrameLike,
        camera: Camera | None = None,
        *,
        mag: ArrayLike | None = None,
        sigma_px: ArrayLike | None = None,
        fov_error: float | None = None,
        prior: PriorLike | None = None,
        prior_error_deg: float | None = None,
        fov_deg: float | tuple[float, float] | None = None,
        explain: bool = False,
    ) -> MatchResult:
        """Identify the stars of a frame.

        Parameters
        ----------
        centroids_px : array_like of float64, shape (N, 2)
            Pixels, in any order. Centroids that are not finite (or masked), outside of the frame
            or repeated get no star and are reported. If there are more than 512, the brightest
            are searched, and `MatchResult.n_not_searched` counts the others. A frame of
            `starcat.simulate`, `starcat.read_frames` or a result is read with its ``mag`` and
            ``sigma_px``. A table (astropy, pandas, polars, Arrow, structured array, mapping) is
            read by the names of its columns, as files are: ``x_px``, ``y_px``, and ``mag`` or
            ``flux``, and ``sigma_px`` if it has them, or the names of photutils, SExtractor and
            astrometry.net. `MatchResult.remarks` lists the columns that are not used.
            The frame of a file, such as a picture, is identified by `starcat.identify_file`.
        camera : Camera, optional
            The database's own by default.
        mag : array_like of float64, shape (N,), optional
            Magnitudes. They decide what is tried first; with ``noise_mag`` also what is accepted,
            and then they must have the zero point of the database. NaN, a masked entry, and any
            number outside of -100 to 100 are unknown magnitudes.
        sigma_px : float or array_like of float64, shape (N,), optional
            Standard deviation of each centroid on each axis, or of all; NaN if unknown. They weight
            the attitude of an answer and give its covariance. Stars do not depend on them.
        fov_error : float, optional
            Largest relative error of the camera's focal length, 0 to 0.5; by default 0. If it is
            above 0, the focal length is found with the attitude; this needs the method
            ``triangle``.
        prior, prior_error_deg : array_like of float64, shape (4,), and float, optional
            Attitude that is expected, as ``q_body_from_icrs`` or as a scipy ``Rotation`` like
            `MatchResult.rotation` returns, and its largest error as an angle of rotation, at most
            20. Only the stars near it are compared; the verification is the same. An astropy
            ``SkyCoord`` is the expected boresight alone: the whole sky is searched, and an
            attitude whose boresight is farther from it than the error is withheld.
        fov_deg : float or pair of float, optional
            Field across the width in place of the camera's, for a lens without distortion. If only
            a range is known: the narrowest and widest field; this needs the product ``levels``.
        explain : bool, default False
            Whether a frame that is not identified is tried mirrored, and in fields of half to
            twice the stated one, for 2 seconds at most. An explanation that is found is in
            ``MatchResult.refusal``, and its field is ``MatchResult.fits_fov_deg``. Frames with a
            prior or a range of fields are not tried so.

        Returns
        -------
        MatchResult
            ``no_match`` and ``too_few_stars`` are answers too.

        Raises
        ------
        ConfigError
            If a shape is wrong, the prior not a quaternion, or an error missing or too large.
        """
        # The first test is the faster one, and nearly all calls have an array.
        if not isinstance(centroids_px, np.ndarray) and isinstance(centroids_px, str | os.PathLike):
            raise ConfigError(
                f"{os.fspath(centroids_px)} is a file; identify it with starcat.identify_file, or "
                "read its frames with starcat.read_frames"
            )
        values: Any = centroids_px
        remarks: tuple[str, ...] = ()
        if type(values) is not np.ndarray or values.dtype.names:
            values = frame_of_table(values)
            remarks = remarks_of(values)
        camera, expected = self._camera(camera), prior_of(prior, prior_error_deg)
        if fov_deg is not None:
            fov_deg = self.checked_field(fov_deg, fov_error, expected)
            if not isinstance(fov_deg, tuple):
                size_px = camera.width_px, camera.height_px
                camera, fov_deg = Camera(*size_px, fov_x_deg=fov_deg), None
        fov_error = 0.0 if fov_error is None else fov_error
        px, mags, sigma = as_arrays(values, mag, sigma_px)
        frame = Frame(px, mags, camera, sigma)
        near = expected if isinstance(expected, Prior) else None
        if len(frame) <= MAX_CENTROIDS:
            answer = self._search(frame, fov_error, near, fov_deg)
        else:
            part = brightest_of(copied(frame))
            answer = part.answer_of(self._search(part.frame, fov_error, near, fov_deg))
        if answer.ok and fov_deg is None and not answer.n_not_searched:
            rows = rows_of_second_pattern(answer, px, self.settings.tolerance_px)
            if rows is not None:
                answer = with_second_attitude(answer, rows, self._search(frame.at(rows), fov_error))
        if isinstance(expected, BoresightPrior):
            answer = expected.checked(answer)
        elif explain and answer.status == "no_match" and near is None and fov_deg is None:
            answer = explained(
                answer, MeasuredFrame("", px, mags, sigma_px=sigma), camera, self._search_other,
                fov_error=fov_error, with_fields=self.settings.method in SCALE_FREE,
                limit=self.settings.max_false_match_probability,
            )  # fmt: skip
        return answer.with_facts(frame_remarks=remarks) if remarks else answer

    def checked_field(
        self, fov_deg: Any, fov_error: float | None, near: Prior | BoresightPrior | None
    ) -> float | tuple[float, float]:
        """Return one field of view, or a range of fields and that nothing else contradicts it."""
        if not isinstance(fov_deg, tuple | list):
            return checked_number("fov_deg", fov_deg, 0.0, WIDEST_FOV_DEG)
        fields_deg = checked_fields(fov_deg)
        others = {"fov_error": fov_error, "prior": near if isinstance(near, Prior) else None}
        for name, value in others.items():
            if value:
                raise ConfigError(
                    f"a range of fields has no {name}",
                    parameter="fov_deg",
                    hint=f"give either {{fov_deg}} or {{{name}}}",
                )
        return fields_deg

    def _search_other(self, frame: MeasuredFrame, fov_error: float, camera: Camera) -> MatchResult:
        """Identify a frame that was turned, or with another camera."""
        px, mag, sigma_px = frame.centroids_px, frame.mag, frame.sigma_px
        return self.identify(px, camera, mag=mag, sigma_px=sigma_px, fov_error=fov_error)

    def _search(
        self,
        frame: Frame,
        fov_error: float,
        near: Prior | None = None,
        fov_deg: tuple[float, float] | None = None,
    ) -> MatchResult:
        """Identify the stars of a frame of at most `MAX_CENTROIDS`, in C if possible."""
        error = 0.0 if fov_deg is not None else self._checked_fov_error(fov_error)
        # The C library has no range of fields, and not an error of the scale and a prior at once.
        in_c = None if fov_deg is not None or (error and near) else self._in_c(frame.camera, error)
        if in_c is not None and (answer := in_c.identify(frame, near)) is not None:
            return answer
        return self._in_numpy(copied(frame), error, near, fov_deg)

    def _in_numpy(
        self,
        frame: Frame,
        fov_error: float = 0.0,
        near: Prior | None = None,
        fov_deg: tuple[float, float] | None = None,
    ) -> MatchResult:
        """Identify a frame with numpy; the answer has the time, and what the caller gave."""
        before_s = time.perf_counter()
        if fov_deg is None:
            answer = solve(self.settings, self.database, frame, fov_error=fov_error, prior=near)
        else:
            answer = identify_blind(self.settings, self.database, frame, fov_deg=fov_deg)
        return answer.with_facts(
            time_s=time.perf_counter() - before_s,
            frame=frame,
            database=self.database,
            noise_px=self.settings.noise_px,
            otherwise_px=self.settings.assumed_noise_px,
            fov_error=fov_error,
        )

    def identify_many(
        self,
        frames: Iterable[FrameLike],
        camera: Camera | None = None,
        *,
        mag: Iterable[ArrayLike] | None = None,
        sigma_px: Iterable[ArrayLike] | None = None,
        threads: int | None = None,
    ) -> BatchResult:
        """Identify the stars of many frames of one camera.

        Parameters
        ----------
        frames : iterable of array_like of float64, shape (n, 2)
            Centroids of each frame, as `identify` takes them.
        camera : Camera, optional
            The database's own by default.
        mag, sigma_px : sequence of array_like of float64, shape (n,), optional
            Those of each frame.
        threads : int, optional
            Threads that the C library runs in at once; all cores by default. The answers do not
            depend on it.

        Returns
        -------
        BatchResult
            A sequence with one `MatchResult` per frame, and arrays over all frames.

        Raises
        ------
        ConfigError
            As `identify`, or if there are not as many arrays of each as frames.
        """
        camera = self._camera(camera)
        batch = as_frames(frames, camera, mag, sigma_px)
        searched, crowded = brightest_of_frames(batch)
        workers = (os.cpu_count() or 1) if threads is None else whole_number("threads", threads, 1)
        in_c = self._in_c(camera)
        if in_c is None:
            answers, remaining = no_answers(len(batch)), list(range(len(batch)))
        else:
            answers, remaining = in_c.identify_many(searched, workers)
        answers = answers.with_answers({n: self._in_numpy(searched[n]) for n in remaining})
        answers = answers.with_answers(
            {n: part.answer_of(answers[n]) for n, part in crowded.items()}
        )
        return answers.with_answers(
            {
                n: answers[n].with_facts(frame_remarks=remarks)
                for n, remarks in batch.remarks.items()
            }
        )

    def _camera(self, camera: Camera | None) -> Camera:
        if camera is None:
            return self.database.camera
        expected = "a starcat.Camera. Give magnitudes by name: identify(centroids_px, mag=...)"
        check_type("camera", camera, Camera, expected)
        return camera

    @property
    def _c_engine(self) -> CEngine | None:
        """The C library with this matcher's image; None if it cannot be used."""
        if self.settings.engine == "numpy" or not has_default_search(self.settings):
            return None
        return c_engine(self.database, self.settings.method, self.settings.engine == "c")

    def _without_c(self) -> str:
        """Return why the C library cannot be used with this matcher."""
        if not is_compiled():
            return (
                "this starcat was installed without a C compiler; install one, then starcat again"
            )
        if self.settings.method not in FEATURES:
            return (
                f"method {self.settings.method!r} is not in C; choose one of {', '.join(FEATURES)}"
            )
        if not has_default_search(self.settings):
            return "it has no other selection, share of the frame and limits than the default"
        return f"{self.database.name} has too many stars or features for an onboard image"

    @cached_property
    def _searches(self) -> dict[tuple[Camera | int, float], Search]:
        """The latest searches, by camera and its error, and by the identity of the camera.

        Each search holds its camera, so that the identity stays unique. Equal cameras share one.
        """
        return {}

    def _in_c(self, camera: Camera, fov_error: float = 0.0) -> Search | None:
        """Return the search of the C library for a camera; None if it cannot be used."""
        search = self._searches.get((id(camera), fov_error))
        if search is None:
            search = self._searches.get((camera, fov_error))
        if search is None:
            engine = self._c_engine
            if engine is None:
                return None
            if len(self._searches) >= 2 * MAX_CAMERAS:
                self._searches.clear()
            search = engine.search(camera, self.settings, fov_error)
            self._searches[id(camera), fov_error] = self._searches[camera, fov_error] = search
        return search

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for another process, without addresses."""
        return {name: value for name, value in vars(self).items() if name != "_searches"}

    def _checked_fov_error(self, fov_error: float) -> float:
        if type(fov_error) is float and fov_error == 0.0:  # nearly all calls end here
            return fov_error
        fov_error = checked_option("fov_error", fov_error)
        if not fov_error:
            return 0.0
        check_scale_free(self.settings)
        return float(fov_error)
