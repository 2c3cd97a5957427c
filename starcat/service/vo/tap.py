"""Routers of TAP: queries that are answered at once, and what the service tells of itself."""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Generator, Iterator
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path
from tempfile import TemporaryFile
from typing import Annotated, Literal

from anyio import CancelScope, to_thread
from fastapi import APIRouter, Query, Request
from fastapi.responses import Response, StreamingResponse
from starlette.types import Receive, Scope, Send

from starcat.errors import TargetMissing, quoted
from starcat.service.access import Reader
from starcat.service.service import Service, TheService
from starcat.service.vo.tap_request import (
    FORM,
    IN_ADDRESS,
    PREFIX,
    TapRequest,
    TapRoute,
    TheRequest,
    base_url,
)
from starcat.vo.documents import (
    MEDIA_TYPE,
    availability,
    capabilities,
    examples_page,
    for_tap_plus,
    table_document,
    tableset,
)
from starcat.vo.parameters import Question, question

router = APIRouter(prefix=PREFIX, tags=["TAP"], route_class=TapRoute)

_STARTED = datetime.now(UTC)


READ_BYTES = 1 << 18

LOOK_S = 1.0
"""How often a reader that waits looks whether the answer has ended."""


class ClientGone(Exception):  # noqa: N818 - the name reads as the fact
    """Nobody waits for the answer any more."""


class Spool:
    """An answer on its way: made as fast as the query gives it, sent as fast as the client reads.

    What is not taken yet waits in a file, so a client that reads slowly keeps no query from being
    answered.
    """

    def __init__(
        self, parts: Generator[bytes, None, None], scratch: Path, gone: threading.Event
    ) -> None:
        self._parts = parts
        self._gone = gone
        self._written = 0
        self._is_done = False
        self._error: BaseException | None = None
        self._changed = threading.Condition()
        self._file = TemporaryFile(dir=scratch)  # noqa: SIM115 - closed by `close`
        self._thread = threading.Thread(target=self._make, name="tap-answer", daemon=True)
        self._thread.start()

    def __iter__(self) -> Iterator[bytes]:
        """Give the bytes in order; what failed is raised behind the last that were made."""
        at = 0
        while True:
            with self._changed:
                while self._written == at and not self._is_done:
                    self._changed.wait(LOOK_S)
                if self._written == at:
                    if self._error is not None:
                        raise self._error
                    return
                self._file.seek(at)
                part = self._file.read(min(READ_BYTES, self._written - at))
            at += len(part)
            yield part

    def close(self) -> None:
        """End the making, and forget what was made."""
        self._gone.set()
        self._thread.join()
        self._file.close()

    def _make(self) -> None:
        try:
            for part in self._parts:
                if self._gone.is_set():
                    break
                with self._changed:
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
    """A stream that is let go when it ends, also where the client went away."""

    def __init__(self, first: bytes, rest: Spool, media_type: str) -> None:
        super().__init__(chain([first], rest), media_type=media_type)
        self._rest = rest

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            with CancelScope(shield=True):
                await to_thread.run_sync(self._rest.close)


@router.get("/sync", summary="Answer a query in ADQL", openapi_extra=IN_ADDRESS)
@router.post(
    "/sync", summary="Answer a query in ADQL, perhaps about uploaded tables", openapi_extra=FORM
)
async def sync(given: TheRequest, service: TheService, who: Reader) -> Response:
    """Answer a query; parameters as TAP 1.1 has them."""
    asked = question(given.parameters, service.settings.max_rows)
    first, rest = await service.query_pool.run(_begun, service, asked, given, who.name)
    answer = _Closing(first, rest, asked.form.tap_type)
    name = f"result{asked.form.suffix}"
    answer.headers["Content-Disposition"] = f'inline; filename="{name}"'
    return answer


def _begun(service: Service, asked: Question, given: TapRequest, owner: str) -> tuple[bytes, Spool]:
    """Return the first part of an answer, and what gives the others."""
    gone = threading.Event()

    def watch(*_: object) -> None:
        if gone.is_set():
            raise ClientGone

    scratch = service.paths.scratch
    with tempfile.TemporaryDirectory(prefix="sync-", dir=scratch) as folder:
        files = given.keep(Path(folder)) | service.tap.jobs.answers(asked.uploads, owner)
        parts = service.tap.queries.answer(asked, files, progress=watch)
        # What came is read before the first part of the answer is there.
        first = next(parts, b"")
    return first, Spool(parts, scratch, gone)


@router.get("/capabilities", summary="What the service can do (VOSI)")
def get_capabilities(request: Request, service: TheService) -> Response:
    """Return languages, formats and limits."""
    return Response(capabilities(base_url(request), service.tap.limits), media_type=MEDIA_TYPE)


@router.get("/availability", summary="Whether the service answers (VOSI)")
def get_availability() -> Response:
    """Return that the service is there, and since when."""
    return Response(availability(_STARTED), media_type=MEDIA_TYPE)


TAP_PLUS = ("tables", "only_tables", "share_accessible")
"""Parameters that TapPlus of astroquery asks for tables with, beside those of VOSI."""


@router.get("/tables", summary="All tables (VOSI)")
def get_tables(
    request: Request,
    service: TheService,
    who: Reader,
    detail: Annotated[Literal["min", "max"], Query(description="min without columns")] = "max",
) -> Response:
    """Return schemas, tables and columns."""
    given = request.query_params
    found = service.tap.tables.state().tables
    if "tables" in given:
        found = found.chosen(given["tables"].split(","))
    content = tableset(found, detail == "max" and given.get("only_tables") != "true")
    # TapPlus is the one client that does not say its name.
    if any(name in given for name in TAP_PLUS) or "user-agent" not in request.headers:
        content = for_tap_plus(content)
    return Response(content, headers={"Vary": "User-Agent"}, media_type=MEDIA_TYPE)


@router.get("/tables/{name}", summary="A table (VOSI)")
def get_table(name: str, service: TheService, who: Reader) -> Response:
    """Return a table with its columns."""
    for table in service.tap.tables.state().tables.chosen([name]):
        return Response(table_document(table), media_type=MEDIA_TYPE)
    raise TargetMissing(f"no table {quoted(name)}; /tap/tables lists those that there are")


@router.get("/examples", summary="Queries to begin with (DALI)")
def get_examples(service: TheService, who: Reader) -> Response:
    """Return queries that run on the tables that there are."""
    page = examples_page(service.tap.tables.state().tables)
    return Response(page, media_type="application/xhtml+xml")
