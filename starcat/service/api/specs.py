"""Specs: their keys, presets, checks, and estimates of what they will give."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Path, Response

from starcat.service.access import Reader
from starcat.service.api.coverage_map import CoverageMap, coverage_answer, coverage_svg
from starcat.service.api.spec_bodies import SPEC_BODY, SpecOfRequest
from starcat.service.api.spec_models import (
    CheckedSpec,
    EstimateAnswer,
    Presets,
    StarterAnswer,
    StarterRequest,
    checked_spec,
    estimate_answer,
    preset_facts,
    starter_answer,
)
from starcat.service.problems import MEDIA_TYPE, ProblemDetails
from starcat.service.service import TheService
from starcat.specs.build_spec import BuildSpec
from starcat.specs.reading import preset, preset_names

router = APIRouter(prefix="/specs", tags=["specs"])

KIND: dict[int | str, dict[str, Any]] = {
    415: {
        "model": ProblemDetails,
        "content": {MEDIA_TYPE: {}},
        "description": "Neither TOML nor JSON.",
    }
}
BUSY: dict[int | str, dict[str, Any]] = {
    503: {
        "model": ProblemDetails,
        "content": {MEDIA_TYPE: {}},
        "description": "A catalog is being read; ``Retry-After`` says when to ask again.",
    },
}
SVG: dict[int | str, dict[str, Any]] = {
    200: {"content": {"image/svg+xml": {"schema": {"type": "string"}}}, "description": "The map."}
}


@router.get("/schema", summary="Keys of a spec")
def schema(reader: Reader) -> dict[str, Any]:
    """Return the keys of a spec as JSON Schema: types, ranges, defaults, meanings, examples."""
    return BuildSpec.model_json_schema()


@router.get("/presets", summary="Presets")
def presets(reader: Reader) -> Presets:
    """Return the specs that ship with starcat, the default first."""
    return Presets(presets=[preset_facts(name) for name in preset_names()])


@router.get("/presets/{name}", summary="A preset")
def one_preset(
    name: Annotated[str, Path(max_length=100, examples=["gaia-12deg"])], reader: Reader
) -> CheckedSpec:
    """Return a spec that ships with starcat: its keys, and the text that explains each."""
    return checked_spec(preset(name))


@router.post("/validate", summary="Check a spec", openapi_extra=SPEC_BODY, responses=KIND)
def validate(spec: SpecOfRequest, reader: Reader) -> CheckedSpec:
    """Check a spec; what is wrong is told in the words of the command line, with the key."""
    return checked_spec(spec)


@router.post(
    "/estimate",
    summary="What a spec will give",
    openapi_extra=SPEC_BODY,
    responses={**KIND, **BUSY},
)
def estimate(spec: SpecOfRequest, service: TheService, reader: Reader) -> EstimateAnswer:
    """Return guide stars, to the last one, and fields, files, time and memory by estimate.

    The first estimate from a catalog waits until it has been read.
    """
    return estimate_answer(service.catalogs.estimate(spec))


@router.post(
    "/coverage",
    summary="Guide stars by field",
    openapi_extra=SPEC_BODY,
    responses={**KIND, **BUSY},
)
def coverage(spec: SpecOfRequest, service: TheService, reader: Reader) -> CoverageMap:
    """Return the guide stars in each field that a spec will give."""
    return coverage_answer(service.catalogs.estimate(spec))


@router.post(
    "/coverage.svg",
    summary="Map of the guide stars by field",
    openapi_extra=SPEC_BODY,
    response_class=Response,
    responses={**KIND, **BUSY, **SVG},
)
def coverage_picture(spec: SpecOfRequest, service: TheService, reader: Reader) -> Response:
    """Return a map of the whole sky; a pointer on a field says where it is and what it has."""
    picture = coverage_svg(service.catalogs.estimate(spec))
    return Response(picture, media_type="image/svg+xml")


@router.post("/starter", summary="A first spec for a camera", responses=BUSY)
def starter(wanted: StarterRequest, service: TheService, reader: Reader) -> StarterAnswer:
    """Return a spec for a camera, as 'starcat init' writes it, from the embedded sky."""
    found = service.catalogs.starter(
        wanted.name, wanted.camera, wanted.faint_limit_mag, wanted.widest_fov_x_deg
    )
    return starter_answer(found)
