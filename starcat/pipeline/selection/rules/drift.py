"""Stars that move too far from their place within the span of a mission."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import Field

from starcat.catalog.stars.star_table import floats_of
from starcat.pipeline.selection.rule import Context, FormField, Rejection, RuleReason
from starcat.sections import Section

STEP = "drift"
COLUMNS = {"max_drift_arcsec": ("drift_arcsec",)}
DRIFTS = RuleReason("drifts", "further from its place at an end of the span than max_drift_arcsec")
REASONS = (DRIFTS,)
FORM = {
    "max_drift_arcsec": FormField(
        "Drift in a span at most",
        "slide",
        low=0.1,
        high=60,
        step=0.1,
        scale="log",
        none_at="high",
        placeholder="any",
    )
}


class DriftLimit(Section):
    """The limit of drift."""

    later_keys = ("max_drift_arcsec",)

    max_drift_arcsec: float | None = Field(
        None,
        gt=0.0,
        le=36_000.0,
        description="stars that are further from their place at the ends of the span of "
        "epoch_jyear are rejected; default: none",
    )


KEYS = DriftLimit


def check_spec(spec: Any) -> None:
    """Check that a spec with a limit of drift has a span."""
    if spec.selection.max_drift_arcsec is not None and not isinstance(spec.epoch_jyear, tuple):
        raise ValueError(
            "selection.max_drift_arcsec: epoch_jyear is one year, in which no star drifts; "
            "give a span, such as epoch_jyear = [2027.0, 2042.0]"
        )


def reject(context: Context, keys: DriftLimit) -> list[Rejection] | None:
    """Reject stars that drift too far; a star whose motion is not known stays."""
    if keys.max_drift_arcsec is None:
        return None
    with np.errstate(invalid="ignore"):
        too_far = floats_of(context.stars, "drift_arcsec") > keys.max_drift_arcsec
    return [Rejection(too_far, DRIFTS)]
