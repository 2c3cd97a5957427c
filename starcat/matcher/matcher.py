"""The matcher: centroids in, identified stars and attitude out.

A method proposes which centroids are which stars; every proposal goes through the same
verification, and only an agreement that chance does not explain is an answer. What stands here is
the readable reference in numpy; where it can, the C library answers, with the same stars.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal, get_args

from numpy.typing import ArrayLike

from starcat.arrays import Array
from starcat.errors import ConfigError
from starcat.geometry.camera import Camera
from starcat.geometry.distortion import checked_number
from starcat.matcher.asking import check_scale_free
from starcat.matcher.blind import identify_blind
from starcat.matcher.database import Database, open_database, open_image, products_in
from starcat.matcher.fast import FastMatcher, Limits, fast_matcher, is_compiled
from starcat.matcher.many import MatchResults
from starcat.matcher.methods.table import best_method, method_named
from starcat.matcher.methods.triangle_order import DEFAULT, TriangleOrder
from starcat.matcher.observation import MIN_SHARE, WIDEST_FOV_ERROR, as_frame
from starcat.matcher.prior import Prior, expected_near, prior_of
from starcat.matcher.refusal import Refusal
from starcat.matcher.result import MatchResult
from starcat.matcher.searching import CERTAIN, searched
from starcat.matcher.stars import Asked
from starcat.onboard.layout import FEATURES
from starcat.onboard.reading import is_image

TOLERANCE_PX = 2.0
"""Tolerance where neither it nor the noise of a centroid is stated."""

NOISE_DEVIATIONS = 3.0
"""Tolerance in standard deviations of a centroid on one axis, where that is stated.

