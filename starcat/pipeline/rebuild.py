"""Build a database again from its own manifest, and compare the bytes."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from starcat.catalog.source import data_source, known_maps
from starcat.catalog.source_files import SourceFiles, locate
from starcat.catalog.store.wire import url_of_input
from starcat.database.diff import Change, changes_between
from starcat.database.manifest import MANIFEST_NAME, read_manifest
from starcat.database.reader import DatabaseFolder, open_database_folder
from starcat.errors import ChecksumMismatch, SourceMissing
from starcat.pipeline.build import build
from starcat.pipeline.draft import Inputs
from starcat.pipeline.reading import check_inputs
from starcat.pipeline.specs.reading import spec_of_database
from starcat.progress import Progress, no_progress
from starcat.results import in_record
from starcat.storage.atomic import MAX_NAMED, file_sha256


@dataclass(frozen=True)
class FileChange:
    """A file that differs between a database and its rebuild."""

    file: str  # path within the database
    what: str  # the difference, also of its product


Verdict = Literal["identical", "same products", "different"]


@dataclass(frozen=True)
class Rebuilt:
    """The outcome of a rebuild."""

    name: str  # ``<name>-<version>``
    files: int  # number of compared files
    changes: tuple[FileChange, ...]  # files that differ
    software: tuple[Change, ...]  # changed versions: then (``a``) and now (``b``)
    # ``identical``: every file has the same bytes; ``same products``: other software wrote the
    # same products, but not all files have the same bytes; ``different``: anything else
    verdict: Verdict

    @property
    @in_record()
    def is_identical(self) -> bool:
        """Whether every file has the same bytes."""
        return self.verdict == "identical"


def rebuild(
    database: Path, inputs: Inputs, output: Path | None = None, progress: Progress = no_progress
) -> Rebuilt:
    """Build a database again from its manifest, and compare every file."""
    old = open_database_folder(database)
    spec = spec_of_database(old)
    check_inputs(spec, inputs)
    # A user's own table is read with the map that was used for the database.
    with known_maps(maps_in(old.manifest)):
        checked = _same_inputs(old, inputs, progress)
        with tempfile.TemporaryDirectory(prefix="starcat-") as folder:
            built = build(spec, output or Path(folder), inputs=checked, progress=progress)
            _check_remote(old, built.manifest, checked)
            return _compare(old, built.folder)


def maps_in(manifest: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the maps of a manifest."""
    return [facts["map"] for facts in manifest["sources"] if "map" in facts]


def _same_inputs(old: DatabaseFolder, inputs: Inputs, progress: Progress) -> Inputs:
    """Return the inputs of a build, after checking that they are the files of the manifest.

    Inputs at an address are checked after the build has read them (`_check_remote`).
    """
    inputs_by_source = {}
    progress("check inputs", 0, None)
    for facts in old.manifest["sources"]:
        name = facts["source"]
        try:
            inputs_by_source[name] = locate(name, inputs)
        except SourceMissing as error:
            files = [file["name"] for file in facts["files"]]
            more = f" and {len(files) - MAX_NAMED:,} more" if len(files) > MAX_NAMED else ""
            named = ", ".join(files[:MAX_NAMED])
            error.problem += f"; {old.folder.name} was made from {named}{more}"
            raise
        if any(map(url_of_input, inputs_by_source[name])):
            continue
        paths = [
            file.path for file in SourceFiles.find(data_source(name), inputs_by_source[name]).files
        ]
        expected = [(file["name"], file["sha256"]) for file in facts["files"]]
        if len(paths) != len(expected):
            raise ChecksumMismatch(
                f"{len(paths)} input files; {old.folder.name} was made from "
                f"{len(expected)}: {', '.join(file for file, _ in expected)}",
                where=name,
                source=name,
            )
        for path, (file, sha256) in zip(paths, expected, strict=True):
            digest = file_sha256(path)
            if digest != sha256:
                raise ChecksumMismatch(
                    f"sha256 {digest}; {old.folder.name} was made from {file} with {sha256}",
                    where=path,
                    source=name,
                    hint=f"Name that file with {{inputs[{name}]}}",
                )
    return inputs_by_source


