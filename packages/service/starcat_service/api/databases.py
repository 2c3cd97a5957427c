"""Databases: their list, their contents, their files."""

from __future__ import annotations

import json
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Query, Request
from fastapi import Path as PathParameter
from fastapi.responses import JSONResponse, Response, StreamingResponse
from pydantic import BaseModel, Field

from starcat import diff
from starcat.database import MANIFEST_NAME, Difference
from starcat.errors import ProductError, TargetMissing
from starcat.pipeline.report import Fields
from starcat.results import to_dict
from starcat.ship.releases import Blob
from starcat_service.access import Builder, Reader
from starcat_service.library import ListedDatabase
from starcat_service.problems import Problem
from starcat_service.removal import remove_database
from starcat_service.service import Service, TheService
from starcat_service.transfers import (
    FILE,
    REVALIDATED,
    LinkedFolder,
    archive_bytes,
    archive_chunks,
    file_answer,
    has_already,
    type_of,
)

router = APIRouter(prefix="/databases", tags=["databases"])

DatabaseId = Annotated[
    str, PathParameter(description="Sixteen hexadecimal digits.", examples=["0123456789abcdef"])
]

REPORT, COVERAGE, FIELDS = "report/report.json", "report/coverage.json", "report/coverage.csv"

SAME: dict[int | str, dict[str, Any]] = {304: FILE[304]}


class Databases(BaseModel):
    """All databases there are."""

    databases: list[ListedDatabase]


class DatabaseFile(BaseModel):
    """A file of a database."""

    path: str = Field(description="Within its folder.", examples=["stars.parquet"])
    bytes: int = Field(description="Size.")
    sha256: str = Field(description="Digest of the content; also its ETag.")
    content_type: str = Field(examples=["application/vnd.apache.parquet"])


class CoverageFields(BaseModel):
    """Stars, pairs and triangles by field: lists of the same length."""

    boresight: list[int] = Field(description="Number of the boresight.")
    ra_deg: list[float] = Field(description="Right ascension of the boresight, degrees.")
    dec_deg: list[float] = Field(description="Declination, degrees.")
    stars: list[int]
    pairs: list[int]
    triangles: list[int]


class CoverageAnswer(BaseModel):
    """Number of stars, pairs and triangles in the fields of a database."""

    summary: dict[str, Any] = Field(description="As 'starcat coverage --json' prints it.")
    fields: CoverageFields


@router.get("", summary="All databases")
def all_databases(service: TheService, reader: Reader) -> Databases:
    """Return all databases, by name and version."""
    return Databases(databases=service.library.databases())


@router.get("/{database}", summary="One database")
def one_database(database: DatabaseId, service: TheService, reader: Reader) -> ListedDatabase:
    """Return the sources and the contents of a database."""
    return service.library.database(database)


@router.get("/{database}/manifest", summary="Manifest", responses=SAME)
def manifest(
    database: DatabaseId, request: Request, service: TheService, reader: Reader
) -> Response:
    """Return the manifest exactly as in its file; its SHA-256 is the ETag."""
    return _file(service, database, MANIFEST_NAME, request, REVALIDATED)


@router.get("/{database}/report", summary="Report", responses=SAME)
def report(database: DatabaseId, request: Request, service: TheService, reader: Reader) -> Response:
    """Return the report of the build: counts, coverage, magnitudes, rates of the self-test."""
    return _file(service, database, REPORT, request, REVALIDATED)


@router.get("/{database}/coverage", summary="Coverage", response_model=CoverageAnswer)
def coverage(
    database: DatabaseId, request: Request, service: TheService, reader: Reader
) -> Response:
    """Return stars, pairs and triangles by field, and their summary."""
    listed = service.library.database(database)
    digest = _listed(listed, FIELDS).sha256
    headers = {"ETag": f'"{digest}"', "Cache-Control": REVALIDATED}
    if has_already(request, digest):
        return Response(status_code=304, headers=headers)
    summary = json.loads((listed.folder / COVERAGE).read_bytes())
    fields = {name: column.tolist() for name, column in vars(fields_of(listed)).items()}
    fields = {"boresight": list(range(len(fields["stars"]))), **fields}
    return JSONResponse({"summary": summary, "fields": fields}, headers=headers)


@router.get("/{database}/diff/{other}", summary="Difference of two databases")
async def difference(
    database: DatabaseId,
    other: DatabaseId,
    service: TheService,
    reader: Reader,
    most: Annotated[
        int, Query(ge=0, le=10_000, description="Stars of each kind to list at most.")
    ] = 1000,
) -> dict[str, Any]:
    """Return the differences: spec, sources, software, stars and why, products.

    ``counts`` has the numbers of added, removed and moved stars, not limited by ``most``.
    """
    return await service.query_pool.run(_difference, service, database, other, most)


