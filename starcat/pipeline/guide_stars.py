"""The stages that choose guide stars: select them, thin them if requested, and tile the sphere.

The selection does not depend on fields. This module applies a spec's requirements on fields.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from starcat.catalog.stars.star_table import directions_of, floats_of
from starcat.catalog.stars.verdict import count_by_reason
from starcat.database.products.coverage import MIN_GUIDE_STARS
from starcat.database.products.table import PRODUCTS, USUAL_PRODUCTS
from starcat.database.products.thinning import thin_by_cells, thin_by_information
from starcat.database.products.tiling import FieldStars, reach_rad, stars_in_fields
from starcat.errors import BuildError
from starcat.geometry.sphere import radec_from_directions
from starcat.pipeline.cost import GIB, Cost, base_memory, check_memory, count_products, product_cost
from starcat.pipeline.draft import Draft, stage
from starcat.pipeline.recipes import (
    boresights_of,
    field_size,
    product_inputs,
    tile_guide_stars,
    tile_stars,
)
from starcat.pipeline.selection.rules.count import BEYOND_COUNT
from starcat.pipeline.selection.rules.density import DENSITY
from starcat.pipeline.selection.ruleset import ALL_REASONS
from starcat.pipeline.selection.selecting import Selected, reject_dense, select_guide_stars
from starcat.pipeline.specs.build_spec import BuildSpec
from starcat.pipeline.supply import guide_star_motions

MAX_FIELD_STARS = 4_000_000
"""Most stars in all fields of a tiling, and in all levels, that an estimate processes."""

MIN_CONTAMINATION = 0.001
"""A neighbour with less than a thousandth of a star's light does not shift its centroid."""

MAX_COMPANION_LIGHT = 0.1
"""A companion with a larger share of the light of a spot is noted."""

FIRST_LOOK = 4.0
"""The first search uses this multiple of the stars that fill an average field."""

STARS_A_FIELD = 12
"""The brightest stars of every field that are kept if a database is to be small."""

NEVER_LEFT_OUT = "triangles"
"""The product that a matcher looks up first."""

POOL = 2.0
"""Other rules of thinning choose from this multiple of the stars kept per field on average."""


def _select_plan(spec: BuildSpec) -> str:
    limits = spec.selection
    return f"select stars of {limits.bright_limit_mag:g} to {limits.faint_limit_mag:g} mag"


@stage("select", "select", _select_plan)
def select(draft: Draft) -> None:
    """Select guide stars by the rules of the spec."""
    spec = draft.spec
    pixel_arcsec = spec.camera.camera().pixel_arcsec
    draft.selected = select_guide_stars(draft.stars, spec.selection, pixel_arcsec)
    check_guide_stars(draft.selected, spec)
    stars = draft.selected.guide_stars
    draft.note(
        select.name,
        *spec.limit_notes,
        *draft.selected.notes,
        *depth_notes(draft.stars, spec),
        *companion_notes(stars, spec),
    )


def _thin_plan(spec: BuildSpec) -> str | None:
    thinning, most = spec.selection.thinning, spec.selection.max_stars_per_field
    if thinning != "brightest":
        return f"thin stars by {thinning}"
    return None if most is None else f"keep the {most} brightest stars of every field"


@stage("thin", "select", _thin_plan)
def thin(draft: Draft) -> None:
    """Thin the guide stars to an even density, if the spec asks for it."""
    spec, stars = draft.spec, draft.selected.guide_stars
    most = spec.selection.max_stars_per_field
    if spec.selection.thinning != "brightest":
        reason = BEYOND_COUNT if most is None else DENSITY
        draft.selected = reject_dense(draft.selected, even_stars(stars, spec), reason)
    elif most is not None:
        draft.selected = reject_dense(draft.selected, brightest_of_fields(stars, spec, most))
    check_guide_stars(draft.selected, spec)


def _tile_plan(spec: BuildSpec) -> str:
    of_region = "" if spec.selection.region.footprint is None else ", keep those of the region"
    count = spec.boresights.count
    return f"tile the sphere with {count:,} fields{of_region}, and find the stars of each"


@stage("tile", "select", _tile_plan)
def tile(draft: Draft) -> None:
    """Tile the sphere, and find the guide stars of each field."""
    draft.fields = tile_guide_stars(draft.selected.guide_stars, draft.spec)
    with refusing(draft):
        check_fields(draft.fields, draft.spec)


