"""What TAP's handlers share: parameters of a request wherever they stand, and errors as VOTable."""

from __future__ import annotations

import shutil
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from fastapi import Depends, Request
from fastapi.responses import Response
from starlette.datastructures import FormData, UploadFile
from starlette.exceptions import HTTPException

from starcat.errors import ConfigError, StarcatError
from starcat.service.problems import Problem, RenderingRoute, as_json, problem_of
from starcat.service.service import Service, service_of
from starcat.service.transfers import body_type
from starcat.vo.documents import VOTABLE_TYPE, error_votable
from starcat.vo.parameters import MAX_UPLOADS, Parameters

PREFIX = "/tap"

MAX_PARAMETERS = 100
MAX_PARAMETER_BYTES = 1 << 20

_FORMS = ("application/x-www-form-urlencoded", "multipart/form-data")

_PARAMETERS: tuple[tuple[str, str, object, str], ...] = (
    ("QUERY", "string", "SELECT TOP 5 * FROM tap_schema.tables", "The query, in ADQL 2.1."),
    ("LANG", "string", "ADQL", "ADQL, ADQL-2.0 or ADQL-2.1."),
    ("RESPONSEFORMAT", "string", "csv", "A format of the capabilities; VOTable by default."),
    ("MAXREC", "integer", 1000, "Rows at most; VOTable says where there were more."),
    ("RUNID", "string", "mine", "What the client calls it."),
    ("UPLOAD", "string", "mine,param:file1", "Tables that come along, as parts of the form."),
)

IN_ADDRESS: dict[str, Any] = {
    "parameters": [
        {
            "name": name,
            "in": "query",
            "required": name == "QUERY",
            "description": told,
            "schema": {"type": kind},
            "example": example,
        }
        for name, kind, example, told in _PARAMETERS
        if name != "UPLOAD"
    ]
}
"""For ``openapi_extra=``: the parameters of TAP in the address."""

FORM: dict[str, Any] = {
    "requestBody": {
        "content": {
            kind: {
                "schema": {
                    "type": "object",
                    "properties": {
                        name: {"type": type_, "description": told, "example": example}
                        for name, type_, example, told in _PARAMETERS
                    },
                }
            }
            for kind in _FORMS
        }
    }
}
"""For ``openapi_extra=``: the parameters of TAP in a form."""


class TapRoute(RenderingRoute):
    """A route whose errors are VOTables, but for those of who may do what."""

    def render(self, error: Exception, request: Request) -> Response:
        """Return an error as TAP has it."""
        problem = problem_of(error)
        is_own = isinstance(error, StarcatError | Problem)
        if not is_own or problem.status in (401, 403):
            return as_json(error)
        headers = getattr(error, "headers", None)
        return Response(error_votable(problem.detail), problem.status, headers, VOTABLE_TYPE)


@dataclass(frozen=True)
class TapRequest:
    """What a request says, in its address and its body."""

    parameters: Parameters
    uploads: dict[str, UploadFile]  # parts of the body that are files, by their names

    def keep(self, folder: Path) -> dict[str, Path]:
        """Copy the files of the request into a folder."""
        kept = {}
        for number, (name, upload) in enumerate(self.uploads.items()):
            kept[name] = folder / f"upload-{number}.vot"
            upload.file.seek(0)
            with kept[name].open("wb") as stream:
                shutil.copyfileobj(upload.file, stream)
        return kept


async def tap_request(request: Request) -> AsyncIterator[TapRequest]:
    """Give what a request says; its files are there while it is answered."""
    service = service_of(request)
    given = list(request.query_params.multi_items())
    kind = body_type(request)
    if request.method != "POST" or not kind:
        yield TapRequest(Parameters(given), {})
        return
    if kind not in _FORMS:
        raise Problem(415, f"the body is {kind[:60]}; send one of {', '.join(_FORMS)}")
    form = await _form(request, service)
    try:
        uploads = {}
        for name, value in form.multi_items():
            if isinstance(value, UploadFile):
                _check_size(value, service)
                uploads[name] = value
            else:
                given.append((name, value))
        yield TapRequest(Parameters(given), uploads)
    finally:
        await form.close()


TheRequest = Annotated[TapRequest, Depends(tap_request)]


async def _form(request: Request, service: Service) -> FormData:
    most = int(service.settings.upload_mib * 2**20)
    stated = request.headers.get("content-length", "0")
    if stated.isdigit() and int(stated) > most + MAX_PARAMETERS * MAX_PARAMETER_BYTES:
        raise Problem(413, f"the request has {int(stated):,} bytes; at most {most:,} are read")
    try:
        return await request.form(
            max_files=MAX_UPLOADS, max_fields=MAX_PARAMETERS, max_part_size=MAX_PARAMETER_BYTES
        )
    except HTTPException as error:
        if error.status_code != 400:  # too large, or too slow
            raise
        raise ConfigError(f"the form cannot be read: {error.detail}") from error


def _check_size(upload: UploadFile, service: Service) -> None:
    most = int(service.settings.upload_mib * 2**20)
    if (upload.size or 0) > most:
        raise Problem(413, f"an upload has {upload.size:,} bytes; at most {most:,} are read")


def base_url(request: Request) -> str:
    """Return the address of TAP as the client sees it."""
    own = service_of(request).settings.public_url or str(request.base_url)
    return own.rstrip("/") + PREFIX
