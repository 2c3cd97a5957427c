"""Stars that do not meet conditions which the spec states as expressions of star-table columns."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from pydantic import Field, field_validator, model_validator

from starcat.arrays import Mask
from starcat.catalog.stars.expressions import columns_in, evaluate_expression
from starcat.errors import BuildError
from starcat.pipeline.selection.rule import Context, Rejection, RuleReason
from starcat.sections import NAME_PATTERN, Section
from starcat.storage.schema import product_schema

STEP = "require"
UNMET = RuleReason("requirement", "a condition of [[selection.require]] does not hold")
REASONS = (UNMET,)

MAX_EXPRESSION_CHARACTERS = 1000

_TABLE = "the star table"


class Requirement(Section):
    """A condition that guide stars meet."""

    name: str = Field(pattern=NAME_PATTERN, description="of the condition", examples=["good-fit"])
    expression: str = Field(
        min_length=1,
        max_length=MAX_EXPRESSION_CHARACTERS,
        description="of columns of the star table; a star stays if it is true. A star for which a "
        "value is unknown is rejected, unless the expression says otherwise, such as "
        "'ruwe < 1.4 OR ruwe IS NULL'",
        examples=["ruwe < 1.4"],
    )
    description: str = Field(
        "", max_length=200, description="why it is asked for", examples=["well-behaved in Gaia"]
    )

    @field_validator("expression")
    @classmethod
    def _is_condition(cls, value: str) -> str:
        none = product_schema("stars").arrow_schema.empty_table()
        names, _ = columns_in(value, none.column_names, "expression", _TABLE)
        columns = {name: none[name].combine_chunks() for name in names}
        kind = evaluate_expression(value, columns, 0, "expression").type
        if not pa.types.is_boolean(kind):
            raise ValueError(
                f"expression: {value!r} gives {kind}; write a condition, such as 'ruwe < 1.4'"
            )
        return value


class Requirements(Section):
    """The conditions that guide stars meet."""

    later_keys = ("require",)

    require: tuple[Requirement, ...] = Field(
        (),
        strict=False,  # a list in TOML
        max_length=20,
        description="conditions that guide stars meet, in [[selection.require]] each",
    )

    @model_validator(mode="after")
    def _names_differ(self) -> Requirements:
        names = [each.name for each in self.require]
        if len(set(names)) != len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise ValueError(f"require: {twice!r} is named twice; name each once")
        return self


KEYS = Requirements


def reject(context: Context, keys: Requirements) -> list[Rejection] | None:
    """Reject the stars that do not meet a condition, with its name as the detail."""
    if not keys.require:
        return None
    return [
        Rejection(
            ~_is_met(context.stars, condition), UNMET, f"{condition.name}: {condition.expression}"
        )
        for condition in keys.require
    ]


def _is_met(stars: pa.Table, condition: Requirement) -> Mask:
    """Return which stars meet a condition; stars with an unknown value in it do not."""
    key, count = f"selection.require.{condition.name}", len(stars)
    names, _ = columns_in(condition.expression, stars.column_names, key, _TABLE)
    missing = [name for name in names if count and stars[name].null_count == count]
    if missing:
        filled = [name for name in stars.column_names if stars[name].null_count < count]
        raise BuildError(
            f"no star of the catalogs has {' or '.join(missing)}, which "
            f"{condition.expression!r} needs; their stars have {', '.join(filled)}",
            where=key,
        )
    columns = {name: stars[name].combine_chunks() for name in names}
    holds = evaluate_expression(condition.expression, columns, count, key)
    return np.asarray(pc.fill_null(holds, False).to_numpy(zero_copy_only=False), dtype=bool)
