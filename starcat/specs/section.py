"""What all sections of a spec share, and the patterns of names and versions.

Sections are frozen, and strict about their values. A version is three numbers in ASCII digits
without leading zeros, so that each version has one spelling; 18 digits fit into 64 bits. A registry
and a lock file know the same names and versions.
"""

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


NAME_PATTERN = r"^[a-z0-9][a-z0-9-]{0,63}$"

_NUMBER = r"(0|[1-9][0-9]{0,17})"
VERSION_PATTERN = rf"^{_NUMBER}\.{_NUMBER}\.{_NUMBER}$"


def version_numbers(version: str) -> tuple[int, int, int]:
    """Return what versions are sorted by, as semantic versions go.

    Examples
    --------
    >>> version_numbers("1.10.0") > version_numbers("1.9.0")
    True
    """
    major, minor, patch = (int(number) for number in version.split("."))
    return major, minor, patch
