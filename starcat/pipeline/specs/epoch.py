"""The epoch of a database: one Julian year, or the years of a mission."""

from __future__ import annotations

from typing import Annotated, Any, TypeAlias

from pydantic import Field, PlainSerializer, PlainValidator

from starcat.storage.toml_files import toml_shown

FIRST_JYEAR, LAST_JYEAR = 1800.0, 2200.0

Span: TypeAlias = float | tuple[float, float]


def _epoch_or_span(value: Any) -> Span:
    """Return a checked Julian year, or the two years of a span."""
    is_span = isinstance(value, list | tuple)
    years = tuple(value) if is_span else (value,)
    if is_span and len(years) != 2:
        raise ValueError(f"found a list of {len(years)}; give one year, or [begin, end] of a span")
    for year in years:
        is_number = isinstance(year, int | float) and not isinstance(year, bool)
        if not is_number or not FIRST_JYEAR <= year <= LAST_JYEAR:
            raise ValueError(
                f"found {toml_shown(year)}; give a Julian year from {FIRST_JYEAR:g} to "
                f"{LAST_JYEAR:g}, or [begin, end] of a span"
            )
    if not is_span:
        return float(value)
    begin, end = map(float, years)
    if begin >= end:
        raise ValueError(
            f"the span ends in {end:g} and begins in {begin:g}; give the earlier year first"
        )
    return begin, end


_Year = Annotated[float, Field(ge=FIRST_JYEAR, le=LAST_JYEAR)]

EpochOrSpan = Annotated[
    Span,
    PlainValidator(_epoch_or_span, json_schema_input_type=_Year | tuple[_Year, _Year]),
    PlainSerializer(lambda value: list(value) if isinstance(value, tuple) else value),
]
"""A Julian year, or a span of them: positions are then at its middle."""
