"""The manifest: the contents and inputs of a database, with a digest for every part.

It contains no times, host names or paths, so the same inputs and the same spec give the same
manifest.
"""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starcat.errors import (
    FileMissing,
    ProductError,
    SchemaVersionError,
    SourceError,
    literal,
    no_database,
)
from starcat.results import entry
from starcat.storage.regular_files import read_regular_file
from starcat.version import __version__

if TYPE_CHECKING:  # reading a manifest needs none of these
    from starcat.catalog.source_files import FileFacts

MANIFEST_NAME = "manifest.json"
MAX_MANIFEST_BYTES = 256 << 20
MANIFEST_VERSION = "1.0.0"
DATABASE_NAME = "database.h5"

SHAPE: dict[Any, Any] = {
    "name": str,
    "version": str,
    "frame": str,
    "epoch_jyear": (int, float),
    "spec": {"catalog": {"source": str}},
    "sources": [
        {
            "source": str,
            "role": str,
            "files": [{"name": str, "sha256": str, "bytes": int, "rows": int}],
            "rows_read": int,
            "kept": int,
            "rejected": {...: int},
        }
    ],
    "products": {
        ...: {
            "schema": str,
            "rows": int,
            "content_sha256": str,
            "parquet": str,
            "in_database": bool,
        }
    },
    "files": {...: {"bytes": int, "sha256": str}},
    "software": {...: str},
}
"""Parts that a manifest must have; other keys are allowed (`_shape_problem` has the notation)."""

LIBRARIES = ("numpy", "scipy", "pyerfa", "pyarrow", "h5py", "pydantic", "matplotlib", "pillow")


@dataclass(frozen=True)
class SourceFacts:
    """One source of a build, for the manifest."""

    # name of the data source; ``stars``, ``motions``, ``variability``, ``doubles``, ``photometry``
    # or ``crossmatch``
    source: str
    role: str
    files: Sequence[FileFacts]  # its input files
    # records, and the number of them that became guide stars (joined source: that were usable)
    rows_read: int
    kept: int
    rejected: dict[str, int]  # rejected records by reason
    # stars with an amplitude, motion or magnitude from this source, or with a counterpart in it
    joined: int | None = field(default=None, metadata=entry(is_optional=True))
    # ``median`` and ``largest`` displacement of the stars whose motion came from this source
    moved_arcsec: dict[str, float] | None = field(default=None, metadata=entry(is_optional=True))
    # map of the user's own table
    map: dict[str, Any] | None = field(default=None, metadata=entry(is_optional=True))


def software_versions() -> dict[str, str]:
    """Return the versions of the software that computes and writes the products."""
    versions = {name: version(name) for name in LIBRARIES}
    return {"starcat": __version__, "python": platform.python_version(), **versions}


def manifest_digest(manifest: Mapping[str, Any]) -> str:
    """Return the digest of a manifest, which it also contains."""
    from starcat.storage.atomic import json_bytes  # imports pyarrow, which reading does not need

    others = {key: value for key, value in manifest.items() if key != "manifest_sha256"}
    return hashlib.sha256(json_bytes(others)).hexdigest()


def read_manifest(folder: Path) -> dict[str, Any]:
    """Read the manifest of a database."""
    path = folder / MANIFEST_NAME
    try:
        data = read_regular_file(path, MAX_MANIFEST_BYTES)
    except FileMissing as error:
        raise no_database(folder) from error
    except SourceError as error:
        raise ProductError(f"{error}; expected the manifest of a database", path=folder) from error
    return parse_manifest(data, str(path), "rebuild the database", path)


def parse_manifest(
    data: bytes, where: str, advice: str, path: Path | None = None
) -> dict[str, Any]:
    """Return a manifest from the bytes of its file, after checking the parts that starcat needs."""
    try:
        manifest = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise _no_manifest(where, str(error), advice, path) from error
    problem = _shape_problem(manifest, {"manifest_version": str}, "")
    if problem:
        raise _no_manifest(where, problem, advice, path)
    manifest_version = manifest["manifest_version"]
    if manifest_version.split(".")[0] != MANIFEST_VERSION.split(".")[0]:
        software = manifest.get("software")
        made_by = software.get("starcat") if isinstance(software, dict) else None
        raise SchemaVersionError(
            f"manifest version {manifest_version}; this starcat reads {MANIFEST_VERSION}",
            where=where,
            product="manifest",
            found=manifest_version,
            expected=MANIFEST_VERSION,
            hint=f"Install starcat {literal(made_by) or 'of the release that wrote it'}",
        )
    problem = _shape_problem(manifest, SHAPE, "") or _name_problem(manifest["products"])
    if problem:
        raise _no_manifest(where, problem, advice, path)
    return dict(manifest)


def database_files(folder: Path) -> set[str]:
    """Return the names of the files of a database: the manifest and what it lists.

    The set is empty if the folder has no manifest of starcat; its version does not matter.
    """
    try:
        manifest = json.loads(read_regular_file(folder / MANIFEST_NAME, MAX_MANIFEST_BYTES))
    except (SourceError, FileMissing, ValueError, RecursionError):
        return set()
    if _shape_problem(manifest, {"manifest_version": str, "files": {...: {}}}, ""):
        return set()
    return {MANIFEST_NAME, *manifest["files"]}


def _no_manifest(where: str, problem: str, advice: str, path: Path | None) -> ProductError:
    return ProductError(f"not a starcat manifest ({problem})", where=where, path=path, hint=advice)


def _shape_problem(value: object, shape: Any, path: str) -> str:
    """Return the first place where a value does not have a shape, or an empty text.

    A shape is a type, or a tuple of types; a list with one shape, for a list of any length; a dict
    of shapes by required keys; or a dict with the single key ``...`` for any keys.
    """
    if isinstance(shape, list):
        if not isinstance(value, list):
            return f"{path} is no list"
        items = ((f"{path}[{n}]", item, shape[0]) for n, item in enumerate(value))
    elif isinstance(shape, dict):
        if not isinstance(value, dict):
            return f"{path or 'it'} is no object"
        dot = f"{path}." if path else ""
        lacking = [name for name in shape if name is not ... and name not in value]
        if lacking:
            return f"no {', '.join(dot + name for name in lacking)}"
        names = value if ... in shape else shape
        items = ((f"{dot}{n}", value[n], shape.get(..., shape.get(n))) for n in names)
    else:
        is_right = isinstance(value, shape) and (shape is bool or not isinstance(value, bool))
        return "" if is_right else f"{path} is {str(value)[:40]!r}"
    return next(filter(None, (_shape_problem(v, s, p) for p, v, s in items)), "")


def _name_problem(products: Mapping[str, Any]) -> str:
    """Return the problem of a product whose file has another name, or an empty text."""
    for name, facts in products.items():
        if facts["parquet"] != f"{name}.parquet" or "/" in name or "\\" in name:
            return f"products.{name}.parquet is {facts['parquet'][:40]!r}"
    return ""
