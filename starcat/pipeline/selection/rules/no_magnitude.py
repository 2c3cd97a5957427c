"""Stars without a magnitude in the band of the build."""

from __future__ import annotations

import numpy as np

from starcat.catalog.stars.star_table import floats_of
from starcat.pipeline.selection.rule import Context, Rejection, RuleReason

STEP = "magnitude"
NO_MAGNITUDE = RuleReason("no_magnitude", "no magnitude in the band of the build")
REASONS = (NO_MAGNITUDE,)


def reject(context: Context, _: object) -> list[Rejection]:
    """Reject stars without a magnitude."""
    return [Rejection(np.isnan(floats_of(context.stars, "mag")), NO_MAGNITUDE)]
