"""Routers of TAP: queries that are answered at once, and what the service tells of itself."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Literal

from fastapi import APIRouter, Query, Request
from fastapi.responses import Response, StreamingResponse
from starlette.types import Receive, Scope, Send

from starcat.errors import TargetMissing, quoted
from starcat.service.access import Reader
from starcat.service.service import Service, TheService
from starcat.service.vo.tap_request import PREFIX, TapRequest, TapRoute, TheRequest, base_url
from starcat.vo.documents import (
    MEDIA_TYPE,
    availability,
    capabilities,
    table_document,
    tableset,
)
from starcat.vo.examples import examples_page
from starcat.vo.parameters import Question, question
from starcat.vo.tables import full_name

router = APIRouter(prefix=PREFIX, tags=["TAP"], route_class=TapRoute)

_STARTED = datetime.now(UTC)


class _Closing(StreamingResponse):
    """A stream that is let go when it ends, also where the client went away."""

    def __init__(self, first: bytes, rest: Iterator[bytes], media_type: str) -> None:
        def parts() -> Iterator[bytes]:
            yield first
            yield from rest

        super().__init__(parts(), media_type=media_type)
        self._rest = rest

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            close = getattr(self._rest, "close", None)
            if close is not None:
                close()


@router.get("/sync", summary="Answer a query in ADQL")
@router.post("/sync", summary="Answer a query in ADQL, perhaps about uploaded tables")
async def sync(given: TheRequest, service: TheService, who: Reader) -> Response:
    """Answer a query; parameters as TAP 1.1 has them."""
    asked = question(given.parameters, service.settings.max_rows)
    first, rest = await service.sessions.run(_begun, service, asked, given, who.name)
    answer = _Closing(first, rest, asked.form.media_type)
    name = f"result.{asked.form.suffix}"
    answer.headers["Content-Disposition"] = f'inline; filename="{name}"'
    return answer


def _begun(
    service: Service, asked: Question, given: TapRequest, owner: str
) -> tuple[bytes, Iterator[bytes]]:
    """Return the first part of an answer, and what gives the others."""
    with tempfile.TemporaryDirectory(prefix="sync-", dir=service.places.scratch) as folder:
        files = given.keep(Path(folder)) | service.tap.jobs.answers(asked.uploads, owner)
        parts = service.tap.queries.answer(asked, files)
        # What came is read before the first part of the answer is there.
        return next(parts, b""), parts


@router.get("/capabilities", summary="What the service can do (VOSI)")
def get_capabilities(request: Request, service: TheService) -> Response:
    """Return languages, formats and limits."""
    return Response(capabilities(base_url(request), service.tap.limits), media_type=MEDIA_TYPE)


@router.get("/availability", summary="Whether the service answers (VOSI)")
def get_availability() -> Response:
    """Return that the service is there, and since when."""
    return Response(availability(_STARTED), media_type=MEDIA_TYPE)


@router.get("/tables", summary="All tables (VOSI)")
def get_tables(
    service: TheService,
    who: Reader,
    detail: Annotated[Literal["min", "max"], Query(description="min without columns")] = "max",
) -> Response:
    """Return schemas, tables and columns."""
    found = service.tap.tables.state().tables
    return Response(tableset(found, detail == "max"), media_type=MEDIA_TYPE)


@router.get("/tables/{name}", summary="A table (VOSI)")
def get_table(name: str, service: TheService, who: Reader) -> Response:
    """Return a table with its columns."""
    for table in service.tap.tables.state().tables:
        if name.lower() in (full_name(table).lower(), f"{table.schema}.{table.name}".lower()):
            return Response(table_document(table), media_type=MEDIA_TYPE)
    raise TargetMissing(f"no table {quoted(name)}; /tap/tables lists those that there are")


@router.get("/examples", summary="Queries to begin with (DALI)")
def get_examples(service: TheService, who: Reader) -> Response:
    """Return queries that run on the tables that there are."""
    page = examples_page(service.tap.tables.state().tables)
    return Response(page, media_type="application/xhtml+xml")
