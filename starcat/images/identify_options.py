"""Options for the frames of a file: the same for the command, the REST interface and the page."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from starcat.errors import ConfigError
from starcat.failures import validation_message
from starcat.matcher.options import OPTIONS
from starcat.matcher.settings import CERTAIN

# Options that a matcher is opened with; the others are about a file.
MATCHER_OPTIONS = (
    *("method", "tolerance_px", "noise_px", "noise_mag", "max_false_match_probability"),
    *("min_share", "camera_error", "max_steps", "time_limit_s"),
)


def _field(name: str, default: Any = None, **more: Any) -> Any:
    """Return the field of an option of an identification."""
    description, low, high = OPTIONS[name]
    if low > -math.inf:
        more["ge"] = low
    if high < math.inf:
        more["le"] = high
    return Field(default, description=description, **more)


class IdentifyOptions(BaseModel):
    """How frames are identified; each as the option of 'starcat identify' with that name."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    method: str | None = _field("method", max_length=40)
    tolerance_px: float | None = _field("tolerance_px")
    noise_px: float | None = _field("noise_px")
    noise_mag: float | None = _field("noise_mag")
    max_false_match_probability: float = _field("max_false_match_probability", CERTAIN)
    fov_error: float | None = _field("fov_error")
    fov_deg: tuple[float, float] | None = _field("fov_deg")
    size_px: tuple[int, int] | None = _field("size_px")
    min_share: float | None = _field("min_share")
    camera_error: float | None = _field("camera_error")
    max_steps: int | None = _field("max_steps")
    time_limit_s: float | None = _field("time_limit_s")
    flip: bool | None = _field("flip")
    time: str | None = _field("time", max_length=40)
    psf_sigma_px: float | None = _field("psf_sigma_px")
    threshold: float = _field("threshold", 5.0)
    most_spots: int = _field("most_spots", 200)
    plane: int | None = _field("plane")
    bayer: bool = _field("bayer", False)
    camera: str | None = Field(
        None,
        max_length=20_000,
        description="Text of a camera file; the database's by default. Without a size it is of a "
        "camera whose frames have the size of the image, or of the database's camera.",
    )
    prior_q: tuple[float, float, float, float] | None = _field("prior_q")
    prior_error_deg: float | None = _field("prior_error_deg")

    @property
    def is_one_field(self) -> bool:
        """Whether one field of view is stated in place of the camera's, and not a range."""
        return self.fov_deg is not None and self.fov_deg[0] == self.fov_deg[1]

    @property
    def is_range(self) -> bool:
        """Whether a range of fields of view is stated."""
        return self.fov_deg is not None and not self.is_one_field

    @model_validator(mode="after")
    def _go_together(self) -> IdentifyOptions:
        if (self.prior_q is None) != (self.prior_error_deg is None):
            raise ValueError("prior_q and prior_error_deg go together; give both, or neither")
        if self.is_range and self.fov_error is not None:
            raise ValueError("give either fov_deg, a range of fields, or fov_error, not both")
        if self.size_px is not None and self.fov_deg is None:
            raise ValueError("size_px is the size of frames with fov_deg")
        return self


def validated_options(content: Mapping[str, Any]) -> IdentifyOptions:
    """Return options of Python or of the command line; `ConfigError` if a value is refused."""
    try:
        return IdentifyOptions.model_validate(dict(content))
    except ValidationError as error:
        key, problem = validation_message(error, show_input=True)
        raise ConfigError(problem, parameter=key or None) from None
