"""Releases: the list of them, publishing, and the files that 'starcat pull' reads."""

from __future__ import annotations

import hashlib
import pathlib
import re
import time
from functools import partial
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Path, Request
from fastapi.responses import Response
from pydantic import BaseModel, ConfigDict, Field

from starcat.errors import ConfigError, TargetMissing
from starcat.progress import Progress, no_progress
from starcat.ship.releases import (
    INDEX_NAME,
    METADATA,
    METADATA_PATH,
    RELEASE_PATH,
    Listed,
    Published,
    recorded,
)
from starcat.ship.releases import publish as publish_into
from starcat_service.access import Publisher, Reader
from starcat_service.library import ListedDatabase
from starcat_service.problems import REFUSALS
from starcat_service.records import Records
from starcat_service.security.request_limits import check_disk
from starcat_service.service import Service, TheService
from starcat_service.transfers import FILE, IMMUTABLE, REVALIDATED, file_answer, has_already

router = APIRouter(prefix="/releases", tags=["releases"])
registry_router = APIRouter(prefix="/registry", tags=["releases"], responses=REFUSALS)

BLOB = re.compile(r"blobs/sha256/(?P<two>[0-9a-f]{2})/(?P<digest>(?P=two)[0-9a-f]{62})", re.ASCII)

MAX_NOTE = 4000


def publications(records: Records) -> dict[tuple[str, str], dict[str, Any]]:
    """Return the database, publisher, time and note of each release by name and version."""
    rows = records.rows("SELECT * FROM publications")
    keys = ("database", "note", "owner", "published_s")
    return {(row["name"], row["version"]): {key: row[key] for key in keys} for row in rows}


class ReleaseFacts(BaseModel):
    """A release."""

    name: str = Field(examples=["gaia-12deg"])
    version: str = Field(examples=["1.0.0"])
    title: str = Field(examples=["gaia-12deg-1.0.0"])
    manifest_sha256: str = Field(description="Digest of the file ``manifest.json``.")
    files: int = Field(description="How many files it has.")
    bytes: int = Field(description="Their sizes together.")
    database: str | None = Field(None, description="Id of the published database.")
    note: str | None = Field(None, description="Note of the publisher.")
    owner: str | None = Field(None, description="Who published it.")
    published_s: float | None = Field(None, description="Time of publication; seconds since 1970.")
    pull: str = Field(
        description="Command to get it, with the address of the service before the path.",
        examples=["starcat pull gaia-12deg@1.0.0 --registry http://127.0.0.1:8000/registry"],
    )


class Releases(BaseModel):
    """All releases."""

    releases: list[ReleaseFacts]


