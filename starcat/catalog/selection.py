"""Selection: which stars of a table become guide stars, and why the others do not.

Filters are tried in a fixed order (magnitude, doubles, variables, distrust, count, density) and the
first that applies is the verdict. Doubles are judged by separation and magnitude difference at the
sensor's resolution, or by what neighbours do to their centroids (`blended.py`), and variables by
amplitude; a bare flag of an archive is only one input.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import scipy
from numpy.typing import NDArray

from starcat.arrays import Array, Mask
from starcat.catalog.blended import Judged, judge_neighbours
from starcat.catalog.doubles import is_joined
from starcat.catalog.observed import is_distrusted
from starcat.catalog.photometry import combined_magnitude
from starcat.errors import BuildError
from starcat.geometry.proximity import pairs_within
from starcat.geometry.sphere import radec_from_directions
from starcat.specs.build_spec import Selection
from starcat.specs.doubtful_stars import Doubles, Variables
from starcat.stars.star_table import (
    directions_of,
    floats_of,
    sort_rows,
    split_by_verdict,
    with_columns,
)
from starcat.stars.verdict import Quality, Reason, Verdicts
from starcat.storage.schema import product_schema

_STEPS = {Reason.beyond_count: "count", Reason.density: "density"}

MOST_PAIRS = 10_000_000
"""Close pairs that are looked at; they take half a gigabyte, and no camera has a tenth of them."""


@dataclass(frozen=True)
class Step:
    """The stars that are left after one filter."""

    name: str  # what was filtered
    directions: Array  # ICRS, shape (N, 3)


@dataclass(frozen=True)
class NeighbourTally:
    """What [selection.neighbours] decided otherwise than the separation rule of the same spec."""

    regained: int  # stars that it keeps, and the separation rule would leave out
    lost: int  # the other way round
    absorbed: int  # stars whose light is in a merged star's


@dataclass(frozen=True)
class Selected:
    """Guide stars, and every other star with its reason."""

    guide_stars: pa.Table  # of the stars schema, by star_id
    rejected: pa.Table  # of the rejected schema, by star_id
    steps: tuple[Step, ...]  # what was left after each filter, in order
    neighbours: NeighbourTally | None = None  # where the spec has [selection.neighbours]


def select_guide_stars(
    stars: pa.Table, selection: Selection, pixel_arcsec: float | None = None
) -> Selected:
    """Select guide stars from a star table.

    ``pixel_arcsec`` is the side of a pixel at the camera's axis, for [selection.neighbours].
    """
    verdicts = Verdicts(len(stars))
    steps: list[Step] = []

    def note(name: str) -> None:
        steps.append(Step(name, directions_of(stars)[verdicts.is_kept]))

    verdicts.reject(np.isnan(floats_of(stars, "mag")), Reason.no_magnitude)
    catalog, judged, tally = stars, None, None
    if selection.neighbours.is_on:
        if pixel_arcsec is None:
            raise ValueError("pixel_arcsec is None; [selection.neighbours] needs the camera's")
        judged = judge_neighbours(stars, selection, pixel_arcsec)
        stars = judged.stars
        verdicts.reject(judged.is_absorbed, Reason.merged)
    elif selection.doubles.action == "merge":
        stars = merge_doubles(stars, selection, verdicts)
    mag = floats_of(stars, "mag")
    with np.errstate(invalid="ignore"):
        verdicts.reject(mag < selection.bright_limit_mag, Reason.too_bright)
        verdicts.reject(mag > selection.faint_limit_mag, Reason.too_faint)
    note("magnitude")
    if judged is not None:
        if selection.neighbours.action != "keep":
            verdicts.reject(judged.is_blended, Reason.blended)
        tally = _tally(catalog, selection, judged, verdicts.is_kept)
    elif selection.doubles.action == "remove":
        verdicts.reject(has_companion(stars, selection), Reason.double)
    is_flagged = is_unresolved_double(stars, selection.doubles)
    verdicts.reject(is_flagged, Reason.flagged_double)
    note("doubles")
    reject_variables(stars, selection.variables, verdicts)
    note("variables")
    if selection.max_drift_arcsec is not None:
        with np.errstate(invalid="ignore"):
            too_far = floats_of(stars, "drift_arcsec") > selection.max_drift_arcsec
        verdicts.reject(too_far, Reason.drifts)
        note("drift")
    if selection.observed.reject:
        verdicts.reject(is_distrusted(stars, selection.observed), Reason.distrusted)
        note("distrust")
    if selection.max_stars is not None and selection.thinning == "brightest":
        verdicts.reject(
            beyond_brightest(stars, verdicts.is_kept, selection.max_stars), Reason.beyond_count
        )
        note("count")
    kept, rejected = split_by_verdict(stars, verdicts)
    return Selected(kept.combine_chunks(), rejected, tuple(steps), tally)


def _tally(catalog: pa.Table, selection: Selection, judged: Judged, kept: Mask) -> NeighbourTally:
    plain, mag = has_companion(catalog, selection), floats_of(catalog, "mag")
    with np.errstate(invalid="ignore"):
        in_limits = (mag >= selection.bright_limit_mag) & (mag <= selection.faint_limit_mag)
    masks = (kept & plain, in_limits & ~plain & ~kept, judged.is_absorbed)
    return NeighbourTally(*(int(np.count_nonzero(mask)) for mask in masks))


def _companion_pairs(stars: pa.Table, selection: Selection) -> tuple[NDArray[np.int64], Array]:
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
    """Check that stars are not so many, or so far apart, that nearly all of them are doubles."""
    pairs = 0.25 * stars**2 * (1.0 - np.cos(np.radians(separation_deg)))
    if pairs > MOST_PAIRS:
        raise BuildError(
            f"selection.doubles.min_separation_deg = {separation_deg:g} makes about {pairs:,.0f} "
            f"doubles of {stars:,} stars, at most {MOST_PAIRS:,} are looked at; give the few "
            "pixels that the camera cannot tell apart, or a brighter faint_limit_mag"
        )


def has_companion(stars: pa.Table, selection: Selection) -> Mask:
    """Return which stars have a companion that the sensor cannot tell apart.

    It lies within ``min_separation_deg`` and is not fainter by more than ``max_delta_mag``.
    """
    pairs, mag = _companion_pairs(stars, selection)
    most = selection.doubles.max_delta_mag
    found = np.zeros(len(stars), dtype=bool)
    for star, companion in ((0, 1), (1, 0)):
        delta = mag[pairs[:, companion]] - mag[pairs[:, star]]
        counts = np.ones(len(pairs), dtype=bool) if most is None else delta <= most
        found[pairs[counts, star]] = True
    return found


def merge_doubles(stars: pa.Table, selection: Selection, verdicts: Verdicts) -> pa.Table:
    """Merge groups of close stars into one star each, at their photocentre.

    The rows stay; the brightest of each group, a chain of pairs as `has_companion` finds them,
    has the combined magnitude and direction, the others are rejected.
    """
    pairs, mag = _companion_pairs(stars, selection)
    if selection.doubles.max_delta_mag is not None:
        delta = np.abs(mag[pairs[:, 0]] - mag[pairs[:, 1]])
        pairs = pairs[delta <= selection.doubles.max_delta_mag]
    if not len(pairs):
        return stars
    number = stars["star_id"].to_numpy()
    directions, flags = directions_of(stars), stars["quality_flags"].to_numpy().copy()
    absorbed = np.zeros(len(stars), dtype=bool)
    for members in _groups(pairs, len(stars)):
        ranked = members[np.lexsort((number[members], mag[members]))]
        flux = 10.0 ** (-0.4 * (mag[members] - mag[ranked[0]]))
        centre = flux @ directions[members]
        total = combined_magnitude(mag[members])
        directions[ranked[0]] = centre / np.sqrt(centre @ centre)
        mag[ranked[0]] = total
        flags[ranked[0]] |= int(Quality.MERGED | Quality.PHOTOCENTRE)
        absorbed[ranked[1:]] = True
    verdicts.reject(absorbed, Reason.merged)
    return _with_photocentres(stars, directions, mag, flags)


def _groups(pairs: NDArray[np.int64], count: int) -> list[NDArray[np.int64]]:
    graph = scipy.sparse.coo_array(
        (np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count)
    )
    _, label = scipy.sparse.csgraph.connected_components(graph, directed=False)
    rows = np.unique(pairs)
    order = np.argsort(label[rows], kind="stable")
    cuts = np.flatnonzero(np.diff(label[rows][order])) + 1
    return sorted(np.split(rows[order], cuts), key=lambda members: int(members[0]))


def _with_photocentres(
    stars: pa.Table, directions: Array, mag: Array, flags: NDArray[np.int32]
) -> pa.Table:
    merged = (flags & int(Quality.MERGED)) > 0
    ra, dec = radec_from_directions(directions)
    columns = {
        "ra_deg": np.where(merged, ra, stars["ra_deg"].to_numpy()),
        "dec_deg": np.where(merged, dec, stars["dec_deg"].to_numpy()),
        "x": directions[:, 0],
        "y": directions[:, 1],
        "z": directions[:, 2],
        "mag": mag,
        "quality_flags": flags,
    }
    return with_columns(stars, columns)


def is_unresolved_double(stars: pa.Table, doubles: Doubles) -> Mask:
    """Return which stars an archive's flags say to leave out as doubles.

    With ``unresolved``: flagged, with a separation below the limit or not stated, and a stated
    magnitude difference within ``max_delta_mag``. That of a joined pair need not be stated.
    """
    flagged = np.array(stars["is_flagged_double"])
    if doubles.flags == "ignore" or doubles.action == "keep":
        return np.zeros(len(stars), dtype=bool)
    if doubles.flags == "strict":
        return flagged
    apart = floats_of(stars, "companion_separation_arcsec") / 3600.0
    delta = floats_of(stars, "companion_delta_mag")
    # A joined pair without magnitudes may be of two equal stars.
    delta[np.isnan(delta) & is_joined(stars, doubles)] = 0.0
    close = np.isnan(apart) | (apart <= doubles.min_separation_deg)
    if doubles.max_delta_mag is None:
        return np.asarray(flagged & close & ~np.isnan(delta))
    return np.asarray(flagged & close & (delta <= doubles.max_delta_mag))


def reject_variables(stars: pa.Table, variables: Variables, verdicts: Verdicts) -> None:
    """Reject the stars whose brightness cannot be relied on."""
    amplitude = floats_of(stars, "amplitude_mag")
    if variables.max_amplitude_mag is not None:
        verdicts.reject(amplitude > variables.max_amplitude_mag, Reason.variable)
    flagged = np.array(stars["is_flagged_variable"])
    if variables.flags == "strict":
        verdicts.reject(flagged, Reason.flagged_variable)
    elif variables.flags == "known":
        verdicts.reject(flagged & np.isnan(amplitude), Reason.flagged_variable)


def beyond_brightest(stars: pa.Table, kept: Mask, count: int) -> Mask:
    """Return which stars are not among the brightest."""
    rows = np.flatnonzero(kept)
    order = np.lexsort((stars["star_id"].to_numpy()[rows], floats_of(stars, "mag")[rows]))
    beyond = np.zeros(len(stars), dtype=bool)
    beyond[rows[order[count:]]] = True
    return beyond


def reject_dense(
    selected: Selected, kept: NDArray[np.integer], reason: Reason = Reason.density
) -> Selected:
    """Thin the guide stars to those that a tiling asks for, by row."""
    verdicts = Verdicts(len(selected.guide_stars))
    verdicts.reject(~np.isin(np.arange(len(selected.guide_stars)), kept), reason)
    stars, dense = split_by_verdict(selected.guide_stars, verdicts)
    rejected = pa.concat_tables([selected.rejected, dense]).combine_chunks()
    return Selected(
        stars.combine_chunks(),
        sort_rows(rejected, product_schema("rejected").order),
        (*selected.steps, Step(_STEPS[reason], directions_of(stars))),
        selected.neighbours,
    )
