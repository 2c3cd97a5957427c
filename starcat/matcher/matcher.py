"""The matcher: centroids in, identified stars and attitude out.

A method proposes triangles of stars; every proposal goes through the same verification, and
only an agreement that chance does not explain is an answer.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from starcat.attitude import solve_wahba_svd
from starcat.camera import Camera
from starcat.matcher.database import Database, open_database
from starcat.matcher.pairs import candidate_triangles, observed_triangles
from starcat.matcher.result import MatchResult, identified, unidentified
from starcat.matcher.verification import agree, chance_of_agreement

Array = NDArray[np.float64]

MIN_STARS = 4
"""Three stars make an attitude; at least one more has to agree with it."""


@dataclass(frozen=True)
class Matcher:
    """A database and the limits of an identification.

    Attributes
    ----------
    database : Database
        The stars and their pairs.
    tolerance_px : float
        Largest error of a centroid, as a radius.
    max_false_match_probability : float
        Answers that chance would give more often than this are withheld.
    max_triangles : int
        Observed triangles tried before giving up.
    """

    database: Database
    tolerance_px: float = 2.0
    max_false_match_probability: float = 1e-6
    max_triangles: int = 200

    @classmethod
    def open(cls, artifact: Path, tolerance_px: float = 2.0) -> Matcher:
        """Open the database of an artifact.

        Parameters
        ----------
        artifact : Path
            The artifact's folder.
        tolerance_px : float, default 2
            Largest error of a centroid, as a radius.

        Returns
        -------
        Matcher
            Ready to identify.
        """
        return cls(open_database(artifact), tolerance_px)

    def identify(self, centroids_px: ArrayLike, camera: Camera | None = None) -> MatchResult:
        """Identify the stars of a frame.

        Parameters
        ----------
        centroids_px : array_like of float64, shape (N, 2)
            Pixels; the order carries no meaning. Centroids that are not finite or lie
            outside the frame get no star.
        camera : Camera, optional
            The database's own by default.

        Returns
        -------
        MatchResult
            ``no_match`` and ``too_few_stars`` are answers too.

        Raises
        ------
        ValueError
            If the centroids are not pairs of numbers.
        """
        camera = camera or self.database.camera
        given = np.asarray(centroids_px, dtype=np.float64)
        if given.size == 0:
            given = given.reshape(0, 2)
        if given.ndim != 2 or given.shape[1] != 2:
            raise ValueError(f"centroids_px has shape {given.shape}; expected (N, 2)")
        # Sorted by distance from the centre, so that the answer does not depend on the order.
        offset = given - [0.5 * camera.width_px, 0.5 * camera.height_px]
        usable = np.flatnonzero(camera.contains(given))
        order = usable[np.lexsort((*offset[usable].T, np.hypot(*offset[usable].T)))]
        if len(order) < MIN_STARS:
            return unidentified("too_few_stars", len(given))
        found = self._search(given[order], camera)
        if found is None:
            return unidentified("no_match", len(given))
        matrix, index, residual_rad, chance = found
        star_index = np.full(len(given), -1, dtype=np.int32)
        star_index[order] = index
        residual_arcsec = float(np.degrees(residual_rad) * 3600.0)
        return identified(matrix, star_index, self.database.star_id, residual_arcsec, chance)

    def _search(
        self, centroids_px: Array, camera: Camera
    ) -> tuple[Array, NDArray[np.int32], float, float] | None:
        """Try triangles until an attitude explains the frame beyond chance."""
        body = camera.directions_from_pixels(centroids_px)
        tolerance_rad = self.tolerance_px / camera.focal_length_px
        radius_px = 1.5 * self.tolerance_px
        fraction = np.pi * radius_px**2 / (camera.width_px * camera.height_px)
        tried = 0
        for triangle in observed_triangles(body, self.max_triangles):
            for stars in candidate_triangles(body, triangle, self.database, tolerance_rad):
                tried += 1
                matrix = solve_wahba_svd(body[list(triangle)], self.database.directions[stars])
                found = agree(matrix, body, centroids_px, camera, self.database, radius_px)
                chance = tried * chance_of_agreement(
                    len(body), found.n_matched, 3, found.stars_in_frame, fraction
                )
                if chance <= self.max_false_match_probability:
                    return found.matrix, found.star_index, found.residual_rad, chance
        return None
