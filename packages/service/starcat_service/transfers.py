"""Transfers of files: uploads in scratch folders, files and ranges of them, tar archives.

Starlette sends the bytes. This module decides what to send: for a range that cannot be parsed, or
for several ranges at once, it is the whole file, as RFC 9110 requires.
"""

from __future__ import annotations

import os
import re
import secrets
import shutil
import tarfile
import weakref
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import IO, TYPE_CHECKING, Any

from fastapi import Request
from fastapi.responses import FileResponse, Response, StreamingResponse
from starlette.datastructures import MutableHeaders

from starcat.errors import QueryLimitError, TargetMissing
from starcat.ship.exchange import FILE_FORMATS, FORMATS, FirstRows
from starcat.ship.releases import Blob
from starcat_service.paths import ServicePaths
from starcat_service.problems import Problem, refusals
from starcat_service.security.request_limits import room_for
from starcat_service.settings import ServiceSettings

if TYPE_CHECKING:
    import pyarrow as pa

IMMUTABLE = "private, max-age=31536000, immutable"
"""Cache control of content with a digest as its name, which never changes."""

REVALIDATED = "private, no-cache"
"""Cache control of content that can change: the client asks each time if it has changed."""

SMALL_BYTES = 1 << 20
"""Files up to this size are sent as a whole, not in pieces."""

TYPES = {
    **{FORMATS[name].suffix: FORMATS[name].media_type for name in FILE_FORMATS},
    ".h5": "application/x-hdf5",
    ".html": "text/html; charset=utf-8",
    ".svg": "image/svg+xml",
    ".png": "image/png",
    ".toml": "application/toml",
}
"""Content types by suffix; all other files are bytes."""

BYTES = "application/octet-stream"

CHUNK_BYTES = 1 << 18

MAX_BYTES = 4 << 30
"""Largest size of a result, which is kept on disk until it is sent."""

CONTENTS: dict[str, dict[str, object]] = {
    kind: {} for kind in sorted({BYTES, *(kind.partition(";")[0] for kind in TYPES.values())})
}
"""All of them, as OpenAPI has them."""

FILE: dict[int | str, dict[str, Any]] = {
    200: {"content": CONTENTS, "description": "The file."},
    206: {"content": CONTENTS, "description": "The range that was asked for."},
    304: {"description": "The same as you have (``If-None-Match``)."},
    **refusals({416: "The range lies outside of the file."}),
}
"""For ``responses=`` of operations that answer with files."""

_RANGE = re.compile(r"\s*bytes\s*=\s*([0-9]{0,18})-([0-9]{0,18})\s*", re.IGNORECASE | re.ASCII)


def file_answer(
    request: Request,
    path: Path,
    sha256: str,
    *,
    file_name: str,
    cache: str = IMMUTABLE,
    content_type: str | None = None,
) -> Response:
    """Answer with a file."""
    try:
        stat = path.stat()
    except OSError:
        raise TargetMissing(
            f"{file_name} is not there any more", hint="look at the list again"
        ) from None
    headers = {"ETag": f'"{sha256}"', "Cache-Control": cache}
    if has_already(request, sha256):
        return Response(status_code=304, headers=headers)
    kind = content_type or type_of(file_name)
    answer = FileResponse(
        path, headers=headers, media_type=kind, filename=file_name, stat_result=stat
    )
    part = _part(request, stat.st_size, answer.headers)
    if part is None:  # Starlette must not send a range either
        del MutableHeaders(scope=request.scope)["range"]
    if request.method == "HEAD" or stat.st_size > SMALL_BYTES:
        return answer
    return _at_once(path.read_bytes(), part, dict(answer.headers))


def _at_once(content: bytes, part: tuple[int, int] | None, headers: dict[str, str]) -> Response:
    """Answer with a small file, read here: using other threads for it takes longer."""
    status = 200
    if part is not None:
        status, (start, end) = 206, part
        headers["content-range"] = f"bytes {start}-{end - 1}/{len(content)}"
        content = content[start:end]
    del headers["content-length"]
    return Response(content, status_code=status, headers=headers)


def has_already(request: Request, sha256: str) -> bool:
    """Return whether the client has the same content already."""
    header = request.headers.get("if-none-match", "")
    tags = [tag.strip().removeprefix("W/") for tag in header.split(",")]
    return "*" in tags or f'"{sha256}"' in tags


def body_type(request: Request) -> str:
    """Return the content type of a request's body without parameters; empty if not given."""
    return request.headers.get("content-type", "").partition(";")[0].strip().lower()


def type_of(file_name: str) -> str:
    """Return the content type of a file.

    Examples
    --------
    >>> type_of("stars.parquet")
    'application/vnd.apache.parquet'
    """
    return TYPES.get(PurePosixPath(file_name).suffix.lower(), BYTES)


def _part(request: Request, size: int, headers: Mapping[str, str]) -> tuple[int, int] | None:
    """Return the range of bytes to send, None for all; refuse ranges outside of the file."""
    match = _RANGE.fullmatch(request.headers.get("range", ""))
    if request.method != "GET" or match is None or match[1] == match[2] == "":
        return None
    if_range = request.headers.get("if-range")
    if if_range is not None and if_range not in (headers["etag"], headers["last-modified"]):
        return None
    start = int(match[1]) if match[1] else max(size - int(match[2]), 0)
    end = min(int(match[2]) + 1, size) if match[1] and match[2] else size
    if match[1] and match[2] and int(match[2]) < start:
        return None
    if start >= size:
        raise Problem(
            416,
            f"the range begins at byte {start:,}, and the file has {size:,}; ask for less",
            headers={"Content-Range": f"bytes */{size}"},
        )
    return start, end


