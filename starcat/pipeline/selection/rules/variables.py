"""Stars whose brightness varies too much, or is flagged to vary."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np
from pydantic import Field

from starcat.catalog.stars.star_table import floats_of
from starcat.pipeline.selection.rule import Context, Rejection, RuleReason
from starcat.resources import sources_supplying
from starcat.sections import Section

STEP = "variables"
COLUMNS = {"max_amplitude_mag": ("amplitude_mag",), "flags": ("is_flagged_variable",)}
VARIABLE = RuleReason("variable", "amplitude above max_amplitude_mag")
FLAGGED_VARIABLE = RuleReason("flagged_variable", "flagged variable, amplitude unknown")
REASONS = (VARIABLE, FLAGGED_VARIABLE)


if TYPE_CHECKING:
    AmplitudeSource: TypeAlias = str
else:
    AmplitudeSource = Literal[sources_supplying("amplitudes")]


class Variables(Section):
    """Stars whose brightness cannot be relied on."""

    max_amplitude_mag: float | None = Field(
        0.6, ge=0.0, le=30.0, description="stars with a larger amplitude are rejected"
    )
    flags: Literal["ignore", "known", "strict"] = Field(
        "ignore",
        description="what an archive's flag of a variable means: nothing; a rejection of those "
        "without a known amplitude; or always a rejection",
    )
    join: tuple[AmplitudeSource, ...] = Field(
        (),
        strict=False,  # a list in TOML
        description="sources whose amplitudes are joined by HIP, HD, TYC or Gaia number, or (vsx) "
        "by place",
        examples=[["hipparcos"]],
    )


TABLE, KEYS = "variables", Variables


def reject(context: Context, keys: Variables) -> list[Rejection]:
    """Reject the stars whose brightness cannot be relied on."""
    amplitude = floats_of(context.stars, "amplitude_mag")
    flagged = np.array(context.stars["is_flagged_variable"])
    rejections = []
    if keys.max_amplitude_mag is not None:
        rejections.append(Rejection(amplitude > keys.max_amplitude_mag, VARIABLE))
    if keys.flags != "ignore":
        is_rejected = flagged if keys.flags == "strict" else flagged & np.isnan(amplitude)
        rejections.append(Rejection(is_rejected, FLAGGED_VARIABLE))
    return rejections
