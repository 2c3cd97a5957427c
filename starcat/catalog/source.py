"""Descriptions of archives: the TOML files in ``data_sources``, read and checked.

Only `data_source` finds a source by its name: first the sources that ship with starcat, then the
user's own tables whose map was given or is in ``$STARCAT_SOURCES``. `source_given` also accepts
the path of a map; it is for input of the user of this machine only.

A source has one or more files, each with a record layout: the columns byte by byte (fixed
width), in order (delimited) or as a packed structure (binary). The readers use these
descriptions; nothing about a layout is stated elsewhere. This module reads no stars.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from starcat.catalog.table_map import ArchiveMap, TableMap
from starcat.errors import ConfigError, suggest
from starcat.failures import validation_message
from starcat.resources import resource_folder
from starcat.storage.toml_files import content_of_toml, text_of_toml, what_is_wrong

UNITS = frozenset((
    "deg", "rad", "h", "min", "s", "arcmin", "arcsec", "mas", "cas", "darcsec", "mag", "mmag",
    "yr", "d", "mas/yr", "arcsec/yr", "s/yr", "cas/yr", "pix", "ct", "km/s",
))  # fmt: skip
"""Units that a column may name; ``cas`` is 10 mas, ``darcsec`` is 0.1 arcsec."""

RANGES = {
    "h": (0.0, 24.0),
    "min": (0.0, 60.0),
    "arcmin": (0.0, 60.0),
    "mag": (-30.0, 100.0),
    "mas/yr": (-100_000.0, 100_000.0),
    "arcsec/yr": (-100.0, 100.0),
}
"""Range of numbers with a unit, in any archive: the Sun has -27 mag, and Barnard's star, the
fastest star, moves 10.4 arcsec per year."""

SOURCES_VARIABLE = "STARCAT_SOURCES"
"""Environment variable with the maps of the user's own tables: TOML files and folders of them."""

_ENDINGS = ("csv", "tsv", "ecsv", "fits", "vot", "xml", "parquet", "arrow", "feather")

_MOTIONS = ("mas/yr", "arcsec/yr", "s/yr", "cas/yr")

_FORMAT = re.compile(r"^(?:(?P<text>A)\d*|(?P<int>I)\d*|(?P<float>[FDE])(?:\d+\.(?P<dec>\d+))?)$")
_BINARY = re.compile(r"^<[if][1248]$")


