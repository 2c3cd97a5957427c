"""Stars outside a region of the sky: a cone, a zone of declination, or a MOC."""

from __future__ import annotations

from starcat.catalog.stars.region import Region
from starcat.catalog.stars.star_table import directions_of, floats_of
from starcat.pipeline.selection.rule import Context, FormField, Rejection, RuleReason

STEP = "region"
OUTSIDE = RuleReason("outside_region", "outside the region of [selection.region]")
REASONS = (OUTSIDE,)
FORM = {
    "cone": FormField(
        "Cone",
        "text",
        "limits",
        "right ascension, declination and radius, degrees",
        "266.4, -29, 20",
    ),
    "zone": FormField("Zone of declination", "text", "limits", "from and to, degrees", "-30, 30"),
    "moc": FormField("MOC in ASCII", "text", "limits", "orders and HEALPix cells", "0/0-3"),
}
TABLE, KEYS = "region", Region


def reject(context: Context, keys: Region) -> list[Rejection] | None:
    """Reject the stars outside the region."""
    if keys == Region():
        return None
    directions = directions_of(context.stars)
    ra_deg, dec_deg = (floats_of(context.stars, name) for name in ("ra_deg", "dec_deg"))
    return [Rejection(~keys.contains(directions, ra_deg, dec_deg), OUTSIDE)]
