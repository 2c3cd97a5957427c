"""Stars brighter or fainter than the limits of the spec."""

from __future__ import annotations

import numpy as np
from pydantic import Field, model_validator

from starcat.catalog.stars.star_table import floats_of
from starcat.pipeline.selection.rule import Context, FormField, Rejection, RuleReason
from starcat.sections import Mag, Section

STEP = "magnitude"
TOO_BRIGHT = RuleReason("too_bright", "brighter than bright_limit_mag")
TOO_FAINT = RuleReason("too_faint", "fainter than faint_limit_mag")
REASONS = (TOO_BRIGHT, TOO_FAINT)
FORM = {
    "faint_limit_mag": FormField("Faint limit", "slide", "limits", low=2, high=10, step=0.05),
    "bright_limit_mag": FormField(
        "Bright limit",
        "slide",
        "limits",
        low=-2,
        high=6,
        step=0.1,
        none_at="low",
        placeholder="none",
    ),
}


class MagnitudeLimits(Section):
    """Limits of magnitude."""

    bright_limit_mag: Mag = Field(-30.0, description="brighter stars are rejected")
    faint_limit_mag: Mag = Field(
        description="fainter stars are rejected; the limit itself is kept", examples=[6.0]
    )

    @model_validator(mode="after")
    def _limits_in_order(self) -> MagnitudeLimits:
        if self.bright_limit_mag >= self.faint_limit_mag:
            raise ValueError(
                f"bright_limit_mag {self.bright_limit_mag} is not below faint_limit_mag "
                f"{self.faint_limit_mag}: larger is fainter, so they may be swapped"
            )
        return self


KEYS = MagnitudeLimits


def reject(context: Context, keys: MagnitudeLimits) -> list[Rejection]:
    """Reject stars beyond the limits; NaN is beyond neither."""
    mag = floats_of(context.stars, "mag")
    with np.errstate(invalid="ignore"):
        return [
            Rejection(mag < keys.bright_limit_mag, TOO_BRIGHT),
            Rejection(mag > keys.faint_limit_mag, TOO_FAINT),
        ]