@stage("cost", "select", lambda spec: "estimate files and memory; stop if memory is short")
def check_cost(draft: Draft) -> None:
    """Estimate files and memory, and stop the build if memory is short."""
    selected, rejected = draft.selected, draft.rejected_rows
    if rejected is None:
        rejected = len(draft.rejected) + len(selected.rejected)
    others = {"rejected": rejected}
    others |= {product.name: len(product.table) for product in guide_star_motions(draft)}
    inputs = product_inputs(selected.guide_stars, draft.fields, draft.spec)
    draft.cost = product_cost(inputs, base_memory(draft.catalog_bytes), others=others)
    if draft.announce is not None:
        draft.announce(draft.cost)
    with refusing(draft):
        remedy = partial(_lines_that_help, draft)
        check_memory(draft.cost, draft.spec, remedy, draft.max_memory_bytes)


def _lines_that_help(draft: Draft, most_bytes: float) -> str:
    """Return the lines with which a spec needs less memory, and how much it then needs."""
    spec, base = draft.spec, base_memory(draft.catalog_bytes)
    stars, fields = draft.selected.guide_stars, draft.fields

    def fits(cost: Cost) -> bool:
        return cost.memory_bytes <= most_bytes

    lines: list[str] = []
    smaller, cost = without_costly(stars, fields, spec, base, fits)
    most = spec.selection.max_stars_per_field
    if not fits(cost) and (most is None or most > STARS_A_FIELD):
        rows = brightest_of_fields(stars, spec, STARS_A_FIELD)
        stars = stars.take(pa.array(rows))
        lines.append(f"selection.max_stars_per_field = {STARS_A_FIELD}")
        smaller, cost = without_costly(stars, tile_guide_stars(stars, spec), spec, base, fits)
    enabled = smaller.products.requested
    lines += [
        f"products.{name}.enabled = false"
        for name in spec.products.requested
        if name not in enabled
    ]
    if fits(cost):
        ending = (
            ""
            if most is not None
            else (f". selection.max_stars_per_field = {STARS_A_FIELD} makes all products smaller")
        )
    else:
        ending = (
            ". Use a brighter selection.faint_limit_mag, or a smaller boresights.count than "
            f"{spec.boresights.count:,}, too, or more memory"
        )
    even = "" if fits(cost) else "even "
    takes = f"{even}with these lines of the spec it takes {cost.memory_bytes / GIB:.1f} GiB"
    return f"{takes}: {', '.join(lines) or 'none helps'}{ending}"


def without_costly(
    guide_stars: pa.Table,
    fields: FieldStars,
    spec: BuildSpec,
    base_bytes: float,
    fits: Callable[[Cost], bool],
) -> tuple[BuildSpec, Cost]:
    """Return a spec without the products that take the most memory until its cost fits."""
    inputs = product_inputs(guide_stars, fields, spec)
    extents = count_products(inputs)
    cost = product_cost(inputs, base_bytes, extents)
    while not fits(cost):
        others = [name for name in cost.rows if name in USUAL_PRODUCTS and name != NEVER_LEFT_OUT]
        if not others:
            break
        costly = max(others, key=lambda name: cost.bytes[name])
        content = spec.model_dump(mode="json")
        content["products"][costly]["enabled"] = False
        spec = BuildSpec.model_validate(content)
        inputs = product_inputs(guide_stars, fields, spec)
        cheaper = {name: extent for name, extent in extents.items() if name != costly}
        extents = {name: cheaper[name] for name in cheaper if PRODUCTS[name].is_requested(inputs)}
        cost = product_cost(inputs, base_bytes, extents)
    return spec, cost


@contextmanager
def refusing(draft: Draft) -> Iterator[None]:
    """Record the reason why a spec cannot be built, if the draft is for an estimate."""
    try:
        yield
    except BuildError as error:
        if draft.refusals is None:
            raise
        draft.refusals.append(error)