class _Model(BaseModel):
    """An immutable model that refuses unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class SourceColumn(_Model):
    """One column of a record."""

    name: str = Field(pattern=r"^[a-z][a-z0-9_]*$")  # label in the archive, in snake_case
    bytes: tuple[int, int] | None = None  # first and last in the record, 1-based inclusive
    format: str  # format of the archive's ReadMe (I6, F9.6, A3); for packed records such as <f8
    unit: str | None = None  # one of `UNITS`
    null: tuple[str, ...] = ()  # texts that mean "no value", like a blank field
    required: bool = False  # a record whose field is blank is malformed
    limits: tuple[float, float] | None = None  # a record with a number outside is malformed
    description: str = ""

    @model_validator(mode="after")
    def _check(self) -> SourceColumn:
        if not (_FORMAT.match(self.format) or _BINARY.match(self.format)):
            raise ValueError(f"column {self.name}: format {self.format!r} is not like I6, F9.6, A3")
        if self.unit not in (None, *UNITS):
            units = ", ".join(sorted(UNITS))
            raise ValueError(f"column {self.name}: unknown unit {self.unit!r}; known: {units}")
        if self.bytes is not None and not 1 <= self.bytes[0] <= self.bytes[1]:
            raise ValueError(f"column {self.name}: bytes {self.bytes} are not first <= last")
        if self.limits is not None and not self.limits[0] <= self.limits[1]:
            raise ValueError(f"column {self.name}: limits {self.limits} are not least <= greatest")
        return self

    @property
    def is_text(self) -> bool:
        """Whether the field is kept as text."""
        return self.format.startswith("A")

    @property
    def is_integer(self) -> bool:
        """Whether the field holds a whole number."""
        return self.format.startswith("I") or self.format.startswith("<i")

    @property
    def decimals(self) -> int | None:
        """Number of digits after the point in the format; None if the format does not state it."""
        match = _FORMAT.match(self.format)
        if match is None or match["text"]:
            return None
        if match["int"]:
            return 0
        return int(match["dec"]) if match["dec"] else None

    @property
    def range(self) -> tuple[float, float] | None:
        """Smallest and largest number of the field, from its limits, its digits or its unit."""
        digits = re.fullmatch(r"I(\d+)", self.format)
        if self.limits is None and digits:
            largest = 10.0 ** int(digits[1]) - 1.0
            return -largest, largest
        return self.limits or RANGES.get(self.unit or "")


class RecordFile(_Model):
    """One file of a source, or one file in several parts, and its record layout."""

    name: str  # name of the layout, by which the archive's module distinguishes files
    # Accepted names without .gz, most usual first; {part} stands for a part, here and in urls.
    file_names: tuple[str, ...] = Field(min_length=1)
    parts: tuple[str, ...] = ()  # names of the parts in order; empty for a single file
    optional: bool = False  # the source is usable without this file
    description: str = ""  # contents of the file, if a source has several files
    layout: Literal["fixed_width", "delimited", "binary", "table"]
    table: TableMap | ArchiveMap | None = None  # meaning of the columns (table)
    record_bytes: int | None = None  # length without the line end (fixed width, binary)
    trimmed: bool = False  # lines may end after their last field, or continue after the record
    header_bytes: int = 0  # bytes before the first record (binary)
    magic: str = ""  # text that a binary file begins with
    delimiter: str = "|"
    comment: str = ""  # lines that begin with it are not records
    literals: dict[str, str] = {}  # characters that every record has, by 1-based byte
    rows: int | None = None  # records in the whole archive file
    sha256: str | None = None  # digest of the file as published, if known
    urls: tuple[str, ...] = ()  # the preferred address first
    columns: tuple[SourceColumn, ...] = ()  # columns in order; a table's file states them

    @model_validator(mode="after")
    def _check(self) -> RecordFile:
        if (self.layout == "table") == (self.table is None) or (not self.columns) == (
            not self.table
        ):
            raise ValueError(f"file {self.name}: {self.layout} records need columns, tables a map")
        names = [column.name for column in self.columns]
        repeated = {name for name in names if names.count(name) > 1}
        if repeated:
            raise ValueError(
                f"file {self.name}: columns named twice: {', '.join(sorted(repeated))}"
            )
        if self.layout in ("delimited", "table"):
            return self
        if self.record_bytes is None:
            raise ValueError(f"file {self.name}: {self.layout} records need record_bytes")
        for column in self.columns:
            if column.bytes is None or column.bytes[1] > self.record_bytes:
                raise ValueError(
                    f"file {self.name}: column {column.name} has bytes {column.bytes}; "
                    f"expected a range within 1-{self.record_bytes}"
                )
        return self

    def column(self, name: str) -> SourceColumn:
        """Return the column called ``name``."""
        return {column.name: column for column in self.columns}[name]


class DataSource(_Model):
    """An archive as ``data_sources/<name>.toml`` describes it."""

    name: str  # name in commands
    title: str
    identifier: str  # its identifier in a catalog of catalogs
    citation: str
    licence: str
    reference: str = ""  # the document that defines the layout
    # For a star archive the module that gives its records their meaning; for other tables the
    # function that reads them, as module:function.
    python: str = ""
    supplies: Literal["", "amplitudes", "companions"] = ""  # values for other catalogs
    kind: Literal["stars", "variability", "doubles"] = (
        "stars"  # a catalog, or a table joined to one
    )
    frame: Literal["ICRS", "FK5", "FK4", "galactic", "none"]  # axes of the positions
    epoch_jyear: float | None = None  # epoch of the positions, if all records have the same
    bands: tuple[str, ...] = ()  # bands of the magnitudes, default first
    urls_retrieved: str  # date and method of the last test of the addresses
    files: tuple[RecordFile, ...] = Field(min_length=1)  # files in reading order

    @property
    def rows(self) -> int | None:
        """Number of records in the whole archive, if every file states its number."""
        counts = [file.rows for file in self.files]
        return None if None in counts else sum(filter(None, counts))

    @property
    def main_file(self) -> RecordFile:
        """The first file that the source is not usable without."""
        return next((file for file in self.files if not file.optional), self.files[0])

    @property
    def has_motions(self) -> bool:
        """Whether its records have proper motions."""
        if isinstance(self.table, TableMap):
            return self.table.columns.pm_dec is not None
        if self.table is not None:
            return data_source(self.table.archive).has_motions
        return any(column.unit in _MOTIONS for file in self.files for column in file.columns)

    @property
    def table(self) -> TableMap | ArchiveMap | None:
        """The map, if the source is the user's own table."""
        return self.files[0].table

    @property
    def archive(self) -> str:
        """Name of the archive that defines the records: for some tables another source."""
        return self.table.archive if isinstance(self.table, ArchiveMap) else self.name


