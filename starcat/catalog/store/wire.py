"""HATS catalogs at an address: the required parts are downloaded into a copy, which is then read.

A file of the copy is as long as the remote file, with the downloaded bytes at the same positions;
the rest is a hole of zeros. So its digest depends only on the downloaded bytes: it is the same for
the same remote file, source, band and limit. An interrupted copy is continued later; every answer
is compared with the version of the file with which the copy began.

Only the command line and Python accept an address as input (`input_path`); a service does not.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import BinaryIO
from urllib.parse import quote, urlsplit

import pyarrow.parquet as pq
from pydantic import BaseModel, ConfigDict

from starcat.arguments import text_of_path
from starcat.catalog.archives.mapped import needed_columns
from starcat.catalog.parts import IngestOptions
from starcat.catalog.readers.tables import open_table
from starcat.catalog.source import data_source
from starcat.catalog.source_files import InputFile
from starcat.catalog.stars.verdict import Reason
from starcat.catalog.store.finish import split_name
from starcat.catalog.store.layout import (
    COLLECTION_NAME,
    DATASET,
    MANIFEST_NAME,
    PARTITIONS_NAME,
    PROPERTIES_NAMES,
    REJECTED,
    REPEATED,
    Pixel,
    groups_within,
    parquet_file,
    pixels_of,
    primary_of,
    read_properties,
    star_columns,
)
from starcat.errors import ChecksumMismatch, ConfigError, DownloadError, ProductError
from starcat.progress import Progress
from starcat.resources import PathLike
from starcat.storage.atomic import file_sha256, json_bytes, locked, placed, writing
from starcat.storage.cache import cache_folder
from starcat.storage.download import (
    DownloadOptions,
    RemoteVersion,
    download,
    fetch_range,
    forget_part,
    is_address,
    part_of,
    rename,
)
from starcat.threads import map_in_order

NOTE_NAME = "address.json"
FOOTER_BYTES = 1 << 16
"""Bytes requested first from the end of a Parquet file: most footers are shorter."""

GAP_BYTES = 1 << 18
"""A smaller gap between two parts is downloaded too: that is faster than a second request."""

CONNECTIONS = 4
HOW = DownloadOptions()
_MAGIC = b"PAR1"

Ranges = list[tuple[int, int]]
Choose = Callable[[Path, pq.FileMetaData], tuple[Sequence[int], Sequence[str]]]
"""Function that returns the row groups and columns to read of a file with a footer."""


def input_path(text: str) -> Path:
    """Return the path of an input; for an address, the path of a note that represents it."""
    if not is_address(text, "input"):
        return Path(text)
    if "@" in urlsplit(text).netloc:
        raise ConfigError(
            "an address with a name or password in it, which manifests would show",
            where="input",
            key="input",
            hint="put them into ~/.netrc, and leave them out of the address",
        )
    url = text.rstrip("/")
    note = _notes() / hashlib.sha256(url.encode()).hexdigest()[:16]
    with writing(note, "set STARCAT_CACHE to a folder with free space"):
        note.mkdir(parents=True, exist_ok=True)
        with placed(note / NOTE_NAME) as partial_note:
            partial_note.write_bytes(json_bytes({"address": url}))
    return note


def input_paths(name: str, inputs: PathLike | Sequence[PathLike]) -> list[Path]:
    """Return the inputs of a catalog as paths; a text may be the address of a HATS catalog."""
    if isinstance(inputs, str | os.PathLike) or not isinstance(inputs, Iterable):
        return [input_path(text_of_path(name, inputs))]
    return [input_path(text_of_path(name, path)) for path in inputs]


def _notes() -> Path:
    return cache_folder() / "wire"


def url_of_input(path: Path) -> str | None:
    """Return the address that a note represents, else None; notes are in the download cache."""
    if path.parent != _notes() or not (path / NOTE_NAME).is_file():
        return None
    return str(json.loads((path / NOTE_NAME).read_bytes())["address"])


def bring(note: Path, options: IngestOptions, progress: Progress) -> Path:
    """Return the copy for the note of an address, with the data that the options select."""
    table = data_source(options.source_name).table
    selection = [
        options.source_name,
        table and table.recorded(),
        options.band,
        options.read_limit_mag,
    ]
    name = hashlib.sha256(json_bytes(selection)).hexdigest()[:16]
    copy = _Copy(url_of_input(note) or "", note / name, HOW)
    with writing(note, "set STARCAT_CACHE to a folder with space; finished parts are kept"):
        copy.folder.mkdir(exist_ok=True)
        with locked(copy.folder):
            inner, pixels = _bring_listing(copy)
            is_ours = copy.whole(MANIFEST_NAME)
            if is_ours:
                _bring_beside(copy)
            choose = _choose_stars if is_ours or table is None else _choose_mapped
            names = [f"{inner}{DATASET}/{pixel.path.as_posix()}" for pixel in pixels]
            bring_one = partial(copy.part, choose=partial(choose, options))
            for done, _ in enumerate(map_in_order(bring_one, iter(names), CONNECTIONS), 1):
                progress(f"partitions {options.source_name}", done, len(names))
    return copy.folder


def _bring_listing(copy: _Copy) -> tuple[str, list[Pixel]]:
    """Download the list of partitions; return the catalog's inner folder and the partitions."""
    inner = ""
    if copy.whole(COLLECTION_NAME, _without_margins):
        inner = f"{primary_of(copy.folder).relative_to(copy.folder).as_posix()}/"
    if not any(copy.whole(inner + name) for name in PROPERTIES_NAMES):
        raise ProductError(
            f"{copy.url}/{inner}: no {' or '.join(PROPERTIES_NAMES)} there; expected the address "
            "of a HATS catalog or collection",
            hint="Other files are read from a path: download them",
        )
    if not copy.whole(inner + PARTITIONS_NAME):
        raise ProductError(
            f"{copy.url}/{inner}: no {PARTITIONS_NAME} there, and an address lists no files",
            hint="download the catalog, and give its folder",
        )
    folder = copy.folder / inner
    facts = next(read_properties(folder / n) for n in PROPERTIES_NAMES if (folder / n).is_file())
    if facts.get("hats_npix_suffix", ".parquet") != ".parquet":
        raise ProductError(
            f"{copy.url}/{inner}: its partitions are folders of files, and an address lists no "
            "files",
            hint="download the catalog, and give its folder",
        )
    return inner, pixels_of(folder)


