"""What a search is asked with: the database, the method and the limits of a `Matcher`."""

from __future__ import annotations

from typing import Protocol

from starcat.arrays import Array
from starcat.errors import ConfigError
from starcat.geometry.camera import Camera
from starcat.matcher.budget import Budget
from starcat.matcher.database import Database
from starcat.matcher.methods.triangle_order import TriangleOrder
from starcat.matcher.observation import Observation, observe

SCALE_FREE = ("triangle",)
"""Methods that find the focal length with the attitude."""


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


def check_scale_free(asking: Asking) -> None:
    """Check that a method can do without the focal length."""
    if asking.method not in SCALE_FREE:
        text = f"method {asking.method!r} needs the focal length; only 'triangle' can find it"
        raise ConfigError(text, key="method", value=asking.method)


def as_asked(
    asking: Asking,
    centroids_px: Array,
    camera: Camera,
    mag: Array | None,
    fov_error: float = 0.0,
    budget: Budget | None = None,
) -> Observation:
    """Return a frame with all that a matcher states of it."""
    return observe(
        centroids_px,
        camera,
        asking.tolerance_px,
        mag,
        noise_px=asking.noise_px,
        noise_mag=asking.noise_mag,
        fov_error=fov_error,
        min_share=asking.min_share,
        budget=budget or Budget(asking.max_steps, asking.time_limit_s),
    )
