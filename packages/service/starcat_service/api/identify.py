"""Identification: centroids or an image in, attitude and named stars out."""

from __future__ import annotations

import io
import json
import pathlib
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import asdict, dataclass
from typing import Annotated, Any, BinaryIO, Literal

from fastapi import APIRouter, Path, Query, Request
from fastapi.responses import Response
from pydantic import BaseModel, Field, TypeAdapter, ValidationError
from starlette.datastructures import UploadFile

from starcat.errors import ConfigError
from starcat.failures import validation_message
from starcat.frames.images import IMAGE_SUFFIXES
from starcat.matcher import IdentifyOptions
from starcat_service.access import Reader
from starcat_service.problems import Problem, refusals
from starcat_service.service import Service, TheService
from starcat_service.transfers import (
    body_type,
    copy_within_disk,
    safe_name,
    scratch_folder,
    type_of,
)

router = APIRouter(
    prefix="/identify",
    tags=["identify"],
    responses=refusals({415: "The content is of another type."}),
)

MIB = 2**20
SUFFIXES = (*IMAGE_SUFFIXES, ".csv", ".json")
Kind = Literal["png", "svg"]

_BEGIN_BYTES = 200
"""Bytes of a file that tell whether it has markup."""

DatabaseId = Annotated[
    str, Path(description="Id or title.", examples=["0123456789abcdef", "gaia-12deg-1.0.0"])
]


class Identified(BaseModel):
    """The answers to some frames."""

    database: str = Field(examples=["gaia-12deg-1.0.0"])
    method: str = Field(examples=["triangle"])
    frames: list[dict[str, Any]] = Field(
        description="One per frame, as 'starcat identify --json' prints it: ``status``; if it "
        "is identified ``q_body_from_icrs``, ``boresight_ra_deg``, ``boresight_dec_deg``, "
        "``roll_deg``, ``covariance_arcsec2`` and the names of ``stars``; else ``refusal``."
    )
    notes: list[str] = Field(description="For people.")


def _object(required: str, **properties: Any) -> dict[str, Any]:
    return {"type": "object", "required": [required], "properties": properties}


_VALIDATED = TypeAdapter(IdentifyOptions)  # the dataclass declares the options for pydantic, too
_OPTIONS = _VALIDATED.json_schema()
_CENTROIDS = _object(
    "centroids_px",
    centroids_px={
        "type": "array",
        "items": {"type": "array", "items": {"type": "number"}},
        "description": "Pairs of x to the right and y down, pixels.",
    },
    mag={"type": "array", "items": {"type": ["number", "null"]}},
    sigma_px={
        "type": "array",
        "items": {"type": ["number", "null"]},
        "description": "Noise of each centroid on each axis: the weights of the attitude.",
    },
    name={"type": "string"},
    options=_OPTIONS,
)
_FRAMES = _object("frames", frames={"type": "array", "items": _CENTROIDS}, options=_OPTIONS)
_FILE = _object(
    "file",
    file={
        "type": "string",
        "format": "binary",
        "description": "Centroids (CSV, JSON) or image (FITS, PNG, TIFF, JPEG, HEIC, BMP).",
    },
    options={
        "type": "string",
        "description": "IdentifyOptions as JSON.",
        "example": '{"fov_error": 0.02}',
    },
)
_EXAMPLE = {
    "centroids_px": [[101.2, 33.1], [400.0, 211.9], [88.4, 300.7], [251, 96.6]],
    "mag": [3.1, 4.0, 4.4, 5.2],
    "options": {"tolerance_px": 1.5},
}
BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {
            "application/json": {"schema": {"oneOf": [_CENTROIDS, _FRAMES]}, "example": _EXAMPLE},
            "multipart/form-data": {"schema": _FILE},
        },
    }
}


@router.get("/options", summary="Options")
def options_schema(reader: Reader) -> dict[str, Any]:
    """Return the JSON schema of the options."""
    return _OPTIONS


@router.post("/{database}", summary="Identify frames", openapi_extra=BODY)
async def identify(
    database: DatabaseId, request: Request, service: TheService, reader: Reader
) -> Identified:
    """Identify the stars of frames and find the camera's attitude."""
    async with _sent(request, service.settings.upload_mib) as (frames, options):
        content, _ = await service.sandbox.run(
            identify_upload, service, database, frames, options, None
        )
    return Identified.model_validate(content)


