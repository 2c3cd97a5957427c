"""Stars with a companion that the sensor cannot resolve, by separation and magnitude."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pydantic import Field

from starcat.arrays import Array, Mask, Rows
from starcat.catalog.stars.star_table import directions_of, floats_of
from starcat.errors import BuildError
from starcat.geometry.proximity import pairs_within
from starcat.pipeline.selection.merging import (
    MAX_PAIRS,
    MERGED,
    combined_magnitude,
    group_numbers,
    with_merged,
)
from starcat.pipeline.selection.rule import Context, FormField, Rejection, RuleReason
from starcat.resources import sources_supplying
from starcat.sections import Mag, Section

STEP = "doubles"
DOUBLE = RuleReason("double", "a companion within min_separation_deg")
REASONS = (DOUBLE,)
FORM = {
    "min_separation_deg": FormField(
        "Doubles are closer than", "slide", "limits", low=0, high=0.5, step=0.001
    ),
    "action": FormField(
        "Doubles",
        "choice",
        "limits",
        choices=(
            ("remove", "remove both stars"),
            ("merge", "merge them into one"),
            ("keep", "keep them"),
        ),
    ),
}


if TYPE_CHECKING:
    CompanionSource: TypeAlias = str
else:
    CompanionSource = Literal[sources_supplying("companions")]


class Doubles(Section):
    """Stars too close for the sensor to tell apart."""

    later_keys = ("join",)

    min_separation_deg: float = Field(
        0.047, ge=0.0, le=10.0, description="stars that are closer are a double"
    )
    max_delta_mag: float | None = Field(
        None,
        ge=0.0,
        le=30.0,
        description="a companion fainter by more does not count; default: every one counts",
    )
    companion_limit_mag: Mag | None = Field(
        None,
        description="only stars up to this magnitude form doubles, as either of the two; "
        "default: faint_limit_mag",
    )
    action: Literal["remove", "merge", "keep"] = Field(
        "remove", description="remove both, merge them into their photocentre, or keep them"
    )
    flags: Literal["ignore", "unresolved", "strict"] = Field(
        "unresolved",
        description="what an archive's flag of a double means: nothing; a rejection if the "
        "separation is below the limit or unknown and the magnitudes are known to be close; or "
        "always a rejection",
    )
    join: tuple[CompanionSource, ...] = Field(
        (),
        strict=False,  # a list in TOML
        description="sources that flag stars with a companion closer than min_separation_deg, by "
        "HIP number or place; a pair without magnitudes counts as one of equal stars where it is "
        "closer than 5 arcsec, and not at all where it is wider",
        examples=[["wds"]],
    )


TABLE, KEYS = "doubles", Doubles


def check(selection: Any) -> None:
    """Check that guide stars can form doubles."""
    limit, bright = selection.doubles.companion_limit_mag, selection.bright_limit_mag
    if limit is not None and limit <= bright:
        raise ValueError(
            f"doubles.companion_limit_mag {limit:g} is not fainter than bright_limit_mag "
            f"{bright:g}, so that no guide star could be a double; larger is fainter"
        )


def combine(context: Context, keys: Doubles) -> None:
    """Merge close stars, if the spec asks for it and no rule of neighbours takes its place."""
    if keys.action == "merge" and not context.selection.neighbours.is_on:
        context.stars, absorbed = merge_doubles(context.stars, context.selection)
        context.verdicts.reject(absorbed, MERGED)


def reject(context: Context, keys: Doubles) -> list[Rejection]:
    """Reject both stars of a double."""
    if keys.action != "remove" or context.selection.neighbours.is_on:
        return []
    return [Rejection(has_companion(context.stars, context.selection), DOUBLE)]


def has_companion(stars: pa.Table, selection: Any) -> Mask:
    """Return which stars have a companion that the sensor cannot resolve.

    It lies within ``min_separation_deg`` and is not fainter by more than ``max_delta_mag``.
    """
    pairs, mag = _companion_pairs(stars, selection)
    largest = selection.doubles.max_delta_mag
    is_double = np.zeros(len(stars), dtype=bool)
    for star, companion in ((0, 1), (1, 0)):
        delta = mag[pairs[:, companion]] - mag[pairs[:, star]]
        counts = np.ones(len(pairs), dtype=bool) if largest is None else delta <= largest
        is_double[pairs[counts, star]] = True
    return is_double


def merge_doubles(stars: pa.Table, selection: Any) -> tuple[pa.Table, Mask]:
    """Merge groups of close stars into one star each, at their photocentre.

    A group is a chain of pairs as `has_companion` finds them. The rows stay; the brightest star of
    each group gets the combined magnitude and direction. The mask marks the stars that it absorbs.
    """
    pairs, mag = _companion_pairs(stars, selection)
    if selection.doubles.max_delta_mag is not None:
        delta = np.abs(mag[pairs[:, 0]] - mag[pairs[:, 1]])
        pairs = pairs[delta <= selection.doubles.max_delta_mag]
    absorbed = np.zeros(len(stars), dtype=bool)
    if not len(pairs):
        return stars, absorbed
    number, directions = stars["star_id"].to_numpy(), directions_of(stars)
    groups = _groups(pairs, len(stars))
    heads = np.empty(len(groups), dtype=np.int64)
    centres, mags = np.empty((len(groups), 3)), np.empty(len(groups))
    for group, members in enumerate(groups):
        ranked = members[np.lexsort((number[members], mag[members]))]
        flux = 10.0 ** (-0.4 * (mag[members] - mag[ranked[0]]))
        centre = flux @ directions[members]
        heads[group], centres[group] = ranked[0], centre / np.sqrt(centre @ centre)
        mags[group] = combined_magnitude(mag[members])
        absorbed[ranked[1:]] = True
    return with_merged(stars, heads, centres, mags), absorbed


def _companion_pairs(stars: pa.Table, selection: Any) -> tuple[Rows, Array]:
    """Return close pairs of the stars that count as companions, and the magnitudes of all stars."""
    doubles = selection.doubles
    limit = doubles.companion_limit_mag
    mag = floats_of(stars, "mag")
    with np.errstate(invalid="ignore"):
        pool = np.flatnonzero(mag <= (selection.faint_limit_mag if limit is None else limit))
    _check_pairs(len(pool), doubles.min_separation_deg)
    pairs, _ = pairs_within(directions_of(stars)[pool], np.radians(doubles.min_separation_deg))
    return pool[pairs], mag


def _check_pairs(stars: int, separation_deg: float) -> None:
    """Check that the separation is not so large, for these stars, that most become doubles."""
    pairs = 0.25 * stars**2 * (1.0 - np.cos(np.radians(separation_deg)))
    if pairs > MAX_PAIRS:
        raise BuildError(
            f"selection.doubles.min_separation_deg = {separation_deg:g} makes about {pairs:,.0f} "
            f"doubles of {stars:,} stars, the limit is {MAX_PAIRS:,}",
            hint="give the few pixels that the camera cannot resolve, or a brighter "
            "faint_limit_mag",
        )


def _groups(pairs: Rows, count: int) -> list[NDArray[np.int64]]:
    """Return the rows of the stars of each group, in the order of the first row of each."""
    number = group_numbers(pairs, count)
    rows = np.unique(pairs)
    order = np.argsort(number[rows], kind="stable")
    cuts = np.flatnonzero(np.diff(number[rows][order])) + 1
    return sorted(np.split(rows[order], cuts), key=lambda members: int(members[0]))
