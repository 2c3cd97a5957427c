"""Tracking: a sequence of frames; each is searched near the attitude predicted from the last ones.

The camera is assumed to keep turning as it did, about the same axes of its own frame. The allowed
error of the prediction follows from the errors of the last predictions. A frame that is not there
is searched for in the whole sky at once, so a jump costs one slow frame but no answer.

Before the first answer, and after a jump, frames without an answer are put together
(`starcat.matcher.composite`): together they can have an attitude that none of them has alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from numbers import Real
from typing import Any

from numpy.typing import ArrayLike

from starcat.arguments import check_type, without_unit
from starcat.errors import ConfigError
from starcat.geometry.attitude import Quaternion, Turn, after_turn, turn_between
from starcat.geometry.camera import Camera
from starcat.matcher.brightest import MAX_CENTROIDS, brightest_of
from starcat.matcher.composite import Composite, composite_of, joined
from starcat.matcher.matcher import Matcher
from starcat.matcher.observation import FrameLike, observe
from starcat.matcher.options import OPTIONS
from starcat.matcher.prior import PriorLike, turn_of_noise_rad
from starcat.matcher.result import MatchResult

MAX_TURN_DEG = OPTIONS["prior_error_deg"].high
"""Largest error of a prediction that can be allowed."""

FLOOR = 2.0
"""Smallest error of a prediction, in units of the largest error of a centroid."""

MARGIN = 2.0
"""Error that is allowed for a prediction, over the error of the last predictions."""

FADING = 0.5
"""Weight of the error of an earlier prediction, for every step since."""

MAX_STEPS = 5.0
"""Longest time of a prediction after the last answer, over the time between the last two."""

MAX_GAP = 2
"""Largest number of frames from one frame of a composite to the next one."""


@dataclass(frozen=True)
class _Motion:
    """The motion that the last answers predict; after a single answer nothing of it is known."""

    q_body_from_icrs: Quaternion
    time: float
    step: float = math.inf  # time between the last two answers
    turn: Turn = (0.0, 0.0, 0.0)  # in a step
    change_rad: float = math.inf  # of the turn, from one step to the next


def _is_number(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


@dataclass
class Tracker:
    """A matcher that follows a sequence of frames.

    Attributes
    ----------
    matcher : Matcher
        Of any method and engine.
    max_turn_deg : float
        Largest error of a prediction that is tried, and the largest turn from the first frame to
        the second; above 0, at most 20. A frame beyond it is found in the whole sky.

    Examples
    --------
    >>> tracker = Tracker(matcher)  # doctest: +SKIP
    >>> [tracker.identify(px).origin for px in frames]  # doctest: +SKIP
    ['lost_in_space', 'tracking', 'tracking']
    """

    matcher: Matcher
    max_turn_deg: float = 5.0
    _motion: _Motion | None = field(default=None, init=False, repr=False, compare=False)
    _time: float = field(default=-math.inf, init=False, repr=False, compare=False)
    # The composite before the next frame, and the one that its first attempt has made with it.
    _composite: Composite | None = field(default=None, init=False, repr=False, compare=False)
    _attempted: Composite | None = field(default=None, init=False, repr=False, compare=False)
    # Whether the last attempt with an answer had it together with the frames before.
    _is_confirmed: bool = field(default=False, init=False, repr=False, compare=False)
    # Frames since the last one of the composite.
    _gap: int = field(default=0, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        check_type("matcher", self.matcher, Matcher, "a starcat.Matcher")
        turn_deg = self.max_turn_deg = without_unit("max_turn_deg", self.max_turn_deg)
        if not _is_number(turn_deg) or not 0.0 < turn_deg <= MAX_TURN_DEG:
            raise ConfigError(
                f"expected above 0, at most {MAX_TURN_DEG:g}",
                parameter="max_turn_deg",
                value=turn_deg,
            )

    def reset(self) -> None:
        """Forget all frames: the next one is searched for in the whole sky."""
        self._motion, self._time = None, -math.inf
        self._composite = self._attempted = None
        self._is_confirmed = False

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
        time_s: float | None = None,
    ) -> MatchResult:
        """Identify the stars of the next frame.

        Parameters
        ----------
        centroids_px, camera, mag, sigma_px, fov_error, prior, prior_error_deg
            As for `Matcher.identify`; a prior, from a gyroscope for example, replaces the
            prediction.
        time_s : float, optional
            Time of the frame, later than the previous frame's. Frames without a time follow each
            other at equal intervals. Give it for every frame, or for none.

        Returns
        -------
        MatchResult
            ``origin`` is ``tracking`` if it was found near the prediction, and ``lost_in_space``
            if it was found in the whole sky. Near the prediction fewer stars are enough, as
            chance could only agree there. A frame that is not answered alone can be answered
            together with the frames before it, which its spots continue:
            ``false_match_probability`` is then the larger one of the bounds of both.

        Raises
        ------
        ConfigError, ValueError
            As `Matcher.identify`, or if the time is not later than the previous frame's.
        """
        answer = self.attempt(
            centroids_px, camera, mag=mag, sigma_px=sigma_px, fov_error=fov_error,
            prior=prior, prior_error_deg=prior_error_deg, time_s=time_s,
        )  # fmt: skip
        self.record(answer, camera, time_s=time_s)
        return answer

    def attempt(
        self,
        centroids_px: FrameLike,
        camera: Camera | None = None,
        *,
        mag: ArrayLike | None = None,
        sigma_px: ArrayLike | None = None,
        fov_error: float | None = None,
        prior: PriorLike | None = None,
        prior_error_deg: float | None = None,
        time_s: float | None = None,
    ) -> MatchResult:
        """Identify the stars of the next frame as `identify` does, without recording the answer.

        A frame can be attempted several times, with other centroids or another ``fov_error``.
        `record` then ends the frame. The centroids of the first attempt are those that are put
        together with the frames before.
        """
        now = self._next_time(time_s)
        camera = camera or self.matcher.database.camera
        expected, error_deg = prior, prior_error_deg
        if expected is None and error_deg is None:
            expected, error_deg = self._predicted(now, camera)
        beside: dict[str, Any] = {"mag": mag, "sigma_px": sigma_px}
        identify = partial(
            self.matcher.identify, centroids_px, camera, fov_error=fov_error, **beside
        )
        answer = None
        if expected is not None or error_deg is not None:
            answer = identify(prior=expected, prior_error_deg=error_deg)
        if answer is None or answer.status == "no_match":
            answer = identify()
        if answer.ok:
            self._is_confirmed = False
        elif answer.status == "no_match" and self._attempted is None:
            answer = self._confirmed(answer, fov_error)
        return answer

    def _confirmed(self, refused: MatchResult, fov_error: float | None) -> MatchResult:
        """Return the answer to a refused frame that the frames before it confirm, if they do.

        The composite of the frames has to have an attitude, and the frame itself one near it: the
        spots of the frames before do not show that the last turn was found. The two bounds hold
        for two hypotheses: that the spots of all frames are false, and that those of this frame
        are. An attitude that is near after the turn that was found is near after every turn that
        is allowed, within twice the turn.
        """
        frame, matcher = refused.frame, self.matcher
        if frame is None:
            return refused
        first = frame if len(frame) <= MAX_CENTROIDS else brightest_of(frame).frame
        seen = observe(first, matcher.settings)
        turn_deg = min(self.max_turn_deg, 0.5 * MAX_TURN_DEG)
        before, self._attempted = self._composite, composite_of(seen)
        longer = None if before is None else joined(before, seen, math.radians(turn_deg))
        if longer is None:
            return refused
        self._attempted = longer
        centroids_px, mag = longer.pixels(frame.camera)
        whole = matcher.identify(centroids_px, frame.camera, mag=mag, fov_error=fov_error)
        if not whole.ok:
            return refused
        answer = matcher.identify(
            frame.centroids_px, frame.camera, mag=frame.mag, sigma_px=frame.sigma_px,
            fov_error=fov_error, prior=whole.q_body_from_icrs, prior_error_deg=2.0 * turn_deg,
        )  # fmt: skip
        if not answer.ok:
            return refused
        self._is_confirmed = True
        chance = max(whole.false_match_probability, answer.false_match_probability)
        answer = answer.with_facts(frame_remarks=refused.frame_remarks)
        return replace(answer, false_match_probability=chance)

    def record(
        self,
        found: MatchResult | None,
        camera: Camera | None = None,
        *,
        time_s: float | None = None,
    ) -> None:
        """End a frame with its result, or with None if the frame could not be read."""
        now = self._next_time(time_s)
        self._time, made, self._attempted = now, self._attempted, None
        if found is None or not found.ok:
            self._gap = 1 if made is not None else self._gap + 1
            if made is not None or self._gap > MAX_GAP:
                self._composite = made
            return
        self._composite = None
        x, y, z, w = found.q_body_from_icrs.tolist()
        is_new = found.origin == "lost_in_space" or self._is_confirmed
        # An attitude beyond the prediction means a new motion: the next attitude is expected to
        # be the same as this one, within the largest turn.
        self._motion = (
            _Motion((x, y, z, w), now)
            if is_new or self._motion is None
            else self._learnt(
                self._motion, (x, y, z, w), now, camera or self.matcher.database.camera
            )
        )

    def follow(self, frames: Iterable[FrameLike]) -> Iterator[MatchResult]:
        """Identify the frames in turn, each when the next answer is requested.

        Parameters
        ----------
        frames : iterable of array_like of float64, shape (n, 2)
            Centroids of each frame, pixels.

        Yields
        ------
        MatchResult
            As `identify` gives it.
        """
        check_type("frames", frames, Iterable, "an iterable of frames")
        return (self.identify(frame) for frame in frames)

    def _next_time(self, time_s: float | None) -> float:
        if time_s is None:
            return 0.0 if math.isinf(self._time) else self._time + 1.0
        now = without_unit("time_s", time_s)
        if not _is_number(now) or not self._time < now < math.inf:
            raise ConfigError(
                f"expected a number above {self._time}, the time of the frame before",
                parameter="time_s",
                value=now,
            )
        return float(now)

    def _predicted(
        self, now: float, camera: Camera
    ) -> tuple[Quaternion, float] | tuple[None, None]:
        """Return the attitude that is expected, and its largest error; None if there is none."""
        return (
            (None, None) if self._motion is None else self._predicted_by(self._motion, now, camera)
        )

    def _predicted_by(
        self, motion: _Motion, now: float, camera: Camera
    ) -> tuple[Quaternion, float] | tuple[None, None]:
        if math.isinf(motion.change_rad):
            return motion.q_body_from_icrs, self.max_turn_deg
        steps = (now - motion.time) / motion.step
        if steps > MAX_STEPS:
            return None, None
        floor_rad = FLOOR * self.matcher.settings.tolerance_px / camera.focal_length_px
        # The turn of the last step is that of its middle. With a constant acceleration it changes
        # by `change_rad` from step to step, and the turns of the next steps by 1, 2, 3 ... of it.
        change_rad = motion.change_rad * 0.5 * steps * (steps + 1.0)
        error_deg = math.degrees(floor_rad + MARGIN * change_rad)
        x, y, z = motion.turn
        expected = after_turn(motion.q_body_from_icrs, (x * steps, y * steps, z * steps))
        return expected, min(self.max_turn_deg, error_deg)

    def _learnt(self, before: _Motion, q: Quaternion, now: float, camera: Camera) -> _Motion:
        step = now - before.time
        x, y, z = (part * step / before.step for part in before.turn)
        x, y, z = turn_between(after_turn(before.q_body_from_icrs, (x, y, z)), q)
        # The noise of centroids turns a narrow field about its axis by much more than across.
        noise_rad = turn_of_noise_rad(camera, self.matcher.settings.tolerance_px)
        about_axis = max(abs(z) * math.tan(camera.radius_rad), abs(z) - noise_rad)
        change_rad = math.hypot(x, y) + about_axis
        if math.isfinite(before.change_rad):
            # Of two steps as long as this one.
            change_rad *= 2.0 * step / (step + before.step)
            longer = step / before.step
            change_rad = max(change_rad, FADING**longer * longer**2 * before.change_rad)
        return _Motion(q, now, step, turn_between(before.q_body_from_icrs, q), change_rad)