def _without_margins(text: bytes) -> bytes:
    """Return a collection's properties without its margins, which the copy lacks."""
    margins = (b"default_margin", b"all_margins")
    lines = text.splitlines(keepends=True)
    return b"".join(line for line in lines if not line.lstrip().startswith(margins))


def _bring_beside(copy: _Copy) -> None:
    """Download the rejected and repeated records of a store that starcat made."""
    try:
        manifest = json.loads((copy.folder / MANIFEST_NAME).read_bytes())
        # Convert to numbers: no other content from a server may become a path.
        partitions = [
            (int(partition["order"]), int(partition["pixel"]))
            for partition in manifest["partitions"]
        ]
        repeated = [int(partition["repeated"]) for partition in manifest["partitions"]]
        counts = {str(name): int(count) for name, count in manifest["rejected"].items()}
        files = len(manifest["files"])
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ProductError(
            f"{copy.url}/{MANIFEST_NAME}: cannot be read ({error!r}); expected the account of a "
            "store",
            hint="Make the store again with 'starcat ingest SOURCE --to hats'",
        ) from error
    for (order, pixel), count in zip(partitions, repeated, strict=True):
        name = f"{REPEATED}/{order}-{pixel}.parquet"
        if count and not copy.whole(name):
            raise ProductError(f"{copy.url}/{name}: is missing; the store is not whole")
    for reason in (Reason.beyond_read_limit, Reason.duplicate_record):
        counts.pop(reason.name, None)
    names = [f"{REJECTED}/{split_name(n)}.parquet" for n in range(files)]
    present = [copy.folder / name for name in (names if counts else ()) if copy.whole(name)]
    rows = 0
    for path in present:
        with parquet_file(path, ProductError, f"{copy.url}/{REJECTED} is damaged") as file:
            rows += file.metadata.num_rows
    if rows != sum(counts.values()):
        raise ProductError(
            f"{copy.url}/{REJECTED}: {rows} rejected records are there; the store has "
            f"{sum(counts.values())}. It is not whole"
        )


def _choose_stars(
    options: IngestOptions, path: Path, footer: pq.FileMetaData
) -> tuple[Sequence[int], Sequence[str]]:
    """Choose the parts that a build reads of a partition with the columns of stars."""
    has = footer.schema.to_arrow_schema().names
    groups = groups_within(footer, "mag", options.read_limit_mag) if "mag" in has else []
    return groups, star_columns(has)


def _choose_mapped(
    options: IngestOptions, path: Path, footer: pq.FileMetaData
) -> tuple[Sequence[int], Sequence[str]]:
    """Choose the parts that a build reads of a partition whose columns a map describes."""
    source = data_source(options.source_name)
    opened = open_table(InputFile(path, source.files[0], source.name))
    names = needed_columns(source.table, opened, where=path.name) if source.table else []
    return range(footer.num_row_groups), names


