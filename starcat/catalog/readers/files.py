"""The files of a source on disk: finding them, and reading them in blocks of whole lines.

A source is given as a file (plain or ``.gz``), several files, or a folder that holds them
under the archive's names, in parts or whole. Blocks are read in order and parsed by two
workers, so that decompression and parsing overlap and memory stays flat; the order of the
results is the order of the files.
"""

from __future__ import annotations

import gzip
import hashlib
import io
import re
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from starcat.catalog.readers.gunzip import MAGIC, GzipReader, Readable
from starcat.catalog.readers.records import line_ends
from starcat.catalog.source import DataSource, RecordFile, data_source, source_names
from starcat.errors import ParseError, SourceError, SourceMissing

BLOCK_BYTES = 1 << 22

MAX_LINE_BYTES = 1 << 24
"""A longer text without a line end is of no archive, and is not read to its end."""

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


@dataclass(frozen=True)
class InputFile:
    """One file on disk and the layout of its records."""

    path: Path
    layout: RecordFile


@dataclass(frozen=True)
class Block:
    """Whole lines (or whole binary records) of one file.

    Attributes
    ----------
    file : InputFile
        Where it is from.
    data : bytes
        The lines.
    first_line : int
        1-based number of the first line (or record) in the file.
    bytes_read : int
        Bytes of the file, as it lies on disk, that had been read when the block was whole.
    """

    file: InputFile
    data: bytes
    first_line: int
    bytes_read: int = 0


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


def find_files(source: DataSource, paths: Sequence[Path]) -> list[InputFile]:
    """Find the files of a source."""
    found: list[InputFile] = []
    for path in paths:
        if path.is_dir():
            found += _files_in_folder(source, path)
        elif path.exists():
            found.append(InputFile(path, _layout_of(source, path)))
        else:
            raise SourceMissing(
                f"{source.name}: {path} does not exist; give a file or a folder with "
                f"{_expected_names(source)}",
                source=source.name,
                path=path,
            )
    return found


def lacking(source: DataSource, folder: Path) -> tuple[str, ...] | None:
    """Return what a folder lacks of a source."""
    lacks: list[str] = []
    has_some = False
    for layout in source.files:
        places = [_places(layout, name, folder) for name in layout.file_names]
        has_some |= any(path for place in places for path in place.values())
        if layout.optional or any(all(place.values()) for place in places):
            continue
        fullest = max(places, key=lambda place: sum(path is not None for path in place.values()))
        lacks.append(_few([name for name, path in fullest.items() if path is None]))
    return tuple(lacks) if has_some else None


def _places(layout: RecordFile, name: str, folder: Path) -> dict[str, Path | None]:
    """Return where the files of one of a layout's names are, by name; None where they are not."""
    parts = layout.parts if "{part}" in name else ("",)
    names = [name.replace("{part}", part) for part in parts]
    return {each: _existing(folder, each) for each in names}


def _few(names: Sequence[str]) -> str:
    return f"{', '.join(names[:8])}{' …' if len(names) > 8 else ''}"


def _expected_names(source: DataSource) -> str:
    return " and ".join(source_file.file_names[0] + "[.gz]" for source_file in source.files)


def _existing(folder: Path, name: str) -> Path | None:
    for candidate in (folder / name, folder / f"{name}.gz"):
        if candidate.is_file():
            return candidate
    return None


def source_of_file(path: Path) -> str | None:
    """Return the source whose archive name a file has."""
    named = (name for name in source_names() if named_layout(data_source(name), path))
    return next(named, None)


def _layout_of(source: DataSource, path: Path) -> RecordFile:
    """Return the layout whose archive name the file has; the first where none fits."""
    return named_layout(source, path) or source.files[0]


def named_layout(source: DataSource, path: Path) -> RecordFile | None:
    """Return the layout of a source whose archive name a file has."""
    name = path.name.removesuffix(".gz")
    for layout in source.files:
        for pattern in layout.file_names:
            stem = re.escape(pattern).replace(re.escape("{part}"), r"\w+")
            if re.fullmatch(stem, name):
                return layout
    return None


def _files_in_folder(source: DataSource, folder: Path) -> list[InputFile]:
    found: list[InputFile] = []
    for layout in source.files:
        paths = _layout_in_folder(source, layout, folder)
        if not paths and not layout.optional:
            raise SourceMissing(
                f"{source.name}: {folder} has no {layout.file_names[0]}[.gz]; fetch it with "
                f"'starcat fetch {source.name}' or name the file itself",
                source=source.name,
                path=folder,
            )
        found += [InputFile(path, layout) for path in paths]
    return found


def _layout_in_folder(source: DataSource, layout: RecordFile, folder: Path) -> list[Path]:
    for name in layout.file_names:
        if "{part}" not in name:
            path = _existing(folder, name)
            if path:
                return [path]
            continue
        parts = dict(zip(layout.parts, _places(layout, name, folder).values(), strict=True))
        missing = [part for part, path in parts.items() if path is None]
        if missing and len(missing) < len(parts):
            raise SourceMissing(
                f"{source.name}: {folder} has {len(parts) - len(missing)} of {len(parts)} parts "
                f"of {name}; missing: {_few(missing)}. "
                "Fetch the rest, or name the parts one by one to use only them",
                source=source.name,
                path=folder,
            )
        if not missing:
            return [path for path in parts.values() if path is not None]
    return []


def open_input(path: Path) -> tuple[DigestReader, Readable]:
    """Open a plain or gzipped file for reading, with the digest of its raw bytes."""
    try:
        with path.open("rb") as file:
            is_gzip = file.read(2) == MAGIC
        raw = DigestReader(path)
    except OSError as error:
        raise SourceError(f"{path}: cannot be read: {error.strerror}", path=path) from error
    buffered = io.BufferedReader(raw, 1 << 20)
    return raw, GzipReader(buffered) if is_gzip else buffered


def read_blocks(
    file: InputFile, source_name: str, on_end: Callable[[DigestReader], None]
) -> Iterator[Block]:
    """Read a file in blocks of whole lines or whole binary records."""
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
    except (EOFError, gzip.BadGzipFile) as error:
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
        for item in items:
            pending.append(pool.submit(function, item))
            if len(pending) > workers + 1:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
