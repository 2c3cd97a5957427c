"""The keys of jobs: everything that a result depends on, and nothing else, as one digest.

Two requests with the same key have the same answer, whoever sends them, however the spec is
written, and wherever the input files are.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from starcat.catalog import SourceFiles, data_source, locate, map_of
from starcat.catalog.store import is_store
from starcat.errors import SourceMissing, reason
from starcat.pipeline.specs import BuildSpec
from starcat.storage import file_sha256, json_bytes
from starcat.version import __version__
from starcat_service.jobs.job import Kind
from starcat_service.records import Records

LARGE_BYTES = 2 << 30
"""Larger files are identified by path, size and time: reading them would take seconds."""


def build_key(records: Records, spec: BuildSpec) -> str:
    """Return the key of a build."""
    inputs = {name: source_digests(records, name) for name in spec.sources}
    return key_of("build", {"spec": spec.recorded(), "inputs": inputs})


def ingest_key(records: Records, request: Mapping[str, Any]) -> str:
    """Return the key of an ingest."""
    source = str(request["source"])
    inputs = {source: source_digests(records, source)}
    return key_of("ingest", {**request, "inputs": inputs})


def key_of(kind: Kind, content: Mapping[str, Any]) -> str:
    """Return the key of a job of any kind."""
    whole = {"kind": kind, "starcat": __version__, **content}
    return hashlib.sha256(json_bytes(whole)).hexdigest()


def source_digests(records: Records, name: str) -> list[str]:
    """Return the digests that identify the files of a source."""
    paths = locate(name, {})
    try:
        digests = file_digests(records, source_files(name, paths))
    except OSError as error:
        raise SourceMissing(
            f"{name}: a file cannot be read ({reason(error)}); the operator has to look at "
            f"{', '.join(map(str, paths))}",
            source=name,
        ) from error
    table_map = map_of(name)
    return [*digests, hashlib.sha256(json_bytes(table_map)).hexdigest()] if table_map else digests


def source_files(name: str, paths: Iterable[Path]) -> list[Path]:
    """Return the files of a source."""
    files: list[Path] = []
    for path in paths:
        if path.is_dir() and is_store(path):
            # The metadata of a store lists its partitions with their digests.
            files += sorted(file for file in path.iterdir() if file.is_file())
        else:
            files += [file.path for file in SourceFiles.find(data_source(name), [path]).files]
    return files


def file_digests(records: Records, paths: Iterable[Path]) -> list[str]:
    """Return the digests of files; a file that does not change is read once."""
    return [_digest(records, path.resolve()) for path in paths]


def _digest(records: Records, path: Path) -> str:
    stat = path.stat()
    if stat.st_size > LARGE_BYTES:
        text = f"{path} {stat.st_size} {stat.st_mtime_ns}"
        return hashlib.sha256(text.encode()).hexdigest()
    facts = (str(path), stat.st_size, stat.st_mtime_ns)
    query = "SELECT sha256 FROM file_digests WHERE path = ? AND size_bytes = ? AND changed_ns = ?"
    for row in records.rows(query, *facts):
        return str(row["sha256"])
    digest = file_sha256(path)
    with records.writing() as connection:
        connection.execute(
            "INSERT OR REPLACE INTO file_digests (path, size_bytes, changed_ns, sha256) "
            "VALUES (?, ?, ?, ?)",
            (*facts, digest),
        )
    return digest
