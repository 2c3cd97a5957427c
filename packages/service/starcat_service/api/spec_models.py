"""What the REST interface says of specs."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from starcat.geometry import radec_from_directions
from starcat.pipeline import Estimate, LimitRow, Starter, advice
from starcat.products import Spread
from starcat.specs import BuildSpec, CameraSpec, preset, spec_toml

MAX_FIELDS = 50_000  # fields that are listed one by one at the most


class CheckedSpec(BaseModel):
    """A spec that can be built."""

    name: str = Field(examples=["gaia-12deg"])
    version: str = Field(examples=["1.0.0"])
    description: str = Field(description="Purpose.")
    sources: list[str] = Field(description="Catalogs that it reads.", examples=[["gaia"]])
    spec: dict[str, Any] = Field(description="All keys, with those that are as by default.")
    toml: str = Field(description="The same as a file in which every key is explained.")


class PresetFacts(BaseModel):
    """A spec that ships with starcat."""

    name: str = Field(examples=["gaia-12deg"])
    version: str = Field(examples=["1.0.0"])
    source: str = Field(description="Its catalog.", examples=["gaia"])
    description: str = Field(description="Purpose.")


class Presets(BaseModel):
    """The specs that ship with starcat, the default first."""

    presets: list[PresetFacts]


class WorstField(BaseModel):
    """The field with the fewest stars."""

    boresight: int
    ra_deg: float
    dec_deg: float
    stars: int


class FieldFigures(BaseModel):
    """Guide stars in the fields of the tiling."""

    count: int = Field(description="Boresights.")
    stars: Spread
    enough_share: float = Field(description="Share of the fields with at least 4 stars.")
    full_share: float = Field(
        description="Share of fields with ``boresights.brightest`` stars, the number for triangles."
    )
    worst: WorstField


class FilterFigures(BaseModel):
    """What a filter leaves."""

    filter: str = Field(examples=["doubles"])
    stars: int = Field(description="Stars of the whole sky that are left.")


class EstimateAnswer(BaseModel):
    """What a spec will give."""

    guide_stars: int = Field(description="Exact number of guide stars.", examples=[6682])
    fields: FieldFigures
    filters: list[FilterFigures]
    rejected: dict[str, int] = Field(description="All other records, by reason.")
    rows: dict[str, int] = Field(description="Rows of each product that is made from them.")
    files: dict[str, int] = Field(
        description="Bytes of each file; ``report`` is that folder and the manifest."
    )
    total_bytes: int = Field(description="Of all files.")
    memory_bytes: int = Field(description="Most memory that the build will hold.")
    read_seconds: float = Field(description="Time to read the catalogs.")
    build_seconds: float = Field(description="Time of the whole build, on one quiet processor.")
    refusals: list[str] = Field(description="Why the build will be refused; empty if it will not.")
    warnings: list[str] = Field(description="Warnings.")
    in_words: str = Field(description="The line that 'starcat build' prints.")


class CoverageMap(BaseModel):
    """Guide stars by field: lists of the same length, in the order of the tiling."""

    ra_deg: list[float] = Field(description="Right ascension of the boresight, degrees.")
    dec_deg: list[float] = Field(description="Declination, degrees.")
    stars: list[int] = Field(description="Guide stars in the field.")
    fields: int = Field(description="Fields of the tiling.")
    step: int = Field(description="1, or every how manyth field is listed of a tiling of many.")


class StarterRequest(BaseModel):
    """A camera that a spec is wanted for."""

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


class StarterAnswer(BaseModel):
    """A first spec for a camera, as 'starcat init' writes it."""

    checked: CheckedSpec
    limits: list[LimitRow] = Field(description="Its own limit, and some around it.")
    thinned: LimitRow = Field(description="Faintest magnitude left after thinning.")
    advice: list[str] = Field(description="Remarks on the limit.")
    in_words: str = Field(description="Size, memory and time of the build, in one line.")


def checked_spec(spec: BuildSpec) -> CheckedSpec:
    """Return what is said of a spec that was checked."""
    return CheckedSpec(
        name=spec.name,
        version=spec.version,
        description=spec.description,
        sources=list(spec.sources),
        spec=spec.model_dump(mode="json"),
        toml=spec_toml(spec),
    )


def preset_facts(name: str) -> PresetFacts:
    """Return what is said of a preset."""
    spec = preset(name)
    return PresetFacts(
        name=spec.name,
        version=spec.version,
        source=spec.catalog.source,
        description=spec.description,
    )


def estimate_answer(found: Estimate) -> EstimateAnswer:
    """Return what is said of an estimate."""
    cost, coverage = found.cost, found.coverage
    return EstimateAnswer(
        guide_stars=cost.stars,
        fields=FieldFigures(
            count=cost.fields,
            stars=coverage.stars,
            enough_share=round(found.enough_share, 6),
            full_share=round(found.full_share, 6),
            worst=WorstField(
                boresight=coverage.worst_boresight,
                ra_deg=round(coverage.worst_ra_deg, 6),
                dec_deg=round(coverage.worst_dec_deg, 6),
                stars=coverage.stars.minimum,
            ),
        ),
        filters=[FilterFigures(filter=name, stars=stars) for name, stars in found.filters],
        rejected=dict(found.rejected),
        rows=dict(cost.rows),
        files=dict(cost.files),
        total_bytes=found.total_bytes,
        memory_bytes=cost.memory_bytes,
        read_seconds=round(found.read_seconds, 2),
        build_seconds=round(found.build_seconds, 2),
        refusals=list(map(str, found.refusals)),
        warnings=list(found.warnings),
        in_words=cost.in_words,
    )


def starter_answer(starter: Starter) -> StarterAnswer:
    """Return what is said of a first spec."""
    return StarterAnswer(
        checked=checked_spec(starter.spec),
        limits=list(starter.limits),
        thinned=starter.thinned,
        advice=list(advice(starter)),
        in_words=starter.cost.in_words,
    )


def coverage_answer(found: Estimate) -> CoverageMap:
    """Return the guide stars of each field, or of some of very many."""
    count = found.fields.count
    step = -(-len(count) // MAX_FIELDS)
    ra_deg, dec_deg = radec_from_directions(found.fields.boresights[::step])
    return CoverageMap(
        ra_deg=np.round(ra_deg, 4).tolist(),
        dec_deg=np.round(dec_deg, 4).tolist(),
        stars=count[::step].tolist(),
        fields=len(count),
        step=step,
    )
