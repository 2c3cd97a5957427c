"""Specs in the REST interface: models of requests and answers."""

from __future__ import annotations

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from starcat.geometry import radec_from_directions
from starcat.pipeline import Estimate
from starcat.pipeline.specs import CameraSpec, preset

MAX_FIELDS = 50_000  # largest number of fields that are listed singly


class PresetFacts(BaseModel):
    """A spec that ships with starcat."""

    name: str = Field(examples=["gaia-12deg"])
    version: str = Field(examples=["1.0.0"])
    source: str = Field(description="Its catalog.", examples=["gaia"])
    description: str = Field(description="Purpose.")


class Presets(BaseModel):
    """The specs that ship with starcat, the default first."""

    presets: list[PresetFacts]


class CoverageMap(BaseModel):
    """Guide stars by field: lists of the same length, in the order of the tiling."""

    ra_deg: list[float] = Field(description="Right ascension of the boresight, degrees.")
    dec_deg: list[float] = Field(description="Declination, degrees.")
    stars: list[int] = Field(description="Guide stars in the field.")
    fields: int = Field(description="Fields of the tiling.")
    step: int = Field(description="1, or every how manyth field is listed of a tiling of many.")


class StarterRequest(BaseModel):
    """A camera for which a spec is requested."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "examples": [
                {
                    "name": "mycam",
                    "camera": {
                        "width_px": 1280,
                        "height_px": 960,
                        "focal_length_mm": 25.0,
                        "pixel_um": 5.5,
                    },
                    "faint_limit_mag": 5.8,
                }
            ]
        },
    )

    name: str = Field("mycam", max_length=100, description="Name of the database.")
    camera: CameraSpec
    faint_limit_mag: float | None = Field(
        None, ge=-30.0, le=40.0, description="What the camera sees, Gaia's G; default: enough."
    )
    widest_fov_x_deg: float | None = Field(
        None,
        gt=0.0,
        lt=120.0,
        description="Field that the database is to serve too; the camera is the narrow end.",
    )


def preset_facts(name: str) -> PresetFacts:
    """Return the facts that the interface shows of a preset."""
    spec = preset(name)
    return PresetFacts(
        name=spec.name,
        version=spec.version,
        source=spec.catalog.source,
        description=spec.description,
    )


def coverage_answer(estimate: Estimate) -> CoverageMap:
    """Return the guide stars of each field, or of a sample if there are very many."""
    count = estimate.fields.count
    step = -(-len(count) // MAX_FIELDS)
    ra_deg, dec_deg = radec_from_directions(estimate.fields.boresights[::step])
    return CoverageMap(
        ra_deg=np.round(ra_deg, 4).tolist(),
        dec_deg=np.round(dec_deg, 4).tolist(),
        stars=count[::step].tolist(),
        fields=len(count),
        step=step,
    )
