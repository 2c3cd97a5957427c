"""Which stars of a star table become guide stars, and why the others do not: runs the rules."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from starcat.arrays import Array, Mask
from starcat.catalog.stars.star_table import directions_of, sort_rejected, split_by_verdict
from starcat.catalog.stars.verdict import Verdicts
from starcat.pipeline.selection.rule import Context, RuleReason
from starcat.pipeline.selection.rules.density import DENSITY
from starcat.pipeline.selection.rules.neighbours import TABLE as NEIGHBOURS
from starcat.pipeline.selection.rules.neighbours import NeighbourTally
from starcat.pipeline.selection.ruleset import RULES, Selection, keys_of_rule, keys_without_effect


@dataclass(frozen=True)
class Step:
    """The stars that are left after one filter."""

    name: str  # name of the filter
    directions: Array  # ICRS, shape (N, 3)


@dataclass(frozen=True)
class Selected:
    """Guide stars, and every other star with its reason."""

    guide_stars: pa.Table  # in the stars schema, by star_id
    rejected: pa.Table  # in the rejected schema, by star_id
    steps: tuple[Step, ...]  # the stars that were left after each filter, in order
    neighbours: NeighbourTally | None = None  # if the spec has [selection.neighbours]
    notes: tuple[str, ...] = ()  # keys of the spec that reject nothing


def select_guide_stars(
    stars: pa.Table, selection: Selection, pixel_arcsec: float | None = None
) -> Selected:
    """Select guide stars from a star table.

    All rules are run in their order. First they combine stars, then they reject; the first reason
    that applies to a star is its verdict.

    Parameters
    ----------
    stars : pyarrow.Table
        Of the stars schema.
    selection : Selection
        The section of the spec.
    pixel_arcsec : float, optional
        Side of a pixel at the camera's axis, which [selection.neighbours] needs.

    Returns
    -------
    Selected
    """
    verdicts = Verdicts(len(stars))
    context = Context(stars, stars, verdicts, selection, pixel_arcsec)
    for rule in RULES:
        if hasattr(rule, "combine"):
            rule.combine(context, keys_of_rule(rule, selection))
    kept: dict[str, Mask] = {}
    for rule in RULES:
        rejections = rule.reject(context, keys_of_rule(rule, selection))
        if rejections is None:
            continue
        for rejection in rejections:
            verdicts.reject(rejection.where, rejection.reason, rejection.detail)
        kept[rule.STEP] = verdicts.is_kept  # rules that share a row: after the last of them
    directions = directions_of(context.stars)
    guide_stars, rejected = split_by_verdict(context.stars, verdicts)
    return Selected(
        guide_stars.combine_chunks(),
        rejected,
        tuple(Step(name, directions[is_kept]) for name, is_kept in kept.items()),
        context.tallies.get(NEIGHBOURS),
        tuple(keys_without_effect(stars, selection)),
    )


def reject_dense(
    selected: Selected, kept: NDArray[np.integer], reason: RuleReason = DENSITY
) -> Selected:
    """Thin the guide stars to the rows that a tiling keeps."""
    (step,) = (rule.STEP for rule in RULES if reason in rule.REASONS)
    verdicts = Verdicts(len(selected.guide_stars))
    verdicts.reject(~np.isin(np.arange(len(selected.guide_stars)), kept), reason)
    stars, dense = split_by_verdict(selected.guide_stars, verdicts)
    rejected = pa.concat_tables([selected.rejected, dense]).combine_chunks()
    return Selected(
        stars.combine_chunks(),
        sort_rejected(rejected),
        (*selected.steps, Step(step, directions_of(stars))),
        selected.neighbours,
        selected.notes,
    )
