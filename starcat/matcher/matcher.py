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

from starcat.geometry.camera import Camera
from starcat.matcher.database import Database, open_database, products_in
from starcat.matcher.methods.table import METHODS, best_method, method_named
from starcat.matcher.methods.triangle_order import DEFAULT, TriangleOrder
from starcat.matcher.observation import Observation, observe
from starcat.matcher.result import MatchResult, identified, unidentified
from starcat.matcher.verification import MIN_STARS, Agreement, verify

CERTAIN = 1e-9
"""Largest false-match probability of an answer, unless another one is asked for.

Where more is allowed, a hundredth of it ends the search; else the best answer is taken.
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
        Largest error of a centroid, as a radius.
    max_false_match_probability : float
        Answers that chance would give more often than this are withheld.
    selection : TriangleOrder
        Order and limits of the triangles of centroids, for the methods that use triangles.
    max_batches : int
        Batches of candidates tried before giving up.
    """

    database: Database
    method: str = "triangle"
    tolerance_px: float = 2.0
    max_false_match_probability: float = CERTAIN
    selection: TriangleOrder = DEFAULT
    max_batches: int = 200

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
        tolerance_px: float = 2.0,
        max_false_match_probability: float = CERTAIN,
        selection: TriangleOrder = DEFAULT,
    ) -> Matcher:
        """Open the database of an artifact.

        Parameters
        ----------
        artifact : str or path-like
            The artifact's folder.
        method : str, default "triangle"
            A key of `METHODS`; None for the best one that the artifact's products allow.
        tolerance_px, max_false_match_probability, selection
            As the attributes.

        Returns
        -------
        Matcher
            Ready to identify.

        Raises
        ------
        ConfigError
            If there is no such method.
        ProductError, SchemaVersionError
            If the artifact cannot be read, or lacks a product that the method needs.
        """
        path = Path(artifact)
        method = best_method(products_in(path)) if method is None else method
        database = open_database(path, method_named(method).products)
        return cls(database, method, tolerance_px, max_false_match_probability, selection)

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
            Magnitudes with any zero point; they decide what is tried first, never what is
            accepted.

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
        observation = observe(centroids_px, camera, self.tolerance_px, magnitudes)
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