def read_source(path: Path) -> DataSource:
    """Read one data-source file, or the map of a table."""
    advice = "no such map; 'starcat sources --draft FILE' proposes one for a table"
    content = content_of_toml(text_of_toml(path, advice), path.name)
    try:
        return DataSource.model_validate(content) if "files" in content else mapped(content)
    except ValidationError as error:
        if "files" not in content:
            raise what_is_wrong(error, path.name, _map_of(content), "map") from error
        key, problem = validation_message(error)
        raise ConfigError(problem, where=f"{path.name}: {key}", key=key) from error


def mapped(content: Mapping[str, Any]) -> DataSource:
    """Return the source that a map of a table defines."""
    table = _map_of(content).model_validate(content)
    usual = tuple(f"{table.name}.{ending}" for ending in _ENDINGS)
    names = table.file_names or usual
    return DataSource(
        name=table.name,
        title=table.title or table.name,
        identifier=table.identifier or "a table of one's own",
        citation=table.citation,
        licence=table.licence,
        **_frame_and_bands(table),
        urls_retrieved="no address",
        files=(RecordFile(name=table.name, file_names=names, layout="table", table=table),),
    )


def _map_of(content: Mapping[str, Any]) -> type[TableMap] | type[ArchiveMap]:
    return ArchiveMap if "archive" in content else TableMap


def _frame_and_bands(table: TableMap | ArchiveMap) -> dict[str, Any]:
    """Return frame, epoch and bands of a map, or of the archive whose records the table has."""
    if isinstance(table, TableMap):
        bands = table.ordered_bands
        return {"frame": table.frame, "epoch_jyear": table.epoch_jyear, "bands": bands}
    if table.archive not in _shipped_names() or not _is_archive(_shipped(table.archive)):
        archives = [name for name in _shipped_names() if _is_archive(_shipped(name))]
        raise ConfigError(
            f"{table.archive!r} is not an archive of stars",
            where="archive",
            key="archive",
            value=table.archive,
            hint=f"choose one of {', '.join(archives)}",
        )
    archive = _shipped(table.archive)
    names = [column.name for column in archive.main_file.columns]
    for name in table.fields:
        if name not in names:
            raise ConfigError(
                f"fields.{name}: {table.archive} has no such field",
                key=f"fields.{name}",
                hint=f"{suggest(name, names)}it has {', '.join(names)}",
            )
    return archive.model_dump(include={"frame", "epoch_jyear", "bands"})


def _is_archive(source: DataSource) -> bool:
    return source.kind == "stars" and bool(source.python)


@cache
def _shipped_names() -> tuple[str, ...]:
    return tuple(sorted(path.stem for path in resource_folder("data_sources").glob("*.toml")))


@cache
def _shipped(name: str) -> DataSource:
    return read_source(resource_folder("data_sources") / f"{name}.toml")


_registered: dict[str, DataSource] = {}


def _user_maps() -> dict[str, Path]:
    """Return the maps that ``$STARCAT_SOURCES`` names, by the names of the files."""
    places = filter(None, os.environ.get(SOURCES_VARIABLE, "").split(os.pathsep))
    paths = [
        path
        for folder in map(Path, places)
        for path in (sorted(folder.glob("*.toml")) if folder.is_dir() else [folder])
    ]
    return {path.stem: path for path in reversed(paths)}  # the first file with a name counts


