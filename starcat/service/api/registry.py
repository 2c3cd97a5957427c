"""The registry that releases are published into, as the tree of files that `starcat pull` reads."""

from __future__ import annotations

import hashlib
import re
from typing import Annotated

from fastapi import APIRouter, Path, Request
from fastapi.responses import Response

from starcat.errors import TargetMissing
from starcat.releases.tree import INDEX_NAME
from starcat.service.access import Reader
from starcat.service.file_answers import FILE, IMMUTABLE, REVALIDATED, file_answer, has_already
from starcat.service.problems import REFUSALS
from starcat.service.service import TheService
from starcat.specs.version import NAME_PATTERN, VERSION_PATTERN

router = APIRouter(prefix="/registry", tags=["releases"], responses=REFUSALS)

BLOB = re.compile(r"blobs/sha256/(?P<two>[0-9a-f]{2})/(?P<digest>(?P=two)[0-9a-f]{62})", re.ASCII)
RELEASE = re.compile(
    rf"versions/(?P<name>{NAME_PATTERN[1:-1]})/(?P<version>{VERSION_PATTERN[1:-1]})\.json",
    re.ASCII,
)


@router.get(
    "/{path:path}", summary="A file of the registry", response_class=Response, responses=FILE
)
def registry_file(
    path: Annotated[str, Path(examples=[INDEX_NAME])],
    request: Request,
    service: TheService,
    reader: Reader,
) -> Response:
    """Return ``index.json``, ``versions/NAME/VERSION.json`` or ``blobs/sha256/AB/ABCD...``.

    ``starcat pull NAME --registry http://HOST:PORT/registry`` reads these.
    """
    root = service.paths.registry
    # A name is of one of the forms that the tree has, or there is no such file: no other text
    # becomes part of a path.
    blob = BLOB.fullmatch(path)
    if blob is None and path != INDEX_NAME and RELEASE.fullmatch(path) is None:
        raise _missing(path)
    found = root / path
    if found.is_symlink() or not found.is_file():
        raise _missing(path)
    if blob is not None:
        digest = blob["digest"]
        return file_answer(
            request, found, digest, file_name=digest, content_type="application/octet-stream"
        )
    # Both are small and replaced as a whole: what is read is what the digest is of.
    content = found.read_bytes()
    digest = hashlib.sha256(content).hexdigest()
    cache = REVALIDATED if path == INDEX_NAME else IMMUTABLE
    headers = {"ETag": f'"{digest}"', "Cache-Control": cache}
    if has_already(request, digest):
        return Response(status_code=304, headers=headers)
    return Response(content, media_type="application/json", headers=headers)


router.head("/{path:path}", include_in_schema=False)(registry_file)


def _missing(path: str) -> TargetMissing:
    return TargetMissing(
        f"the registry has no file {path[:100]!r}; /registry/{INDEX_NAME} lists its releases"
    )
