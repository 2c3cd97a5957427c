"""The guide stars of a build: selected, thinned to the tiling where asked, and counted.

Selection knows nothing of fields; what a spec asks of a field is looked after here.
"""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from starcat.catalog.ingest import count_by_reason
from starcat.catalog.selection import Selected, reject_dense, select_guide_stars
from starcat.errors import BuildError
from starcat.geometry.sphere import radec_from_directions
from starcat.pipeline.recipes import tile_guide_stars
from starcat.products.boresights import FieldStars
from starcat.specs.build_spec import BuildSpec

MIN_GUIDE_STARS = 4
"""Fewer than these cannot be identified by anything."""


def select_stars(stars: pa.Table, spec: BuildSpec) -> tuple[Selected, FieldStars]:
    """Select guide stars, thin them if the spec says so, and tile the sphere.

    Parameters
    ----------
    stars : pyarrow.Table
        Star table (schema ``stars``), amplitudes joined.
    spec : BuildSpec
        Limits, rules and the tiling.

    Returns
    -------
    selected : Selected
        Guide stars, and the others with their reasons.
    fields : FieldStars
        The tiling of the guide stars.

    Raises
    ------
    BuildError
        If too few stars are left, in all or in a field.
    """
    selected = select_guide_stars(stars, spec.selection)
    check_guide_stars(selected, spec)
    fields = tile_guide_stars(selected.guide_stars, spec)
    if spec.selection.max_stars_per_field is not None:
        _, brightest = fields.brightest(spec.selection.max_stars_per_field)
        selected = reject_dense(selected, brightest)
        check_guide_stars(selected, spec)
        fields = tile_guide_stars(selected.guide_stars, spec)
    check_fields(fields, spec)
    return selected, fields


def check_guide_stars(selected: Selected, spec: BuildSpec) -> None:
    """Check that the selection left stars to build from.

    Parameters
    ----------
    selected : Selected
        The selection.
    spec : BuildSpec
        For the message.

    Raises
    ------
    BuildError
        If fewer than 4 stars are left, with the reasons of the others.
    """
    left = len(selected.guide_stars)
    if left < MIN_GUIDE_STARS:
        counts = count_by_reason(selected.rejected)
        limits = "[selection]"
        if spec.catalog.read_limit_mag is not None:
            limits += f" and read_limit_mag {spec.catalog.read_limit_mag:g}"
        reasons = ", ".join(f"{name} {count}" for name, count in counts.items()) or "none read"
        raise BuildError(
            f"{spec.name}: {left} guide stars left of {len(selected.rejected) + left}; at least "
            f"{MIN_GUIDE_STARS} are needed. Rejected: {reasons}. Check the limits of {limits}"
        )


def check_fields(fields: FieldStars, spec: BuildSpec) -> None:
    """Check that every field has the guide stars that the spec asks for.

    Parameters
    ----------
    fields : FieldStars
        The tiling.
    spec : BuildSpec
        ``boresights.min_stars_per_field``.

    Raises
    ------
    BuildError
        Naming the fields that fall short, the worst first.
    """
    wanted, count = spec.boresights.min_stars_per_field, fields.count
    if wanted is None or count.min() >= wanted:
        return
    short = np.flatnonzero(count < wanted)
    worst = short[np.argsort(count[short], kind="stable")][:5]
    ra_deg, dec_deg = radec_from_directions(fields.boresights[worst])
    named = ", ".join(
        f"boresight {tile} (RA {ra:.2f}, Dec {dec:+.2f} deg): {count[tile]}"
        for tile, ra, dec in zip(worst.tolist(), ra_deg, dec_deg, strict=True)
    )
    raise BuildError(
        f"{spec.name}: {len(short)} of {len(count)} fields have fewer than {wanted} guide stars "
        f"(boresights.min_stars_per_field): {named}{', ...' if len(short) > 5 else ''}. A fainter "
        "faint_limit_mag or a wider camera gives more stars a field"
    )
