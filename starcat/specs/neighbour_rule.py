"""Section [selection.neighbours] of a spec: how much other stars may spoil a star's centroid."""

from __future__ import annotations

import math
from typing import Literal

from pydantic import Field, model_validator

from starcat.sections import Section

DEFAULT_OFFSET_PX = 0.1
"""Largest shift of a centroid where a spec states none: a fifth of the self-test's noise."""


class NeighbourRule(Section):
    """Stars whose light others in their window spoil; with psf_sigma_px, in place of doubles."""

    is_later = True
    later_keys = ("centroid", "box_px")

    psf_sigma_px: float | None = Field(
        None,
        ge=0.1,
        le=50.0,
        description="width of a star's spot before the pixels sample it, standard deviation; "
        "switches the rule on: it judges every star by all that were read and replaces the "
        "separation rule of [selection.doubles], whose flags stay",
        examples=[1.0],
    )
    window_px: float | None = Field(
        None,
        ge=0.1,
        le=100.0,
        description="width of the window of a centroid, standard deviation; default: that of the "
        "spot on the pixels, at least 1",
        examples=[1.04],
    )
    centroid: Literal["window", "box"] = Field(
        "window",
        description="how the sensor measures a star: in a Gaussian window that is moved until it "
        "is centred on the light, or as the centre of mass of the pixels in a box around the "
        "brightest pixel",
    )
    box_px: int | None = Field(
        None,
        ge=3,
        le=51,
        description='pixels on a side of the box, an odd number; with centroid = "box"',
        examples=[5],
    )
    max_offset_px: float | None = Field(
        None,
        ge=0.0,
        le=50.0,
        description="largest shift of the centroid by other stars; default: 0.1, where "
        "max_offset_arcsec is not given",
        examples=[0.1],
    )
    max_offset_arcsec: float | None = Field(
        None,
        ge=0.0,
        le=36_000.0,
        description="the same as an angle; with both, both apply",
        examples=[5.0],
    )
    max_contamination: float = Field(
        0.1, ge=0.0, le=1.0, description="largest share of other stars in the light of the centroid"
    )
    action: Literal["remove", "merge", "keep"] = Field(
        "remove",
        description="remove stars beyond these limits, give them position and magnitude of the "
        "blend as the sensor sees it, or keep them as they are",
    )

    @model_validator(mode="after")
    def _switched_on(self) -> NeighbourRule:
        fields = type(self).model_fields.items()
        if not self.is_on and any(getattr(self, name) != key.default for name, key in fields):
            raise ValueError(
                "psf_sigma_px is missing: without the width of a spot there are no blends; state "
                "it, such as psf_sigma_px = 1.0, or leave the section out"
            )
        if (self.centroid == "box") != (self.box_px is not None):
            raise ValueError(
                f'centroid is "{self.centroid}" and box_px is {self.box_px}; state both centroid = '
                '"box" and the size of the box, such as box_px = 5, or neither'
            )
        if self.box_px is not None and (self.box_px % 2 == 0 or self.window_px is not None):
            raise ValueError(
                f"box_px is {self.box_px} and window_px is {self.window_px}; a box has an odd "
                "number of pixels on a side, around the brightest one, and no window"
            )
        return self

    @property
    def is_on(self) -> bool:
        """Whether the spec asks for the rule."""
        return self.psf_sigma_px is not None

    def max_offset_of(self, pixel_arcsec: float) -> float:
        """Return the largest allowed shift of a centroid, arcsec."""
        pixels, angle = self.max_offset_px, self.max_offset_arcsec
        if pixels is None:
            pixels = DEFAULT_OFFSET_PX if angle is None else math.inf
        return min(pixels * pixel_arcsec, math.inf if angle is None else angle)
