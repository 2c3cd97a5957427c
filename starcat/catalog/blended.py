"""Blended stars of a star table: what their neighbours do to them, and what becomes of them.

Every star that may become a guide star is judged by all stars of the table with a magnitude,
however faint, as `starcat.products.blends` says a centroid sees them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import scipy
from numpy.typing import NDArray

from starcat.arrays import Array, Directions, Mask, Rows
from starcat.errors import BuildError
from starcat.geometry.proximity import pairs_within
from starcat.geometry.sphere import chord_from_separation, radec_from_directions, tangent_axes
from starcat.products.blends import Blends, Widths, blends, widths_px
from starcat.products.match_figures import ARCSEC
from starcat.specs.build_spec import Selection
from starcat.stars.star_table import directions_of, floats_of, with_columns
from starcat.stars.verdict import Quality

MOST_PAIRS = 10_000_000
"""Pairs of a star and a neighbour that are looked at; they take a gigabyte."""

FAINTER_MAG = 2.0
"""Stars up to so much beyond the faint limit may be one guide star together."""

_SAME_SPOT = 0.5  # of a spot's width: nothing tells apart centroids that are as close


@dataclass(frozen=True)
class Judged:
    """A star table with what neighbours do to its stars."""

    # the columns about blends are filled in; with "merge" blended stars are as the sensor sees them
    stars: pa.Table
    is_blended: Mask  # beyond the limits of the rule, and left as they were
    is_absorbed: Mask  # part of another star's spot, which has their light


@dataclass(frozen=True)
class _Sky:
    directions: Directions
    mag: Array  # NaN where it is not known
    number: NDArray[np.int64]
    widths: Widths  # radians


def judge_neighbours(stars: pa.Table, selection: Selection, pixel_arcsec: float) -> Judged:
    """Judge the stars of a table by their neighbours; with "merge", blend them."""
    rule = selection.neighbours
    widths = widths_px(rule.psf_sigma_px or 0.0, rule.window_px, rule.box_px)
    widths = widths.times(pixel_arcsec * ARCSEC)
    mag, number = floats_of(stars, "mag"), stars["star_id"].to_numpy()
    sky = _Sky(directions_of(stars), mag, number, widths)
    with np.errstate(invalid="ignore"):
        margin = FAINTER_MAG if rule.action == "merge" else 0.0
        rows = np.flatnonzero(mag <= selection.faint_limit_mag + margin)
    pairs = _neighbours(sky, rows)
    seen = _seen(sky, rows, pairs)
    moved_arcsec = np.hypot(*seen.offset.T) / ARCSEC
    is_beyond = moved_arcsec > rule.max_offset_of(pixel_arcsec)
    is_beyond |= seen.contamination > rule.max_contamination
    blend_mag = mag[rows] - 2.5 * np.log10(seen.brightening)
    columns = (blend_mag, seen.contamination, moved_arcsec)
    names = ("blend_mag", "contamination", "centroid_offset_arcsec")
    filled = {name: np.full(len(stars), np.nan) for name in names}
    for name, values in zip(names, columns, strict=True):
        filled[name][rows] = values
    judged = with_columns(stars, filled)
    is_blended, absorbed = np.zeros((2, len(stars)), dtype=bool)
    is_blended[rows] = is_beyond
    if rule.action != "merge":
        return Judged(judged, is_blended, absorbed)
    may_merge = is_blended.copy()
    may_merge[rows] &= ~seen.is_lost & (blend_mag <= selection.faint_limit_mag)
    heads, absorbed = _spots(sky, rows, pairs, seen, may_merge)
    place = np.searchsorted(rows, heads)
    centre = _moved(sky.directions[heads], seen.offset[place])
    is_blended[heads] = False
    merged = _as_seen(judged, heads, centre, blend_mag[place])
    return Judged(merged, is_blended & ~absorbed, absorbed)


def _neighbours(sky: _Sky, rows: Rows) -> tuple[Rows, Rows]:
    """Return pairs of a place in ``rows`` and the row of a neighbour, in order."""
    pool = np.flatnonzero(~np.isnan(sky.mag))
    _check_pairs(len(rows), len(pool), sky.widths.reach)
    if not len(rows):
        return rows, rows
    trees = (scipy.spatial.cKDTree(sky.directions[some]) for some in (rows, pool))
    reach = chord_from_separation(sky.widths.reach)
    near = next(trees).sparse_distance_matrix(next(trees), reach, output_type="ndarray")
    place, other = near["i"].astype(np.int64), pool[near["j"]]
    is_other = rows[place] != other
    place, other = place[is_other], other[is_other]
    order = np.lexsort((other, place))
    return place[order], other[order]


def _check_pairs(stars: int, pool: int, reach_rad: float) -> None:
    """Check that the window is not so wide that it is full of stars."""
    pairs = 0.5 * stars * pool * (1.0 - np.cos(min(reach_rad, np.pi)))
    if pairs > MOST_PAIRS:
        raise BuildError(
            f"selection.neighbours: {stars:,} stars have about {pairs:,.0f} neighbours within "
            f"{np.degrees(reach_rad):.3g} deg, which the window reaches; at most {MOST_PAIRS:,} "
            "are looked at. Check psf_sigma_px and the camera, or give a brighter faint_limit_mag "
            "or catalog.read_limit_mag"
        )


def _seen(sky: _Sky, rows: Rows, pairs: tuple[Rows, Rows]) -> Blends:
    """Return the blends of stars with their neighbours; offsets east and north, radians."""
    place, other = pairs
    own, theirs = sky.directions[rows], sky.directions[other]
    axes = tangent_axes(*radec_from_directions(own))
    offset = [np.einsum("ij,ij->i", theirs, axis[place]) for axis in axes]
    own_mag, mag = sky.mag[rows][place], sky.mag[other]
    light = 10.0 ** (0.4 * (own_mag - mag))
    is_first = sky.number[other] < sky.number[rows][place]
    is_brighter = (mag < own_mag) | ((mag == own_mag) & is_first)
    return blends(len(rows), place, np.stack(offset, axis=1), light, is_brighter, sky.widths)


def _moved(directions: Directions, offset: Array) -> Directions:
    axes = tangent_axes(*radec_from_directions(directions))
    moved = directions + sum(offset[:, [k]] * axis for k, axis in enumerate(axes))
    return np.asarray(moved / np.linalg.norm(moved, axis=1)[:, None])


def _spots(
    sky: _Sky, rows: Rows, pairs: tuple[Rows, Rows], seen: Blends, may_merge: Mask
) -> tuple[Rows, Mask]:
    """Return the rows of stars that become the star of their spot, and who is absorbed by them.

    A spot is of the stars whose centroids are at one place, and has the name of the brightest.
    """
    place, other = pairs
    faint = np.setdiff1d(other[may_merge[rows][place]], rows)
    more = _seen(sky, faint, _neighbours(sky, faint))
    every = np.concatenate([rows, faint])
    centroid = _moved(sky.directions[every], np.concatenate([seen.offset, more.offset]))
    same, _ = pairs_within(centroid, _SAME_SPOT * sky.widths.spot)
    graph = scipy.sparse.coo_array(
        (np.ones(len(same)), (same[:, 0], same[:, 1])), shape=(len(every),) * 2
    )
    _, spot = scipy.sparse.csgraph.connected_components(graph, directed=False)
    order = np.lexsort((sky.number[every], sky.mag[every], spot))
    _, first = np.unique(spot[order], return_index=True)
    head_of_spot = every[order[first]]
    head = head_of_spot[spot]
    absorbed = np.zeros(len(sky.mag), dtype=bool)
    absorbed[every[(head != every) & may_merge[head]]] = True
    return np.sort(head_of_spot[may_merge[head_of_spot]]), absorbed


def _as_seen(stars: pa.Table, rows: Rows, directions: Directions, mag: Array) -> pa.Table:
    """Return a star table with stars at other places and of other brightness."""
    ra_deg, dec_deg = radec_from_directions(directions)
    x, y, z = directions.T
    values = {"ra_deg": ra_deg, "dec_deg": dec_deg, "x": x, "y": y, "z": z, "mag": mag}
    columns: dict[str, NDArray[np.float64] | NDArray[np.int32]] = {}
    for name, changed in values.items():
        columns[name] = floats_of(stars, name)
        columns[name][rows] = changed
    flags = stars["quality_flags"].to_numpy().copy()
    flags[rows] |= int(Quality.MERGED | Quality.PHOTOCENTRE)
    return with_columns(stars, {**columns, "quality_flags": flags})
