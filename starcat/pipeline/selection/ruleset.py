"""The rules of selection in their order, and the keys of a spec and the reasons they define."""

from __future__ import annotations

from collections.abc import Iterator
from types import ModuleType
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
from pydantic import model_validator

from starcat.catalog.stars.region import Region
from starcat.catalog.stars.verdict import Reason
from starcat.pipeline.selection.rule import FormField
from starcat.pipeline.selection.rules import (
    count,
    density,
    distrust,
    doubles,
    drift,
    flagged_doubles,
    magnitude,
    neighbours,
    no_magnitude,
    region,
    require,
    variables,
)
from starcat.pipeline.selection.rules.distrust import Observed
from starcat.pipeline.selection.rules.doubles import Doubles
from starcat.pipeline.selection.rules.neighbours import NeighbourRule
from starcat.pipeline.selection.rules.variables import Variables

RULES: tuple[ModuleType, ...] = (
    no_magnitude,
    magnitude,
    region,  # after the limits of magnitude, which an estimate applies first
    doubles,
    neighbours,
    flagged_doubles,
    variables,
    require,
    drift,
    distrust,
    count,
    density,
)
"""The rules in the order in which they reject: the first reason that applies to a star is its
verdict. `starcat.pipeline.selection.rules` describes what a rule defines."""


def table_of_rule(rule: ModuleType) -> str:
    """Return the name of a rule's table in ``[selection]``; empty if its keys are not in one."""
    return str(getattr(rule, "TABLE", ""))


def keys_of_rule(rule: ModuleType, selection: Any) -> Any:
    """Return the section with the keys of a rule."""
    table = table_of_rule(rule)
    return getattr(selection, table) if table else selection


def key_path(rule: ModuleType, name: str) -> str:
    """Return the dotted name of a rule's key in a spec."""
    return ".".join(filter(None, ("selection", table_of_rule(rule), name)))


NOT_USED = (None, "ignore")
"""Values of a key with which a rule does not look at its columns."""


def keys_without_effect(stars: pa.Table, selection: Any) -> Iterator[str]:
    """Yield a message for each stated key that rejects nothing because its columns are empty."""
    for rule in RULES:
        keys = keys_of_rule(rule, selection)
        for name, columns in getattr(rule, "COLUMNS", {}).items():
            value = getattr(keys, name)
            is_stated = value not in (*NOT_USED, type(keys).model_fields[name].default)
            if is_stated and len(stars) and all(_is_empty(stars[column]) for column in columns):
                yield (
                    f"{key_path(rule, name)} rejects nothing: no star of the catalogs has "
                    f"{' or '.join(columns)}. Add a source that has it, or leave the key out"
                )


def _is_empty(column: pa.ChunkedArray) -> bool:
    """Return whether no row of a column has a value; a flag has one where it is set."""
    if pa.types.is_boolean(column.type):
        return not pc.any(column).as_py()
    return int(column.null_count) == len(column)


class Selection(
    # The fields of the last base class come first.
    density.Thinning,
    drift.DriftLimit,
    require.Requirements,
    count.StarCounts,
    magnitude.MagnitudeLimits,
):
    """Which stars become guide stars: the keys of the rules, and a field for each of their tables.

    The keys of a rule without ``TABLE`` are a base class.
    """

    region: Region = Region()
    doubles: Doubles = Doubles()
    neighbours: NeighbourRule = NeighbourRule()
    variables: Variables = Variables()
    observed: Observed = Observed()

    @model_validator(mode="after")
    def _rules_agree(self) -> Selection:
        for rule in RULES:
            if hasattr(rule, "check"):
                rule.check(self)
        return self


def check_rules(spec: Any) -> None:
    """Check a whole spec by the rules that depend on more than ``[selection]``."""
    for rule in RULES:
        if hasattr(rule, "check_spec"):
            rule.check_spec(spec)


ALL_REASONS: dict[str, str] = {
    **{reason.name: reason.value for reason in Reason},
    **{reason.name: reason.value for rule in RULES for reason in rule.REASONS},
}
"""Meaning of each reason of a rejected record: reasons of archives, then reasons of rules, in the
order in which they are tried."""


def form_fields() -> dict[str, FormField]:
    """Return how a form shows keys of rules, by the dotted name of the key."""
    return {
        key_path(rule, name): field
        for rule in RULES
        for name, field in getattr(rule, "FORM", {}).items()
    }
