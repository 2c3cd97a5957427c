"""Settings of an identification, and the budget of one search."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, get_args

from starcat.arguments import check_type
from starcat.errors import ConfigError
from starcat.matcher.options import OPTIONS, SearchOptions, check_options

Engine = Literal["auto", "c", "numpy"]

Limit = Literal["time", "steps"]

METHOD = "triangle"
"""Method if none is stated."""

TOLERANCE_PX = 2.0
"""Tolerance if neither it nor the noise of a centroid is stated."""

NOISE_DEVIATIONS = 3.0
"""Tolerance in standard deviations of a centroid on one axis, if that noise is stated.

One of 25,000 centroids is farther from its star than `REACH` times this, 4.5 deviations.
"""

REACH = 1.5
"""Largest distance between a centroid and its star, in units of the tolerance.

It is larger than 1 because an attitude that was computed from a few stars has an error too.
"""

CERTAIN: float = OPTIONS["max_false_match_probability"].default
"""Default of the largest false-match probability of an answer.

If the caller allows more, the search is the same, and its best answer is taken.
"""

MAX_TRIANGLES = 5000
"""Number of triangles of centroids that are looked up, in the order of their selection."""

MAX_STEPS = 100_000
"""Default of the steps that a frame may take; about a second with numpy."""

MIN_SHARE = 0.0
"""Smallest fraction of the frame that must match: of the centroids, or of the stars if fewer."""

SCALE_FREE = ("triangle",)
"""Methods that find the focal length with the attitude."""

LOOKUP = 10
"""Number of steps that count for looking up one pattern of a frame."""

AGREEMENT = 50
"""Steps that count for refining an attitude once, for each full `PAIRS` of centroids and stars."""

PAIRS = 4000
"""Pairs of a centroid and a star near the frame, up to which a refinement costs `AGREEMENT`."""


@dataclass(frozen=True)
class TriangleOrder:
    """Order and limits of the triangles of a frame.

    Attributes
    ----------
    order : {"auto", "brightness", "inradius", "compact", "spread"}
        ``brightness`` is S3's, ``inradius`` S4's, the largest first; ``compact`` has the
        triangles with the shortest long side first, which the most fields hold whole. ``spread``
        takes the most compact triangle at every centroid, then the second of each, and so on.
        ``auto`` is ``brightness`` if magnitudes are known, else ``spread`` in frames with more
        than ``most_centroids``, else ``compact``.
    min_side_px : float
        Triangles with a shorter side are left out, for example at double stars (d_min of S3).
    min_angle_deg : float
        Triangles with a narrower angle are left out, as three stars in a line (theta_min of S3).
    most_centroids : int
        Number of centroids that take part: the first ones in the observation's order. With
        ``spread`` all of them do.
    few_centroids : int
        In frames with at most this many centroids, the triangles that are left out are tried
        at the end.

    References
    ----------
    Li et al. 2015 (S3), whose thresholds are unstated: the defaults reproduce its counts.
    Liao and Zhang 2024 (S4), eq. 7.
    """

    order: Literal["auto", "brightness", "inradius", "compact", "spread"] = "auto"
    min_side_px: float = 10.0
    min_angle_deg: float = 15.0
    most_centroids: int = 32
    few_centroids: int = 12


@dataclass(frozen=True, kw_only=True, repr=False)
class Settings(SearchOptions):
    """The method and the limits of an identification: `SearchOptions` with their defaults.

    Attributes
    ----------
    method : str
        A key of `METHODS`; ``triangle`` by default.
    tolerance_px : float
        Largest error of a centroid, as a radius: 2 px by default, or three times ``noise_px`` if
        that is stated.
    noise_px : float, optional
        Standard deviation of a centroid on each axis. If it is stated instead of a tolerance,
        frames of few stars become certain that would otherwise be withheld.
    noise_mag : float, optional
        Standard deviation of the magnitudes of centroids in the band of the database, including
        the error of their zero point. If it is stated, a centroid cannot be a star whose magnitude
        differs by more than 3.5 of it. If ``noise_px`` is stated too, differences of magnitudes
        are residuals as those of places are. A value that is too large costs less than one that
        is too small.
    max_false_match_probability : float
        Answers that chance would give more often than this are withheld; they are then the
        candidate of the refusal. It does not change the search, unless it is below 1e-9: then
        the search goes on until it finds such an answer.
    min_share : float
        Smallest share of the centroids, or of the stars in the frame if they are fewer, that an
        answer identifies. None is required by default: the stars of an answer determine the
        corners of the frame.
    camera_error : float, optional
        Largest error of a calibrated camera at the corners of the frame, as a share of the half
        diagonal, 1e-6 to 0.1. It narrows the ranges of the frame's shape, so that frames of few
        stars become certain and determine their corners. By default the ranges are wide: 5 % of
        the scale, 10 % of the other terms.
    max_steps : float
        Candidates that numpy may compare for a frame (`Budget`), 2 to 20 microseconds each; then
        the best answer so far is given, or none. The same number gives the same answer. 100,000 by
        default, which is about a second. Steps of the C library are smaller, 1 to
        5 nanoseconds each; its own limit is about a second too.
    time_limit_s : float
        Seconds that a frame may take. Infinite by default. If this, ``min_share`` or
        ``max_steps`` is given, ``auto`` is ``numpy``.
    selection : TriangleOrder
        Order and limits of the triangles of centroids, for the methods that use triangles.
    engine : {"auto", "c", "numpy"}
        ``numpy`` is the reference. ``c`` is the library that flies, for the methods ``triangle``
        and ``pyramid`` with the default selection: with triangles forty times as fast from
        Python, and a hundred times in itself. Both name the same stars. ``auto`` is ``c`` if it
        can be used.
    """

    selection: TriangleOrder = TriangleOrder()
    engine: Engine = "auto"

    if TYPE_CHECKING:  # __post_init__ has replaced None
        method: str = METHOD
        tolerance_px: float = TOLERANCE_PX
        min_share: float = MIN_SHARE
        max_steps: int = MAX_STEPS
        time_limit_s: float = math.inf

    def __post_init__(self) -> None:
        check_type("selection", self.selection, TriangleOrder, "a TriangleOrder")
        check_options(self, SearchOptions)
        of_noise = None if self.noise_px is None else NOISE_DEVIATIONS * self.noise_px
        if of_noise is not None and self.tolerance_px not in (None, of_noise):
            raise ConfigError(
                f"the tolerance is {self.tolerance_px!r}, and the tolerance of a noise is "
                f"{NOISE_DEVIATIONS:g} times as large as it",
                parameter="noise_px",
                value=self.noise_px,
                hint="give one of {tolerance_px} and {noise_px}",
            )
        defaults = {
            "method": METHOD,
            "tolerance_px": of_noise or TOLERANCE_PX,
            "min_share": MIN_SHARE,
            "max_steps": MAX_STEPS,
            "time_limit_s": math.inf,
        }
        for name, default in defaults.items():
            if getattr(self, name) is None:
                object.__setattr__(self, name, default)
        if self.engine not in get_args(Engine):
            choices = ", ".join(get_args(Engine))
            raise ConfigError(f"choose one of {choices}", parameter="engine", value=self.engine)

    @property
    def assumed_noise_px(self) -> float:
        """Noise of a centroid on each axis if it is stated, else what the tolerance stands for."""
        return self.noise_px or self.tolerance_px / NOISE_DEVIATIONS

    def __repr__(self) -> str:
        return (
            f"<Settings {self.method}: tolerance {self.tolerance_px:g} px, "
            f"chance {self.max_false_match_probability:g}, engine {self.engine}>"
        )


def has_default_search(settings: Settings) -> bool:
    """Return whether the settings that only numpy supports have their defaults."""
    values = (settings.selection, settings.min_share, settings.max_steps, settings.time_limit_s)
    return values == (TriangleOrder(), MIN_SHARE, MAX_STEPS, math.inf)


def certainty(settings: Settings) -> float:
    """Return the false-match probability that ends a search; a higher limit ends none earlier."""
    return min(settings.max_false_match_probability, CERTAIN)


def check_scale_free(settings: Settings) -> None:
    """Check that the method can do without the focal length."""
    if settings.method not in SCALE_FREE:
        text = "it needs the focal length; only 'triangle' can find it"
        raise ConfigError(text, parameter="method", value=settings.method)


class BudgetSpentError(Exception):
    """A search ended because its budget was spent."""

    def __init__(self, limit: Limit) -> None:
        super().__init__(f"the {limit} of a search are used up")
        self.limit: Limit = limit


@dataclass
class Budget:
    """The steps and the time that a search has left.

    A step is a candidate that is compared with the frame. It takes 2 to 20 microseconds, in long
    searches 2 to 6. The C library has smaller steps, of 1 to 5 nanoseconds. Looking up
    a pattern of the frame counts as `LOOKUP` steps, refining an attitude as `AGREEMENT` or more.
    The same budget in steps gives the same answer everywhere; a limit of time does not.
    """

    max_steps: float = math.inf
    time_limit_s: float = math.inf
    steps: int = 0  # steps that were taken
    _start_s: float = field(default_factory=time.perf_counter, repr=False)

    def spend(self, steps: int) -> None:
        """Take steps; `BudgetSpentError` if none are left."""
        if self.steps + steps > self.max_steps:
            raise BudgetSpentError("steps")
        self.steps += steps
        limit_s = self.time_limit_s
        if limit_s != math.inf and time.perf_counter() - self._start_s > limit_s:
            raise BudgetSpentError("time")
