"""Frames to answers, in a process of the sandbox that keeps the databases open."""

from __future__ import annotations

import os
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

if TYPE_CHECKING:
    from starcat.images.identification import MeasuredFile
    from starcat.matcher.matcher import Matcher

CAMERA_NAME = "camera.toml"
MATCHERS = 4
"""Databases that are kept open with what was asked of them."""


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
        None, ge=0, le=0.5, description="Error of the field that is allowed; 0.02 for images."
    )
    fov_deg: tuple[float, float] | None = Field(
        None, description="Smallest and largest field across the width, of an unknown camera."
    )
    size_px: tuple[int, int] | None = Field(
        None, description="Width and height of a frame of centroids; with fov_deg."
    )
    min_share: float | None = Field(
        None, ge=0, le=1, description="Least share of the frame to be explained; a third."
    )
    max_steps: int | None = Field(None, ge=1, description="Steps of a search.")
    time_limit_s: float | None = Field(None, ge=0.001, description="Seconds that a frame may take.")
    flip: bool | None = Field(None, description="First row at the bottom; y upwards.")
    psf_sigma_px: float | None = Field(
        None, ge=0.3, le=20, description="Width of a star in an image; by default measured."
    )
    threshold: float = Field(5.0, ge=1, le=1000, description="Least signal over noise of a spot.")
    most_spots: int = Field(200, ge=4, le=10_000, description="Brightest spots that are used.")
    plane: int | None = Field(None, ge=0, description="Plane of a FITS cube, from 0.")
    bayer: bool = Field(False, description="The image is a raw colour mosaic.")
    camera: str | None = Field(
        None, max_length=20_000, description="Text of a camera file; the database's by default."
    )
    prior_q: tuple[float, float, float, float] | None = Field(
        None, description="Expected attitude; with prior_error_deg."
    )
    prior_error_deg: float | None = Field(
        None, gt=0, le=20, description="Largest error of prior_q."
    )

    @model_validator(mode="after")
    def _go_together(self) -> IdentifyOptions:
        if (self.prior_q is None) != (self.prior_error_deg is None):
            raise ValueError("prior_q and prior_error_deg go together; give both, or neither")
        if self.fov_deg is not None and self.fov_error is not None:
            raise ValueError("give either fov_deg, a range of fields, or fov_error, not both")
        if self.size_px is not None and self.fov_deg is None:
            raise ValueError("size_px is the size of frames with fov_deg")
        return self


def identify(
    folder: str,
    file: str,
    artifact: str,
    options: dict[str, Any],
    picture: Literal["png", "svg"] | None = None,
) -> dict[str, Any]:
    """Identify the frames of a file."""
    from starcat.images.answering import answer_each, camera_of_size, write_extras
    from starcat.images.identification import PictureOptions, measure
    from starcat.matcher.answer_json import answer_content
    from starcat.matcher.centroids import said_of_columns
    from starcat.specs.camera_file import read_camera

    os.chdir(folder)  # so that messages say the name of the file alone
    how = IdentifyOptions.model_validate(options)
    matcher = _matcher(artifact, how)
    eye = read_camera(Path(CAMERA_NAME)) if how.camera else matcher.database.camera
    spots = PictureOptions(
        how.threshold, how.psf_sigma_px, how.most_spots, how.plane, is_mosaic=how.bayer
    )
    measured = measure(Path(file), flip=how.flip, options=spots)
    if how.fov_deg is not None:
        eye = camera_of_size(measured, how.size_px, eye)
    near = None
    if how.prior_q is not None and how.prior_error_deg is not None:
        near = list(how.prior_q), how.prior_error_deg
    answered = list(
        answer_each(
            *(matcher, measured, eye),
            flip=how.flip, fov_error=how.fov_error, near=near, fov_deg=how.fov_deg,
        )
    )  # fmt: skip
    if picture is not None and answered:
        path = Path(f"picture.{picture}")
        write_extras(Path(file), measured, *answered[0], eye, picture=path, flip=how.flip)
    unknown = said_of_columns([frame for frame, _ in answered[:1]])
    is_any = any(result.ok for _, result in answered)
    return {
        "database": matcher.database.name,
        "method": matcher.method,
        "frames": [answer_content(frame, result) for frame, result in answered],
        "notes": [*([unknown] if unknown else []), *_notes(measured, is_any)],
    }


def _notes(measured: MeasuredFile, is_identified: bool) -> list[str]:
    if measured.image is None or is_identified:
        return []
    return ["An image that was read upside down is never identified: try flip."]


@lru_cache(maxsize=MATCHERS)
def _opened(artifact: str, how: IdentifyOptions) -> Matcher:
    from starcat.matcher.matcher import Matcher

    limits = {
        name: value
        for name in ("min_share", "max_steps", "time_limit_s")
        if (value := getattr(how, name)) is not None
    }
    return Matcher.open(
        artifact,
        how.method,
        tolerance_px=how.tolerance_px,
        max_false_match_probability=how.max_false_match_probability,
        noise_px=how.noise_px,
        noise_mag=how.noise_mag,
        **limits,
    )


def _matcher(artifact: str, how: IdentifyOptions) -> Matcher:
    """Return the matcher of a database; what is not about it does not open another."""
    mine = ("method", "tolerance_px", "max_false_match_probability", "noise_px", "noise_mag")
    limits = ("min_share", "max_steps", "time_limit_s")
    return _opened(artifact, IdentifyOptions(**how.model_dump(include={*mine, *limits})))
