"""The databases that a service has: built ones, each under the id that its content gives it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from starcat.artifact.manifest import MANIFEST_NAME, read_manifest
from starcat.errors import ProductError, TargetMissing
from starcat.releases.tree import Blob, files_of
from starcat.service.paths import DATABASE_ID, ServicePaths
from starcat.specs.version import version_numbers
from starcat.storage.digests import file_sha256


@dataclass(frozen=True)
class Database:
    """A built database.

    Attributes
    ----------
    id : str
        Sixteen hexadecimal digits: the beginning of the digest of what it was made from.
    folder : Path
        Its artifact, ``<name>-<version>``.
    manifest : dict
        The manifest of that.
    """

    id: str
    folder: Path
    manifest: dict[str, Any]

    @property
    def name(self) -> str:
        """Name of the artifact."""
        return str(self.manifest["name"])

    @property
    def version(self) -> str:
        """Version of the artifact."""
        return str(self.manifest["version"])

    @property
    def title(self) -> str:
        """Name and version, as the folder has them."""
        return f"{self.name}-{self.version}"

    @cached_property
    def manifest_blob(self) -> Blob:
        """Digest and size of the file of its manifest, by which releases name it."""
        path = self.folder / MANIFEST_NAME
        return Blob(sha256=file_sha256(path), bytes=path.stat().st_size)

    @cached_property
    def files(self) -> dict[str, Blob]:
        """Its files by path within its folder, none of which leads out of it; the manifest first.

        Raises `ProductError` if the manifest lists what is no plain path.
        """
        return {MANIFEST_NAME: self.manifest_blob, **files_of(self.manifest, self.title)}


class Shelf:
    """All databases there are."""

    def __init__(self, paths: ServicePaths) -> None:
        self._paths = paths
        self._known: dict[Path, tuple[int, Database]] = {}

    def databases(self) -> list[Database]:
        """Return all databases."""
        found = []
        for path in self._paths.databases.glob(f"*/*/{MANIFEST_NAME}"):
            if not DATABASE_ID.fullmatch(path.parents[1].name):
                continue
            try:
                found.append(self._at(path))
            except (ProductError, OSError):
                continue
        return sorted(found, key=lambda one: (one.name, version_numbers(one.version), one.id))

    def database(self, database_id: str) -> Database:
        """Return a database."""
        for path in self._paths.database(database_id).glob(f"*/{MANIFEST_NAME}"):
            return self._at(path)
        raise TargetMissing(
            f"no database has the id {database_id!r}; the list of them tells theirs"
        )

    def _at(self, path: Path) -> Database:
        changed_ns = path.stat().st_mtime_ns
        known = self._known.get(path)
        if known is None or known[0] != changed_ns:
            folder = path.parent
            known = changed_ns, Database(folder.parent.name, folder, read_manifest(folder))
            self._known[path] = known
        return known[1]
