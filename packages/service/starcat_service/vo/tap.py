"""TAP: queries that are answered at once, and the documents about the service.

It also has the code that its handlers share: parameters of a request from all of its parts, and
errors as VOTable.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import AsyncIterator, Generator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from tempfile import SpooledTemporaryFile
from typing import Annotated, Any, Literal

from anyio import CancelScope
from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import Response, StreamingResponse
from starlette.datastructures import FormData, UploadFile
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.types import Receive, Scope, Send

from starcat.errors import ConfigError, StarcatError, TargetMissing, quoted
from starcat_service.access import Reader
from starcat_service.paths import ServicePaths
from starcat_service.problems import Problem, ProblemDetails, RenderingRoute, as_json, problem_of
from starcat_service.protocols.documents import (
    MEDIA_TYPE,
    VOTABLE_TYPE,
    availability,
    capabilities,
    error_votable,
    examples_page,
    for_tap_plus,
    table_document,
    tableset,
)
from starcat_service.protocols.parameters import MAX_UPLOADS, Parameters, TapQuestion, question
from starcat_service.sandbox.limiter import asker, in_thread
from starcat_service.security.request_limits import room_for
from starcat_service.service import Service, TheService, service_of
from starcat_service.settings import ServiceSettings
from starcat_service.transfers import body_type, copy_within_disk, scratch_folder

PREFIX = "/tap"

MAX_PARAMETERS = 100
MAX_PARAMETER_BYTES = 1 << 20

READ_BYTES = 1 << 18

HELD_BYTES = 4 << 20
"""Memory limit of an answer; a larger answer is kept in an unnamed file."""

LOOK_S = 1.0
"""Seconds between two checks of a waiting reader whether the answer has ended."""

TAP_PLUS = ("tables", "only_tables", "share_accessible")
"""Parameters with which TapPlus of astroquery requests tables, in addition to VOSI's."""

_logger = logging.getLogger(__name__)

_STARTED = datetime.now(UTC)

_FORMS = ("application/x-www-form-urlencoded", "multipart/form-data")

_PARAMETERS: tuple[tuple[str, str, object, str], ...] = (
    ("QUERY", "string", "SELECT TOP 5 * FROM tap_schema.tables", "The query, in ADQL 2.1."),
    ("LANG", "string", "ADQL", "ADQL, ADQL-2.0 or ADQL-2.1."),
    ("RESPONSEFORMAT", "string", "csv", "A format of the capabilities; VOTable by default."),
    ("MAXREC", "integer", 1000, "Rows at most; a VOTable states if there were more."),
    ("RUNID", "string", "mine", "The client's name for the query."),
    ("UPLOAD", "string", "mine,param:file1", "Tables to upload, as parts of the form."),
)

FORM: dict[str, Any] = {
    "requestBody": {
        "content": {
            kind: {
                "schema": {
                    "type": "object",
                    "properties": {
                        name: {"type": type_, "description": description, "example": example}
                        for name, type_, example, description in _PARAMETERS
                    },
                }
            }
            for kind in _FORMS
        }
    }
}
"""For ``openapi_extra=``: the parameters of TAP in a form."""


def in_address(
    parameters: Sequence[tuple[str, str, object, str]], required: Sequence[str]
) -> dict[str, Any]:
    """Return for ``openapi_extra=`` the parameters that a handler takes from the address itself.

    Each has a name, a type, an example and a description.
    """
    return {
        "parameters": [
            {
                "name": name,
                "in": "query",
                "required": name in required,
                "description": description,
                "schema": {"type": kind},
                "example": example,
            }
            for name, kind, example, description in parameters
        ]
    }


class VOTableRoute(RenderingRoute):
    """A route whose errors are VOTables, except errors of authentication and permission."""

    def render(self, error: Exception, request: Request) -> Response:
        """Return an error in the format of the protocol."""
        problem = problem_of(error)
        if not isinstance(error, StarcatError | Problem) or problem.status in (401, 403):
            return as_json(error)
        answer = self.votable(error, problem)
        answer.headers.update(getattr(error, "headers", {}))
        return answer

    def votable(self, error: Exception, problem: ProblemDetails) -> Response:
        """Return an error in the format of TAP."""
        return Response(error_votable(problem.detail), problem.status, media_type=VOTABLE_TYPE)


