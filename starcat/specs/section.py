"""What all sections of a spec share: they are frozen, and strict about what they are given."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, field_validator

Mag = Annotated[float, Field(ge=-30.0, le=40.0)]
"""A magnitude that some star may have."""

SMALLEST_DEG = 0.001
"""Below 4 arcsec an angle of a spec is a slip: of a unit or of the decimal point."""

SmallDeg = Annotated[float, Field(ge=SMALLEST_DEG, le=90.0)]
"""A radius or the width of a bin, degrees."""

FieldDeg = Annotated[float, Field(ge=0.01, lt=120.0)]
"""The full angle of a field of view, degrees."""


class Section(BaseModel):
    """A part of a spec: frozen; refuses unknown keys, wrong types and numbers not finite."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    @field_validator("*", mode="after")
    @classmethod
    def _no_negative_zero(cls, value: Any) -> Any:
        """Return 0.0 for -0.0, which passes for a number that is not negative and is none."""
        return value + 0.0 if isinstance(value, float) else value
