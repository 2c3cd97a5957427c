"""The files of a source on disk: among given paths, or in the folders that are searched.

A source is given as a file (plain or ``.gz``), several files, or a folder that contains them
under the archive's names, in parts or whole.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from starcat.catalog.archives.gaia import completed_sky
from starcat.catalog.archives.hipparcos2 import embedded_hipparcos2
from starcat.catalog.source import DataSource, RecordFile, data_source, source_names
from starcat.errors import ParseError, SourceError, SourceMissing, literal
from starcat.storage.cache import cache_folder

CATALOGS_VARIABLE = "STARCAT_CATALOGS"


@dataclass(frozen=True)
class InputFile:
    """One file of a source on disk."""

    path: Path
    layout: RecordFile  # layout of its records
    source: str  # name of the source
    number: int = 0  # position in the reading order

    def error(self, message: str, **fields: Any) -> ParseError:
        """Return an error about the content of the file; ``fields`` are those of `ParseError`."""
        return ParseError(message, where=self.path, source=self.source, **fields)


@dataclass(frozen=True)
class FileFacts:
    """One input file as the manifest records it."""

    name: str  # name without the folder
    sha256: str  # digest of the file on disk
    bytes: int
    rows: int  # number of records, including malformed ones


@dataclass(frozen=True)
class SourceFiles:
    """The files of one source, in reading order."""

    source: DataSource
    files: tuple[InputFile, ...]  # the order in which they were given does not matter

    @classmethod
    def find(cls, source: DataSource, paths: Sequence[Path]) -> SourceFiles:
        """Find the files of a source in paths (files or folders).

        `SourceMissing` if there are no files, or a folder lacks a required file;
        `SourceError` if a file of the archive is given twice.
        """
        inputs: list[tuple[Path, RecordFile, Path]] = []
        for path in paths:
            if path.is_dir():
                inputs += [(*each, path) for each in _files_in_folder(source, path)]
            elif path.exists():
                layout = named_layout(source, path) or source.main_file
                inputs.append((path, layout, path.parent))
            else:
                expected = " and ".join(file.file_names[0] + "[.gz]" for file in source.files)
                raise SourceMissing(
                    "no such file",
                    where=f"{source.name}: {path}",
                    source=source.name,
                    path=path,
                    hint=f"give a file or a folder with {expected}",
                )
        if not inputs:
            raise SourceMissing("no input files given", where=source.name, source=source.name)
        inputs.sort(key=lambda each: _reading_order(source, *each))
        # Files can have any name; only names of the archive show the content.
        named = [] if source.table else [path for path, *_ in inputs if named_layout(source, path)]
        numbered = enumerate(inputs)
        files = cls(
            source,
            tuple(InputFile(path, layout, source.name, n) for n, (path, layout, _) in numbered),
        )
        files._check_duplicates(
            (path.name.removesuffix(".gz"), path, f"{path.name.removesuffix('.gz')} is there twice")
            for path in named
        )
        return files

    @cached_property
    def sizes(self) -> tuple[int, ...]:
        """Bytes of each file on disk."""
        return tuple(file.path.stat().st_size for file in self.files)

    @property
    def notes(self) -> tuple[str, ...]:
        """A note for each missing optional file of the source."""
        present = {file.layout.name for file in self.files}
        return tuple(
            f"{self.source.name}: {layout.file_names[0]} is not among the inputs "
            f"({layout.description})"
            for layout in self.source.files
            if layout.optional and layout.name not in present
        )

    def check_contents(self, facts: Sequence[FileFacts]) -> None:
        """Check that no two of the first files have the same content."""
        what = "two files have the same content (sha256 {}…)"
        self._check_duplicates(
            (fact.sha256, file.path, what.format(fact.sha256[:12]))
            for file, fact in zip(self.files, facts, strict=False)
        )

    def _check_duplicates(self, keyed: Iterable[tuple[str, Path, str]]) -> None:
        """Raise if two files have the same key: their stars would be read twice."""
        seen: dict[str, Path] = {}
        for key, path, what in keyed:
            if key in seen:
                raise SourceError(
                    f"{seen[key]} and {path}; expected each part of the archive once",
                    where=f"{self.source.name}: {what}",
                    source=self.source.name,
                    path=path,
                    hint="Leave one of them out, or fetch the part that should be there instead",
                )
            seen[key] = path


def _reading_order(
    source: DataSource, path: Path, layout: RecordFile, folder: Path
) -> tuple[int, int, tuple[str, ...], str]:
    """Return the key by which files are read in the same order, however they were given.

    The parts of an archive have its order. Other files are sorted by their names; the name of a
    file in a given folder is its path relative to the folder.
    """
    name = path.name.removesuffix(".gz")
    parts = [file.replace("{part}", part) for file in layout.file_names for part in layout.parts]
    part = parts.index(name) if name in parts else len(parts)
    return source.files.index(layout), part, path.relative_to(folder).parts, str(path)


def named_layout(source: DataSource, path: Path) -> RecordFile | None:
    """Return the layout that a file has by its archive name, with or without ``.gz``."""
    name = path.name.removesuffix(".gz")
    for layout in source.files:
        for pattern in layout.file_names:
            stem = re.escape(pattern).replace(re.escape("{part}"), r"\w+")
            if re.fullmatch(stem, name):
                return layout
    return None


def source_of_file(path: Path) -> str | None:
    """Return the source to which a file belongs by its archive name."""
    named = (name for name in source_names() if named_layout(data_source(name), path))
    return next(named, None)


def lacking(source: DataSource, folder: Path) -> tuple[str, ...] | None:
    """Return the names of the files that a folder lacks; None if it has no file of the source.

    Optional files are not listed: if the result is empty, the source can be read from the folder.
    """
    lacks: list[str] = []
    has_some = False
    for layout in source.files:
        every = [_parts_in_folder(layout, name, folder) for name in layout.file_names]
        has_some |= any(path for parts in every for path in parts.values())
        if layout.optional or any(all(parts.values()) for parts in every):
            continue
        fullest = max(every, key=lambda parts: sum(path is not None for path in parts.values()))
        lacks.append(_few([name for name, path in fullest.items() if path is None]))
    return tuple(lacks) if has_some else None


def _parts_in_folder(layout: RecordFile, name: str, folder: Path) -> dict[str, Path | None]:
    """Return the paths of the parts with one of a layout's names; None for a missing part."""
    paths: dict[str, Path | None] = {}
    for part in layout.parts if "{part}" in name else ("",):
        each = name.replace("{part}", part)
        beside = (folder / each, folder / f"{each}.gz")
        paths[each] = next((path for path in beside if path.is_file()), None)
    return paths


