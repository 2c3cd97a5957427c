"""Copies of a database that tests change, and functions that correct their manifests."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from starcat.database.manifest import MANIFEST_NAME, manifest_digest
from starcat.storage.atomic import file_sha256, json_bytes


def copied(database: Path, folder: Path) -> Path:
    """Copy a database into a folder, under its own name; the files can be written to."""
    return Path(shutil.copytree(database, folder / database.name, copy_function=shutil.copyfile))


def seal(
    database: Path, change: Callable[[dict[str, Any]], object] = lambda manifest: None
) -> None:
    """Make the digests of files and of the manifest right, after a change of what it says."""
    manifest = json.loads((database / MANIFEST_NAME).read_bytes())
    for name, facts in manifest["files"].items():
        path = database / name
        if path.is_file():
            facts |= {"bytes": path.stat().st_size, "sha256": file_sha256(path)}
    change(manifest)
    manifest["manifest_sha256"] = manifest_digest(manifest)
    (database / MANIFEST_NAME).write_bytes(json_bytes(manifest))