def _check_remote(old: DatabaseFolder, manifest: dict[str, Any], inputs: Inputs) -> None:
    """Check that the data read from addresses has the digests in the manifest of the database."""
    read = {facts["source"]: facts["files"] for facts in manifest["sources"]}
    for facts in old.manifest["sources"]:
        name = facts["source"]
        before = {file["sha256"] for file in facts["files"]}
        for file in read[name] if any(map(url_of_input, inputs[name])) else ():
            if file["sha256"] not in before:
                raise ChecksumMismatch(
                    f"{file['name']} has changed: the part that was read has sha256 "
                    f"{file['sha256']}, which {old.folder.name} was not made from",
                    where=name,
                    source=name,
                    hint=f"Name what it was made from with {{inputs[{name}]}}",
                )


def _compare(old: DatabaseFolder, folder: Path) -> Rebuilt:
    new = DatabaseFolder(folder, read_manifest(folder))
    names = {
        path.relative_to(root).as_posix()
        for root in (old.folder, folder)
        for path in root.rglob("*")
        if path.is_file()
    }
    changes = [
        FileChange(name, what) for name in sorted(names) if (what := _what_differs(name, old, new))
    ]
    software = changes_between(old.manifest["software"], new.manifest["software"])
    verdict: Verdict = "different" if changes else "identical"
    if software and all(_is_of_software(change, old, new) for change in changes):
        verdict = "same products"
    return Rebuilt(
        f"{new.manifest['name']}-{new.manifest['version']}",
        len(names),
        tuple(changes),
        software,
        verdict,
    )


def _is_of_software(change: FileChange, old: DatabaseFolder, new: DatabaseFolder) -> bool:
    """Return whether a file differs only because other versions of software wrote it.

    This is true of the report, of the manifest if it differs only in the software and in digests
    of files, and of a table with the same values in other bytes.
    """
    if change.what in (MISSING, NOT_MADE, CHANGED):
        return False
    if change.file == MANIFEST_NAME:
        keys = {change.name for change in changes_between(old.manifest, new.manifest)}
        return keys <= {"software", "files", "manifest_sha256"}
    return change.file.startswith("report/") or change.what == BUILT_DIFFERENTLY + SAME_VALUES


MISSING, NOT_MADE = "missing in the database", "not made by the rebuild"
CHANGED, BUILT_DIFFERENTLY = "changed since it was built", "built differently"
SAME_VALUES = ": the same values in other bytes"


def _what_differs(name: str, old: DatabaseFolder, new: DatabaseFolder) -> str:
    """Return the difference of a file; empty if the bytes are the same."""
    before, after = old.folder / name, new.folder / name
    if not before.is_file():
        return MISSING
    if not after.is_file():
        return NOT_MADE
    digest = file_sha256(before)
    if digest == file_sha256(after):
        return ""
    if name == MANIFEST_NAME:
        keys = [change.name for change in changes_between(old.manifest, new.manifest)]
        return f"differs in {', '.join(k for k in keys if k != 'manifest_sha256') or 'form'}"
    if digest != old.manifest["files"].get(name, {}).get("sha256"):
        return CHANGED
    return BUILT_DIFFERENTLY + _columns_that_differ(name, old, new)


def _columns_that_differ(name: str, old: DatabaseFolder, new: DatabaseFolder) -> str:
    product = name.removesuffix(".parquet")
    if product not in old.products or product not in new.products:
        return ""
    a, b = old.table(product), new.table(product)
    if len(a) != len(b):
        return f": {len(a)} rows before, {len(b)} now"
    shared = [column for column in a.column_names if column in b.column_names]
    differ = [column for column in shared if not a[column].equals(b[column])]
    differ += sorted(set(a.column_names) ^ set(b.column_names))
    return f": {', '.join(differ)}" if differ else SAME_VALUES
