"""Verdicts on records, kept or rejected with exactly one reason; and the bits of their quality.

`Reason` has the reasons for which the record of an archive cannot be used. The rules of selection
have their own (`starcat.pipeline.selection.rules`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from enum import Enum, IntFlag
from pathlib import Path
from typing import Protocol

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from starcat.arrays import Mask


class Reason(Enum):
    """Why the record of an archive cannot be used; the value of a member is the reason in words.

    The members are in the order in which they are tried; the first that applies is the verdict.
    """

    malformed_record = "the record does not follow the archive's layout"
    beyond_read_limit = "fainter than read_limit_mag, or without magnitude: counted, not listed"
    deleted = "the archive says to ignore the record"
    no_identity = "neither a number nor a designation names the star"
    no_position = "the archive has no position, or none with an epoch"
    impossible_value = "a position, epoch, motion or magnitude that no star can have"
    duplicate_record = "another record has the same star_id, or the archive prefers another"
    counterpart = "another record of a star that an earlier one of merged catalogs has"
    ambiguous_counterpart = (
        "the likeliest of several records that may be a star of an earlier one of merged catalogs"
    )
    minor_planet = "the archive flags a minor planet"
    extended = "the archive flags an extended or non-stellar source"
    artifact = "the archive doubts that there is a star"
    uncertain_magnitude = "the magnitude may be wrong by more than 0.3 mag"


NO_STARS = frozenset(
    {
        Reason.deleted,
        Reason.duplicate_record,
        Reason.counterpart,
        Reason.ambiguous_counterpart,
        Reason.minor_planet,
        Reason.artifact,
    }
)
"""Reasons of records that are no star of the sky: another record has it, or there is none."""


class NamedReason(Protocol):
    """A reason of an archive or of a rule."""

    @property
    def name(self) -> str:
        """The name of the reason in the product ``rejected``."""


class Verdicts:
    """The verdicts on a number of records: kept until rejected, then final."""

    def __init__(self, count: int) -> None:
        self._code = np.zeros(count, dtype=np.int16)  # 0: kept; n: the verdict n - 1
        self._verdicts: list[tuple[str, str | None]] = []  # name of the reason, and the detail

    def reject(self, where: Mask, reason: NamedReason, detail: str | None = None) -> None:
        """Reject records that no earlier reason applied to."""
        verdict = (reason.name, detail)
        if verdict not in self._verdicts:
            self._verdicts.append(verdict)
        self._code[where & (self._code == 0)] = self._verdicts.index(verdict) + 1

    def has(self, reason: NamedReason) -> Mask:
        """Return which records are rejected for a reason."""
        codes = [n for n, (name, _) in enumerate(self._verdicts, start=1) if name == reason.name]
        return np.isin(self._code, codes)

    @property
    def is_kept(self) -> Mask:
        """Whether each record is kept: no reason has applied to it."""
        return np.asarray(self._code == 0)

    @property
    def reasons(self) -> pa.Array:
        """Names of the reasons of the rejected records, in order."""
        return self._of_rejected([name for name, _ in self._verdicts])

    @property
    def details(self) -> pa.Array:
        """Details of the verdicts on the rejected records, in order; null without details."""
        return self._of_rejected([detail for _, detail in self._verdicts])

    def _of_rejected(self, texts: Sequence[str | None]) -> pa.Array:
        # Made only here: the first array from a list imports pandas, if that is installed.
        return pa.array(texts, pa.string()).take(pa.array(self._code[self._code != 0] - 1))


class Quality(IntFlag):
    """The bits of ``quality_flags``: what to know of a star's position and magnitude."""

    ESTIMATED_MAGNITUDE = 1
    COLOUR_OUT_OF_RANGE = 2
    SATURATED = 4
    NO_PROPER_MOTION = 8
    PHOTOCENTRE = 16
    BLENDED = 32
    POOR_PHOTOMETRY = 64
    DUBIOUS_POSITION = 128
    CONTAMINATED = 256
    MERGED = 512
    PERHAPS_NOT_A_STAR = 1024


def quality_flags(count: int, bits: dict[Quality, Mask]) -> NDArray[np.int32]:
    """Return the sum of the bits that apply to each star."""
    flags = np.zeros(count, dtype=np.int32)
    for bit, where in bits.items():
        flags |= np.where(where, np.int32(bit), np.int32(0))
    return flags


def rejected_path(output: Path) -> Path:
    """Return the file of the rejected rows that belong to a star table."""
    return output.with_name(f"{output.stem}.rejected{output.suffix}")


def count_by_reason(
    rejected: pa.Table, beyond_read_limit: int = 0, *, reasons: Iterable[str] = Reason.__members__
) -> dict[str, int]:
    """Return the number of rejected rows by reason, in the order of the reasons.

    By default only reasons of archives are counted. After a selection `ALL_REASONS` of the rules
    are the ``reasons``.
    """
    counts = {
        entry["values"]: entry["counts"]
        for entry in pc.value_counts(rejected["reason"]).to_pylist()
    }
    if beyond_read_limit:
        counts[Reason.beyond_read_limit.name] = beyond_read_limit
    return {name: counts[name] for name in reasons if name in counts}
