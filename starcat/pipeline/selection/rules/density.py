"""Surplus stars of crowded fields of the tiling, and which stars stay if a spec thins."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from starcat.pipeline.selection.rule import Context, FormField, RuleReason
from starcat.sections import Section

STEP = "density"
DENSITY = RuleReason(
    "density",
    "thinned to max_stars_per_field: not among the brightest of a field, or as selection.thinning "
    "says",
)
REASONS = (DENSITY,)
FORM = {
    "thinning": FormField(
        "A field's stars are thinned by",
        "choice",
        hint="as many stay by every rule",
        choices=(
            ("brightest", "brightness"),
            ("voronoi", "the room around each"),
            ("information", "the attitude of the worst fields"),
        ),
    )
}


class Thinning(Section):
    """Which stars stay where a spec thins."""

    later_keys = ("thinning",)

    thinning: Literal["brightest", "voronoi", "information"] = Field(
        "brightest",
        description="which stars stay where max_stars or max_stars_per_field thins, as many by "
        "every rule: the brightest; those whose cell (what is nearer to them than to any other) is "
        "large for their brightness; or those that the attitude of the worst fields needs most",
    )


KEYS = Thinning


def check(selection: Any) -> None:
    """Check that a spec with a ``thinning`` also sets the number of stars that stay."""
    if selection.thinning != "brightest" and (
        selection.max_stars is None is selection.max_stars_per_field
    ):
        raise ValueError(
            f"thinning is {selection.thinning}, but no key sets how many stars stay; give "
            "max_stars or max_stars_per_field"
        )


def reject(_: Context, __: Thinning) -> None:
    """Reject no star: the build thins afterwards, when it has the tiling of the sphere."""
