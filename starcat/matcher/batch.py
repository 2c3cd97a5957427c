"""The answers to many frames, as `Matcher.identify_many` returns them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import overload

import numpy as np

from starcat.arrays import Array
from starcat.matcher.result import MatchResult, Status


@dataclass(frozen=True, eq=False)
class BatchResult(Sequence[MatchResult]):
    """The answers to many frames of one camera: a sequence, with arrays over all frames.

    All methods and engines return it. As of any sequence, ``bool`` says whether there are frames,
    and not whether one is identified: ask ``any(answers)`` or ``all(answers)``.

    Attributes
    ----------
    status : list of str
        The status of each frame, as `MatchResult` has it.
    seconds : ndarray of float64, shape (N,)
        Time that each answer took.
    q_body_from_icrs : ndarray of float64, shape (N, 4)
        Scalar-last attitudes; NaN unless identified.
    """

    status: list[Status]
    seconds: Array
    q_body_from_icrs: Array
    _answer: Callable[[int], MatchResult] = field(repr=False)

    def with_answers(self, answers: Mapping[int, MatchResult]) -> BatchResult:
        """Return the batch with other answers to some of its frames."""
        if not answers:
            return self
        status, seconds, attitudes = list(self.status), self.seconds.copy(), self.q_body_from_icrs
        attitudes = attitudes.copy()
        for n, answer in answers.items():
            status[n], seconds[n] = answer.status, answer.time_s
            attitudes[n] = answer.q_body_from_icrs

        def answer_of(n: int) -> MatchResult:
            return answers[n] if n in answers else self._answer(n)

        return BatchResult(status, seconds, attitudes, answer_of)

    def __len__(self) -> int:
        return len(self.status)

    @overload
    def __getitem__(self, frame: int) -> MatchResult: ...
    @overload
    def __getitem__(self, frame: slice) -> list[MatchResult]: ...
    def __getitem__(self, frame: int | slice) -> MatchResult | list[MatchResult]:
        if isinstance(frame, slice):
            return [self._answer(n) for n in range(*frame.indices(len(self)))]
        return self._answer(range(len(self))[frame])

    def __iter__(self) -> Iterator[MatchResult]:
        return map(self._answer, range(len(self)))


def no_answers(count: int) -> BatchResult:
    """Return a batch of frames whose answers are still to come, by `BatchResult.with_answers`."""
    nothing: list[Status] = ["no_match"] * count
    return BatchResult(nothing, np.full(count, np.nan), np.full((count, 4), np.nan), _missing)


def _missing(frame: int) -> MatchResult:
    raise IndexError(f"frame {frame} has no answer")
