"""The answers to many frames, as `Matcher.identify_many` returns them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array
from starcat.errors import count_of
from starcat.geometry.sphere import radec_from_directions
from starcat.html_tables import html_table
from starcat.matcher.result import MatchResult, Status
from starcat.matcher.sky_objects import sky_object_table

if TYPE_CHECKING:
    from astropy.table import QTable


@dataclass(frozen=True, eq=False, repr=False)
class BatchResult(Sequence[MatchResult]):
    """The answers to many frames of one camera: a sequence, with arrays over all frames.

    All methods and engines return it. As for any sequence, ``bool`` is true if there are frames,
    even if none is identified: use ``any(answers)`` or ``all(answers)``.

    Attributes
    ----------
    status : list of str
        The status of each frame, as `MatchResult` has it.
    seconds : ndarray of float64, shape (N,)
        Time that each answer took.
    q_body_from_icrs : ndarray of float64, shape (N, 4)
        Scalar-last attitudes; NaN unless identified.
    ok : ndarray of bool, shape (N,)
        Whether each frame was identified.
    boresight_ra_deg, boresight_dec_deg : ndarray of float64, shape (N,)
        Directions of the boresights; NaN unless identified.
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

    def table(self) -> QTable:
        """Return the answers as an astropy table, one row per frame.

        Returns
        -------
        astropy.table.QTable
            With units: ``status``, ``reason`` (of `Refusal`; empty if identified),
            ``n_centroids``, ``n_matched``, ``boresight_ra_deg``, ``boresight_dec_deg``,
            ``roll_deg``, ``q_body_from_icrs`` of shape (N, 4), ``residual_arcsec``,
            ``false_match_probability`` and ``time_s``. Angles are NaN unless identified.

        Raises
        ------
        ConfigError
            If astropy is not installed.
        """
        answers = list(self)
        reasons = ["" if answer.refusal is None else answer.refusal.reason for answer in answers]
        columns: dict[str, Any] = {
            "status": np.array(self.status, dtype=np.str_),
            "reason": np.array(reasons, dtype=np.str_),
            "n_centroids": np.array([len(answer.star_index) for answer in answers], dtype=np.int64),
            "n_matched": np.array([answer.n_matched for answer in answers], dtype=np.int64),
        }
        for name in ("boresight_ra_deg", "boresight_dec_deg", "roll_deg"):
            columns[name] = np.array(
                [getattr(answer, name) for answer in answers], dtype=np.float64
            )
        columns["q_body_from_icrs"] = self.q_body_from_icrs
        for name in ("residual_arcsec", "false_match_probability", "time_s"):
            columns[name] = np.array(
                [getattr(answer, name) for answer in answers], dtype=np.float64
            )
        return sky_object_table(columns, {})

    @property
    def ok(self) -> NDArray[np.bool_]:
        """Whether each frame was identified, shape (N,)."""
        return np.array([status == "identified" for status in self.status], dtype=np.bool_)

    @property
    def boresight_ra_deg(self) -> Array:
        """Right ascensions of the boresights, shape (N,); NaN unless identified."""
        return radec_from_directions(self._boresights)[0]

    @property
    def boresight_dec_deg(self) -> Array:
        """Declinations of the boresights, shape (N,); NaN unless identified."""
        return radec_from_directions(self._boresights)[1]

    @cached_property
    def _boresights(self) -> Array:
        x, y, z, w = self.q_body_from_icrs.T
        return np.column_stack(
            [2.0 * (x * z + y * w), 2.0 * (y * z - x * w), 1.0 - 2.0 * (x * x + y * y)]
        )

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for another process: the answers, in place of how they are made."""
        return {**vars(self), "_answer": list(self).__getitem__}

    def __repr__(self) -> str:
        return f"<BatchResult: {int(self.ok.sum()):,} of {count_of(len(self), 'frame')} identified>"

    def _repr_html_(self) -> str:
        """Return the first answers as a table for a notebook."""
        heads = ("frame", "status", "stars", "RA deg", "Dec deg", "roll deg", "chance")
        rows = ((n, *_cells(answer)) for n, answer in enumerate(self))
        return html_table(heads, rows, len(self), repr(self)[1:-1])

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


def _cells(answer: MatchResult) -> list[str]:
    stars = f"{answer.n_matched} of {len(answer.star_index)}"
    if not answer.ok:
        return [
            answer.status if answer.refusal is None else answer.refusal.reason,
            stars,
            *4 * [""],
        ]
    angles = (answer.boresight_ra_deg, answer.boresight_dec_deg, answer.roll_deg)
    chance = f"{answer.false_match_probability:.1e}"
    return [answer.status, stars, *(f"{angle:.4f}" for angle in angles), chance]


def no_answers(count: int) -> BatchResult:
    """Return a batch of frames whose answers are still to come, by `BatchResult.with_answers`."""
    nothing: list[Status] = ["no_match"] * count
    return BatchResult(nothing, np.full(count, np.nan), np.full((count, 4), np.nan), _missing)


def _missing(frame: int) -> MatchResult:
    raise IndexError(f"frame {frame} has no answer")
