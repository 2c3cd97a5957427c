"""Specs: their keys, presets, checks, and estimates of their results.

A request contains a spec as TOML, as JSON, or as a preset with changes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Path, Request, Response
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator

from starcat.errors import ConfigError
from starcat.failures import validation_message
from starcat.pipeline import EstimateFigures, StarterFigures
from starcat.pipeline.specs import (
    BuildSpec,
    CheckedSpec,
    changed,
    preset,
    preset_names,
    spec_from_dict,
)
from starcat.storage import MAX_CHARACTERS, content_of_toml
from starcat_service.access import Reader
from starcat_service.api.spec_models import (
    CoverageMap,
    Presets,
    StarterRequest,
    coverage_answer,
    preset_facts,
)
from starcat_service.problems import Problem, refusals
from starcat_service.sandbox.limiter import WAIT_S
from starcat_service.service import Service, TheService
from starcat_service.transfers import body_type

router = APIRouter(prefix="/specs", tags=["specs"])
ORIGIN = "spec"  # name of the spec of a request in messages
TOML_TYPES = ("application/toml", "text/")

MAX_BODY_BYTES = 4 * MAX_CHARACTERS
"""Limit of a body in bytes: a character of the text can have four bytes."""

MAX_CHANGES = 200

Change = Annotated[str, Field(max_length=2000)]
Key = Annotated[str, Field(min_length=1, max_length=100)]


class GivenSpec(BaseModel):
    """A spec: as TOML, as JSON, or a preset that ships with starcat; optionally with changes."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "examples": [{"preset": "gaia-12deg", "changes": {"selection.faint_limit_mag": "5.5"}}]
        },
    )

    toml: str | None = Field(None, description="The text of a spec.")
    spec: dict[str, Any] | None = Field(None, description="The keys of a spec.")
    preset: str | None = Field(None, description="Name of a preset.", max_length=100)
    changes: dict[Key, Change] = Field(
        {},
        max_length=MAX_CHANGES,
        description="Values by dotted key of the spec; an empty one removes the key.",
    )

    @model_validator(mode="after")
    def _one_of_three(self) -> GivenSpec:
        if [self.toml, self.spec, self.preset].count(None) != 2:
            raise ValueError("give one of toml, spec and preset")
        return self

    def checked(self) -> BuildSpec:
        """Return the spec."""
        if self.preset is not None:
            return preset(self.preset, self.changes)
        content = self.spec if self.toml is None else content_of_toml(self.toml, ORIGIN)
        return spec_from_dict(changed(dict(content or {}), self.changes), ORIGIN)


async def _body_of(request: Request) -> bytes:
    body = bytearray()
    async for part in request.stream():
        body += part
        if len(body) > MAX_BODY_BYTES:
            raise Problem(
                413,
                f"the request has more than {MAX_BODY_BYTES:,} bytes; a spec with every key "
                "explained has 12,000. Leave out everything that is not part of the spec",
            )
    return bytes(body)


def _spec_of(request: Request, body: Annotated[bytes, Depends(_body_of)]) -> BuildSpec:
    """Return the checked spec of a request; runs in a thread of its own."""
    kind = body_type(request)
    if kind.startswith(TOML_TYPES):
        return GivenSpec(toml=_text(body)).checked()
    if kind != "application/json":
        raise Problem(
            415,
            f"the request is of type {kind[:80]!r}; send a spec as application/toml, or as "
            "application/json as /api/openapi.json says",
        )
    try:
        unchecked = GivenSpec.model_validate_json(body)
    except ValidationError as error:
        key, message = validation_message(error)
        where = f"{key}: " if key else ""
        raise ConfigError(
            f"body: {where}{message[:500]}",
            key=key or None,
            hint="give one of toml, spec and preset, and changes if needed",
        ) from error
    return unchecked.checked()


def _text(body: bytes) -> str:
    try:
        return body.decode("utf-8")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{ORIGIN}: not a readable TOML file: {error.reason}") from error


SpecOfRequest = Annotated[BuildSpec, Depends(_spec_of)]  # the spec of a request's body

TOML_EXAMPLE = """\
name = "mycam"
version = "1.0.0"
epoch_jyear = 2016.0
catalog.source = "gaia"
selection.faint_limit_mag = 6.0
camera = { width_px = 1024, height_px = 1024, fov_x_deg = 12.0 }
"""

SPEC_BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "description": "A spec: TOML as it is, or JSON.",
        "content": {
            "application/json": {"schema": GivenSpec.model_json_schema()},
            "application/toml": {"schema": {"type": "string"}, "example": TOML_EXAMPLE},
        },
    }
}
"""``openapi_extra=`` of an operation with `SpecOfRequest`."""

KIND = refusals({415: "Neither TOML nor JSON."})
BUSY = refusals({503: "A catalog is being read; ``Retry-After`` states when to try again."})


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
    return CheckedSpec.of(preset(name))


@router.post("/validate", summary="Check a spec", openapi_extra=SPEC_BODY, responses=KIND)
def validate(spec: SpecOfRequest, reader: Reader) -> CheckedSpec:
    """Check a spec; errors have the words of the command line, and name the key."""
    return CheckedSpec.of(spec)


@router.post(
    "/estimate",
    summary="What a spec will give",
    openapi_extra=SPEC_BODY,
    responses={**KIND, **BUSY},
    response_model=EstimateFigures,
)
async def estimate(spec: SpecOfRequest, service: TheService, reader: Reader) -> Response:
    """Return guide stars, to the last one, and fields, files and memory by estimate.

    The first estimate from a catalog waits until the catalog has been read.
    """
    estimated = await service.catalogs.estimate(spec)
    return await _sent(service, EstimateFigures, lambda: estimated.figures)


@router.post(
    "/coverage",
    summary="Guide stars by field",
    openapi_extra=SPEC_BODY,
    responses={**KIND, **BUSY},
    response_model=CoverageMap,
)
async def coverage(spec: SpecOfRequest, service: TheService, reader: Reader) -> Response:
    """Return the guide stars in each field that a spec will give."""
    estimated = await service.catalogs.estimate(spec)
    return await _sent(service, CoverageMap, lambda: coverage_answer(estimated))


@router.post(
    "/starter", summary="A first spec for a camera", responses=BUSY, response_model=StarterFigures
)
async def starter(request: StarterRequest, service: TheService, reader: Reader) -> Response:
    """Return a spec for a camera, as 'starcat init' writes it, from the embedded sky."""
    first_spec = await service.catalogs.starter(
        request.name, request.camera, request.faint_limit_mag, request.widest_fov_x_deg
    )
    return await _sent(service, StarterFigures, lambda: first_spec.figures)


async def _sent(service: Service, kind: type[Any], make: Callable[[], Any]) -> Response:
    """Answer with a model or a dataclass; a thread makes it and its JSON, not the event loop."""

    def content() -> bytes:
        return TypeAdapter(kind).dump_json(make())

    return Response(await service.designs.run(WAIT_S, content), media_type="application/json")
