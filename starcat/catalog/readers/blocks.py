"""Archive files, plain or gzipped, in blocks of whole lines or records, with their digests.

Blocks are read in order; threads may parse them meanwhile, so that decompression and parsing
overlap and memory stays flat. The order of the results is that of the blocks.
"""

from __future__ import annotations

import gzip
import hashlib
import io
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar, cast

from isal import igzip, isal_zlib

from starcat.catalog.readers.records import line_ends
from starcat.catalog.source import RecordFile
from starcat.catalog.source_files import InputFile
from starcat.errors import ParseError, SourceError

BLOCK_BYTES = 1 << 22
GZIP_MAGIC = b"\x1f\x8b"
_Damage = cast(type[Exception], isal_zlib.error)

MAX_LINE_BYTES = 1 << 24
"""A longer text without a line end is of no archive, and is not read to its end."""

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


@dataclass(frozen=True)
class Block:
    """Whole lines (or whole binary records) of one file."""

    file: InputFile
    data: bytes
    first_line: int  # 1-based number of its first line (or record) in the file
    bytes_read: int = 0  # of the file as it lies on disk, when the block was whole


class DigestReader(io.RawIOBase):
    """A binary file that hashes what is read from it."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("rb", buffering=0)
        self._hash = hashlib.sha256()
        self.bytes_read = 0

    def readable(self) -> bool:
        """Return True: the file is open for reading."""
        return True

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        """Read into a buffer and hash what was read."""
        count = self._file.readinto(buffer)
        self._hash.update(memoryview(buffer)[:count])
        self.bytes_read += count
        return count

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        super().close()

    @property
    def sha256(self) -> str:
        """Digest of all that has been read, hexadecimal."""
        return self._hash.hexdigest()


def open_input(path: Path) -> tuple[DigestReader, io.BufferedIOBase]:
    """Open a file for reading, with the digest of its raw bytes once it is read to its end.

    Compression is recognised by content, not by name.
    """
    try:
        with path.open("rb") as file:
            is_gzip = file.read(2) == GZIP_MAGIC
        raw = DigestReader(path)
    except OSError as error:
        raise SourceError(f"{path}: cannot be read: {error.strerror}", path=path) from error
    buffered = io.BufferedReader(raw, 1 << 20)
    if is_gzip:
        return raw, igzip.IGzipFile(fileobj=buffered)  # type: ignore[no-untyped-call]
    return raw, buffered


def read_blocks(
    file: InputFile, source_name: str, on_end: Callable[[DigestReader], None]
) -> Iterator[Block]:
    """Read a file in blocks of whole lines or whole binary records, one at least."""
    raw, stream = open_input(file.path)
    line, tail = 1, b""
    try:
        if file.layout.layout == "binary":
            check_magic(stream.read(file.layout.header_bytes), file, source_name)
        size = _read_size(file.layout)
        while chunk := stream.read(size):
            cut = _last_whole(tail, chunk, file.layout)
            data, tail = (tail + chunk[:cut], chunk[cut:]) if cut else (b"", tail + chunk)
            del chunk
            if len(tail) > MAX_LINE_BYTES:
                raise _endless_line(file, source_name, line)
            if data:
                yield Block(file, data, line, raw.bytes_read)
                line += _count(data, file.layout)
        if tail:
            yield Block(file, tail, line, raw.bytes_read)
        elif line == 1:
            raise ParseError(
                f"{file.path}: the file is empty; expected records of {source_name}",
                source=source_name,
                path=file.path,
            )
        on_end(raw)
    except (EOFError, gzip.BadGzipFile, _Damage) as error:
        what = "cut off" if isinstance(error, EOFError) else "damaged"
        where = f" after line {line - 1}" if line > 1 else ""
        raise ParseError(
            f"{file.path}: the compressed data is {what}{where} ({error}); fetch the file again",
            source=source_name,
            path=file.path,
            line=line - 1,
        ) from error
    finally:
        stream.close()
        raw.close()


def _endless_line(file: InputFile, source_name: str, line: int) -> ParseError:
    length = file.layout.record_bytes
    expected = f"records of {length} bytes" if length else "lines"
    return ParseError(
        f"{file.path}: line {line} has no end within {MAX_LINE_BYTES >> 20} MiB; expected "
        f"{expected} of {source_name} ({file.layout.name}). Is this the right archive?",
        source=source_name,
        path=file.path,
        line=line,
    )


def check_magic(header: bytes, file: InputFile, source_name: str) -> None:
    """Check the first bytes of a binary file."""
    magic = file.layout.magic.encode()
    if len(header) < file.layout.header_bytes or not header.startswith(magic):
        raise ParseError(
            f"{file.path}: begins with {header[:8]!r}; expected {magic!r} and a header of "
            f"{file.layout.header_bytes} bytes ({source_name})",
            source=source_name,
            path=file.path,
            byte_range=(1, file.layout.header_bytes),
        )


def _read_size(layout: RecordFile) -> int:
    """Return the bytes of a whole number of records, so that blocks end where records end."""
    record = (layout.record_bytes or 1) + (layout.layout == "fixed_width")
    return max(1, BLOCK_BYTES // record) * record


def _last_whole(tail: bytes, chunk: bytes, layout: RecordFile) -> int:
    """Return how much of a chunk belongs to records that are whole with what was left before."""
    if layout.layout == "binary":
        return max(0, len(chunk) - (len(tail) + len(chunk)) % (layout.record_bytes or 1))
    return chunk.rfind(b"\n") + 1


def _count(data: bytes, layout: RecordFile) -> int:
    if layout.layout == "binary":
        return len(data) // (layout.record_bytes or 1)
    return line_ends(data)


def map_in_order(
    function: Callable[[_Item], _Result], items: Iterator[_Item], workers: int = 2
) -> Iterator[_Result]:
    """Apply a function to items with a few threads, keeping their order."""
    if not workers:
        yield from map(function, items)
        return
    pending: deque[Future[_Result]] = deque()
    with ThreadPoolExecutor(workers) as pool:
        try:
            for item in items:
                pending.append(pool.submit(function, item))
                if len(pending) > workers + 1:
                    yield pending.popleft().result()
        except SourceError:  # what is wrong with an item before it comes first
            yield from (future.result() for future in pending)
            raise
        while pending:
            yield pending.popleft().result()