def source_names() -> tuple[str, ...]:
    """Return the sorted names of all known data sources."""
    return tuple(sorted({*_shipped_names(), *_registered, *_user_maps()}))


def star_sources() -> tuple[str, ...]:
    """Return the names of the star catalogs; a broken map raises an error only when it is used."""
    names = []
    for name in source_names():
        with suppress(ConfigError):
            if data_source(name).kind == "stars":
                names.append(name)
    return tuple(names)


def check_supplies(name: str, what: Literal["stars", "motions"], key: str) -> None:
    """Check that a source has the stars or motions that a key of a spec requires.

    Raises
    ------
    ConfigError
        If the source lists no stars, or its records have no proper motions. The message names the
        sources that have them.
    """
    source = data_source(name)
    if source.kind == "stars" and (what == "stars" or source.has_motions):
        return
    others = (
        other for other in star_sources() if what == "stars" or data_source(other).has_motions
    )
    lacking = "lists no stars" if source.kind != "stars" else "has no proper motions"
    raise ConfigError(
        f"{name} {lacking}",
        where=key,
        key=key,
        value=name,
        hint=f"choose one of {', '.join(others)}",
    )


def data_source(name: str) -> DataSource:
    """Return the data source of a name; it never reads a path, as names can come from anyone."""
    if name in _shipped_names():
        return _shipped(name)
    if name in _registered:
        return _registered[name]
    if name in (maps := _user_maps()):
        source = _user_source(maps[name])
        if source.name != name:
            raise ConfigError(
                f"the map is of {source.name!r}; in ${SOURCES_VARIABLE} a "
                f"file has the name of its source: rename it to {source.name}.toml",
                where=f"{maps[name]}: name",
                key="name",
                value=source.name,
            )
        return source
    hint = suggest(name, source_names())
    raise ConfigError(
        f"unknown source {name!r}; {hint}known sources: {', '.join(source_names())}",
        key="source",
        value=name,
        hint="A table of your own becomes one by a map: {source:MAP.toml}, or the map in "
        f"${SOURCES_VARIABLE}",
    )


def source_given(text: str) -> DataSource:
    """Return the source that the user of this machine gives by its name or the path of its map."""
    if text.endswith(".toml") and text not in source_names():
        return give_map(Path(text))
    return data_source(text)


def give_map(path: Path) -> DataSource:
    """Return the source of a map, and register it under its name."""
    source = _user_source(path)
    _registered[source.name] = source
    return source


def _user_source(path: Path) -> DataSource:
    """Return the source of a user's map."""
    source = read_source(path)
    _check_without_hook(source, str(path))
    if source.table is None:
        raise ConfigError("describes an archive; a map has [columns] and [magnitudes]", where=path)
    if source.name in _shipped_names():
        raise ConfigError(
            f"{source.name} is a source of starcat",
            where=f"{path}: name",
            key="name",
            value=source.name,
            hint="choose another name",
        )
    return source


def _check_without_hook(source: DataSource, where: str) -> None:
    """Check that a map names no function: a data file from elsewhere must not choose code."""
    if source.python or (isinstance(source.table, TableMap) and source.table.python):
        raise ConfigError(
            "only the maps that ship with starcat name a function",
            where=f"{where}: python",
            key="python",
            hint="write expressions of columns, or give a table that has the values",
        )


@contextmanager
def known_maps(contents: Iterable[Mapping[str, Any]]) -> Iterator[None]:
    """Register the sources of a manifest's maps within a ``with`` statement."""
    before = dict(_registered)
    try:
        for source in map(mapped, contents):
            _check_without_hook(source, "manifest")
            _registered[source.name] = source
        yield
    finally:
        _registered.clear()
        _registered.update(before)


def map_of(name: str) -> dict[str, Any] | None:
    """Return the map of a source for a manifest; None for sources that ship with starcat."""
    table = None if name in _shipped_names() else data_source(name).table
    return table.recorded() if table else None