@router.post(
    "/{database}/picture",
    summary="Identify a frame and draw it",
    openapi_extra=BODY,
    response_class=Response,
    responses={
        200: {
            "content": {"image/png": {}, "image/svg+xml": {}},
            "description": "The first frame with its stars circled and named.",
        }
    },
)
async def picture(
    database: DatabaseId,
    request: Request,
    service: TheService,
    reader: Reader,
    kind: Annotated[Kind, Query(alias="format")] = "png",
) -> Response:
    """Return the first frame as a picture with its stars named, or unmarked if none is named."""
    async with _sent(request, service.settings.upload_mib) as (frames, options):
        _, drawn = await service.sandbox.run(
            identify_upload, service, database, frames, options, kind
        )
    return Response(drawn, media_type=type_of(f"picture.{kind}"))


@dataclass(frozen=True)
class FrameUpload:
    """An uploaded file of frames: its name for messages, and its content."""

    name: str
    content: BinaryIO

    @classmethod
    def of_form(cls, upload: UploadFile, most_mib: float) -> FrameUpload:
        """Return the file of a form."""
        if upload.size is None or upload.size > most_mib * MIB:
            raise Problem(413, f"the file is larger than {most_mib:g} MiB; send a smaller one")
        name = safe_name(upload.filename, SUFFIXES, "frame")
        begin = upload.file.read(_BEGIN_BYTES)
        upload.file.seek(0)
        if begin.lstrip(b"\xef\xbb\xbf \t\r\n")[:1] == b"<":
            raise Problem(
                422,
                f"{name}: the file has markup, as SVG and HTML have; send an image "
                f"({', '.join(IMAGE_SUFFIXES)}), or centroids as CSV or JSON",
                key="file",
            )
        return cls(name, upload.file)

    def write_to(self, path: pathlib.Path, service: Service) -> None:
        """Copy the content to a new file."""
        copy_within_disk(self.content, path, service.settings)


@asynccontextmanager
async def _sent(
    request: Request, most_mib: float
) -> AsyncIterator[tuple[FrameUpload, IdentifyOptions]]:
    """Yield the frames and options of a request; the file is closed afterwards."""
    kind = body_type(request)
    if kind == "multipart/form-data":
        async with request.form(max_files=1, max_fields=4) as form:
            upload = form.get("file")
            if not isinstance(upload, UploadFile):
                raise Problem(
                    422, "no file was sent; send centroids or an image as 'file'", key="file"
                )
            frames = FrameUpload.of_form(upload, most_mib)
            yield frames, _options_of(_json(str(form.get("options") or "{}"), "options"))
        return
    if kind != "application/json":
        raise Problem(
            415,
            f"the content is {kind[:60] or 'of no type'!r}; send centroids as application/json, or "
            "a file as multipart/form-data",
        )
    content = _json((await request.body()).decode(errors="replace"), "body")
    if not isinstance(content, dict):
        raise Problem(422, "expected an object with 'centroids_px', or with 'frames'", key="body")
    options = _options_of(content.pop("options", {}))
    # The client did not name the frame: messages use this name.
    yield FrameUpload("frame.json", io.BytesIO(json.dumps(content).encode())), options


def _json(text: str, where: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise Problem(422, f"{where}: not JSON ({str(error)[:200]})", key=where) from None


def _options_of(content: Any) -> IdentifyOptions:
    return checked_options(content, "options", "/api/v1/identify/options lists them")


def checked_options(content: Any, under: str = "", hint: str = "") -> IdentifyOptions:
    """Return the options of a request; ``under`` is the key that contains them."""
    try:
        return _VALIDATED.validate_python(content)
    except ValidationError as error:
        where, message = validation_message(error, show_input=True)
        key = ".".join(filter(None, (under, where)))
        raise ConfigError(message, parameter=key or None, hint=hint) from None


def identify_upload(
    service: Service,
    database: str,
    frames: FrameUpload,
    options: IdentifyOptions,
    kind: Kind | None,
    *,
    for_page: bool = False,
    either_way: bool = False,
) -> tuple[dict[str, Any], bytes]:
    """Identify frames in the sandbox; return the answers and the picture of the first."""
    database_folder = service.library.find(database).folder
    with scratch_folder(service.paths) as folder:
        frames.write_to(folder / frames.name, service)
        arguments = {
            "folder": str(folder),
            "file": frames.name,
            "database": str(database_folder),
            "options": asdict(options),
            "picture": kind,
            "for_page": for_page,
            "either_way": either_way,
        }
        content = service.sandbox.call("identify", arguments)
        drawn = folder / f"picture.{kind}"
        return content, drawn.read_bytes() if drawn.is_file() else b""
