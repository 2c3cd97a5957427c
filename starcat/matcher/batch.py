"""Answers to many frames at once, kept as arrays and read one by one."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from starcat.matcher.c_engine import DROPPED, OUT_OF_STEPS, STATUSES, Answers
from starcat.matcher.database import Database
from starcat.matcher.observation import Dropped, Frame
from starcat.matcher.result import MatchResult, Origin, Refusal, Status, no_match
from starcat.matcher.stars import ARCSEC


@dataclass(frozen=True)
class BatchResult(Sequence[MatchResult]):
    """The answers of the C library to many frames of one camera."""

    # All answers as arrays.
    answers: Answers
    frames: Sequence[Frame]
    database: Database
    # Noise of a centroid, where it was stated.
    noise_px: float | None = None
    # Searches a frame again and says why it gets no answer, which the library does not.
    explain: Callable[[Frame], Refusal | None] | None = None
    # Where the library looked for the stars.
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
        return [STATUSES[code] for code in self.answers.frames["status"].tolist()]

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
        found, asked = answers.frames[frame], self.frames[frame]
        facts: dict[str, Any] = {
            "origin": self.origin,
            "time_s": float(found["seconds"]),
            "frame": asked,
            "database": self.database,
            "noise_px": self.noise_px,
        }
        code, dropped = int(found["status"]), _dropped(star)
        if STATUSES[code] != "identified":
            return no_match(len(star), dropped, self._why(code, asked), **facts)
        return MatchResult(
            "identified",
            np.maximum(star, -1),
            found["matrix"].copy(),
            float(found["residual_rad"]) * ARCSEC,
            math.exp(found["log_chance"]),
            dropped,
            asked.camera,
            **facts,
        )

    def _why(self, code: int, frame: Frame) -> Refusal | Callable[[], Refusal | None] | None:
        """Return why a frame has no answer, or what finds it out."""
        if code == OUT_OF_STEPS:
            return Refusal("steps")
        if STATUSES[code] == "too_few_stars":
            return Refusal("too_few_stars")
        return None if self.explain is None else partial(self.explain, frame)


def _dropped(star: NDArray[np.int32]) -> Dropped:
    """Return row and reason of every centroid that was not used, repeats last."""
    if star.min(initial=-1) >= -1:
        return ()
    rows = np.flatnonzero(star < -1)
    reasons = [(int(row), DROPPED[int(star[row])]) for row in rows]
    return tuple(sorted(reasons, key=lambda item: item[1] == "duplicate"))
