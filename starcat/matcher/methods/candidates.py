"""Candidates: correspondences between centroids and stars that a method proposes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Candidates:
    """Correspondences to be verified, one a row, the most promising first.

    Attributes
    ----------
    centroids : ndarray of int, shape (K, m)
        Rows of the observation, m >= 2 of them.
    stars : ndarray of int, shape (K, m)
        Rows of the database's stars, in the same order.
    """

    centroids: NDArray[np.integer[Any]]
    stars: NDArray[np.integer[Any]]

    def __len__(self) -> int:
        """Return the number of correspondences."""
        return len(self.stars)

    def __getitem__(self, rows: slice | NDArray[np.intp]) -> Candidates:
        """Return some of the correspondences."""
        return Candidates(self.centroids[rows], self.stars[rows])