def even_stars(guide_stars: pa.Table, spec: BuildSpec) -> NDArray[np.int64]:
    """Return the rows of stars that a spec's thinning keeps, ascending.

    Their number is the same as with thinning by brightness. Only the brightest stars of each field
    (`POOL` times as many as stay) are considered, so that deep catalogs take hardly longer.
    """
    order = np.lexsort((guide_stars["star_id"].to_numpy(), floats_of(guide_stars, "mag")))
    stars, selection = guide_stars.take(pa.array(order)), spec.selection
    bright = stars.slice(0, selection.max_stars)
    count = len(bright)
    if selection.max_stars_per_field is not None:
        count = len(brightest_of_fields(bright, spec, selection.max_stars_per_field))
    if count == len(stars):
        return np.arange(count)
    pool = brightest_of_fields(stars, spec, int(np.ceil(POOL * count * field_share(spec))))
    if len(pool) < count:  # the fields leave out a large part of the sphere
        pool = np.arange(len(stars))
    directions, mag = directions_of(stars)[pool], floats_of(stars, "mag")[pool]
    if selection.thinning == "voronoi":
        kept = thin_by_cells(directions, mag, count)
    else:
        check_tiling(len(pool), spec, None, what="thin by information")
        fields = tile_stars(directions, mag, spec)
        reach = reach_rad(field_size(spec), spec.boresights.field)
        kept = thin_by_information(fields, directions, mag, reach, count)
    return np.sort(order[pool[kept]])


def brightest_of_fields(guide_stars: pa.Table, spec: BuildSpec, most: int) -> NDArray[np.int64]:
    """Return the rows of stars that are among the brightest of some field, ascending.

    The brightest stars of the sky fill most fields. Fainter stars are added only for fields that
    are not full, so that deep catalogs take hardly longer than bright ones.
    """
    directions, mag = directions_of(guide_stars), floats_of(guide_stars, "mag")
    by_brightness = np.argsort(mag, kind="stable")
    boresights, size = boresights_of(spec), field_size(spec)
    count = int(np.ceil(FIRST_LOOK * most / field_share(spec)))
    parts = [np.empty(0, dtype=np.int64)]
    while len(boresights):
        near = np.sort(by_brightness[:count])
        tiled = stars_in_fields(
            boresights, directions[near], mag[near], size, spec.boresights.field
        )
        is_full = (tiled.count >= most) | (count >= len(mag))
        _, star = tiled.brightest(most)
        kept = np.repeat(is_full, np.minimum(tiled.count, most))
        parts.append(near[star[kept]])
        boresights, count = boresights[~is_full], 4 * count
    return np.unique(np.concatenate(parts))


def field_share(spec: BuildSpec) -> float:
    """Return the approximate fraction of the sphere that a field of the tiling covers."""
    return 0.5 * (1.0 - float(np.cos(reach_rad(field_size(spec), spec.boresights.field))))


def check_tiling(
    stars: int,
    spec: BuildSpec,
    thinned_to: int | None,
    most: int = MAX_FIELD_STARS,
    what: str = "estimate",
) -> None:
    """Check that the fields of a tiling do not have too many stars for a quick computation."""
    in_field = stars * field_share(spec)
    if thinned_to is not None:
        in_field = min(in_field, FIRST_LOOK * thinned_to)
    field_stars = spec.boresights.count * in_field
    if field_stars > most:
        raise BuildError(
            f"too dense to {what}: the {spec.boresights.count:,} fields of the "
            f"tiling have about {field_stars:,.0f} stars, limit {most:,}",
            where=spec.name,
            key="selection.max_stars_per_field",
            hint="use a brighter faint_limit_mag, selection.max_stars_per_field = "
            f"{STARS_A_FIELD}, or a smaller boresights.count",
        )


def check_guide_stars(selected: Selected, spec: BuildSpec) -> None:
    """Check that the selection left stars to build from."""
    kept = len(selected.guide_stars)
    if kept < MIN_GUIDE_STARS:
        counts = count_by_reason(selected.rejected, reasons=ALL_REASONS)
        limits = "[selection]"
        if spec.catalog.read_limit_mag is not None:
            limits += f" and read_limit_mag {spec.catalog.read_limit_mag:g}"
        reasons = ", ".join(f"{name} {count}" for name, count in counts.items()) or "none read"
        raise BuildError(
            f"{kept} guide stars left of {len(selected.rejected) + kept}; at least "
            f"{MIN_GUIDE_STARS} are needed. Rejected: {reasons}",
            where=spec.name,
            key="selection.faint_limit_mag",
            hint=f"Check the limits of {limits}",
        )


