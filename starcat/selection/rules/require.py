"""Stars that do not meet conditions which the spec states as expressions of star-table columns."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from pydantic import Field, field_validator

from starcat.errors import BuildError, ConfigError
from starcat.sections import NAME_PATTERN, Section
from starcat.selection.rule import Context, Rejection, RuleReason
from starcat.stars.expressions import columns_in, evaluate_expression
from starcat.storage.schema import product_schema

POSITION = 75
STEP = "require"
COLUMNS = ("ruwe",)
UNMET = RuleReason("requirement", "a condition of [[selection.require]] does not hold")
REASONS = (UNMET,)

MAX_EXPRESSION_CHARACTERS = 1000


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
    def _is_expression(cls, value: str) -> str:
        known = [column.name for column in product_schema("stars").columns]
        try:
            columns_in(value, known, "expression", "the star table")
        except ConfigError as error:
            raise ValueError(str(error)) from error
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


KEYS = Requirements


def reject(context: Context, keys: Requirements) -> list[Rejection] | None:
    """Reject the stars that do not meet a condition, with its name as the detail."""
    if not keys.require:
        return None
    found = []
    for wanted in keys.require:
        key = f"selection.require.{wanted.name}"
        names, _ = columns_in(wanted.expression, context.stars.column_names, key, "the star table")
        columns = {name: context.stars[name].combine_chunks() for name in names}
        holds = evaluate_expression(wanted.expression, columns, len(context.stars), key)
        if not pa.types.is_boolean(holds.type):
            raise BuildError(
                f"{key}: {wanted.expression!r} gives {holds.type}; write a condition, such as "
                "'ruwe < 1.4'",
                fields=(key,),
            )
        met = np.asarray(pc.fill_null(holds, False).to_numpy(zero_copy_only=False), dtype=bool)
        found.append(Rejection(~met, UNMET, f"{wanted.name}: {wanted.expression}"))
    return found