@dataclass(frozen=True)
class TapRequest:
    """The parameters of a request, from its address and its body."""

    parameters: Parameters
    uploads: dict[str, UploadFile]  # parts of the body that are files, by their names

    @property
    def upload_bytes(self) -> int:
        """Size of its files."""
        return sum(upload.size or 0 for upload in self.uploads.values())

    def keep(self, folder: Path, settings: ServiceSettings) -> dict[str, Path]:
        """Copy the files of the request into a folder."""
        kept = {}
        for number, (name, upload) in enumerate(self.uploads.items()):
            kept[name] = folder / f"upload-{number}.vot"
            upload.file.seek(0)
            copy_within_disk(upload.file, kept[name], settings)
        return kept


async def tap_request(request: Request) -> AsyncIterator[TapRequest]:
    """Yield the parameters of a request; its files exist while it is answered."""
    pairs = list(request.query_params.multi_items())
    kind = body_type(request)
    if request.method != "POST" or not kind:
        yield TapRequest(Parameters(pairs), {})
        return
    if kind not in _FORMS:
        raise Problem(415, f"the body is {kind[:60]}; send one of {', '.join(_FORMS)}")
    form = await _form(request)
    try:
        pairs += [(name, value) for name, value in form.multi_items() if isinstance(value, str)]
        uploads = {name: value for name, value in form.items() if isinstance(value, UploadFile)}
        yield TapRequest(Parameters(pairs), uploads)
    finally:
        await form.close()


TheRequest = Annotated[TapRequest, Depends(tap_request)]


async def _form(request: Request) -> FormData:
    try:
        return await request.form(
            max_files=MAX_UPLOADS, max_fields=MAX_PARAMETERS, max_part_size=MAX_PARAMETER_BYTES
        )
    except HTTPException as error:
        if error.status_code != 400:  # too large, or too slow
            raise
        raise ConfigError(f"the form cannot be read: {error.detail}") from error


def base_url(request: Request) -> str:
    """Return the address of TAP as the client sees it."""
    url = service_of(request).settings.public_url or str(request.base_url)
    return url.rstrip("/") + PREFIX


router = APIRouter(prefix=PREFIX, tags=["TAP"], route_class=VOTableRoute)


class ClientGone(Exception):  # noqa: N818 - the name reads as the fact
    """The client does not wait for the answer any more."""


class Spool:
    """An answer in transfer: made as fast as the query delivers, sent as fast as the client reads.

    Data that the client has not read yet waits in a file, so that a slow client does not keep the
    query running.
    """

    def __init__(
        self, parts: Generator[bytes, None, None], settings: ServiceSettings, gone: threading.Event
    ) -> None:
        self._parts = parts
        self._settings = settings
        self._gone = gone
        self._written = 0
        self._is_done = False
        self._error: BaseException | None = None
        self._changed = threading.Condition()
        # Closed by `close`. Short answers stay in memory: a busy disk does not delay them.
        self._file: SpooledTemporaryFile[bytes]
        self._file = SpooledTemporaryFile(HELD_BYTES, dir=str(ServicePaths(settings.root).scratch))  # noqa: SIM115
        self._thread = threading.Thread(target=self._make, name="tap-answer", daemon=True)
        self._thread.start()

    async def parts(self) -> AsyncIterator[bytes]:
        """Yield the bytes in order; raise an error of the query after the last bytes."""
        at = 0
        while part := await in_thread(partial(self.part, at)):
            at += len(part)
            yield part

    def part(self, at: int) -> bytes:
        """Wait for the bytes at a position and return some; none at the end."""
        with self._changed:
            while self._written == at and not self._is_done:
                self._changed.wait(LOOK_S)
            if self._written > at:
                self._file.seek(at)
                return self._file.read(min(READ_BYTES, self._written - at))
            if self._error is not None:
                raise self._error
            return b""

    def close(self) -> None:
        """Stop making the answer, and delete its file."""
        self._gone.set()
        self._thread.join()
        self._file.close()

    def _make(self) -> None:
        try:
            for part in self._parts:
                if self._gone.is_set():
                    break
                is_on_disk = self._written + len(part) > HELD_BYTES
                room = room_for(self._settings, len(part)) if is_on_disk else nullcontext()
                with room, self._changed:
                    self._file.seek(self._written)
                    self._file.write(part)
                    self._written += len(part)
                    self._changed.notify_all()
        except BaseException as error:
            self._error = error
        finally:
            self._parts.close()
            with self._changed:
                self._is_done = True
                self._changed.notify_all()


