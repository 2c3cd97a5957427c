"""Reading gzip files in large steps, with Intel's ISA-L in place of zlib.

The standard library's gzip reader asks its file for 8 KiB at a time (Python 3.11), which costs
as much as the decompression; the library is given 256 KiB at once here. Checksums, members
one behind the other and padding are treated as the gzip module treats them.
"""

from __future__ import annotations

from gzip import BadGzipFile
from typing import Protocol, cast

from isal import isal_zlib

STEP_BYTES = 1 << 18
_PIECE_BYTES = 1 << 20
MAGIC = b"\x1f\x8b"
_GZIP_FORMAT = 31
_Damage = cast(type[Exception], isal_zlib.error)


class Readable(Protocol):
    """A binary file open for reading."""

    def read(self, size: int, /) -> bytes:
        """Return at most so many bytes, and none at the end of the file."""

    def close(self) -> None:
        """Close it."""


class GzipReader:
    """The decompressed content of a gzip file."""

    def __init__(self, raw: Readable) -> None:
        self._raw = raw
        self._member: isal_zlib.Decompress | None = None
        self._pending = b""

    def read(self, size: int) -> bytes:
        """Return the next bytes."""
        parts: list[bytes] = []
        while size > 0:
            if not self._pending:
                self._pending = self._raw.read(STEP_BYTES)
            if self._member is None and not self._begin_member():
                break
            data = self._inflate(size)
            parts.append(data)
            size -= len(data)
        return b"".join(parts)

    def close(self) -> None:
        """Close the compressed file."""
        self._raw.close()

    def _begin_member(self) -> bool:
        """Start the next member behind zeros that pad the file; return whether there is one."""
        self._pending = self._pending.lstrip(b"\0")
        while len(self._pending) < len(MAGIC):
            more = self._raw.read(STEP_BYTES)
            if not more:
                break
            self._pending = (self._pending + more).lstrip(b"\0")
        if not self._pending:
            return False
        if not self._pending.startswith(MAGIC):
            raise BadGzipFile(f"Not a gzipped file ({self._pending[:2]!r})")
        self._member = isal_zlib.decompressobj(_GZIP_FORMAT)
        return True

    def _inflate(self, size: int) -> bytes:
        member = self._member
        if member is None:
            return b""
        at_end = not self._pending
        try:
            data = member.decompress(self._pending, min(size, _PIECE_BYTES))
        except _Damage as error:
            raise BadGzipFile(str(error)) from error
        self._pending = member.unconsumed_tail
        if member.eof:
            self._pending = member.unused_data
            self._member = None
        elif at_end and not data:
            raise EOFError("Compressed file ended before the end-of-stream marker was reached")
        return data
