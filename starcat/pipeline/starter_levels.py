"""A first spec for a range of fields of view: its narrow end, and levels for the others."""

from __future__ import annotations

from dataclasses import replace

from starcat.pipeline.starter import Starter
from starcat.specs.reading import spec_from_dict

STARS_PER_FIELD = 20
"""Stars that each level keeps of a field, the narrowest one too: a frame is up to twice as large as
the fields of its level, and has up to forty of them."""

ENOUGH_STARS = 12
"""Stars of the emptiest hundredth of the narrowest fields, where the sky has them."""

KEPT = ("triangles", "levels")
"""Products that find a focal length; the others serve one field of view."""


def with_levels(starter: Starter, widest_fov_x_deg: float, *, keep_limit: bool) -> Starter:
    """Return a first spec that serves wider fields than the camera's too.

    Parameters
    ----------
    starter : Starter
        The spec of the narrow end of the range.
    widest_fov_x_deg : float
        Full angle across the width of the widest frames, degrees.
    keep_limit : bool
        Whether the magnitude limit stays; else it is the first of the starter's that leaves
        `ENOUGH_STARS`. Thinning makes a fainter one cost little.

    Returns
    -------
    Starter
        The same tiling, thinned, with the products `KEPT` alone.

    Raises
    ------
    ConfigError
        If the range is none.
    """
    content = starter.spec.model_dump(mode="json")
    own_deg = starter.spec.camera.camera().fov_x_deg
    content["description"] = (
        f"Guide stars for fields of {own_deg:.4g} to {widest_fov_x_deg:.4g} deg across the width"
    )
    content["selection"]["max_stars_per_field"] = STARS_PER_FIELD
    if not keep_limit:
        enough = (row for row in starter.limits if row.stars.one_percent >= ENOUGH_STARS)
        limit = next(enough, starter.limits[-1]).faint_limit_mag
        content["selection"]["faint_limit_mag"] = limit
    for name, product in content["products"].items():
        product["enabled"] = name in KEPT
    content["products"]["levels"]["widest_fov_x_deg"] = widest_fov_x_deg
    return replace(starter, spec=spec_from_dict(content, "--fov-range"))
