"""Answers to many frames at once, kept as arrays and read one by one."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import overload

import numpy as np
from numpy.typing import NDArray

from starcat.geometry.attitude import radec_roll_from_matrix
from starcat.geometry.camera import Camera
from starcat.matcher.fast import DROPPED, OUT_OF_STEPS, WORDS, Answers
from starcat.matcher.refusal import Refusal
from starcat.matcher.result import MatchResult, Origin, Status
from starcat.matcher.stars import Asked

Explain = Callable[[NDArray[np.float64], Camera, "NDArray[np.float64] | None"], "Refusal | None"]
"""What says why a frame, of a camera and perhaps with magnitudes, gets no answer."""


@dataclass(frozen=True)
class MatchResults(Sequence[MatchResult]):
    """The answers of the C library to many frames.

    Attributes
    ----------
    answers : Answers
        All of them, as arrays.
    asked : sequence of Asked
        What was asked of each frame.
    camera : Camera
        The camera of all of them.
    explain : callable, optional
        Searches a frame again and says why it gets no answer, which the library does not.
    origin : {"lost_in_space", "tracking"}
        Where the library looked for the stars.
    """

    answers: Answers
    asked: Sequence[Asked]
    camera: Camera
    explain: Explain | None = None
    origin: Origin = "lost_in_space"

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.answers.frames)

    def __iter__(self) -> Iterator[MatchResult]:
        """Return the answers one after the other."""
        return (self[n] for n in range(len(self)))

    @property
    def status(self) -> list[Status]:
        """What each frame came to."""
        return [WORDS[code] for code in self.answers.frames["status"].tolist()]

    @property
    def seconds(self) -> NDArray[np.float64]:
        """Time that each frame took, without the call."""
        return np.asarray(self.answers.frames["seconds"])

    @property
    def q_body_from_icrs(self) -> NDArray[np.float64]:
        """Scalar-last attitudes, shape (N, 4); NaN unless identified."""
        found = self.answers.frames
        return np.where(found["status"][:, None] == 0, found["q_body_from_icrs"], np.nan)

    @overload
    def __getitem__(self, frame: int) -> MatchResult: ...
    @overload
    def __getitem__(self, frame: slice) -> list[MatchResult]: ...
    def __getitem__(self, frame: int | slice) -> MatchResult | list[MatchResult]:
        """Return the answer to one frame, or those to some."""
        if isinstance(frame, slice):
            return [self[n] for n in range(*frame.indices(len(self)))]
        frame = range(len(self))[frame]
        answers = self.answers
        star = answers.star_index[answers.starts[frame] : answers.starts[frame + 1]]
        # In the order of `ANSWER`.
        code, n_matched, _, quaternion, matrix, residual_rad, log_chance, seconds = answers.frames[
            frame
        ].item()
        status, index, dropped = WORDS[code], np.maximum(star, -1), _dropped(star)
        asked = self.asked[frame]
        if status != "identified":
            none, nan = np.full(len(index), -1, dtype=np.int64), math.nan
            unknown = np.full(4, nan)
            return MatchResult(
                *(status, none, index, unknown, nan, nan, nan, 0, nan, 1.0, dropped),
                origin=self.origin,
                time_s=seconds,
                asked=asked,
                why=self._why(code, asked),
            )
        ids = asked.database.star_id[index]
        ids[index < 0] = -1
        return MatchResult(
            status,
            ids,
            index,
            quaternion,
            *radec_roll_from_matrix(matrix),
            n_matched,
            math.degrees(residual_rad) * 3600.0,
            math.exp(log_chance),
            dropped,
            self.camera,
            origin=self.origin,
            time_s=seconds,
            asked=asked,
        )

    def _why(self, code: int, asked: Asked) -> Refusal | Callable[[], Refusal | None] | None:
        """Return why a frame has no answer, or what finds it out."""
        if code == OUT_OF_STEPS:
            return Refusal("steps")
        if WORDS[code] == "too_few_stars":
            return Refusal("too_few_stars")
        if self.explain is None:
            return None
        return partial(self.explain, asked.centroids_px, self.camera, asked.magnitudes)


def _dropped(star: NDArray[np.int32]) -> tuple[tuple[int, str], ...]:
    """Return row and reason of every centroid that was not used, repeats last."""
    if star.min(initial=-1) >= -1:
        return ()
    rows = np.flatnonzero(star < -1)
    reasons = [(int(row), DROPPED[int(star[row])]) for row in rows]
    return tuple(sorted(reasons, key=lambda item: item[1] == "duplicate"))
