"""Simple cone searches of databases and of catalogs that were read."""

from __future__ import annotations

import re
from pathlib import Path
from tempfile import SpooledTemporaryFile

from fastapi import APIRouter, Request
from fastapi.responses import Response, StreamingResponse

from starcat.catalog.store import is_store
from starcat.errors import QueryLimitError, TargetMissing
from starcat.ship.exchange import Label, error_document
from starcat_service.access import Reader
from starcat_service.problems import ProblemDetails
from starcat_service.protocols.cone import (
    MEDIA_TYPE,
    ConeRequest,
    cone_query,
    cone_request,
    star_view,
    with_ucds,
)
from starcat_service.service import Service, TheService
from starcat_service.transfers import file_chunks
from starcat_service.vo.tap import HELD_BYTES, VOTableRoute, in_address


class ConeRoute(VOTableRoute):
    """A route with errors in the format of cone searches; a wrong parameter is a bad request."""

    def votable(self, error: Exception, problem: ProblemDetails) -> Response:
        """Return an error in the format of cone searches."""
        is_bad = problem.status == 422 and not isinstance(error, QueryLimitError)
        return Response(error_document(problem.detail), 400 if is_bad else problem.status, _VOTABLE)


router = APIRouter(prefix="/scs", tags=["cone search"], route_class=ConeRoute)

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,99}(\.[A-Za-z0-9_-]{1,99}){0,9}")
_OF_A_JOB = re.compile(r"-[0-9a-f]{16}(\.parquet)?$")
_VOTABLE = {"Content-Type": MEDIA_TYPE}
_STARS = "stars.parquet"
_PARAMETERS = (
    ("RA", "number", 83.6, "Right ascension of the centre, ICRS, decimal degrees."),
    ("DEC", "number", -5.4, "Declination of the centre, ICRS, decimal degrees."),
    ("SR", "number", 1.0, "Radius in degrees; 0 asks for the columns only."),
    ("VERB", "integer", 2, "1: identity and place; 2: columns with a UCD; 3: all."),
    ("MAXREC", "integer", 1000, "Rows at most."),
    ("RESPONSEFORMAT", "string", "text/xml", "A format of TAP; VOTable by default."),
)


@router.get(
    "/{catalog:path}",
    summary="Stars in a circle (Simple Cone Search 1.03)",
    response_class=Response,
    responses={
        200: {"content": {MEDIA_TYPE: {}}, "description": "The stars, nearest first."},
        **{
            status: {"content": {MEDIA_TYPE: {}}, "description": text}
            for status, text in (
                (400, "A VOTable with an INFO named Error."),
                (404, "The same: there is no such database or catalog."),
                (503, "The same: the service is busy."),
            )
        },
    },
    openapi_extra=in_address(_PARAMETERS, ["RA", "DEC", "SR"]),
)
async def search(catalog: str, request: Request, service: TheService, reader: Reader) -> Response:
    """Find the stars within a radius of a position.

    The catalog is the id or the name of a database, with its version or without (then the newest is
    used), or the name of a catalog that was read.
    """
    asked = cone_request(request.query_params.multi_items())
    file = await service.query_pool.run(_answer, service, catalog, asked)
    return StreamingResponse(file_chunks(file), headers={"Content-Type": asked.media_type})


def _target_of(service: Service, name: str) -> tuple[Path, Label]:
    named = [
        database
        for database in service.library.databases()
        if name in (database.id, database.name, database.title)
    ]
    if named:
        newest = named[-1]
        return newest.folder, Label("stars", newest.name, newest.version)
    if _NAME.fullmatch(name):
        for path in _catalog_paths(service.paths.catalogs, name):
            if path.is_file() or (path.is_dir() and is_store(path)):
                return path, Label(name)
    raise TargetMissing(
        f"no database and no catalog is called {name[:80]!r}",
        hint="/api/v1/databases lists the databases",
    )


def _catalog_paths(folder: Path, name: str) -> list[Path]:
    """Return possible files of a catalog that was read: with its name, or with names of jobs."""
    of_name = folder / name
    of_jobs = [path for path in folder.glob(f"{name}-*") if _OF_A_JOB.match(path.name, len(name))]
    newest_first = sorted(of_jobs, key=lambda path: (-path.stat().st_mtime_ns, path.name))
    return [of_name / _STARS, folder / f"{name}.parquet", of_name, *newest_first]


def _answer(service: Service, name: str, asked: ConeRequest) -> SpooledTemporaryFile[bytes]:
    """Return the whole answer, so that a slow client does not keep the session occupied."""
    folder, label = _target_of(service, name)
    max_rows = service.settings.max_rows
    maxrec = max_rows if asked.maxrec is None else min(asked.maxrec, max_rows)
    with service.query_pool.session([folder]) as session:
        view = star_view(session)
        with session.ask(cone_query(view, asked, maxrec)) as running:
            rows = with_ucds(running.batches(), view)
            chunks = service.tap.chunks(rows, asked.form, maxrec, label)
            file: SpooledTemporaryFile[bytes]
            file = SpooledTemporaryFile(HELD_BYTES, dir=str(service.paths.scratch))  # noqa: SIM115
            try:
                file.writelines(chunks)
            except BaseException:
                file.close()
                raise
    file.seek(0)
    return file
