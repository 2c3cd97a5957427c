"""The product ``motions``: the origin of the proper motion of each guide star.

The pipeline makes it if a spec joins motions of other catalogs (`starcat.pipeline.supply`).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from starcat.catalog.stars.proper_motion import MAS
from starcat.catalog.stars.star_table import floats_of
from starcat.database.products.kind import ProductKind

JOINED, OWN_MOTION, NO_CANDIDATE, NO_MOTION = "joined", "own_motion", "no_candidate", "no_motion"

OUTCOMES = (JOINED, OWN_MOTION, NO_CANDIDATE, "ambiguous", "taken", "doubtful", NO_MOTION)
"""Outcomes for a star in the product ``motions``; the schema describes each of them."""

WAY_TOLERANCE_ARCSEC = 1e-6
"""The way between two directions and the way at a speed differ by less."""


def motion_problems(table: pa.Table, stars: pa.Table) -> Iterator[str]:
    """Yield where the product ``motions`` contradicts itself or the stars."""
    if not np.array_equal(table["star"].to_numpy(), np.arange(len(stars))):
        yield f"star: not the rows 0 to {len(stars) - 1} of the stars, each once"
        return
    unknown = set(pc.unique(table["outcome"]).to_pylist()) - set(OUTCOMES)
    if unknown:
        yield f"outcome {', '.join(sorted(unknown))}; expected one of {', '.join(OUTCOMES)}"
    pm = ("pm_ra_cosdec_mas_yr", "pm_dec_mas_yr")
    moves = ~(np.isnan(floats_of(stars, pm[0])) | np.isnan(floats_of(stars, pm[1])))
    named = pc.is_in(table["outcome"], pa.array([JOINED, OWN_MOTION])).to_numpy()
    for row in np.flatnonzero(moves != named)[:1]:
        has = "has a" if moves[row] else "has no"
        yield f"outcome of row {row} is {table['outcome'][int(row)]}, but the star {has} motion"
    joined = pc.equal(table["outcome"], JOINED).to_numpy()
    # A straight line at constant speed: after the angle a the motion is cos(a)^2 of the first.
    years = floats_of(stars, "epoch_jyear") - floats_of(table, "from_jyear")
    motion = np.hypot(floats_of(stars, pm[0]), floats_of(stars, pm[1])) * MAS
    way = np.degrees(0.5 * np.arcsin(np.minimum(2.0 * motion * np.abs(years), 1.0))) * 3600.0
    stated = floats_of(table, "moved_arcsec")
    right = np.where(joined, np.abs(way - stated) <= WAY_TOLERANCE_ARCSEC, np.isnan(stated))
    for row in np.flatnonzero(~right)[:1]:
        yield f"moved_arcsec of row {row} is not the way that its star has gone"


def joined_of(table: pa.Table, catalog: str) -> int:
    """Return how many stars have their motion from a catalog."""
    rows = pc.and_(pc.equal(table["outcome"], JOINED), pc.equal(table["catalog"], catalog))
    return int(pc.sum(rows).as_py() or 0)


KIND = ProductKind(
    name="motions",
    in_database=False,
    count=None,
    problems=motion_problems,
    joined=(joined_of, "have their motion from it"),
)
