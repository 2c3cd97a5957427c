"""Options for the frames of a file: the same for the command, the REST interface and the page."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field, model_validator

# Options that a matcher is opened with; the others are about a file.
MATCHER_OPTIONS = (
    *("method", "tolerance_px", "noise_px", "noise_mag", "max_false_match_probability"),
    *("min_share", "max_steps", "time_limit_s"),
)


class IdentifyOptions(BaseModel):
    """How frames are identified; each as the option of 'starcat identify' with that name."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    method: str | None = Field(None, max_length=40, description="By default the best there is.")
    tolerance_px: float | None = Field(
        None, ge=0.01, le=200, description="Largest error of a centroid; by default 2."
    )
    noise_px: float | None = Field(
        None, ge=0.01, le=50, description="Noise of a centroid, each axis; for tolerance_px."
    )
    noise_mag: float | None = Field(None, ge=0.001, le=10, description="Noise of magnitudes.")
    max_false_match_probability: float = Field(
        1e-9, ge=0, le=1, description="Less certain answers are withheld."
    )
    fov_error: float | None = Field(
        None, ge=0, le=0.5, description="Error of the field that is allowed; by default 0.05."
    )
    fov_deg: tuple[float, float] | None = Field(
        None,
        description="Smallest and largest field across the width, of an unknown camera; twice the "
        "same for one field in place of the camera's.",
    )
    size_px: tuple[int, int] | None = Field(
        None, description="Width and height of a frame of centroids; with fov_deg."
    )
    min_share: float | None = Field(
        None, ge=0, le=1, description="Least share of the frame to be explained; a third."
    )
    max_steps: int | None = Field(
        None, ge=1, description="Candidates that the numpy matcher may compare."
    )
    time_limit_s: float | None = Field(None, ge=0.001, description="Seconds that a frame may take.")
    flip: bool | None = Field(None, description="First row at the bottom; y upwards.")
    time: str | None = Field(
        None, max_length=40, description="Time of the frames, UTC: aberration and planets."
    )
    psf_sigma_px: float | None = Field(
        None, ge=0.3, le=20, description="Width of a star in an image; by default measured."
    )
    threshold: float = Field(5.0, ge=1, le=1000, description="Least signal over noise of a spot.")
    # Measured: spots beyond the brightest 200 identify no further picture, and cost time.
    most_spots: int = Field(200, ge=4, le=10_000, description="Brightest spots that are used.")
    plane: int | None = Field(None, ge=0, description="Plane of a FITS cube, from 0.")
    bayer: bool = Field(False, description="The image is a raw colour mosaic.")
    camera: str | None = Field(
        None,
        max_length=20_000,
        description="Text of a camera file; the database's by default. Without a size it is of a "
        "camera whose frames have the size of the image, or of the database's camera.",
    )
    prior_q: tuple[float, float, float, float] | None = Field(
        None, description="Expected attitude; with prior_error_deg."
    )
    prior_error_deg: float | None = Field(
        None, gt=0, le=20, description="Largest error of prior_q."
    )

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
