"""Stars whose centroid other stars in its window move, or add light to.

Every star that can become a guide star is judged by all stars of the table with a magnitude, even
very faint ones, by their effect on its centroid (`starcat.database.products.blends`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import scipy
from numpy.typing import NDArray
from pydantic import Field, model_validator

from starcat.arrays import Array, Directions, Mask, Rows
from starcat.catalog.stars.star_table import directions_of, floats_of, with_columns
from starcat.catalog.stars.verdict import Quality
from starcat.database.products.blends import Blends, Widths, blends, widths_px
from starcat.database.products.crossmatch import ARCSEC
from starcat.errors import BuildError
from starcat.geometry.proximity import pairs_within
from starcat.geometry.sphere import chord_from_separation, radec_from_directions, tangent_axes
from starcat.pipeline.selection.merging import MAX_PAIRS, MERGED, group_numbers, with_merged
from starcat.pipeline.selection.rule import Context, FormField, Rejection, RuleReason
from starcat.pipeline.selection.rules.doubles import has_companion
from starcat.sections import Section

STEP = "doubles"
BLENDED = RuleReason(
    "blended",
    "neighbours move its centroid or add to its light more than [selection.neighbours] allows",
)
REASONS = (BLENDED, MERGED)
FORM = {
    "psf_sigma_px": FormField(
        "Width of a star's spot",
        "slide",
        low=0.2,
        high=3,
        step=0.05,
        none_at="low",
        placeholder="not told",
        hint="standard deviation; with it, neighbours in the window of a centroid replace the "
        "separation of doubles",
    ),
    "max_offset_px": FormField(
        "Shift by neighbours", "number", placeholder="0.1", hint="of a centroid, at most"
    ),
    "max_contamination": FormField("Share of their light", "number", hint="at most, 0 to 1"),
    "action": FormField(
        "Stars beyond that",
        "choice",
        choices=(
            ("remove", "remove them"),
            ("merge", "merge them as the sensor does"),
            ("keep", "keep them"),
        ),
    ),
}

FAINTER_MAG = 2.0
"""Stars up to this much beyond the faint limit can form one guide star together."""

_SAME_SPOT = 0.5  # in widths of a spot: centroids that are as close cannot be distinguished

DEFAULT_OFFSET_PX = 0.1
"""Largest shift of a centroid if a spec states none: a fifth of the self-test's noise."""