class _Closing(StreamingResponse):
    """A stream that is closed when it ends, also if the client has gone."""

    def __init__(self, first: bytes, rest: Spool, media_type: str) -> None:
        super().__init__(_joined(first, rest), media_type=media_type)
        self._rest = rest

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            with CancelScope(shield=True):
                await in_thread(self._rest.close)


async def _joined(first: bytes, rest: Spool) -> AsyncIterator[bytes]:
    yield first
    try:
        async for part in rest.parts():
            yield part
    except (StarcatError, Problem) as error:  # the answer has begun: it can only be broken off
        _logger.warning("an answer was broken off: %s", error)
        raise ClientDisconnect from error


@router.get(  # an upload needs a form
    "/sync", summary="Answer a query in ADQL", openapi_extra=in_address(_PARAMETERS[:-1], ["QUERY"])
)
@router.post(
    "/sync", summary="Answer a query in ADQL, perhaps about uploaded tables", openapi_extra=FORM
)
async def sync(query_request: TheRequest, service: TheService, who: Reader) -> Response:
    """Answer a query; parameters as TAP 1.1 has them."""
    asked = question(query_request.parameters, service.settings.max_rows)
    first, rest = await service.query_pool.run(_begun, service, asked, query_request, who.name)
    answer = _Closing(first, rest, asked.form.tap_type)
    name = f"result{asked.form.suffix}"
    answer.headers["Content-Disposition"] = f'inline; filename="{name}"'
    return answer


def _begun(
    service: Service, asked: TapQuestion, query_request: TapRequest, owner: str
) -> tuple[bytes, Spool]:
    """Return the first part of an answer, and the spool of the other parts."""
    gone = threading.Event()

    def watch(*_: object) -> None:
        if gone.is_set():
            raise ClientGone

    with scratch_folder(service.paths) if query_request.uploads else nullcontext() as folder:
        files = query_request.keep(folder, service.settings) if folder else {}
        files |= service.query_jobs.answers(asked.uploads, owner, asker.get())
        parts = service.tap.answer(asked, files, progress=watch)
        # Parameters and uploads have been read before the first part of the answer exists.
        first = next(parts, b"")
    return first, Spool(parts, service.settings, gone)


@router.get("/capabilities", summary="What the service can do (VOSI)")
def get_capabilities(request: Request, service: TheService) -> Response:
    """Return languages, formats and limits."""
    return Response(capabilities(base_url(request), service.tap.limits), media_type=MEDIA_TYPE)


@router.get("/availability", summary="Whether the service answers (VOSI)")
def get_availability() -> Response:
    """Return that the service is available, and since when."""
    return Response(availability(_STARTED), media_type=MEDIA_TYPE)


@router.get("/tables", summary="All tables (VOSI)")
async def get_tables(
    request: Request,
    service: TheService,
    who: Reader,
    detail: Annotated[Literal["min", "max"], Query(description="min without columns")] = "max",
) -> Response:
    """Return schemas, tables and columns."""
    query = request.query_params
    has_columns = detail == "max" and query.get("only_tables") != "true"

    def document() -> bytes:
        tables = service.tap.state().tables
        selected = tables.subset(query["tables"].split(",")) if "tables" in query else tables
        return tableset(selected, has_columns)

    content = await service.query_pool.run(document)
    # TapPlus is the only client that does not send its name.
    if any(name in query for name in TAP_PLUS) or "user-agent" not in request.headers:
        content = for_tap_plus(content)
    return Response(content, headers={"Vary": "User-Agent"}, media_type=MEDIA_TYPE)


@router.get("/tables/{name}", summary="A table (VOSI)")
async def get_table(name: str, service: TheService, who: Reader) -> Response:
    """Return a table with its columns."""
    state = await service.query_pool.run(service.tap.state)
    for table in state.tables.subset([name]):
        return Response(table_document(table), media_type=MEDIA_TYPE)
    raise TargetMissing(f"no table {quoted(name)}", hint="/tap/tables lists all tables")


@router.get("/examples", summary="Queries to begin with (DALI)")
async def get_examples(service: TheService, who: Reader) -> Response:
    """Return queries that run on the existing tables."""
    page = examples_page((await service.query_pool.run(service.tap.state)).tables)
    return Response(page, media_type="application/xhtml+xml")