class _State(BaseModel):
    """The version of a remote file, and the ranges that its copy has."""

    model_config = ConfigDict(extra="forbid")

    version: RemoteVersion
    there: list[tuple[int, int]] = []


@dataclass(frozen=True)
class _Copy:
    """A copy of the required parts of a catalog."""

    url: str
    folder: Path
    how: DownloadOptions

    def whole(self, name: str, edit: Callable[[bytes], bytes] | None = None) -> bool:
        """Download a whole file; return whether it exists."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        forget_part(path)
        try:
            download(self._url(name), path, self.how)
        except DownloadError as error:
            # Object stores answer 403 for missing files.
            if getattr(error.__cause__, "status", None) in (403, 404, 410):
                return False
            error.at(f"{self.url}/{name}")
            raise
        part = part_of(path)
        if edit is not None:
            part.write_bytes(edit(part.read_bytes()))
        if path.exists() and file_sha256(path) != file_sha256(part):
            forget_part(path)
            raise ChecksumMismatch(f"{self.url}/{name}: has changed", path=path, hint=self._advice)
        rename(part, path)
        forget_part(path)
        return True

    def part(self, name: str, choose: Choose) -> None:
        """Download the footer of a Parquet file, and the chosen columns and row groups."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
        try:
            with path.open("r+b") as file:
                _Part(self._url(name), path, file, self.how).fill(choose)
        except ChecksumMismatch as error:
            error.hint = self._advice
            error.path = path
            raise

    def _url(self, name: str) -> str:
        return f"{self.url}/{quote(name, safe='/=')}"

    @property
    def _advice(self) -> str:
        return f"the earlier version is in {self.folder}: remove that to read the current one"


class _Part:
    """A Parquet file of the copy during its download."""

    def __init__(self, url: str, path: Path, file: BinaryIO, how: DownloadOptions) -> None:
        self.url, self.path, self.file, self.how = url, path, file, how
        self.note = path.with_name(f".{path.name}.json")
        self.state: _State | None = None
        if self.note.exists():
            state = _State.model_validate_json(self.note.read_bytes())
            self.state = state if path.stat().st_size == state.version.size else None
        if self.state is None:
            file.truncate(0)  # its bytes are of an unknown version

    def fill(self, choose: Choose) -> None:
        """Download the chosen parts that are missing."""
        # Always request the end: the answer shows whether the file is still the same version.
        size = self._get(-FOOTER_BYTES, 0).version.size
        self.file.seek(max(0, size - 8))
        length = int.from_bytes(self.file.read(4), "little") + 8
        if self.file.read(4) != _MAGIC or length > size:
            raise ProductError(
                "is not a Parquet file; expected a catalog's partition", where=self.url
            )
        self._need([(0, 4), (size - length, size)])
        with parquet_file(self.path, ProductError, f"{self.url} is damaged") as opened:
            footer = opened.metadata
        groups, names = choose(self.path, footer)
        self._need(chunks_of(footer, groups, names))

    def _need(self, ranges: Ranges) -> None:
        size = self.state.version.size if self.state else 0
        for first, end in ((first, min(end, size - FOOTER_BYTES)) for first, end in ranges):
            if first < end and self.state and (first, end) not in self.state.there:
                state = self._get(first, end)
                state.there.append((first, end))
                with placed(self.note) as whole:
                    whole.write_text(state.model_dump_json() + "\n", encoding="utf-8")

    def _get(self, first: int, end: int) -> _State:
        def write(offset: int, block: bytes) -> None:
            self.file.seek(offset)
            self.file.write(block)

        expected = self.state.version if self.state else None
        version = fetch_range(self.url, first, end, write, self.how, expected)
        self.file.truncate(version.size)
        self.file.flush()
        os.fsync(self.file.fileno())
        self.state = self.state or _State(version=version)
        return self.state


def chunks_of(footer: pq.FileMetaData, groups: Sequence[int], names: Sequence[str]) -> Ranges:
    """Return the byte ranges of columns of row groups in a file; near ranges are joined."""
    chunks: Ranges = []
    for group in map(footer.row_group, groups):
        for column in map(group.column, range(group.num_columns)):
            if column.path_in_schema.partition(".")[0] in names:
                starts = (column.data_page_offset, column.dictionary_page_offset)
                first = min(start for start in starts if start)
                chunks.append((first, first + column.total_compressed_size))
    joined: Ranges = []
    for first, end in sorted(chunks):
        if joined and first - joined[-1][1] <= GAP_BYTES:
            joined[-1] = (joined[-1][0], max(end, joined[-1][1]))
        else:
            joined.append((first, end))
    return joined
