"""The matcher: centroids in, identified stars and attitude out.

A method proposes which centroids are which stars; every proposal goes through the same
verification, and only an agreement that chance does not explain is an answer. The readable
reference is in numpy. If possible, the C library answers, with the same stars.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from starcat.arguments import HasFolder, check_type, database_path, whole_number
from starcat.arrays import Array, Pixels
from starcat.errors import ConfigError
from starcat.geometry.camera import WIDEST_FOV_DEG, Camera
from starcat.geometry.distortion import checked_number
from starcat.matcher.batch import BatchResult, no_answers
from starcat.matcher.blind import checked_fields, identify_blind
from starcat.matcher.brightest import MAX_CENTROIDS, brightest_of, brightest_of_frames
from starcat.matcher.c_engine import CEngine, Search, c_engine, is_compiled
from starcat.matcher.centroids import MeasuredFrame
from starcat.matcher.database import Database, open_database, open_image, products_in
from starcat.matcher.methods.table import best_method, method_named
from starcat.matcher.numpy_engine import solve
from starcat.matcher.observation import (
    Frame,
    FrameLike,
    as_arrays,
    as_frame,
    as_frames,
    frame_of_table,
    remarks_of,
)
from starcat.matcher.other_fields import explained
from starcat.matcher.prior import BoresightPrior, Prior, PriorLike, prior_of
from starcat.matcher.result import MatchResult
from starcat.matcher.second_attitude import with_second_attitude
from starcat.matcher.settings import (
    CERTAIN,
    MAX_STEPS,
    MIN_SHARE,
    SCALE_FREE,
    Engine,
    Settings,
    TriangleOrder,
    check_scale_free,
    checked_option,
    has_default_search,
)
from starcat.onboard.layout import FEATURES
from starcat.onboard.reading import is_image

MAX_CAMERAS = 16
"""Cameras that a matcher keeps ready for the C library."""


@dataclass(frozen=True)
class _WithDatabase:
    """The first field of a `Matcher`, before the fields of its settings."""

    database: Database


@dataclass(frozen=True, repr=False)
class Matcher(Settings, _WithDatabase):
    """A database, a method and the limits of an identification.

    Attributes
    ----------
    database : Database
        The stars and the products that the method needs; then come the fields of `Settings`.
    """

    def __post_init__(self) -> None:
        check_type(
            "database", self.database, Database,
            "the database of a matcher; open one with starcat.Matcher.open",
        )  # fmt: skip
        method_named(self.method)
        super().__post_init__()
        if self.database.image is not None and self.engine == "numpy":
            text = "engine 'numpy' needs a database; an onboard image has no products"
            raise ConfigError(text, key="engine", value=self.engine)
        if self.engine == "c" and self._c_engine is None:
            raise ConfigError(f"engine 'c': {self._without_c()}", key="engine", value="c")

    def __repr__(self) -> str:
        return (
            f"<Matcher {self.method} on {self.database.name}: {len(self.database.mag):,} stars, "
            f"tolerance {self.tolerance_px:g} px, chance {self.max_false_match_probability:g}>"
        )

    @classmethod
    def open(
        cls,
        artifact: HasFolder | str | os.PathLike[str],
        method: str | None = "triangle",
        *,
        tolerance_px: float | None = None,
        max_false_match_probability: float = CERTAIN,
        selection: TriangleOrder = TriangleOrder(),  # noqa: B008
        noise_px: float | None = None,
        noise_mag: float | None = None,
        engine: Engine = "auto",
        min_share: float = MIN_SHARE,
        max_steps: float = MAX_STEPS,
        time_limit_s: float = math.inf,
        camera_error: float | None = None,
        verify: bool = True,
    ) -> Self:
        """Open the database of an artifact, or an onboard image with the C library, as in flight.

        Parameters
        ----------
        artifact : Database, str or path-like
            What ``starcat.open`` returns, the folder of a database, or an image as
            `starcat export --to onboard` writes it.
        method : str, default "triangle"
            A key of `METHODS`; None for the best that the products allow. An image has its own.
        tolerance_px, max_false_match_probability, selection, noise_px, noise_mag, engine, \
        min_share, max_steps, time_limit_s, camera_error
            As the fields of `Settings`.
        verify : bool, default True
            Whether to compare the SHA-256 of ``database.h5`` with the manifest's, which finds
            any change since the build: about 2 ms for each MB of the file. The manifest itself
            is trusted, and a ``database.h5`` without one is not compared; `starcat.verify`
            checks everything. With False only types, lengths, ranges and references are checked.
            An onboard image has checksums of its own, which are always checked.

        Returns
        -------
        Matcher
            Ready to identify.

        Raises
        ------
        ConfigError
            If there is no such method or engine, or a number is out of range.
        ProductError, SchemaVersionError
            If the artifact cannot be read, or lacks a product that the method needs.
        """
        path = database_path("artifact", artifact)
        if is_image(path):
            database = open_image(path)
            chosen = database.image.method if database.image else ""
            engine = "c" if engine == "auto" else engine
        else:
            held = products_in(path)
            chosen = best_method(held) if method is None else method
            known = method_named(chosen)
            usable = (name for name in known.optional if name in held)
            database = open_database(path, (*known.products, *usable), verify=verify)
        return cls(
            database,
            chosen,
            tolerance_px,  # type: ignore[arg-type]
            max_false_match_probability,
            selection,
            noise_px=noise_px,
            noise_mag=noise_mag,
            engine=engine,
            min_share=min_share,
            max_steps=max_steps,
            time_limit_s=time_limit_s,
            camera_error=camera_error,
        )

    def identify(
        self,
        centroids_px: FrameLike | os.PathLike[str],
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
            `starcat.Matcher` also takes the path of a file. A file of centroids has the same
            answer as its frame of `starcat.read_frames`. A picture is identified as by ``starcat
            identify``: with further attempts, with an explanation if it is not identified, and
            without the arguments ``mag`` and ``sigma_px``, which are measured.
        camera : Camera, optional
            The database's own by default.
        mag : array_like of float64, shape (N,), optional
            Magnitudes. They decide what is tried first; with ``noise_mag`` also what is accepted,
            and then they must have the zero point of the database. NaN, a masked entry, and any
            number outside of -100 to 100 are unknown magnitudes.
        sigma_px : array_like of float64, shape (N,), optional
            Standard deviation of each centroid on each axis, NaN if unknown. They weight the
            attitude of an answer and give its covariance. Stars do not depend on them.
        fov_error : float, optional
            Largest relative error of the camera's focal length, 0 to 0.5; by default 0, and 0.05
            for a picture. If it is above 0, the focal length is found with the attitude; this
            needs the method ``triangle``.
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
            return self._identify_file(
                Path(centroids_px), camera,
                mag=mag, sigma_px=sigma_px, fov_error=fov_error, prior=prior,
                prior_error_deg=prior_error_deg, fov_deg=fov_deg, explain=explain,
            )  # fmt: skip
        given: Any = centroids_px
        if type(given) is not np.ndarray or given.dtype.names:
            given = frame_of_table(given)
            if remarks := remarks_of(given):
                found = self.identify(
                    given.centroids_px, camera, mag=given.mag if mag is None else mag,
                    sigma_px=given.sigma_px if sigma_px is None else sigma_px, fov_error=fov_error,
                    prior=prior, prior_error_deg=prior_error_deg, fov_deg=fov_deg, explain=explain,
                )  # fmt: skip
                return found.with_facts(frame_remarks=remarks)
        camera, near = self._camera(camera), prior_of(prior, prior_error_deg)
        if fov_deg is not None:
            fov_deg = self.checked_field(fov_deg, fov_error, near)
            if not isinstance(fov_deg, tuple):
                size_px = camera.width_px, camera.height_px
                camera, fov_deg = Camera(*size_px, fov_x_deg=fov_deg), None
        fov_error = 0.0 if fov_error is None else fov_error
        px, mags, sigma = as_arrays(given, mag, sigma_px)
        if near is not None and isinstance(near, BoresightPrior):
            found = self.identify(px, camera, mag=mags, sigma_px=sigma, fov_error=fov_error,
                                  fov_deg=fov_deg)  # fmt: skip
            return near.checked(found)
        if len(px) <= MAX_CENTROIDS:
            found = self._search(px, camera, mags, sigma, fov_error, near, fov_deg)
        else:
            part = brightest_of(as_frame(px, camera, mags, sigma))
            few = part.frame
            searched = few.centroids_px, camera, few.mag, few.sigma_px
            found = part.answer_of(self._search(*searched, fov_error, near, fov_deg))
        if found.ok and fov_deg is None and not found.n_not_searched:
            found = with_second_attitude(
                found, px, self.tolerance_px,
                lambda rows: self._search(
                    px[rows], camera,
                    None if mags is None else mags[rows], None if sigma is None else sigma[rows],
                    fov_error, None, None,
                ),
            )  # fmt: skip
        if not explain or found.status != "no_match" or near is not None or fov_deg is not None:
            return found
        return self._explained(
            found, MeasuredFrame("", px, mags, sigma_px=sigma), camera, fov_error
        )

    def checked_field(
        self, fov_deg: Any, fov_error: float | None, near: Prior | BoresightPrior | None
    ) -> float | tuple[float, float]:
        """Return one field of view, or a range of fields and that nothing else contradicts it."""
        if not isinstance(fov_deg, tuple | list):
            return checked_number("fov_deg", fov_deg, 0.0, WIDEST_FOV_DEG)
        fields_deg = checked_fields(fov_deg)
        others = {"fov_error": fov_error, "prior": near if isinstance(near, Prior) else None}
        for name, given in others.items():
            if given:
                raise ConfigError(
                    f"fov_deg is a range of fields, which has no {name}; give either fov_deg or "
                    f"{name}",
                    key=name,
                    fields=("fov_deg", name),
                )
        return fields_deg

    def _explained(
        self, refused: MatchResult, frame: MeasuredFrame, camera: Camera, fov_error: float
    ) -> MatchResult:
        def search(
            frame: MeasuredFrame, fov_error: float, other: Camera | None, time_limit_s: float
        ) -> MatchResult:
            eye = other or camera
            return self.within(time_limit_s, eye, fov_error).identify(
                frame.centroids_px, eye,
                mag=frame.mag, sigma_px=frame.sigma_px, fov_error=fov_error,
            )  # fmt: skip

        return explained(
            refused, frame, camera, search, fov_error=fov_error,
            with_fields=self.method in SCALE_FREE, limit=self.max_false_match_probability,
        )  # fmt: skip

    def within(
        self, time_limit_s: float, camera: Camera, fov_error: float, *, is_range: bool = False
    ) -> Self:
        """Return a matcher whose searches with numpy end after a time; C has its own limit.

        ``is_range`` is whether it is to search a range of fields, which C does not.
        """
        in_c = not is_range and self._in_c(camera, fov_error) is not None
        if in_c or time_limit_s >= self.time_limit_s:
            return self
        return replace(self, time_limit_s=time_limit_s)

    def _search(
        self,
        px: Pixels,
        camera: Camera,
        mags: Array | None,
        sigma: Array | None,
        fov_error: float,
        near: Prior | None,
        fov_deg: tuple[float, float] | None,
    ) -> MatchResult:
        """Identify the stars of a frame of at most `MAX_CENTROIDS`, in C if possible."""
        if fov_deg is not None:
            frame = as_frame(px, camera, mags, sigma)
            return self._timed(frame, partial(identify_blind, fov_deg=fov_deg))
        error = self._checked_fov_error(fov_error)
        in_c = None if error and near else self._in_c(camera, error)  # C has not both at once
        if in_c is not None and (found := in_c.one(px, mags, near, sigma)) is not None:
            return found
        frame = as_frame(px, camera, mags, sigma)
        return self._timed(frame, partial(solve, fov_error=error, prior=near), error)

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
        given = as_frames(frames, camera, mag, sigma_px)
        searched, crowded = brightest_of_frames(given)
        workers = (os.cpu_count() or 1) if threads is None else whole_number("threads", threads, 1)
        in_c = self._in_c(camera)
        if in_c is None:
            found, left = no_answers(len(given)), list(range(len(given)))
        else:
            found, left = in_c.many(searched, workers)
        found = found.with_answers({n: self._timed(searched[n], solve) for n in left})
        found = found.with_answers({n: part.answer_of(found[n]) for n, part in crowded.items()})
        return found.with_answers(
            {n: found[n].with_facts(frame_remarks=told) for n, told in given.remarks.items()}
        )

    def _camera(self, camera: Camera | None) -> Camera:
        if camera is None:
            return self.database.camera
        expected = "a starcat.Camera. Give magnitudes by name: identify(centroids_px, mag=...)"
        check_type("camera", camera, Camera, expected)
        return camera

    def _identify_file(self, path: Path, camera: Camera | None, **options: Any) -> MatchResult:
        """Identify the frame of a file; `starcat.Matcher` can."""
        raise ConfigError(f"{path} is a file; read its centroids first, or use starcat.Matcher")

    @cached_property
    def _settings(self) -> Settings:
        return Settings(**{field.name: getattr(self, field.name) for field in fields(Settings)})

    @property
    def _c_engine(self) -> CEngine | None:
        """The C library with this matcher's image; None if it cannot be used."""
        if self.engine == "numpy" or not has_default_search(self):
            return None
        return c_engine(self.database, self.method, self.engine == "c")

    def _without_c(self) -> str:
        """Return why the C library cannot be used with this matcher."""
        if not is_compiled():
            return (
                "this starcat was installed without a C compiler; install one, then starcat again"
            )
        if self.method not in FEATURES:
            return f"method {self.method!r} is not in C; choose one of {', '.join(FEATURES)}"
        if not has_default_search(self):
            return (
                "it has no other selection, share of the frame, ranges and limits than the default"
            )
        return f"{self.database.name} has too many stars or features for an onboard image"

    @cached_property
    def _searches(self) -> dict[tuple[Camera | int, float], Search]:
        """The latest searches, by camera and its error, and by the identity of the camera.

        Each search holds its camera, so that the identity stays unique. Equal cameras share one.
        """
        return {}

    def _in_c(self, camera: Camera, fov_error: float = 0.0) -> Search | None:
        """Return the search of the C library for a camera; None if it cannot be used."""
        found = self._searches.get((id(camera), fov_error))
        if found is None:
            found = self._searches.get((camera, fov_error))
        if found is None:
            engine = self._c_engine
            if engine is None:
                return None
            if len(self._searches) >= 2 * MAX_CAMERAS:
                self._searches.clear()
            found = engine.search(camera, self._settings, fov_error)
            self._searches[id(camera), fov_error] = self._searches[camera, fov_error] = found
        return found

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for another process, without addresses."""
        return {name: value for name, value in vars(self).items() if name != "_searches"}

    def _timed(
        self,
        frame: Frame,
        search: Callable[[Settings, Database, Frame], MatchResult],
        fov_error: float = 0.0,
    ) -> MatchResult:
        """Identify a frame with numpy; add the time, and what the caller gave, to the answer."""
        before_s = time.perf_counter()
        found = search(self._settings, self.database, frame)
        return found.with_facts(
            time_s=time.perf_counter() - before_s,
            frame=frame,
            database=self.database,
            noise_px=self.noise_px,
            otherwise_px=self._settings.assumed_noise_px,
            fov_error=fov_error,
        )

    def _checked_fov_error(self, fov_error: float) -> float:
        if type(fov_error) is float and fov_error == 0.0:  # nearly all calls end here
            return fov_error
        fov_error = checked_option("fov_error", fov_error)
        if not fov_error:
            return 0.0
        check_scale_free(self)
        return float(fov_error)
