"""The files of a database as one tar archive, written while it is sent."""

from __future__ import annotations

import tarfile
from collections.abc import Iterator, Mapping
from pathlib import Path

from starcat.releases.tree import Blob

CHUNK_BYTES = 1 << 18


def archive_bytes(folder: str, files: Mapping[str, Blob]) -> int:
    """Return the size of an archive."""
    parts = (len(_head(folder, name, blob)) + _whole(blob.bytes) for name, blob in files.items())
    return sum(parts) + 2 * tarfile.BLOCKSIZE


def archive_chunks(folder: Path, files: Mapping[str, Blob]) -> Iterator[bytes]:
    """Give the bytes of an archive, the same for the same files."""
    for name, blob in files.items():
        yield _head(folder.name, name, blob)
        left = blob.bytes
        with (folder / name).open("rb") as file:
            while left:
                chunk = file.read(min(left, CHUNK_BYTES))
                if not chunk:
                    raise OSError(f"{name}: {left} bytes are missing")
                left -= len(chunk)
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