def archive_bytes(folder: str, files: Mapping[str, Blob]) -> int:
    """Return the size of an archive."""
    parts = (len(_head(folder, name, blob)) + _whole(blob.bytes) for name, blob in files.items())
    return sum(parts) + 2 * tarfile.BLOCKSIZE


class LinkedFolder:
    """Hard links to files of a folder: they can be read when the folder is removed.

    They are removed when nothing refers to this any more.
    """

    def __init__(self, paths: ServicePaths, folder: Path, names: Iterable[str]) -> None:
        within = paths.scratch / f"links-{secrets.token_hex(16)}"
        weakref.finalize(self, shutil.rmtree, within, ignore_errors=True)
        self.folder = within / folder.name
        for name in names:
            path = self.folder / name
            path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            os.link(folder / name, path)


def archive_chunks(linked: LinkedFolder, files: Mapping[str, Blob]) -> Iterator[bytes]:
    """Yield the bytes of an archive, the same for the same files."""
    folder = linked.folder
    for name, blob in files.items():
        yield _head(folder.name, name, blob)
        remaining = blob.bytes
        with (folder / name).open("rb") as file:
            while remaining:
                chunk = file.read(min(remaining, CHUNK_BYTES))
                if not chunk:
                    raise OSError(f"{name}: {remaining} bytes are missing")
                remaining -= len(chunk)
                yield chunk
        yield bytes(_whole(blob.bytes) - blob.bytes)
    yield bytes(2 * tarfile.BLOCKSIZE)


def _head(folder: str, name: str, blob: Blob) -> bytes:
    facts = tarfile.TarInfo(f"{folder}/{name}")
    facts.size = blob.bytes
    return facts.tobuf(tarfile.PAX_FORMAT)


def _whole(size: int) -> int:
    """Return a size in whole blocks."""
    return -(-size // tarfile.BLOCKSIZE) * tarfile.BLOCKSIZE


_UNUSUAL = re.compile(r"[^A-Za-z0-9_-]+", re.ASCII)


@contextmanager
def scratch_folder(paths: ServicePaths) -> Iterator[Path]:
    """Yield a new folder, which is removed afterwards."""
    folder = paths.scratch / secrets.token_hex(16)
    folder.mkdir(mode=0o700)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def safe_name(sent_name: str | None, suffixes: tuple[str, ...], default: str) -> str:
    """Return a safe name for an uploaded file.

    Examples
    --------
    >>> safe_name("../../a b.PNG", (".png",), "frame"), safe_name("x.exe", (".png",), "frame")
    ('a_b.png', 'x_exe')
    >>> safe_name("....", (".png",), "frame")
    'frame'
    """
    name = (sent_name or "").replace("\\", "/").rpartition("/")[2]
    suffix = PurePosixPath(name).suffix.lower()
    extension = suffix if suffix in suffixes else ""
    stem = name[: -len(extension)] if extension else name
    return (_UNUSUAL.sub("_", stem).strip("_")[:80] or default) + extension


def copy_within_disk(source: IO[bytes], path: Path, settings: ServiceSettings) -> None:
    """Copy a file, as long as ``free_gib`` is left on the disk."""
    with path.open("wb") as file:
        while part := source.read(CHUNK_BYTES):
            with room_for(settings, len(part)):
                file.write(part)


def within_disk(batches: pa.RecordBatchReader, settings: ServiceSettings) -> pa.RecordBatchReader:
    """Return batches on their way to a file, as long as ``free_gib`` is left on the disk."""
    import pyarrow as pa

    def checked() -> Iterator[pa.RecordBatch]:
        for batch in batches:
            with room_for(settings, batch.nbytes):
                yield batch

    return pa.RecordBatchReader.from_batches(batches.schema, checked())


def write_rows(batches: pa.RecordBatchReader, path: Path, most: int) -> tuple[int, bool]:
    """Write the first rows as an Arrow stream; return their number, and whether there are more."""
    import pyarrow as pa

    count = size = 0
    first = FirstRows(batches, most)
    with pa.OSFile(str(path), "wb") as file, pa.ipc.new_stream(file, batches.schema) as stream:
        for part in first:
            stream.write_batch(part)
            count, size = count + part.num_rows, size + part.nbytes
            if size > MAX_BYTES and not first.were_more:
                raise QueryLimitError(
                    f"the answer is larger than {MAX_BYTES >> 30} GiB", hint="ask for fewer rows"
                )
    return count, first.were_more


def open_attachment(path: Path, name: str, media_type: str) -> StreamingResponse:
    """Return a file as a named attachment; the file can be removed before it is sent."""
    file = path.open("rb")
    headers = {
        "Content-Length": str(path.stat().st_size),
        "Content-Disposition": f'attachment; filename="{name}"',
    }
    return StreamingResponse(file_chunks(file), media_type=media_type, headers=headers)


def file_chunks(file: IO[bytes]) -> Iterator[bytes]:
    """Yield the rest of an open file, and close it."""
    with file:
        while chunk := file.read(CHUNK_BYTES):
            yield chunk
