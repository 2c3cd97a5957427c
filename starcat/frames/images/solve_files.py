"""Frames of a file to answers: the same for the command, the REST interface and the page.

A file holds centroids or is an image. `answer_file` measures it and answers its frames in turn,
each when it is requested; an answer is JSON, a row of a table, a picture or a WCS.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from starcat.arguments import HasFolder, check_type, database_path, path_of
from starcat.errors import ConfigError, count_of
from starcat.frames.images.attempts import (
    BRIGHTEST,
    MAX_SEARCHES,
    FurtherAttempt,
    counted,
    further_attempts,
    is_new,
)
from starcat.frames.images.measure import FrameFile, LocalInputs, MeasuredFile, read_frame_file
from starcat.frames.images.spots import weighed
from starcat.frames.images.stated_camera import stated_camera
from starcat.geometry.camera import Camera
from starcat.matcher.centroids import MeasuredFrame, upside_down
from starcat.matcher.matcher import Matcher
from starcat.matcher.options import IdentifyOptions, SearchOptions, options_of
from starcat.matcher.other_fields import FOV_ERROR, SEARCHES, explained
from starcat.matcher.prior import PriorLike, prior_of
from starcat.matcher.refusal import Fact
from starcat.matcher.result import GivenAs, MatchResult
from starcat.matcher.settings import MAX_STEPS, SCALE_FREE
from starcat.matcher.tracking import Tracker
from starcat.resources import PathLike

if TYPE_CHECKING:
    from starcat.frames.images.centroiding import Spots
    from starcat.frames.sky.in_time import SkyInTime
    from starcat.frames.sky.observer import Observer

Content = dict[str, Any]


@dataclass(frozen=True)
class FrameAnswer:
    """A frame, the stars and the attitude found for it, and results that need the time."""

    frame: MeasuredFrame
    result: MatchResult
    observer: Observer | None = None
    spots: Spots | None = None  # the spots of the frame if it is an image
    attempt: FurtherAttempt | None = None  # the attempt that identified an image, after the first

    @cached_property
    def sky(self) -> SkyInTime | None:
        """The attitude without aberration, and planets; None without an observer or an answer."""
        if self.observer is None:
            return None
        from starcat.frames.sky.in_time import sky_in_time

        return sky_in_time(self.result, self.observer)

    def content(self) -> Content:
        """Return the answer as ``starcat identify --json`` prints it."""
        content = {"frame": self.frame.name, **self.result.to_dict(self.frame)}
        if self.spots is not None and self.spots.streak is not None:
            content["streak_px"] = [self.spots.streak.dx_px, self.spots.streak.dy_px]
        if self.attempt is not None:
            content |= {"attempt": self.attempt.number, "spots_of_attempt": self.attempt.words}
            content["searches_in_chance"] = MAX_SEARCHES
        if self.observer is not None:
            content["in_time"] = None if self.sky is None else self.sky.content()
        return content


@dataclass(frozen=True)
class FileAnswers:
    """The answers to the frames of a file; each is found when the iteration reaches it."""

    path: Path
    matcher: Matcher
    measured: MeasuredFile
    camera: Camera
    options: IdentifyOptions
    local: LocalInputs
    tracker: Tracker | None = None  # of the sequence, if the frames are one

    @property
    def is_image(self) -> bool:
        """Whether the file is an image."""
        return self.measured.shape is not None

    def __iter__(self) -> Iterator[FrameAnswer]:
        self._check_size()
        self._check_options()
        tracker, error = self.tracker, self._fov_error
        for measured in self.measured.frames:
            turned = self.options.flip and not self.is_image
            frame = upside_down(measured, self.camera.height_px) if turned else measured
            answer = self._answer(frame, error)
            result = answer.result
            if answer.observer is not None:
                from starcat.frames.sky.in_time import with_planets

                result = with_planets(result, answer.observer)
            if turned or self.is_image:
                given_as: GivenAs = "picture" if self.is_image else "upside_down"
                result = result.with_facts(given_as=given_as)
            if frame.remarks:
                result = replace(result, frame_remarks=frame.remarks)
            answer = replace(answer, result=result)
            if tracker is not None:  # once per frame, even after several searches
                tracker.record(answer.result, self.camera)
            yield answer

    def _answer(self, frame: MeasuredFrame, fov_error: float) -> FrameAnswer:
        observer, spots = self._observer, self.measured.spots
        result = self._search(frame, fov_error, self.camera)
        if not result.ok and fov_error and self.options.fov_error is None:
            # Few stars can determine an attitude, but no focal length with it: it is as stated.
            exact = self._search(frame, 0.0, self.camera)
            result = exact if exact.ok else result
        if spots is not None:
            result = weighed(result, spots.sigma_px)
        if not result.ok and (again := self._answer_again(result, frame, fov_error)):
            return again
        if result.status == "no_match" and not (_is_limited(result) and self._has_own_limit):
            result = self._explained(result, frame, fov_error)
        return FrameAnswer(frame, self._of_picture(result), observer, spots)

    def _explained(
        self, refused: MatchResult, frame: MeasuredFrame, fov_error: float
    ) -> MatchResult:
        """Return a refused answer with the findings of a second look."""
        if self.local.track or self._prior is not None:
            return refused
        return explained(
            refused, frame, self.camera, self._search, fov_error=fov_error,
            with_fields=self._is_scale_free and self._is_lost_in_space, flip=self.options.flip,
            limit=self.matcher.settings.max_false_match_probability,
            is_picture=self.is_image, searches=MAX_SEARCHES if self.is_image else SEARCHES,
        )  # fmt: skip

    def _of_picture(self, refused: MatchResult) -> MatchResult:
        """Return the answer to a picture, with the facts that decide which advice helps."""
        why = refused.refusal
        if why is None or not self.is_image:
            return refused
        facts: list[Fact] = ["picture"]
        if self.options.fov_deg is not None:
            facts.append("range")
        if why.reason == "too_few_stars" and _is_bright(self._image):
            facts.append("bright_picture")
        return replace(refused, refusal=replace(why, facts=why.facts.union(facts)))

    def _answer_again(
        self, refused: MatchResult, first: MeasuredFrame, fov_error: float
    ) -> FrameAnswer | None:
        """Return the answer to an image that is measured once more; None if there is none."""
        limit, is_limited = self.matcher.settings.max_false_match_probability, _is_limited(refused)
        if not self.is_image or (is_limited and self._has_own_limit):
            return None
        searched = [first.centroids_px]
        end_s = time.monotonic() + self.matcher.settings.time_limit_s
        for attempt in further_attempts(self.options, is_limited=is_limited):
            if attempt.number > 2 and time.monotonic() > end_s:
                break
            measured = self._measured_again(attempt)
            if measured is None:
                continue
            [frame], spots = measured.frames, measured.spots
            if spots is None or (attempt.number > 2 and not is_new(frame.centroids_px, searched)):
                continue
            searched.append(frame.centroids_px)
            result = counted(self._search(frame, fov_error, self.camera), limit)
            if result is not None:
                result = weighed(result, spots.sigma_px)
                return FrameAnswer(frame, result, self._observer, spots, attempt)
        return None

    def _measured_again(self, attempt: FurtherAttempt) -> MeasuredFile | None:
        """Return the image with its spots of an attempt; None if the attempt does not apply."""
        if attempt.threshold is None:
            return self.measured.brightest(BRIGHTEST)
        try:
            image = self._image
            if attempt.without_blocks and image is not None:
                from starcat.frames.images.blocks import without_block_edges

                image = without_block_edges(image)
            if image is None:
                return None
            return FrameFile(self.path, image=image).measured(
                attempt.options(self.options), without_hot_pixels=attempt.without_hot_pixels
            )
        except ConfigError:  # too much stands out: keep the result of the first measurement
            return None

    @cached_property
    def _image(self) -> NDArray[Any] | None:
        """The image, read again if it was not kept; None for centroids."""
        if self.measured.image is not None:
            return self.measured.image
        return read_frame_file(self.path, self.options, self.local).image

    @cached_property
    def _observer(self) -> Observer | None:
        """When and from where the frames were taken; None if that is not stated."""
        if self.local.observer is not None or self.options.time is None:
            return self.local.observer
        from starcat.frames.sky.observer import Observer

        return Observer.at(self.options.time)

    def _check_size(self) -> None:
        camera, shape = self.camera, self.measured.shape
        if shape is not None and shape != (camera.height_px, camera.width_px):
            is_own = camera == self.matcher.database.camera
            raise ConfigError(
                f"the image has {shape[1]} x {shape[0]} px, the camera"
                f"{' of the database' if is_own else ''} {camera.width_px} x {camera.height_px}",
                where=str(self.path),
                hint=(
                    "state the field across the width of the image in degrees ({fov_deg})",
                    "give a file of the camera that took it ({camera})",
                ),
            )

    @property
    def _has_own_limit(self) -> bool:
        settings = self.matcher.settings
        return settings.time_limit_s < math.inf or settings.max_steps != MAX_STEPS

    @property
    def _is_lost_in_space(self) -> bool:
        """Whether the whole sky is searched with one camera."""
        return not self.local.track and self._prior is None and self.options.fov_deg is None

    @property
    def _prior(self) -> tuple[Any, Any] | None:
        """The expected attitude and its error; None if there is none."""
        if self.local.prior is not None or self.options.prior_q is None:
            return self.local.prior
        return list(self.options.prior_q), self.options.prior_error_deg

    @property
    def _fov_error(self) -> float:
        stated, may_be_off = self.options.fov_error, self.is_image or self._is_lost_in_space
        if self.options.fov_deg is not None or not (self._is_scale_free or stated):
            return 0.0
        return (FOV_ERROR if may_be_off else 0.0) if stated is None else stated

    @property
    def _is_scale_free(self) -> bool:
        return self.matcher.settings.method in SCALE_FREE

    def _check_options(self) -> None:
        """Check that the ways in which the frames are searched go together."""
        is_near = self.options.prior_q is not None or self.local.track
        if self.options.fov_deg is not None and is_near:
            raise ConfigError(
                "it is for frames of an unknown camera",
                parameter="fov_deg",
                hint="leave out {track:True} and {prior_q}",
            )

    def _search(self, frame: MeasuredFrame, fov_error: float, camera: Camera) -> MatchResult:
        """Identify a frame: in the whole sky, near an attitude, or along a sequence."""
        arguments: dict[str, Any] = {
            "camera": camera, "fov_error": fov_error, "sigma_px": frame.sigma_px,
        }  # fmt: skip
        if self.tracker is not None:
            return self.tracker.attempt(frame.centroids_px, mag=frame.mag, **arguments)
        prior, error_deg = self._prior or (None, None)
        arguments |= {
            "fov_deg": self.options.fov_deg, "prior": prior, "prior_error_deg": error_deg,
        }  # fmt: skip
        return self.matcher.identify(frame.centroids_px, mag=frame.mag, **arguments)

    def notes(self, first: FrameAnswer | None) -> list[str]:
        """Return notes for the user in addition to the answers."""
        notes = []
        if first and first.spots is not None and first.spots.streak is not None:
            notes.append(
                f"The stars are streaks of {first.spots.streak.length_px:.0f} px: centroids and "
                "attitude hold for the middle of the exposure."
            )
        if first and first.attempt is not None:
            notes.append(
                f"The image was identified in attempt {first.attempt.number}, with "
                f"{first.attempt.words}; the chance of a false match counts all "
                f"{MAX_SEARCHES} searches that an image can have."
            )
        return notes

    def draw(self, path: Path, answer: FrameAnswer) -> None:
        """Draw a frame with its stars circled and named, as PNG or SVG."""
        from starcat.frames.images.picture import draw

        if answer.result.database is not None:
            database, image = answer.result.database, self.measured.image
            camera = answer.result.camera or self.camera
            draw(path, answer.frame, image, answer.result, database, camera, answer.sky)

    def expect_picture(self, wcs: Path) -> None:
        """Raise `ConfigError` if the file has no picture into whose copy a WCS can be written."""
        if not self.is_image:
            raise ConfigError(
                f"{self.path} holds centroids, and a WCS is written into a copy of a picture",
                parameter="wcs",
                value=str(wcs),
                hint=("give the picture", "use MatchResult.wcs() in Python"),
            )

    def write_wcs(self, path: Path, answer: FrameAnswer) -> None:
        """Write a FITS copy of the image with the world coordinates that were found."""
        from starcat.frames.images.image_file import write_wcs

        if self.measured.image is not None:
            write_wcs(path, self.path, self.measured.image, answer.result, flip=self.options.flip)


def _is_bright(image: NDArray[Any] | None) -> bool:
    """Return whether most of an image is nearer to its brightest than to its darkest pixel."""
    if image is None:
        return False
    low, middle, high = np.nanquantile(image, (0.0, 0.5, 1.0))
    return bool(2.0 * middle > low + high or low == high > 0.0)


def _is_limited(result: MatchResult) -> bool:
    """Return whether a limit of the search ended it."""
    return result.refusal is not None and result.refusal.reason in ("time", "steps")


def open_matcher(database: Path, options: SearchOptions) -> Matcher:
    """Open a database, or an onboard image, for identifying with some options."""
    names = [each.name for each in fields(SearchOptions)]
    return Matcher.open(database, **{name: getattr(options, name) for name in names})


def identify_file(
    matcher: Matcher | HasFolder | PathLike,
    path: PathLike,
    options: IdentifyOptions | None = None,
    *,
    camera: Camera | None = None,
    prior: PriorLike | None = None,
    prior_error_deg: float | None = None,
    observer: Observer | None = None,
    **stated: Any,
) -> MatchResult:
    """Identify the frame of a file, a picture or centroids, as ``starcat identify`` does.

    Parameters
    ----------
    matcher : Matcher, Database, str or path-like
        A matcher, or the database or onboard image to open one for.
    path : str or path-like
        A picture, or a file of centroids with one frame; `read_frames` reads files with several.
    options : IdentifyOptions, optional
        The options of ``starcat identify``. Options about the search replace the settings of the
        matcher.
    camera : Camera, optional
        The camera that took the frame; the database's by default.
    prior, prior_error_deg : array_like of float64, shape (4,), and float, optional
        Expected attitude or boresight and its largest error, as for `Matcher.identify`.
    observer : Observer, optional
        When and from where the frame was taken; ``time`` in place of it states the time alone.
    **stated
        Single options, such as ``fov_error=0.1`` or ``threshold=8``.

    Returns
    -------
    MatchResult
        A picture is tried with other spots too if it is not identified. An unidentified frame is
        explained if possible.

    Raises
    ------
    ConfigError
        If the file cannot be read or does not have one frame, or an option cannot be used.
    """
    if camera is not None:
        check_type("camera", camera, Camera, "a starcat.Camera")
    expected = None
    if prior is not None:
        prior_of(prior, prior_error_deg)  # it is checked before the file is read
        expected = prior, prior_error_deg
    elif prior_error_deg is not None:
        stated["prior_error_deg"] = prior_error_deg
    local = LocalInputs(camera=camera, observer=observer, prior=expected)
    options = replace(options or IdentifyOptions(), **stated)
    if not isinstance(matcher, Matcher):
        matcher = open_matcher(database_path("matcher", matcher), options)
    else:
        names = options_of(SearchOptions)
        search = {name: value for name, value in options.stated().items() if name in names}
        if search:
            matcher = matcher.with_settings(**search)
    answers = answer_file(path_of("path", path), matcher, options, local)
    if len(answers.measured.frames) != 1:
        raise ConfigError(
            f"{count_of(len(answers.measured.frames), 'frame')}; read them with "
            "starcat.read_frames, and identify each",
            where=path,
        )
    [answer] = answers
    return answer.result


def answer_file(
    path: Path,
    database: Path | Matcher,
    options: IdentifyOptions | None = None,
    local: LocalInputs | None = None,
) -> FileAnswers:
    """Measure a file, or ``-`` for stdin, and identify its frames when they are requested."""
    options, local = options or IdentifyOptions(), local or LocalInputs()
    matcher = database if isinstance(database, Matcher) else open_matcher(database, options)
    file = read_frame_file(path, options, local)
    # Finding the stars takes seconds: a camera that cannot be used is refused before.
    camera, options = stated_camera(file.shape, matcher.database, options, local)
    tracker = Tracker(matcher) if local.track else None
    return FileAnswers(path, matcher, file.measured(options), camera, options, local, tracker)


def identify_either_way(
    path: Path, matcher: Matcher, options: IdentifyOptions, local: LocalInputs | None = None
) -> tuple[FileAnswers, list[FrameAnswer]]:
    """Identify a file; if its first frame only matches mirrored, flip the order of its rows."""
    for flip in (options.flip, True, False):
        answers = answer_file(path, matcher, replace(options, flip=flip), local)
        frame_answers = list(answers)
        refusal = frame_answers[0].result.refusal if frame_answers else None
        if refusal is None or refusal.reason != "mirrored":
            break
    return answers, frame_answers
