"""Stars beyond the largest number of guide stars, the faintest first."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
from pydantic import Field

from starcat.arrays import Mask
from starcat.catalog.stars.star_table import floats_of
from starcat.pipeline.selection.rule import Context, FormField, Rejection, RuleReason
from starcat.sections import Section

STEP = "count"
BEYOND_COUNT = RuleReason(
    "beyond_count", "thinned to max_stars: fainter, or as selection.thinning says"
)
REASONS = (BEYOND_COUNT,)
FORM = {
    "max_stars_per_field": FormField(
        "Stars per field at most",
        "slide",
        "limits",
        low=4,
        high=80,
        step=1,
        none_at="high",
        placeholder="all",
        hint="thins the Milky Way, leaves the poles of the galaxy as they are",
    )
}


class StarCounts(Section):
    """How many stars are kept."""

    max_stars: int | None = Field(
        None,
        ge=1,
        le=2_000_000_000,
        description="number of stars that are kept, by default the brightest",
    )
    max_stars_per_field: int | None = Field(
        None,
        ge=1,
        le=10_000,
        description="thins to an even density: keeps the stars that are among this many brightest "
        "of any field of the tiling",
    )


KEYS = StarCounts


def reject(context: Context, keys: StarCounts) -> list[Rejection] | None:
    """Reject stars beyond the brightest; other ways of thinning need the tiling of the sphere."""
    if keys.max_stars is None or context.selection.thinning != "brightest":
        return None
    beyond = _beyond_brightest(context.stars, context.verdicts.is_kept, keys.max_stars)
    return [Rejection(beyond, BEYOND_COUNT)]


def _beyond_brightest(stars: pa.Table, kept: Mask, count: int) -> Mask:
    """Return which stars are not among the brightest."""
    rows = np.flatnonzero(kept)
    order = np.lexsort((stars["star_id"].to_numpy()[rows], floats_of(stars, "mag")[rows]))
    beyond = np.zeros(len(stars), dtype=bool)
    beyond[rows[order[count:]]] = True
    return beyond