class NeighbourRule(Section):
    """Stars whose light others in their window spoil; with psf_sigma_px, in place of doubles."""

    is_later = True
    later_keys = ("centroid", "box_px")

    psf_sigma_px: float | None = Field(
        None,
        ge=0.1,
        le=50.0,
        description="width of a star's spot before the pixels sample it, standard deviation; "
        "switches the rule on: it judges every star by all that were read and replaces the "
        "separation rule of [selection.doubles], whose flags stay",
        examples=[1.0],
    )
    window_px: float | None = Field(
        None,
        ge=0.1,
        le=100.0,
        description="width of the window of a centroid, standard deviation; default: that of the "
        "spot on the pixels, at least 1",
        examples=[1.04],
    )
    centroid: Literal["window", "box"] = Field(
        "window",
        description="how the sensor measures a star: in a Gaussian window that is moved until it "
        "is centred on the light, or as the centre of mass of the pixels in a box around the "
        "brightest pixel",
    )
    box_px: int | None = Field(
        None,
        ge=3,
        le=51,
        description='pixels on a side of the box, an odd number; with centroid = "box"',
        examples=[5],
    )
    max_offset_px: float | None = Field(
        None,
        ge=0.0,
        le=50.0,
        description="largest shift of the centroid by other stars; default: 0.1, where "
        "max_offset_arcsec is not given",
        examples=[0.1],
    )
    max_offset_arcsec: float | None = Field(
        None,
        ge=0.0,
        le=36_000.0,
        description="the same as an angle; with both, both apply",
        examples=[5.0],
    )
    max_contamination: float = Field(
        0.1, ge=0.0, le=1.0, description="largest share of other stars in the light of the centroid"
    )
    action: Literal["remove", "merge", "keep"] = Field(
        "remove",
        description="remove stars beyond these limits, give them position and magnitude of the "
        "blend as the sensor sees it, or keep them as they are",
    )

    @model_validator(mode="after")
    def _switched_on(self) -> NeighbourRule:
        fields = type(self).model_fields.items()
        if not self.is_on and any(getattr(self, name) != key.default for name, key in fields):
            raise ValueError(
                "psf_sigma_px is missing: blends cannot be computed without it; state "
                "it, such as psf_sigma_px = 1.0, or leave the section out"
            )
        if (self.centroid == "box") != (self.box_px is not None):
            raise ValueError(
                f'centroid is "{self.centroid}" and box_px is {self.box_px}; state both centroid = '
                '"box" and the size of the box, such as box_px = 5, or neither'
            )
        if self.box_px is not None and (self.box_px % 2 == 0 or self.window_px is not None):
            raise ValueError(
                f"box_px is {self.box_px} and window_px is {self.window_px}; a box has an odd "
                "number of pixels on a side, around the brightest one, and no window"
            )
        return self

    @property
    def is_on(self) -> bool:
        """Whether the spec asks for the rule."""
        return self.psf_sigma_px is not None

    def is_beyond(self, moved_arcsec: Array, contamination: Array, pixel_arcsec: float) -> Mask:
        """Return which stars are beyond the limits of the rule."""
        is_moved = moved_arcsec > self.max_offset_of(pixel_arcsec)
        return np.asarray(is_moved | (contamination > self.max_contamination))

    def max_offset_of(self, pixel_arcsec: float) -> float:
        """Return the largest allowed shift of a centroid, arcsec."""
        pixels, angle = self.max_offset_px, self.max_offset_arcsec
        if pixels is None:
            pixels = DEFAULT_OFFSET_PX if angle is None else math.inf
        return min(pixels * pixel_arcsec, math.inf if angle is None else angle)


TABLE, KEYS = "neighbours", NeighbourRule


@dataclass(frozen=True)
class NeighbourTally:
    """Differences between [selection.neighbours] and the separation rule of the same spec."""

    regained: int  # stars that it keeps, and the separation rule would leave out
    lost: int  # the other way round
    absorbed: int  # stars whose light is in a merged star's


def check(selection: Any) -> None:
    """Check that only one rule handles close stars."""
    doubles = selection.doubles
    if selection.neighbours.is_on and doubles.action == "merge":
        raise ValueError(
            'doubles.action = "merge" and [selection.neighbours] both handle close stars; '
            'leave out the first, and set neighbours.action = "merge" to merge them as the '
            "sensor does"
        )
    if selection.neighbours.is_on and doubles.companion_limit_mag is not None:
        raise ValueError(
            f"doubles.companion_limit_mag {doubles.companion_limit_mag:g} is of the separation "
            "rule, which [selection.neighbours] replaces: it counts all stars that were read. "
            "Leave it out, or set catalog.read_limit_mag"
        )


def combine(context: Context, keys: NeighbourRule) -> None:
    """Fill in the columns about blends; with "merge", give blended stars what the sensor sees."""
    if not keys.is_on:
        return
    if context.pixel_arcsec is None:
        raise ValueError("pixel_arcsec is None; [selection.neighbours] needs the camera's")
    limit_mag = context.selection.faint_limit_mag
    context.stars, absorbed = _judged(context.stars, keys, limit_mag, context.pixel_arcsec)
    context.verdicts.reject(absorbed, MERGED)


def reject(context: Context, keys: NeighbourRule) -> list[Rejection]:
    """Reject stars that neighbours disturb beyond the limits, except merged stars."""
    if not keys.is_on:
        return []
    stars = context.stars
    is_blended = np.zeros(len(stars), dtype=bool)
    if keys.action != "keep":
        moved_arcsec, contamination = (
            floats_of(stars, name) for name in ("centroid_offset_arcsec", "contamination")
        )
        is_blended = keys.is_beyond(moved_arcsec, contamination, context.pixel_arcsec or 0.0)
    if keys.action == "merge":
        is_blended &= (stars["quality_flags"].to_numpy() & int(Quality.MERGED)) == 0
    context.tallies[TABLE] = _tally(context, context.verdicts.is_kept & ~is_blended)
    return [Rejection(is_blended, BLENDED)]


