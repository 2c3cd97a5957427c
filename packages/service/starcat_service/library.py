"""What a service has to be asked about: built databases by id or title, catalogs by name."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from starcat.artifact.manifest import MANIFEST_NAME, read_manifest
from starcat.errors import ProductError, TargetMissing
from starcat.geometry.camera import Camera
from starcat.releases.tree import Blob, files_of
from starcat.sections import version_numbers
from starcat.specs.build_spec import CameraSpec
from starcat.storage.digests import file_sha256
from starcat_service.paths import DATABASE_ID, ServicePaths
from starcat_service.problems import Problem

CATALOG = re.compile(r"(?P<source>[a-z0-9_]{1,64})-[0-9a-f]{16}(\.parquet)?", re.ASCII)
"""How jobs name the files and folders of catalogs."""


@dataclass(frozen=True)
class Database:
    """A built database."""

    id: str  # 16 hexadecimal digits: the beginning of the digest of what it was made from
    folder: Path  # the database, ``<name>-<version>``
    manifest: dict[str, Any]

    @property
    def name(self) -> str:
        """Name of the database."""
        return str(self.manifest["name"])

    @property
    def version(self) -> str:
        """Version of the database."""
        return str(self.manifest["version"])

    @property
    def title(self) -> str:
        """Name and version, as the folder has them."""
        return f"{self.name}-{self.version}"

    @property
    def built_ns(self) -> int:
        """When its manifest was written, nanoseconds since 1970."""
        return (self.folder / MANIFEST_NAME).stat().st_mtime_ns

    @property
    def spec(self) -> dict[str, Any]:
        """The spec, with all defaults."""
        return dict(self.manifest["spec"])

    @property
    def description(self) -> str:
        """Description from the spec."""
        return str(self.spec.get("description") or "")

    @property
    def catalog(self) -> str:
        """Name of the star catalog, with the band."""
        catalog = self.spec["catalog"]
        band = catalog.get("band")
        return f"{catalog['source']}{f' ({band})' if band else ''}"

    @cached_property
    def camera(self) -> Camera:
        """The camera that it is for."""
        return CameraSpec.model_validate(self.spec["camera"]).camera()

    @property
    def products(self) -> dict[str, int]:
        """Rows of each product."""
        return {name: int(facts["rows"]) for name, facts in self.manifest["products"].items()}

    @property
    def bytes(self) -> int:
        """Size of all files together, without the manifest."""
        return sum(int(facts["bytes"]) for facts in self.manifest["files"].values())

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


class Library:
    """The databases and catalogs of a service; a manifest is read once for each of its states."""

    def __init__(self, paths: ServicePaths) -> None:
        self._paths = paths
        self._known: dict[Path, tuple[int, Database]] = {}

    def databases(self) -> list[Database]:
        """Return all databases that can be read, by name, version and id."""
        found = []
        paths = list(self._paths.databases.glob(f"*/*/{MANIFEST_NAME}"))
        for gone in set(self._known) - set(paths):
            self._known.pop(gone, None)
        for path in paths:
            if not DATABASE_ID.fullmatch(path.parents[1].name):
                continue
            try:
                found.append(self._at(path))
            except (ProductError, OSError):
                continue
        return sorted(found, key=lambda one: (one.name, version_numbers(one.version), one.id))

    def database(self, database_id: str) -> Database:
        """Return the database of an id."""
        for path in self._paths.database(database_id).glob(f"*/{MANIFEST_NAME}"):
            return self._at(path)
        raise TargetMissing(
            f"no database has the id {database_id!r}; the list of them tells theirs"
        )

    def find(self, name: str) -> Database:
        """Return the database of an id or a title."""
        return self._titled(name) or self.database(name)

    def target(self, name: str) -> Path:
        """Return the folder of a database, or the newest file or folder of a catalog."""
        if DATABASE_ID.fullmatch(name):
            return self.database(name).folder
        database = self._titled(name)
        if database is not None:
            return database.folder
        found = [
            self._paths.catalogs / one
            for one in self.catalogs()
            if name in (one, one.removesuffix(".parquet"), one.rpartition("-")[0])
        ]
        if found:
            return max(found, key=lambda path: (path.stat().st_mtime_ns, path.name))
        raise TargetMissing(
            f"no database or catalog {name[:80]!r}; give the id or the title of one that "
            "/api/v1/databases lists, or the name of a catalog that was read"
        )

    def catalogs(self) -> list[str]:
        """Return the names of the catalogs that jobs have read."""
        folder = self._paths.catalogs
        if not folder.is_dir():
            return []
        return sorted(path.name for path in folder.iterdir() if CATALOG.fullmatch(path.name))

    def _titled(self, title: str) -> Database | None:
        if DATABASE_ID.fullmatch(title):
            return None
        found = [one for one in self.databases() if one.title == title]
        if len(found) > 1:
            ids = ", ".join(one.id for one in found)
            raise Problem(409, f"{len(found)} databases are called {title}; say which: {ids}")
        return found[0] if found else None

    def _at(self, path: Path) -> Database:
        changed_ns = path.stat().st_mtime_ns
        known = self._known.get(path)
        if known is None or known[0] != changed_ns:
            folder = path.parent
            known = changed_ns, Database(folder.parent.name, folder, read_manifest(folder))
            self._known[path] = known
        return known[1]