def depth_notes(stars: pa.Table, spec: BuildSpec) -> tuple[str, ...]:
    """Return a note if a catalog is not deep enough for [selection.neighbours]."""
    rule, mag = spec.selection.neighbours, floats_of(stars, "mag")
    share = max(rule.max_contamination, MIN_CONTAMINATION)
    if not rule.is_on or share >= 0.5 or np.isnan(mag).all():
        return ()
    faintest, fainter = np.nanmax(mag), 2.5 * np.log10((1.0 - share) / share)
    if faintest - fainter >= spec.selection.faint_limit_mag:
        return ()
    return (
        f"selection.neighbours: the faintest star that was read has magnitude {faintest:.2f}, and "
        f"a neighbour {fainter:.2f} mag fainter than a guide star is still {share:.3g} of its "
        f"light. Stars fainter than {faintest - fainter:.2f} are judged by some of their "
        "neighbours only: read a deeper catalog, or raise catalog.read_limit_mag",
    )


def companion_notes(guide_stars: pa.Table, spec: BuildSpec) -> tuple[str, ...]:
    """Return a note if stars that the rule of doubles leaves out of account share a pixel.

    The nearest star of a guide star counts if it has more than `MAX_COMPANION_LIGHT` of the light
    of both.
    """
    doubles, limit = spec.selection.doubles, spec.selection.faint_limit_mag
    if doubles.action == "keep" or spec.selection.neighbours.is_on:
        return ()
    key = "selection.faint_limit_mag"
    if doubles.companion_limit_mag is not None:
        limit, key = doubles.companion_limit_mag, "selection.doubles.companion_limit_mag"
    pixel_arcsec = spec.camera.camera().pixel_arcsec
    apart, delta = (
        floats_of(guide_stars, f"nearest_{name}") for name in ("separation_arcsec", "delta_mag")
    )
    companion_mag = floats_of(guide_stars, "mag") + delta
    fainter_mag = round(2.5 * np.log10((1.0 - MAX_COMPANION_LIGHT) / MAX_COMPANION_LIGHT), 1)
    largest_mag = np.inf if doubles.max_delta_mag is None else doubles.max_delta_mag
    with np.errstate(invalid="ignore"):
        is_one_spot = apart <= min(pixel_arcsec, 3600.0 * doubles.min_separation_deg)
        is_left_out = (
            is_one_spot & (companion_mag > limit) & (delta <= min(fainter_mag, largest_mag))
        )
    if not is_left_out.any():
        return ()
    needed = np.ceil(10.0 * companion_mag[is_left_out].max()) / 10.0
    needed = min(needed, spec.catalog.read_limit_mag or np.inf)
    others = f" (and max_delta_mag = {fainter_mag:g}, to ignore fainter companions)"
    return (
        f"guide stars that share a pixel ({pixel_arcsec:.3g} arcsec) with a star that is fainter "
        f"than {key} {limit:g} and has more than a tenth of the light: "
        f"{np.count_nonzero(is_left_out):,}. The camera sees one spot, brighter and elsewhere; "
        f"selection.doubles.companion_limit_mag = {needed:g}"
        f"{others if doubles.max_delta_mag is None else ''} makes them doubles",
    )


def check_fields(fields: FieldStars, spec: BuildSpec) -> None:
    """Check that every field has the guide stars that the spec asks for."""
    min_stars, count = spec.boresights.min_stars_per_field, fields.count
    if min_stars is None or count.min() >= min_stars:
        return
    short = np.flatnonzero(count < min_stars)
    worst = short[np.argsort(count[short], kind="stable")][:5]
    ra_deg, dec_deg = radec_from_directions(fields.boresights[worst])
    named = ", ".join(
        f"boresight {tile} (RA {ra:.2f}, Dec {dec:+.2f} deg): {count[tile]}"
        for tile, ra, dec in zip(worst.tolist(), ra_deg, dec_deg, strict=True)
    )
    raise BuildError(
        f"{len(short)} of {len(count)} fields have fewer than {min_stars} guide stars "
        f"(boresights.min_stars_per_field): {named}{', ...' if len(short) > 5 else ''}",
        where=spec.name,
        key="boresights.min_stars_per_field",
        hint="A fainter faint_limit_mag or a wider camera gives more stars per field",
    )
