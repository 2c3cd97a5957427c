"""What a search is asked with: the database, the method and the limits of a `Matcher`."""

from __future__ import annotations

from typing import Protocol

from starcat.matcher.database import Database
from starcat.matcher.methods.triangle_order import TriangleOrder


class Asking(Protocol):
    """What a `Matcher` states of a search."""

    @property
    def database(self) -> Database:
        """The stars and the products."""

    @property
    def method(self) -> str:
        """A key of `METHODS`."""

    @property
    def selection(self) -> TriangleOrder:
        """Order and limits of triangles."""

    @property
    def max_batches(self) -> int:
        """Batches of candidates of each level."""

    @property
    def tolerance_px(self) -> float:
        """Largest error of a centroid."""

    @property
    def noise_px(self) -> float | None:
        """Noise of a centroid, where it is stated."""

    @property
    def noise_mag(self) -> float | None:
        """Noise of a magnitude, where it is stated."""

    @property
    def max_false_match_probability(self) -> float:
        """Answers that chance would give more often are withheld."""

    @property
    def min_share(self) -> float:
        """Least share of the frame to be explained."""

    @property
    def max_steps(self) -> float:
        """Steps that a frame may take."""

    @property
    def time_limit_s(self) -> float:
        """Seconds that a frame may take."""