A centroid farther than `REACH` times as many from its star, 4.5, is one of 25,000.
"""


Engine = Literal["auto", "c", "numpy"]

WIDE_PX = 4.0
"""With a wider tolerance, ``auto`` is ``numpy``, which tries smaller reaches too."""

MAX_BATCHES = 200
"""Batches of candidates that are tried before giving up."""


@dataclass(frozen=True)
class Matcher:
    """A database, a method and the limits of an identification.

    Attributes
    ----------
    database : Database
        The stars and the products that the method needs.
    method : str
        A key of `METHODS`.
    tolerance_px : float
        Largest error of a centroid, as a radius: 2 px, or three times ``noise_px`` where that is
        stated.
    max_false_match_probability : float
        Answers that chance would give more often than this are withheld.
    selection : TriangleOrder
        Order and limits of the triangles of centroids, for the methods that use triangles.
    max_batches : int
        Batches of candidates tried before giving up.
    noise_px : float, optional
        Standard deviation of a centroid on each axis. Stating it, instead of a tolerance, makes
        frames of few stars certain that would be withheld.
    noise_mag : float, optional
        Standard deviation of the magnitudes of centroids in the band of the database, its zero
        point included. Where it is stated, a centroid is no star whose magnitude differs by
        more than 3.5 of it, and agreements of magnitudes count as evidence.
    engine : {"auto", "c", "numpy"}
        ``numpy`` is the reference. ``c`` is the library that flies, for the methods ``triangle``
        and ``pyramid`` with the default selection: with triangles twenty times as fast from
        Python, and a hundred times in itself. Both name the same stars. ``auto`` is ``c`` where
        it can serve.
    min_share : float
        Smallest share of the frame, by weight, that the attitude of an answer explains; a third.
    max_steps : float
        Steps that a frame may take (`starcat.matcher.budget`), then the best answer so far is
        given, or none. The same steps give the same answer. Infinite by default.
    time_limit_s : float
        Seconds that a frame may take. Infinite by default. Where this, ``min_share``,
        ``max_steps`` or a tolerance above 4 px is given, ``auto`` is ``numpy``.
    """

    database: Database
    method: str = "triangle"
    # None stands for what is not given, which __post_init__ replaces.
    tolerance_px: float = None  # type: ignore[assignment]
    max_false_match_probability: float = CERTAIN
    selection: TriangleOrder = DEFAULT
    max_batches: int = MAX_BATCHES
    noise_px: float | None = None
    noise_mag: float | None = None
    engine: Engine = "auto"
    min_share: float = MIN_SHARE
    max_steps: float = math.inf
    time_limit_s: float = math.inf

    def __post_init__(self) -> None:
        """Check what was stated, and find the tolerance where it was not given."""
        for name in ("noise_px", "noise_mag"):
            if getattr(self, name) is not None:
                checked_number(name, getattr(self, name), 0.0)
        of_noise = None if self.noise_px is None else NOISE_DEVIATIONS * self.noise_px
        if not 0.0 <= self.min_share <= 1.0:
            text = f"min_share is {self.min_share!r}; expected 0 to 1"
            raise ConfigError(text, key="min_share", value=self.min_share)
        for name in ("max_steps", "time_limit_s"):
            if not getattr(self, name) > 0.0:
                text = f"{name} is {getattr(self, name)!r}; expected a number above 0"
                raise ConfigError(text, key=name, value=getattr(self, name))
        if self.tolerance_px is None:
            object.__setattr__(self, "tolerance_px", of_noise or TOLERANCE_PX)
        elif of_noise not in (None, self.tolerance_px):
            text = (
                f"both tolerance_px, {self.tolerance_px!r}, and noise_px, {self.noise_px!r}, are "
                f"given; give one of them (the tolerance of a noise is {NOISE_DEVIATIONS:g} times "
                "as large)"
            )
            raise ConfigError(text, key="noise_px", value=self.noise_px)
        if self.engine not in get_args(Engine):
            choices = ", ".join(get_args(Engine))
            text = f"engine is {self.engine!r}; choose one of {choices}"
            raise ConfigError(text, key="engine", value=self.engine)
        if self.database.image is not None and self.engine == "numpy":
            text = "engine 'numpy' needs an artifact; an onboard image has no products"
            raise ConfigError(text, key="engine", value=self.engine)
        if self.engine == "c" and self._fast is None:
            raise ConfigError(f"engine 'c': {self._without_c()}", key="engine", value="c")

    def _without_c(self) -> str:
        """Return why the C library does not serve this matcher."""
        if not is_compiled():
            return (
                "this starcat was installed without a C compiler; install one, then starcat again"
            )
        if self.method not in FEATURES:
            return f"method {self.method!r} is not in C; choose one of {', '.join(FEATURES)}"
        if not self._is_default:
            return "it has no other selection, share of the frame and limits than the default ones"
        return f"{self.database.name} has too many stars or features for an onboard image"

    @property
    def _is_default(self) -> bool:
        own = self.selection, self.max_batches, self.min_share, self.max_steps, self.time_limit_s
        return own == (DEFAULT, MAX_BATCHES, MIN_SHARE, math.inf, math.inf)

    @property
    def _fast(self) -> FastMatcher | None:
        """The C library with this matcher's image, where it serves."""
        is_wide = self.engine == "auto" and self.tolerance_px > WIDE_PX
        if self.engine == "numpy" or not self._is_default or (is_wide and not self.database.image):
            return None
        return fast_matcher(self.database, self.method, self.engine == "c")

    @property
    def _limits(self) -> Limits:
        noises = self.noise_px or 0.0, self.noise_mag or 0.0
        return Limits(self.tolerance_px, *noises, self.max_false_match_probability)

    def __repr__(self) -> str:
        """Return database, method and limits in one line."""
        return (
            f"<Matcher {self.method} on {self.database.name}: {len(self.database.mag):,} stars, "
            f"tolerance {self.tolerance_px:g} px, chance {self.max_false_match_probability:g}>"
        )

    @classmethod
    def open(
        cls,
        artifact: str | os.PathLike[str],
        method: str | None = "triangle",
        *,
        tolerance_px: float | None = None,
        max_false_match_probability: float = CERTAIN,
        selection: TriangleOrder = DEFAULT,
        noise_px: float | None = None,
        noise_mag: float | None = None,
        engine: Engine = "auto",
        min_share: float = MIN_SHARE,
        max_steps: float = math.inf,
        time_limit_s: float = math.inf,
    ) -> Matcher:
        """Open the database of an artifact, or an onboard image.

        Parameters
        ----------
        artifact : str or path-like
            The artifact's folder, or an image as `starcat export --to onboard` writes it. With an
            image everything is as in flight: the C library, and directions as they are rounded.
        method : str, default "triangle"
            A key of `METHODS`; None for the best one that the artifact's products allow. An
            image has one method, which is used whatever is asked for.
        tolerance_px, max_false_match_probability, selection, noise_px, noise_mag, engine, \
        min_share, max_steps, time_limit_s
            As the attributes.

        Returns
        -------
        Matcher
            Ready to identify.

        Raises
        ------
        ConfigError
            If there is no such method or engine, both ``tolerance_px`` and ``noise_px`` are
            given, or a noise is not a finite number above 0.
        ProductError, SchemaVersionError
            If the artifact cannot be read, or lacks a product that the method needs.
        """
        path = Path(artifact)
        if is_image(path):
            database = open_image(path)
            chosen = database.image.method if database.image else ""
            engine = "c" if engine == "auto" else engine
        else:
            chosen = best_method(products_in(path)) if method is None else method
            database = open_database(path, _products_of(chosen, products_in(path)))
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
        )

    def identify(
        self,
        centroids_px: ArrayLike,
        camera: Camera | None = None,
        *,
        magnitudes: ArrayLike | None = None,
        fov_error: float = 0.0,
        prior: ArrayLike | None = None,
        prior_error_deg: float | None = None,
        fov_deg: tuple[float, float] | None = None,
    ) -> MatchResult:
        """Identify the stars of a frame.

        Parameters
        ----------
        centroids_px : array_like of float64, shape (N, 2)
            Pixels; the order carries no meaning. Centroids that are not finite, lie outside
            the frame or repeat another get no star and are reported.
        camera : Camera, optional
            The database's own by default.
        magnitudes : array_like of float64, shape (N,), optional
            Magnitudes; they decide what is tried first. With ``noise_mag`` they also decide
            what is accepted, and their zero point has to be that of the database.
        fov_error : float
            Largest relative error of the camera's focal length, 0 to 0.5. Above 0 the focal
            length is found with the attitude, which the method ``triangle`` can.
        prior : array_like of float64, shape (4,), optional
            Attitude that is expected, as ``q_body_from_icrs``. Only the stars near it are then
            compared, which no method and no product is needed for; the verification is the same.
        prior_error_deg : float, optional
            Largest error of the prior, as an angle of rotation; above 0, at most 20.
        fov_deg : pair of float, optional
            Narrowest and widest field across the frame's width where nothing else is known: of
            the camera only the size is used then. The database needs the product ``levels``, and
            the brightness of the spots helps much.

        Returns
        -------
        MatchResult
            ``no_match`` and ``too_few_stars`` are answers too. With a prior it is ``no_match``
            where no attitude as near as that explains the frame.

        Raises
        ------
        ValueError
            If the centroids are not pairs of numbers, the magnitudes are not one each, the
            prior is no quaternion or its error is missing or out of range.
        """
        camera = camera or self.database.camera
        frame, mag = as_frame(centroids_px, magnitudes)
        near = prior_of(prior, prior_error_deg)
        if fov_deg is not None:
            blind = partial(identify_blind, fov_deg=fov_deg)
            return self._timed(frame, camera, mag, search=blind)
        if fov_error:
            return self._timed(frame, camera, mag, self._checked_fov_error(fov_error), near)
        return self._answers([(frame, mag)], camera, near)[0]

    def identify_many(
        self,
        frames: Sequence[ArrayLike],
        camera: Camera | None = None,
        *,
        magnitudes: Sequence[ArrayLike] | None = None,
        threads: int | None = None,
    ) -> Sequence[MatchResult]:
        """Identify the stars of many frames of one camera.

        Parameters
        ----------
        frames : sequence of array_like of float64, shape (n, 2)
            Centroids of each frame, as `identify` takes them.
        camera : Camera, optional
            The database's own by default.
        magnitudes : sequence of array_like of float64, shape (n,), optional
            Those of each frame.
        threads : int, optional
            Threads that the C library runs in at once; all cores by default. The answers do not
            depend on it.

        Returns
        -------
        sequence of MatchResult
            One a frame. `MatchResults`, with arrays over all frames, where the library took them
            all.

        Raises
        ------
        ValueError
            As `identify`, or if there are not as many arrays of magnitudes as frames.
        """
        camera = camera or self.database.camera
        if magnitudes is not None and len(magnitudes) != len(frames):
            raise ValueError(f"magnitudes of {len(magnitudes)} frames; expected {len(frames)}")
        given = [
            as_frame(frame, None if magnitudes is None else magnitudes[n])
            for n, frame in enumerate(frames)
        ]
        return self._answers(given, camera, threads=threads or os.cpu_count() or 1)

    def _answers(
        self,
        given: Sequence[tuple[Array, Array | None]],
        camera: Camera,
        prior: Prior | None = None,
        threads: int = 1,
    ) -> Sequence[MatchResult]:
        """Identify frames in C, or all of them with numpy where the library does not take one."""
        fast = self._fast
        if fast is not None and all(fast.takes(len(frame)) for frame, _ in given):
            px = [frame for frame, _ in given]
            mags = [mag for _, mag in given if mag is not None] or None
            priors = None if prior is None else (prior.q_body_from_icrs[None], prior.error_rad)
            found = fast.identify(px, camera, self._limits, mags, priors, threads)
            if found.is_whole:
                asked = [self._asked(frame, mag) for frame, mag in given]
                explain = None if self.database.image else partial(self._why, prior)
                if prior is None:
                    return MatchResults(found, asked, camera, explain)
                [answer] = MatchResults(found, asked, camera, explain, "tracking")
                return [expected_near(prior, answer, camera, self.tolerance_px)]
        return [self._timed(frame, camera, mag, prior=prior) for frame, mag in given]

    def _asked(self, frame: Array, mag: Array | None) -> Asked:
        return Asked(frame, mag, self.database, self.noise_px)

    def _why(
        self, prior: Prior | None, frame: Array, camera: Camera, mag: Array | None
    ) -> Refusal | None:
        """Return why the C library has no answer: what the search with numpy comes to."""
        # What is unlikely enough for one of the two searches near a prior may not be found by
        # the other.
        found = searched(self, frame, camera, mag, 0.0, prior)
        return Refusal("prior") if found.ok and prior is not None else found.refusal

    def _timed(
        self,
        frame: Array,
        camera: Camera,
        mag: Array | None,
        fov_error: float = 0.0,
        prior: Prior | None = None,
        search: Callable[[Matcher, Array, Camera, Array | None], MatchResult] | None = None,
    ) -> MatchResult:
        """Identify a frame with numpy, and say how long that took and what was asked."""
        before_s = time.perf_counter()
        if search is None:
            found = searched(self, frame, camera, mag, fov_error, prior)
        else:
            found = search(self, frame, camera, mag)
        # A frozen dataclass refuses assignments; nobody else has this one yet.
        vars(found).update(time_s=time.perf_counter() - before_s, asked=self._asked(frame, mag))
        return found

    def _checked_fov_error(self, fov_error: float) -> float:
        if self.database.image is not None:
            text = "an onboard image needs the focal length; open the artifact that it is of"
            raise ConfigError(text, key="fov_error", value=fov_error)
        check_scale_free(self)
        if not 0.0 < fov_error <= WIDEST_FOV_ERROR:
            text = f"fov_error is {fov_error}; expected 0 to {WIDEST_FOV_ERROR:g}"
            raise ConfigError(text, key="fov_error", value=fov_error)
        return float(fov_error)


def _products_of(method: str, there: Collection[str]) -> tuple[str, ...]:
    """Return the products that a method needs, and those that it can use and that are there."""
    known = method_named(method)
    return (*known.products, *(name for name in known.optional if name in there))
