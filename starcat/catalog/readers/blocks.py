"""Archive files, plain or gzipped, in blocks of whole lines or records, with their digests."""

from __future__ import annotations

import gzip
import hashlib
import io
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import cast

from isal import igzip, isal_zlib

from starcat.catalog.readers.records import Rows, line_ends
from starcat.catalog.source import RecordFile
from starcat.catalog.source_files import InputFile
from starcat.errors import ParseError, SourceError
from starcat.storage.regular_files import check_regular_file

BLOCK_BYTES = 1 << 22
GZIP_MAGIC = b"\x1f\x8b"
_Damage = cast(type[Exception], isal_zlib.error)

MAX_LINE_BYTES = 1 << 24
"""A file with a longer line is not an archive file, and is not read to its end."""


@dataclass(frozen=True)
class Block:
    """Whole lines (or binary records, or rows of a table) of one file."""

    file: InputFile
    data: bytes
    first_line: int  # 1-based number of its first line (or record) in the file
    bytes_read: int = 0  # bytes of the file on disk that were read up to the end of this block
    rows: Rows | None = None  # rows of a table, instead of data


class DigestReader(io.FileIO):
    """A binary file that hashes the bytes read from it."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._hash = hashlib.sha256()
        self.bytes_read = 0

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        """Read into a buffer and hash the bytes."""
        count = super().readinto(buffer) or 0
        self._hash.update(memoryview(buffer)[:count])
        self.bytes_read += count
        return count

    @property
    def sha256(self) -> str:
        """Hexadecimal digest of all bytes read so far."""
        return self._hash.hexdigest()


def open_input(path: Path) -> tuple[DigestReader, io.BufferedIOBase]:
    """Open a file for reading; it also returns a reader with the digest of the raw bytes.

    Compression is recognised by content, not by name.
    """
    check_regular_file(path)
    try:
        with path.open("rb") as file:
            is_gzip = file.read(2) == GZIP_MAGIC
        raw = DigestReader(path)
    except OSError as error:
        raise SourceError(f"cannot be read: {error.strerror}", where=path) from error
    buffered = io.BufferedReader(raw, 1 << 20)
    if is_gzip:
        return raw, igzip.IGzipFile(fileobj=buffered)  # type: ignore[no-untyped-call]
    return raw, buffered


def read_blocks(file: InputFile, on_end: Callable[[DigestReader], None]) -> Iterator[Block]:
    """Read a file in at least one block of whole lines or whole binary records."""
    raw, stream = open_input(file.path)
    line, is_binary, is_empty = 1, file.layout.layout == "binary", True
    try:
        if is_binary:
            _check_magic(stream.read(file.layout.header_bytes), file)
        size = _read_size(file.layout)
        while data := stream.read(size):
            if not is_binary and not data.endswith(b"\n"):
                data += (rest := stream.readline(MAX_LINE_BYTES))
                if len(rest) == MAX_LINE_BYTES and not rest.endswith(b"\n"):
                    raise _endless_line(file, line + data.count(b"\n"))
            yield Block(file, data, line, raw.bytes_read)
            line += len(data) // (file.layout.record_bytes or 1) if is_binary else line_ends(data)
            is_empty = False
        if is_empty:
            raise file.error(f"the file is empty; expected records of {file.source}")
        on_end(raw)
    except (EOFError, gzip.BadGzipFile, _Damage) as error:
        if appended := _bytes_behind_gzip(file.path):
            raise file.error(
                f"{appended:,} bytes that are not compressed follow the compressed data; fetch the "
                "file again"
            ) from error
        what = "cut off" if isinstance(error, EOFError) else "damaged"
        where = f" after line {line - 1}" if line > 1 else ""
        raise file.error(
            f"the compressed data is {what}{where} ({error}); fetch the file again", line=line - 1
        ) from error
    finally:
        stream.close()
        raw.close()


def _bytes_behind_gzip(path: Path) -> int:
    """Return how many bytes follow the last whole member of a gzip file, if they begin no other.

    The reader of gzip takes them for the header of a member that is cut off.
    """
    member, end = isal_zlib.decompressobj(wbits=31), 0
    with path.open("rb") as file:
        while data := file.read(1 << 20):
            while data:
                try:
                    member.decompress(data)
                except _Damage:
                    return 0
                if not member.eof:
                    break
                data = member.unused_data.lstrip(b"\0")
                end = file.tell() - len(data)
                if data and not data.startswith(GZIP_MAGIC[: len(data)]):
                    return path.stat().st_size - end
                member = isal_zlib.decompressobj(wbits=31)
    return 0


def _endless_line(file: InputFile, line: int) -> ParseError:
    length = file.layout.record_bytes
    expected = f"records of {length} bytes" if length else "lines"
    return file.error(
        f"line {line} has no end within {MAX_LINE_BYTES >> 20} MiB; expected {expected} of "
        f"{file.source} ({file.layout.name}). Is this the right archive?",
        line=line,
    )


def _check_magic(header: bytes, file: InputFile) -> None:
    magic, length = file.layout.magic.encode(), file.layout.header_bytes
    if len(header) < length or not header.startswith(magic):
        raise file.error(
            f"begins with {header[:8]!r}; expected {magic!r} and a header of {length} bytes "
            f"({file.source})",
            byte_range=(1, length),
        )


def _read_size(layout: RecordFile) -> int:
    """Return the size of a block in bytes: a whole number of records."""
    record = (layout.record_bytes or 1) + (layout.layout == "fixed_width")
    return max(1, BLOCK_BYTES // record) * record
