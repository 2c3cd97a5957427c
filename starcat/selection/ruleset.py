"""The rules of selection in their order, and the keys of a spec and the reasons they define."""

from __future__ import annotations

from collections.abc import Iterator
from types import ModuleType
from typing import TYPE_CHECKING, Any

import pyarrow as pa
import pyarrow.compute as pc
from pydantic import create_model, model_validator

from starcat.plugins import plugin_modules
from starcat.selection.rule import FormField
from starcat.stars.verdict import Reason

if TYPE_CHECKING:
    from starcat.selection.rules.count import StarCounts
    from starcat.selection.rules.density import Thinning
    from starcat.selection.rules.distrust import Observed
    from starcat.selection.rules.doubles import Doubles
    from starcat.selection.rules.drift import DriftLimit
    from starcat.selection.rules.magnitude import MagnitudeLimits
    from starcat.selection.rules.neighbours import NeighbourRule
    from starcat.selection.rules.variables import Variables
    from starcat.stars.region import Region

RULES = plugin_modules("starcat.selection.rules")
"""The rules in their order; `starcat.selection.rules` describes what a rule defines."""


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


def _keys_position(rule: ModuleType) -> float:
    return float(getattr(rule, "KEYS_POSITION", rule.POSITION))


_WITH_KEYS = sorted((rule for rule in RULES if hasattr(rule, "KEYS")), key=_keys_position)
_BESIDE = [rule.KEYS for rule in _WITH_KEYS if not table_of_rule(rule)]

if TYPE_CHECKING:
    # A type checker does not load the rules: list the keys that other modules use here.
    class _KeysOfRules(Thinning, DriftLimit, StarCounts, MagnitudeLimits):
        doubles: Doubles = Doubles()
        neighbours: NeighbourRule = NeighbourRule()
        variables: Variables = Variables()
        observed: Observed = Observed()
        region: Region = Region()

else:
    _KeysOfRules = create_model(
        "_KeysOfRules",
        __base__=tuple(reversed(_BESIDE)),  # the fields of the last base class come first
        **{
            table_of_rule(rule): (rule.KEYS, rule.KEYS())
            for rule in _WITH_KEYS
            if table_of_rule(rule)
        },
    )


class Selection(_KeysOfRules):
    """Which stars become guide stars."""

    later_keys = tuple(key for keys in _BESIDE for key in keys.later_keys)

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