def fields_of(database: ListedDatabase) -> Fields:
    """Read the fields of a database."""
    path = database.folder / FIELDS
    try:
        return _read_fields(path, path.stat().st_mtime_ns)
    except (OSError, ValueError) as error:
        raise ProductError(
            f"{database.title}: {FIELDS} cannot be read ({type(error).__name__})",
            path=path,
            hint="build the database again",
        ) from error


@lru_cache(maxsize=16)
def _read_fields(path: Path, changed_ns: int) -> Fields:
    table = np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2, usecols=range(1, 6))
    ra_deg, dec_deg, *counts = table.T
    return Fields(ra_deg, dec_deg, *(column.astype(np.int64) for column in counts))


def difference_of(service: Service, database: str, other: str) -> Difference:
    """Return the differences between two databases."""
    return diff(service.library.database(database), service.library.database(other))


def _difference(service: Service, database: str, other: str, most: int) -> dict[str, Any]:
    content = to_dict(difference_of(service, database, other))
    stars = ("came", "went", "moved")
    counts = {name: len(content[name]) for name in stars}
    return {**content, **{name: content[name][:most] for name in stars}, "counts": counts}


@router.get("/{database}/files", summary="Files")
def files(database: DatabaseId, service: TheService, reader: Reader) -> list[DatabaseFile]:
    """Return the files of a database with sizes and digests, the manifest first."""
    listed = service.library.database(database)
    return [
        DatabaseFile(path=name, content_type=type_of(name), **blob.model_dump())
        for name, blob in listed.files.items()
    ]


@router.get(
    "/{database}/files/{path:path}", summary="A file", response_class=Response, responses=FILE
)
def file(
    database: DatabaseId,
    path: Annotated[str, PathParameter(examples=["stars.parquet"])],
    request: Request,
    service: TheService,
    reader: Reader,
) -> Response:
    """Return a file that the manifest lists, or a range of it; its SHA-256 is the ETag."""
    return _file(service, database, path, request)


router.head("/{database}/files/{path:path}", include_in_schema=False)(file)


@router.get(
    "/{database}/archive",
    summary="All files in one",
    response_class=StreamingResponse,
    responses={200: {"content": {"application/x-tar": {}}, "description": "A tar archive."}},
)
def archive(database: DatabaseId, service: TheService, reader: Reader) -> StreamingResponse:
    """Return the folder of a database as a tar archive, the same bytes each time."""
    listed = service.library.database(database)
    contents = listed.files
    for name, blob in contents.items():
        size = _path_in(listed, name).stat().st_size
        if size != blob.bytes:
            raise ProductError(
                f"{listed.title}: {name} has {size:,} bytes, and the manifest says {blob.bytes:,}",
                path=listed.folder / name,
                hint="build the database again",
            )
    return StreamingResponse(
        archive_chunks(_linked(service, listed, contents), contents),
        media_type="application/x-tar",
        headers={
            "Content-Length": str(archive_bytes(listed.folder.name, contents)),
            "Content-Disposition": f'attachment; filename="{listed.title}.tar"',
        },
    )


@router.delete("/{database}", status_code=204, summary="Remove a database")
def remove(database: DatabaseId, service: TheService, builder: Builder) -> None:
    """Remove a database from the service; releases of it stay published.

    A builder removes the databases that were built for the builder's token, a publisher all.
    """
    remove_database(service, database, builder)


def _linked(service: Service, listed: ListedDatabase, names: Iterable[str]) -> LinkedFolder:
    """Return links to the files of a database, which outlast its removal."""
    try:
        return LinkedFolder(service.paths, listed.folder, names)
    except FileNotFoundError:
        raise TargetMissing(
            f"{listed.title} was removed; the list of databases shows the others"
        ) from None


def _listed(database: ListedDatabase, name: str) -> Blob:
    blob = database.files.get(name)
    if blob is None:
        raise TargetMissing(
            f"{database.title} has no file {name[:80]!r}",
            hint=f"/api/v1/databases/{database.id}/files lists what it has",
        )
    return blob


def _file(
    service: Service, database: str, name: str, request: Request, cache: str | None = None
) -> Response:
    listed = service.library.database(database)
    blob = _listed(listed, name)
    path = _path_in(listed, name)
    options = {} if cache is None else {"cache": cache}
    return file_answer(request, path, blob.sha256, file_name=path.name, **options)


def _path_in(listed: ListedDatabase, name: str) -> Path:
    """Return the path of a file of a database; refuse links that lead out of it."""
    path = listed.folder / name
    is_inside = path.resolve().is_relative_to(listed.folder.resolve())
    if path.is_symlink() or not is_inside or not path.is_file():
        raise Problem(404, f"{listed.title} has no file {name[:80]!r}")
    return path
