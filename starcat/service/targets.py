"""What a query of a request is about: databases by id or title, catalogs by name, nothing else."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from starcat.errors import TargetMissing
from starcat.service.paths import DATABASE_ID
from starcat.service.problems import Problem
from starcat.service.service import Service
from starcat.service.shelf import Database

CATALOG = re.compile(r"(?P<source>[a-z0-9_]{1,64})-[0-9a-f]{16}(\.parquet)?", re.ASCII)
"""How the files and folders of catalogs are called."""


def catalog_names(service: Service) -> list[str]:
    """Return the names of the catalogs that can be asked about."""
    if not service.paths.catalogs.is_dir():
        return []
    return sorted(
        path.name for path in service.paths.catalogs.iterdir() if CATALOG.fullmatch(path.name)
    )


def target_paths(service: Service, names: Sequence[str]) -> list[Path]:
    """Return what the targets of a query are on disk."""
    return [_target(service, name) for name in names]


def database_of(service: Service, name: str) -> Database:
    """Return a database by its id or its title."""
    titled = [] if DATABASE_ID.fullmatch(name) else _titled(service, name)
    return titled[0] if titled else service.shelf.database(name)


def _titled(service: Service, name: str) -> list[Database]:
    found = [one for one in service.shelf.databases() if one.title == name]
    if len(found) > 1:
        ids = ", ".join(one.id for one in found)
        raise Problem(409, f"{len(found)} databases are called {name}; say which: {ids}")
    return found


def _target(service: Service, name: str) -> Path:
    if DATABASE_ID.fullmatch(name) or _titled(service, name):
        return database_of(service, name).folder
    found = [
        service.paths.catalogs / one
        for one in catalog_names(service)
        if name in (one, one.removesuffix(".parquet"), one.rpartition("-")[0])
    ]
    if found:
        return max(found, key=lambda path: (path.stat().st_mtime_ns, path.name))
    raise TargetMissing(
        f"no database or catalog {name[:80]!r}; give the id or the title of one that "
        "/api/v1/databases lists, or the name of a catalog that was read"
    )
