"""The matcher: centroids in, identified stars and attitude out.

A method proposes which centroids are which stars; every proposal goes through the same
verification, and only an agreement that chance does not explain is an answer.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from numpy.typing import ArrayLike

from starcat.errors import ConfigError
from starcat.geometry.camera import Camera
from starcat.geometry.distortion import checked_number
from starcat.matcher.chance import MIN_STARS
from starcat.matcher.database import Database, open_database, products_in
from starcat.matcher.methods.table import METHODS, best_method, method_named
from starcat.matcher.methods.triangle_order import DEFAULT, TriangleOrder
from starcat.matcher.observation import Observation, observe
from starcat.matcher.result import MatchResult, identified, unidentified
from starcat.matcher.verification import Agreement, verify

CERTAIN = 1e-9
"""Largest false-match probability of an answer, unless another one is asked for.

Where more is allowed, a hundredth of it ends the search; else the best answer is taken.
"""

TOLERANCE_PX = 2.0
"""Tolerance where neither it nor the noise of a centroid is stated."""

NOISE_DEVIATIONS = 3.0
"""Tolerance in standard deviations of a centroid on one axis, where that is stated.

A centroid farther than `REACH` times as many from its star, 4.5, is one of 25,000.
"""


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
    """

    database: Database
    method: str = "triangle"
    # None stands for what is not given, which __post_init__ replaces.
    tolerance_px: float = None  # type: ignore[assignment]
    max_false_match_probability: float = CERTAIN
    selection: TriangleOrder = DEFAULT
    max_batches: int = 200
    noise_px: float | None = None
    noise_mag: float | None = None

    def __post_init__(self) -> None:
        """Check what was stated, and find the tolerance where it was not given."""
        for name in ("noise_px", "noise_mag"):
            if getattr(self, name) is not None:
                checked_number(name, getattr(self, name), 0.0)
        of_noise = None if self.noise_px is None else NOISE_DEVIATIONS * self.noise_px
        if self.tolerance_px is None:
            object.__setattr__(self, "tolerance_px", of_noise or TOLERANCE_PX)
        elif of_noise not in (None, self.tolerance_px):
            text = (
                f"both tolerance_px, {self.tolerance_px!r}, and noise_px, {self.noise_px!r}, are "
                f"given; give one of them (the tolerance of a noise is {NOISE_DEVIATIONS:g} times "
                "as large)"
            )
            raise ConfigError(text, key="noise_px", value=self.noise_px)

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
    ) -> Matcher:
        """Open the database of an artifact.

        Parameters
        ----------
        artifact : str or path-like
            The artifact's folder.
        method : str, default "triangle"
            A key of `METHODS`; None for the best one that the artifact's products allow.
        tolerance_px, max_false_match_probability, selection, noise_px, noise_mag
            As the attributes.

        Returns
        -------
        Matcher
            Ready to identify.

        Raises
        ------
        ConfigError
            If there is no such method, both ``tolerance_px`` and ``noise_px`` are given, or a
            noise is not a finite number above 0.
        ProductError, SchemaVersionError
            If the artifact cannot be read, or lacks a product that the method needs.
        """
        path = Path(artifact)
        method = best_method(products_in(path)) if method is None else method
        database = open_database(path, method_named(method).products)
        return cls(
            database,
            method,
            tolerance_px,  # type: ignore[arg-type]
            max_false_match_probability,
            selection,
            noise_px=noise_px,
            noise_mag=noise_mag,
        )

    def identify(
        self,
        centroids_px: ArrayLike,
        camera: Camera | None = None,
        *,
        magnitudes: ArrayLike | None = None,
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

        Returns
        -------
        MatchResult
            ``no_match`` and ``too_few_stars`` are answers too.

        Raises
        ------
        ValueError
            If the centroids are not pairs of numbers, or the magnitudes are not one each.
        """
        camera = camera or self.database.camera
        observation = observe(
            centroids_px,
            camera,
            self.tolerance_px,
            magnitudes,
            noise_px=self.noise_px,
            noise_mag=self.noise_mag,
        )
        if len(observation) < MIN_STARS:
            return unidentified("too_few_stars", observation)
        found = self._search(observation)
        if found is None:
            return unidentified("no_match", observation)
        return identified(found, observation, self.database.star_id)

    def _search(self, observation: Observation) -> Agreement | None:
        """Return the first agreement that is certain, or the best of those that are accepted."""
        limit = self.max_false_match_probability
        certain = limit if limit <= CERTAIN else max(CERTAIN, 0.01 * limit)
        best: Agreement | None = None
        proposals = METHODS[self.method].propose(observation, self.database, self.selection)
        for candidates in islice(proposals, self.max_batches):
            found = verify(candidates, observation, self.database, certain)
            if best is None or (
                found is not None and found.false_match_probability < best.false_match_probability
            ):
                best = found
            if best is not None and best.false_match_probability <= certain:
                break
        if best is None or best.false_match_probability > self.max_false_match_probability:
            return None
        return best