class ToPublish(BaseModel):
    """A database to publish."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "examples": [{"database": "0123456789abcdef", "note": "For the flight of June."}]
        },
    )

    database: str = Field(description="Id of the database.")
    note: str = Field("", max_length=MAX_NOTE, description="Release note.")


class PublishedRelease(ReleaseFacts):
    """Result of a publication."""

    outcome: Literal["published", "unchanged"] = Field(
        description="``unchanged`` if it was there with the same content."
    )
    new_blobs: int = Field(description="Content that the registry did not have.")
    new_bytes: int = Field(description="Its size.")


@router.get("", summary="All releases")
def all_releases(service: TheService, reader: Reader) -> Releases:
    """Return all releases, by name and then by version."""
    published = publications(service.records)
    return Releases(
        releases=[
            _facts(service, release, published) for release in recorded(service.paths.registry)
        ]
    )


@router.get("/{name}/{version}", summary="One release")
def one_release(
    name: Annotated[str, Path(examples=["gaia-12deg"])],
    version: Annotated[str, Path(examples=["1.0.0"])],
    service: TheService,
    reader: Reader,
) -> ReleaseFacts:
    """Return the facts of a release."""
    for release in recorded(service.paths.registry):
        if (release.name, release.version) == (name, version):
            return _facts(service, release, publications(service.records))
    raise TargetMissing(
        f"no release {name[:80]!r} {version[:80]!r}", hint="/api/v1/releases lists what there is"
    )


@router.post(
    "",
    summary="Publish a database",
    status_code=201,
    responses={200: {"model": PublishedRelease, "description": "It was there already."}},
)
async def publish(
    publication: ToPublish, response: Response, service: TheService, publisher: Publisher
) -> PublishedRelease:
    """Check a database and publish it into the registry, where it will never change.

    Publishing the same content again returns 200; a version that exists with other content is
    refused with 409.
    """
    answer = await service.publishing.run(
        service.settings.job_time_s, partial(_publish, service, publication, publisher.name)
    )
    response.status_code = 201 if answer.outcome == "published" else 200
    return answer


def _publish(service: Service, publication: ToPublish, owner: str) -> PublishedRelease:
    database = service.library.database(publication.database)
    published = _signed(service, database.folder, _room_check(service, database))
    release = published.release
    with service.records.writing() as connection:  # a release that exists keeps its first note
        connection.execute(
            "INSERT OR IGNORE INTO publications "
            "(name, version, database, note, owner, published_s) VALUES (?, ?, ?, ?, ?, ?)",
            (release.name, release.version, database.id, publication.note, owner, time.time()),
        )
    facts = _facts(service, release, publications(service.records))
    return PublishedRelease(
        **facts.model_dump(),
        outcome=published.outcome,
        new_blobs=published.new_blobs,
        new_bytes=published.new_bytes,
    )


def _room_check(service: Service, database: ListedDatabase) -> Progress:
    """Return what checks the free space before each file; the files of all are checked here."""
    new = {blob.path: blob.bytes for blob in database.files.values()}
    lacking = [size for path, size in new.items() if not (service.paths.registry / path).exists()]
    if not lacking:
        return no_progress
    check_disk(service.settings, sum(lacking))
    return lambda *_: check_disk(service.settings)


def _signed(service: Service, folder: pathlib.Path, check: Progress) -> Published:
    """Publish a database, signed with the operator's key if there is one."""
    registry, key = service.paths.registry, service.settings.signing_key
    if key is None:
        if (registry / METADATA).is_dir():
            raise ConfigError(
                "the registry of this service is signed, and the service has no key: its operator "
                "sets signing_key in service.toml"
            )
        return publish_into(folder, registry, progress=check)
    return publish_into(folder, registry, sign=key, progress=check)


def _facts(
    service: Service, release: Listed, published: dict[tuple[str, str], dict[str, Any]]
) -> ReleaseFacts:
    settings = service.settings
    address = settings.public_url or f"http://{settings.host}:{settings.port}"
    return ReleaseFacts(
        name=release.name,
        version=release.version,
        title=release.title,
        manifest_sha256=release.manifest.sha256,
        files=release.files,
        bytes=release.bytes,
        pull=f"starcat pull {release.name}@{release.version} --registry "
        f"{address.rstrip('/')}/registry",
        **published.get((release.name, release.version), {}),
    )


@registry_router.get(
    "/{path:path}", summary="A file of the registry", response_class=Response, responses=FILE
)
def registry_file(
    path: Annotated[str, Path(examples=[INDEX_NAME])],
    request: Request,
    service: TheService,
    reader: Reader,
) -> Response:
    """Return ``index.json``, ``versions/NAME/VERSION.json`` or ``blobs/sha256/AB/ABCD...``.

    Also ``metadata/*.json`` if releases are signed. ``starcat pull NAME --registry
    http://HOST:PORT/registry`` reads these.
    """
    root = service.paths.registry
    # A name is of one of the forms that the tree has, or there is no such file: no other text
    # becomes part of a path.
    blob = BLOB.fullmatch(path)
    small = (RELEASE_PATH, METADATA_PATH)
    if (
        blob is None
        and path != INDEX_NAME
        and not any(pattern.fullmatch(path) for pattern in small)
    ):
        raise _no_file(path)
    file = root / path
    if file.is_symlink() or not file.is_file():
        raise _no_file(path)
    if blob is not None:
        digest = blob["digest"]
        return file_answer(
            request, file, digest, file_name=digest, content_type="application/octet-stream"
        )
    # These files are small and replaced as a whole: the digest is of the content that was read.
    content = file.read_bytes()
    digest = hashlib.sha256(content).hexdigest()
    is_replaced = path in (INDEX_NAME, f"{METADATA}/root.json", f"{METADATA}/timestamp.json")
    cache = REVALIDATED if is_replaced else IMMUTABLE
    headers = {"ETag": f'"{digest}"', "Cache-Control": cache}
    if has_already(request, digest):
        return Response(status_code=304, headers=headers)
    return Response(content, media_type="application/json", headers=headers)


registry_router.head("/{path:path}", include_in_schema=False)(registry_file)


def _no_file(path: str) -> TargetMissing:
    return TargetMissing(
        f"the registry has no file {path[:100]!r}",
        hint=f"/registry/{INDEX_NAME} lists its releases",
    )
