"""Expand gzip files up to a stated size, because it can be a thousand times larger."""

from __future__ import annotations

import gzip
import io
import zlib
from pathlib import Path

from starcat.errors import ConfigError

GZIP = b"\x1f\x8b"
_CHUNK_BYTES = 1 << 20


def expanded(data: bytes, max_bytes: int, path: Path) -> bytes:
    """Return the content of a gzip file.

    Parameters
    ----------
    data : bytes
        The gzip file.
    max_bytes : int
        The largest content that is expanded, bytes.
    path : Path
        The file for messages.

    Returns
    -------
    bytes

    Raises
    ------
    ConfigError
        If the file is damaged, or expands to more.
    """
    parts: list[bytes] = []
    size = 0
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as stream:
            while part := stream.read(min(_CHUNK_BYTES, max_bytes + 1 - size)):
                parts.append(part)
                size += len(part)
                if size > max_bytes:
                    raise expands_too_far(path, len(data), max_bytes)
    except (OSError, EOFError, zlib.error) as error:
        raise damaged_gzip(path, error) from error
    return b"".join(parts)


def expanded_beginning(data: bytes, count: int) -> bytes:
    """Return the first bytes of the content of a gzip file; fewer if it is damaged."""
    try:
        return zlib.decompressobj(wbits=31).decompress(data, count)
    except zlib.error:
        return b""


def damaged_gzip(path: Path, error: Exception) -> ConfigError:
    """Return the error for a gzip file that cannot be expanded."""
    return ConfigError(f"damaged gzip file ({error})", where=path)


def expands_too_far(path: Path, size: int, max_bytes: int) -> ConfigError:
    """Return the error for a file that expands to more than is allowed."""
    return ConfigError(
        f"has {size:,} bytes and expands to more than {max_bytes:,}; files of this kind "
        "are smaller",
        where=path,
        hint="Expand it first if it is what you want to read",
    )
