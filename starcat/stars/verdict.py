"""Verdicts on records, kept or rejected with exactly one reason; and the bits of their quality.

The reasons stand in the order in which they are tried; the first that applies is the verdict.
"""

from __future__ import annotations

from enum import Enum, IntFlag
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from starcat.arrays import Mask


class Reason(Enum):
    """Why a record is not a guide star; the value of a member says it in words."""

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
    no_magnitude = "no magnitude in the band of the build"
    uncertain_magnitude = "the magnitude may be wrong by more than 0.3 mag"
    too_bright = "brighter than bright_limit_mag"
    too_faint = "fainter than faint_limit_mag"
    double = "a companion within min_separation_deg"
    blended = (
        "neighbours move its centroid or add to its light more than [selection.neighbours] allows"
    )
    merged = "merged into the brighter star of a close group"
    flagged_double = "the archive flags an unresolved double"
    variable = "amplitude above max_amplitude_mag"
    flagged_variable = "flagged variable, amplitude unknown"
    drifts = "further from its place at an end of the span than max_drift_arcsec"
    distrusted = "distrusted by what flew: [selection.observed] lists it"
    beyond_count = "thinned to max_stars: fainter, or as selection.thinning says"
    density = (
        "thinned to max_stars_per_field: fainter in every field, or as selection.thinning says"
    )


_CODES = {reason: code for code, reason in enumerate(Reason, start=1)}


class Verdicts:
    """The verdicts on a number of records: kept until rejected, then final."""

    def __init__(self, count: int) -> None:
        self._code = np.zeros(count, dtype=np.int8)

    def reject(self, where: Mask, reason: Reason) -> None:
        """Reject records that no earlier reason applied to."""
        self._code[where & (self._code == 0)] = _CODES[reason]

    @property
    def is_kept(self) -> Mask:
        """Whether each record is kept: no reason has applied to it."""
        return np.asarray(self._code == 0)

    @property
    def reasons(self) -> pa.Array:
        """Names of the reasons of the rejected records, in order."""
        # Made here: the first array of a list imports pandas, where that is installed.
        names = pa.array(["kept", *(reason.name for reason in Reason)])
        return names.take(pa.array(self._code[self._code != 0]))


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
