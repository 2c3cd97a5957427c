"""Stars that an archive, or a joined source, flags as doubles."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from starcat.arrays import Mask
from starcat.catalog.stars.star_table import floats_of
from starcat.pipeline.selection.rule import Context, Rejection, RuleReason
from starcat.pipeline.selection.rules.doubles import Doubles

STEP = "doubles"
COLUMNS = {"flags": ("is_flagged_double",)}
TABLE, KEYS = "doubles", Doubles
FLAGGED_DOUBLE = RuleReason("flagged_double", "the archive flags an unresolved double")
REASONS = (FLAGGED_DOUBLE,)


def reject(context: Context, keys: Doubles) -> list[Rejection]:
    """Reject stars whose flags mean a double that the sensor does not resolve."""
    return [Rejection(is_unresolved_double(context.stars, keys), FLAGGED_DOUBLE)]


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
    delta[np.isnan(delta) & _is_joined(stars, doubles)] = 0.0
    close = np.isnan(apart) | (apart <= doubles.min_separation_deg)
    if doubles.max_delta_mag is None:
        return np.asarray(flagged & close & ~np.isnan(delta))
    return np.asarray(flagged & close & (delta <= doubles.max_delta_mag))


def _is_joined(stars: pa.Table, doubles: Doubles) -> Mask:
    """Return which stars a joined source lists as close doubles."""
    is_listed = np.zeros(len(stars), dtype=bool)
    for source in doubles.join:
        named = pc.match_substring(stars["double_flag"], f"{source}:")
        is_listed |= pc.fill_null(named, False).to_numpy()
    return is_listed
