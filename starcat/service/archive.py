"""The files of a database as one tar archive, written while it is sent."""

from __future__ import annotations

import tarfile
from collections.abc import Iterator, Mapping
from pathlib import Path

from starcat.releases.tree import Blob

CHUNK_BYTES = 1 << 18


def archive_bytes(folder: str, files: Mapping[str, Blob]) -> int:
    """Return the size of an archive.

    Parameters
    ----------
    folder : str
        Name of the folder in it.
    files : mapping of str to Blob
        What is in that, by path.

    Returns
    -------
    int
        Bytes.
    """
    parts = (len(_head(folder, name, blob)) + _whole(blob.bytes) for name, blob in files.items())
    return sum(parts) + 2 * tarfile.BLOCKSIZE


def archive_chunks(folder: Path, files: Mapping[str, Blob]) -> Iterator[bytes]:
    """Give the bytes of an archive, the same for the same files.

    Parameters
    ----------
    folder : Path
        The folder, whose name is in the archive.
    files : mapping of str to Blob
        What of it goes in, by path.

    Yields
    ------
    bytes
        A part of the archive.

    Raises
    ------
    OSError
        If a file is shorter than was said: the archive breaks off.
    """
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
