"""Targets of queries to a service: built databases by id or title, catalogs by name."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from starcat.database import MANIFEST_NAME, read_manifest
from starcat.errors import ProductError, TargetMissing
from starcat.geometry import Camera
from starcat.pipeline.specs import CameraSpec
from starcat.sections import version_numbers
from starcat.ship.releases import Blob, tree_files
from starcat.storage import file_sha256
from starcat_service.paths import DATABASE_ID, ServicePaths
from starcat_service.problems import Problem

CATALOG = re.compile(r"(?P<source>[a-z0-9_]{1,64})-[0-9a-f]{16}(\.parquet)?", re.ASCII)
"""Names that jobs give to files and folders of catalogs."""


class ListedDatabase(BaseModel):
    """A built database: its sources and its contents."""

    model_config = ConfigDict(frozen=True)

    folder: Path = Field(exclude=True)  # ``<name>-<version>``
    manifest: dict[str, Any] = Field(exclude=True)
    id: str = Field(
        description="First digits of the digest of its inputs and spec.",
        examples=["0123456789abcdef"],
    )
    name: str = Field(examples=["gaia-12deg"])
    version: str = Field(examples=["1.0.0"])
    title: str = Field(description="Name of its folder.", examples=["gaia-12deg-1.0.0"])
    description: str = Field(description="Description from the spec.")
    frame: str = Field(description="Axes of all positions.", examples=["ICRS"])
    epoch_jyear: float = Field(description="Epoch of all positions, Julian year.")
    catalog: str = Field(description="The star catalog.", examples=["gaia"])
    stars: int = Field(description="Guide stars.")
    bytes: int = Field(description="Size of all files together, without the manifest.")
    products: dict[str, int] = Field(description="Rows of each product.")
    manifest_sha256: str = Field(description="Digest that the manifest carries of itself.")
    spec: dict[str, Any] = Field(description="The spec, with all defaults.")
    software: dict[str, str] = Field(description="Versions of what built it.")

    @classmethod
    def of_manifest(
        cls, database_id: str, folder: Path, manifest: dict[str, Any]
    ) -> ListedDatabase:
        """Return the database of a manifest."""
        spec = manifest["spec"]
        products = {name: int(facts["rows"]) for name, facts in manifest["products"].items()}
        return cls(
            folder=folder,
            manifest=manifest,
            id=database_id,
            name=manifest["name"],
            version=manifest["version"],
            title=f"{manifest['name']}-{manifest['version']}",
            description=spec.get("description") or "",
            frame=manifest["frame"],
            epoch_jyear=manifest["epoch_jyear"],
            catalog=spec["catalog"]["source"],
            stars=products.get("stars", 0),
            bytes=sum(int(facts["bytes"]) for facts in manifest["files"].values()),
            products=products,
            manifest_sha256=manifest.get("manifest_sha256", ""),
            spec=spec,
            software=manifest["software"],
        )

    @property
    def built_ns(self) -> int:
        """Time at which its manifest was written, nanoseconds since 1970."""
        return (self.folder / MANIFEST_NAME).stat().st_mtime_ns

    @property
    def catalog_in_words(self) -> str:
        """Name of the star catalog, with the band."""
        band = self.spec["catalog"].get("band")
        return f"{self.catalog}{f' ({band})' if band else ''}"

    @cached_property
    def camera(self) -> Camera:
        """The camera that it is for."""
        return CameraSpec.model_validate(self.spec["camera"]).camera()

    @cached_property
    def manifest_blob(self) -> Blob:
        """Digest and size of its manifest file, by which releases identify it."""
        path = self.folder / MANIFEST_NAME
        return Blob(sha256=file_sha256(path), bytes=path.stat().st_size)

    @cached_property
    def files(self) -> dict[str, Blob]:
        """Its files by path within its folder, the manifest first. No path leads out of the folder.

        Raises `ProductError` if the manifest lists a path that is not plain.
        """
        return {MANIFEST_NAME: self.manifest_blob, **tree_files(self.manifest, self.title)}


@dataclass(frozen=True)
class StoredCatalog:
    """A star table that a job has read."""

    name: str  # name of its file or folder
    source: str
    bytes: int


class Library:
    """The databases and catalogs of a service; a manifest is read again only after it changes."""

    def __init__(self, paths: ServicePaths) -> None:
        self._paths = paths
        self._cache: dict[Path, tuple[int, ListedDatabase]] = {}

    def databases(self) -> list[ListedDatabase]:
        """Return all readable databases, by name, version and id."""
        databases = []
        paths = list(self._paths.databases.glob(f"*/*/{MANIFEST_NAME}"))
        for gone in set(self._cache) - set(paths):
            self._cache.pop(gone, None)
        for path in paths:
            if not DATABASE_ID.fullmatch(path.parents[1].name):
                continue
            try:
                databases.append(self._at(path))
            except (ProductError, OSError):
                continue
        return sorted(
            databases,
            key=lambda database: (database.name, version_numbers(database.version), database.id),
        )

    def database(self, database_id: str) -> ListedDatabase:
        """Return the database with an id."""
        for path in self._paths.database(database_id).glob(f"*/{MANIFEST_NAME}"):
            return self._at(path)
        raise TargetMissing(
            f"no database has the id {database_id!r}; the list of databases shows the valid ids"
        )

    def find(self, name: str) -> ListedDatabase:
        """Return the database with an id or a title."""
        return self._titled(name) or self.database(name)

    def target(self, name: str) -> Path:
        """Return the folder of a database, or the newest file or folder of a catalog."""
        if DATABASE_ID.fullmatch(name):
            return self.database(name).folder
        database = self._titled(name)
        if database is not None:
            return database.folder
        paths = [
            self._paths.catalogs / catalog
            for catalog in self.catalogs()
            if name in (catalog, catalog.removesuffix(".parquet"), catalog.rpartition("-")[0])
        ]
        if paths:
            return max(paths, key=lambda path: (path.stat().st_mtime_ns, path.name))
        raise TargetMissing(
            f"no database or catalog {name[:80]!r}",
            hint="give the id or the title of one that /api/v1/databases lists, or the name of a "
            "catalog that was read",
        )

    def stored_catalogs(self) -> list[StoredCatalog]:
        """Return the star tables that jobs have read."""
        catalogs = []
        for name in self.catalogs():
            path = self._paths.catalogs / name
            files = path.rglob("*") if path.is_dir() else [path]
            size = sum(file.lstat().st_size for file in files)
            catalogs.append(StoredCatalog(name, name.rpartition("-")[0], size))
        return catalogs

    def catalogs(self) -> list[str]:
        """Return the names of the catalogs that jobs have read."""
        folder = self._paths.catalogs
        if not folder.is_dir():
            return []
        return sorted(path.name for path in folder.iterdir() if CATALOG.fullmatch(path.name))

    def _titled(self, title: str) -> ListedDatabase | None:
        if DATABASE_ID.fullmatch(title):
            return None
        databases = [database for database in self.databases() if database.title == title]
        if len(databases) > 1:
            ids = ", ".join(database.id for database in databases)
            raise Problem(409, f"{len(databases)} databases are called {title}; say which: {ids}")
        return databases[0] if databases else None

    def _at(self, path: Path) -> ListedDatabase:
        changed_ns = path.stat().st_mtime_ns
        entry = self._cache.get(path)
        if entry is None or entry[0] != changed_ns:
            folder = path.parent
            manifest = read_manifest(folder)
            entry = changed_ns, ListedDatabase.of_manifest(folder.parent.name, folder, manifest)
            self._cache[path] = entry
        return entry[1]
