"""Acceptance by the self-test: it passes a database, or explains why it fails.

A rate from some hundred frames has an error of a few per cent. So the test uses its confidence
interval, not the rate itself: a good database must not fail with another seed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from starcat.database.products.coverage import TilingGap
from starcat.errors import BuildError
from starcat.pipeline.simulation.selftest import Rates
from starcat.pipeline.specs.build_spec import BuildSpec

FEW_STARS = 8
"""With fewer guide stars in a frame, missing or false centroids can defeat any matcher."""

CROWDED = 2.0
"""A frame is crowded if it has this many times the stars that form a field's triangles."""

THINNED = 1.5
"""Recommended stars per field after thinning, as a multiple of the stars that form triangles."""


def check_rates(rates: Sequence[Rates], spec: BuildSpec, gap: TilingGap) -> None:
    """Check that a database identifies its own fields."""
    clean, min_identified = rates[0], spec.self_test.min_identified
    most = clean.interval[1] if clean.identified else 0.0
    if most < min_identified:
        raise BuildError(
            f"the database identifies {clean.identified} of {clean.frames} simulated "
            f"pointings, {clean.identifiable} of which show at least 4 stars; that is "
            f"at most {most:.1%}, and self_test.min_identified requires {min_identified:.1%}. "
            + ". ".join(causes(clean, spec, gap)),
            where=spec.name,
        )
    wrong = sum(rate.wrong for rate in rates)
    if wrong:
        raise BuildError(f"{wrong} simulated fields got a wrong answer", where=spec.name)


def causes(rates: Rates, spec: BuildSpec, gap: TilingGap) -> list[str]:
    """Return the reasons why frames were not identified, with the keys of the spec to change."""
    return list(_causes(rates, spec, gap)) or [
        "The database has more triangles of a frame with a larger boresights.brightest or "
        "boresights.count"
    ]


def _causes(rates: Rates, spec: BuildSpec, gap: TilingGap) -> Iterator[str]:
    middle = float(np.median(rates.missed)) if rates.missed else 0.0
    blind = rates.frames - rates.identifiable
    if blind > len(rates.missed):
        yield (
            f"{blind} pointings show fewer than 4 stars: a fainter selection.faint_limit_mag or a "
            "wider camera gives more stars per field"
        )
    elif middle < FEW_STARS:
        yield (
            f"The missed frames have {middle:g} stars (median), too few: a fainter "
            "selection.faint_limit_mag or a wider camera gives more stars per field"
        )
    are_few = blind > len(rates.missed) or middle < FEW_STARS
    if are_few and spec.selection.region.footprint is not None:
        yield (
            "Frames near the edge of [selection.region] show the guide stars of a part of their "
            "field: a region that is wider by half a field on every side gives them all"
        )
    if gap.has_holes:
        yield (
            f"The fields of boresights.count = {gap.boresights:,} leave holes between them, whose "
            f"triangles are missing: boresights.count = {gap.boresights_needed} leaves none"
        )
    brightest = spec.boresights.brightest
    if spec.products.triangles.enabled and middle > CROWDED * brightest:
        thinned = round(THINNED * brightest)
        yield (
            f"The missed frames have {middle:g} stars (median), and the triangles are of the "
            f"{brightest} brightest of each field: selection.max_stars_per_field = {thinned} "
            "leaves the stars that have triangles"
        )


def advice_without_magnitudes(rates: Sequence[Rates], spec: BuildSpec) -> str | None:
    """Return a warning if a database is good only with magnitudes, else None."""
    clean, bare = rates[0], rates[2]
    min_identified = spec.self_test.min_identified
    if not bare.frames or bare.interval[1] >= min(min_identified, clean.interval[0]):
        return None
    thinned = round(THINNED * spec.boresights.brightest)
    return (
        f"without magnitudes {bare.identified} of {bare.frames} simulated pointings are "
        f"identified, with them {clean.identified} of {clean.frames}: give the magnitudes "
        f"of the centroids, or set selection.max_stars_per_field = {thinned}"
    )