def _few(names: Sequence[str]) -> str:
    return f"{', '.join(names[:8])}{' …' if len(names) > 8 else ''}"


def _files_in_folder(source: DataSource, folder: Path) -> list[tuple[Path, RecordFile]]:
    files: list[tuple[Path, RecordFile]] = []
    if source.table is not None and (parts := table_parts(folder)):
        return [(path, source.files[0]) for path in parts]
    for layout in source.files:
        paths = _layout_in_folder(source, layout, folder)
        if not paths and not layout.optional:
            raise SourceMissing(
                f"{folder} has no {layout.file_names[0]}[.gz]; "
                + (f"fetch it with 'starcat fetch {source.name}' or " if not source.table else "")
                + "name the file itself",
                where=source.name,
                source=source.name,
                path=folder,
            )
        files += [(path, layout) for path in paths]
    return files


def _layout_in_folder(source: DataSource, layout: RecordFile, folder: Path) -> list[Path]:
    for name in layout.file_names:
        paths = list(_parts_in_folder(layout, name, folder).values())
        existing = [path for path in paths if path is not None]
        if len(existing) == len(paths):
            return existing
        if existing:
            missing = [part for part, path in zip(layout.parts, paths, strict=True) if path is None]
            raise SourceMissing(
                f"{folder} has {len(existing)} of {len(paths)} parts of {name}; "
                f"missing: {_few(missing)}",
                where=source.name,
                source=source.name,
                path=folder,
                hint="Fetch the rest, or name the parts one by one to use only them",
            )
    return []


def table_parts(folder: Path) -> list[Path]:
    """Return the sorted Parquet files of a HATS catalog, a collection or a folder of parts.

    Other files of a HATS catalog, such as margins and statistics, contain no stars.
    """
    collection = folder / "collection.properties"
    if collection.is_file():  # its margins can have any name
        match = re.search(
            r"^hats_primary_table_url\s*=\s*(\w[\w.-]*)", collection.read_text("utf-8"), re.M
        )
        folder = folder / match[1] if match else folder
    inside = sorted(folder.rglob("dataset/Norder=*/**/*.parquet"))
    inside = [path for path in inside if "_margin" not in path.relative_to(folder).parts[0]]
    return inside or sorted(folder.glob("*.parquet"))


def locate(source_name: str, inputs: Mapping[str, Sequence[Path]]) -> list[Path]:
    """Return the paths of a source: the given ones, or the first folder that has all its files.

    It searches the folders given for other sources, ``$STARCAT_CATALOGS`` and the cache.
    """
    source = data_source(source_name)
    if inputs.get(source_name):
        return list(inputs[source_name])
    folders = [
        path if path.is_dir() else path.parent for paths in inputs.values() for path in paths
    ]
    if os.environ.get(CATALOGS_VARIABLE):
        folders.append(Path(os.environ[CATALOGS_VARIABLE]))
    folders = list(dict.fromkeys([*folders, cache_folder()]))
    lacks = {folder: lacking(source, folder) for folder in folders if folder.is_dir()}
    for folder, missing in lacks.items():
        if missing == ():
            return [folder]
    if source_name == "gaia":
        return completed_sky()
    if source_name == "hipparcos2":
        return [embedded_hipparcos2()]
    raise SourceMissing(
        f"{source_name} ({source.title}): {_missing_where(lacks, folders)}",
        source=source_name,
        hint=(
            f"Name it with {{inputs[{source_name}]}}",
            f"set ${CATALOGS_VARIABLE} to the folder that has {literal(_usual_file(source))}",
            *_served(source),
        ),
    )


def _usual_file(source: DataSource) -> str:
    """Return the name of a file by which a source is found, in words."""
    names = source.main_file.file_names
    if source.table is None:
        return f"{names[-1]}[.gz]"
    return " or ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def _served(source: DataSource) -> list[str]:
    """Return how to get a source over the network; empty if that is not possible."""
    if source.table is None:
        return [f"run 'starcat fetch {source.name}'"]
    remote = source.table.remote
    ways = [] if remote is None else [
        remote.tap and f"run 'starcat fetch {source.name} --limit-mag MAG -o DIR'",
        remote.hats and f"give its address {remote.hats} with {{inputs[{source.name}]}}",
    ]  # fmt: skip
    return [way for way in ways if way]


def _missing_where(lacks: Mapping[Path, tuple[str, ...] | None], folders: Sequence[Path]) -> str:
    """Return a text: no folder has a file of the source, or some folders lack these files."""
    partly = [f"{folder} lacks {' and '.join(m)}" for folder, m in lacks.items() if m]
    searched = ", ".join(str(folder) for folder in folders if not lacks.get(folder))
    if not partly:
        return f"no file found in {searched}"
    nothing = f"; no file found in {searched}" if searched else ""
    return f"no folder has all of its files: {'; '.join(partly)}{nothing}"