def _tally(context: Context, kept: Mask) -> NeighbourTally:
    catalog, selection = context.catalog, context.selection
    plain, mag = has_companion(catalog, selection), floats_of(catalog, "mag")
    with np.errstate(invalid="ignore"):
        in_limits = (mag >= selection.bright_limit_mag) & (mag <= selection.faint_limit_mag)
    masks = (kept & plain, in_limits & ~plain & ~kept, context.verdicts.has(MERGED))
    return NeighbourTally(*(int(np.count_nonzero(mask)) for mask in masks))


@dataclass(frozen=True)
class _Sky:
    directions: Directions
    mag: Array  # NaN if not known
    number: NDArray[np.int64]
    widths: Widths  # radians


@dataclass(frozen=True)
class SeenStars:
    """Some stars of a table as the sensor sees them among all others."""

    sky: _Sky
    rows: Rows  # the stars, shape (N,)
    pairs: tuple[Rows, Rows]  # places in ``rows``, and the rows of the neighbours of these stars
    blends: Blends  # blends of the N stars; offsets east and north, radians

    @property
    def moved_arcsec(self) -> Array:
        """How far neighbours move each centroid, shape (N,)."""
        return np.asarray(np.hypot(*self.blends.offset.T) / ARCSEC)

    @property
    def mag(self) -> Array:
        """Magnitudes of all light in the window of each star, shape (N,)."""
        return np.asarray(self.sky.mag[self.rows] - 2.5 * np.log10(self.blends.brightening))


def seen_by_sensor(
    stars: pa.Table, rows: Rows, rule: NeighbourRule, pixel_arcsec: float
) -> SeenStars:
    """Return the effect of neighbours on stars of a table, which has x, y, z, mag and star_id."""
    widths = widths_px(rule.psf_sigma_px or 0.0, rule.window_px, rule.box_px)
    mag, number = floats_of(stars, "mag"), stars["star_id"].to_numpy()
    sky = _Sky(directions_of(stars), mag, number, widths.times(pixel_arcsec * ARCSEC))
    pairs = _neighbours(sky, rows)
    return SeenStars(sky, rows, pairs, _seen(sky, rows, pairs))


def _judged(
    stars: pa.Table, rule: NeighbourRule, limit_mag: float, pixel_arcsec: float
) -> tuple[pa.Table, Mask]:
    """Return a star table with what neighbours do to its stars, and which of them are absorbed."""
    mag = floats_of(stars, "mag")
    with np.errstate(invalid="ignore"):
        margin = FAINTER_MAG if rule.action == "merge" else 0.0
        rows = np.flatnonzero(mag <= limit_mag + margin)
    seen = seen_by_sensor(stars, rows, rule, pixel_arcsec)
    sky, moved_arcsec, blend_mag = seen.sky, seen.moved_arcsec, seen.mag
    columns = (blend_mag, seen.blends.contamination, moved_arcsec)
    names = ("blend_mag", "contamination", "centroid_offset_arcsec")
    filled = {name: np.full(len(stars), np.nan) for name in names}
    for name, values in zip(names, columns, strict=True):
        filled[name][rows] = values
    judged = with_columns(stars, filled)
    may_merge = np.zeros(len(stars), dtype=bool)
    if rule.action != "merge":
        return judged, may_merge
    may_merge[rows] = rule.is_beyond(moved_arcsec, seen.blends.contamination, pixel_arcsec)
    may_merge[rows] &= ~seen.blends.is_lost & (blend_mag <= limit_mag)
    heads, absorbed = _spots(sky, rows, seen.pairs, seen.blends, may_merge)
    positions = np.searchsorted(rows, heads)
    centre = _moved(sky.directions[heads], seen.blends.offset[positions])
    return with_merged(judged, heads, centre, blend_mag[positions]), absorbed


def _neighbours(sky: _Sky, rows: Rows) -> tuple[Rows, Rows]:
    """Return pairs of a place in ``rows`` and the row of a neighbour, in order."""
    pool = np.flatnonzero(~np.isnan(sky.mag))
    _check_pairs(len(rows), len(pool), sky.widths.reach)
    if not len(rows):
        return rows, rows
    trees = (scipy.spatial.cKDTree(sky.directions[some]) for some in (rows, pool))
    reach = chord_from_separation(sky.widths.reach)
    near = next(trees).sparse_distance_matrix(next(trees), reach, output_type="ndarray")
    index, other = near["i"].astype(np.int64), pool[near["j"]]
    is_other = rows[index] != other
    index, other = index[is_other], other[is_other]
    order = np.lexsort((other, index))
    return index[order], other[order]


def _check_pairs(stars: int, pool: int, reach_rad: float) -> None:
    """Check that the window is not so wide that it is full of stars."""
    pairs = 0.5 * stars * pool * (1.0 - np.cos(min(reach_rad, np.pi)))
    if pairs > MAX_PAIRS:
        raise BuildError(
            f"selection.neighbours: {stars:,} stars have about {pairs:,.0f} neighbours within "
            f"{np.degrees(reach_rad):.3g} deg, which the window reaches; at most {MAX_PAIRS:,} "
            "are looked at",
            hint="Check psf_sigma_px and the camera, or give a brighter faint_limit_mag or "
            "catalog.read_limit_mag",
        )


def _seen(sky: _Sky, rows: Rows, pairs: tuple[Rows, Rows]) -> Blends:
    """Return the blends of stars with their neighbours; offsets east and north, radians."""
    index, other = pairs
    directions, other_directions = sky.directions[rows], sky.directions[other]
    axes = tangent_axes(*radec_from_directions(directions))
    offset = [np.einsum("ij,ij->i", other_directions, axis[index]) for axis in axes]
    own_mag, mag = sky.mag[rows][index], sky.mag[other]
    light = 10.0 ** (0.4 * (own_mag - mag))
    is_first = sky.number[other] < sky.number[rows][index]
    is_brighter = (mag < own_mag) | ((mag == own_mag) & is_first)
    return blends(len(rows), index, np.stack(offset, axis=1), light, is_brighter, sky.widths)


def _moved(directions: Directions, offset: Array) -> Directions:
    axes = tangent_axes(*radec_from_directions(directions))
    moved = directions + sum(offset[:, [k]] * axis for k, axis in enumerate(axes))
    return np.asarray(moved / np.linalg.norm(moved, axis=1)[:, None])


def _spots(
    sky: _Sky, rows: Rows, pairs: tuple[Rows, Rows], seen: Blends, may_merge: Mask
) -> tuple[Rows, Mask]:
    """Return the rows of stars that represent their spot, and a mask of the stars they absorb.

    A spot holds the stars whose centroids are at the same place; the brightest represents it.
    """
    index, other = pairs
    faint = np.setdiff1d(other[may_merge[rows][index]], rows)
    more = _seen(sky, faint, _neighbours(sky, faint))
    every = np.concatenate([rows, faint])
    centroid = _moved(sky.directions[every], np.concatenate([seen.offset, more.offset]))
    same, _ = pairs_within(centroid, _SAME_SPOT * sky.widths.spot)
    spot = group_numbers(same, len(every))
    order = np.lexsort((sky.number[every], sky.mag[every], spot))
    _, first = np.unique(spot[order], return_index=True)
    head_of_spot = every[order[first]]
    head = head_of_spot[spot]
    absorbed = np.zeros(len(sky.mag), dtype=bool)
    absorbed[every[(head != every) & may_merge[head]]] = True
    return np.sort(head_of_spot[may_merge[head_of_spot]]), absorbed
