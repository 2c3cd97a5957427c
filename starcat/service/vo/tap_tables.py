"""The tables that TAP shows: those of all databases, and of the catalogs that were read.

What is known of them is found out once for each state of the library, and written as TAP_SCHEMA's
tables, which queries read like any others.
"""

from __future__ import annotations

import hashlib
import logging
import threading
from dataclasses import dataclass
from pathlib import Path

from starcat.catalog.verdict import rejected_path
from starcat.errors import StarcatError
from starcat.service.library import Library
from starcat.service.paths import ServicePaths
from starcat.service.query_pool import QueryPool
from starcat.store.layout import is_store
from starcat.vo.tables import Schema, Tables
from starcat.vo.tap_schema import NAME, own_schema, session_schemas, write_tap_schema

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class TapState:
    """What there is to be asked."""

    targets: tuple[Path, ...]  # what a session has to open, TAP_SCHEMA at the end
    tables: Tables  # all tables, with TAP_SCHEMA


class TapTables:
    """The tables of a service, as they are now."""

    def __init__(self, paths: ServicePaths, library: Library, query_pool: QueryPool) -> None:
        self._paths = paths
        self._library = library
        self._query_pool = query_pool
        self._looking = threading.Lock()
        self._state: tuple[str, TapState] | None = None

    def state(self) -> TapState:
        """Return what there is to be asked."""
        about = self._found()
        key = _digest(list(about))
        with self._looking:
            known = self._state
            # What lies in scratch for long is removed.
            if known is None or known[0] != key or not any(known[1].targets[-1].glob("*.parquet")):
                known = self._state = key, self._looked_at(about, key)
            return known[1]

    def _found(self) -> dict[Path, str]:
        """Return what there is on disk, and what each is."""
        found = {
            database.folder: f"Guide-star database {database.name}, version {database.version}"
            for database in self._library.databases()
        }
        for path in sorted(self._paths.catalogs.iterdir()):
            is_table = path.suffix == ".parquet" and path != rejected_path(path)
            if path.is_file() and is_table and not path.stem.endswith("rejected"):
                found[path] = f"Stars of the catalog {path.stem}"
            elif path.is_dir() and (is_store(path) or any(path.glob("*.parquet"))):
                found[path] = f"Stars of the catalog {path.name}"
        return found

    def _looked_at(self, about: dict[Path, str], key: str) -> TapState:
        try:
            return self._opened(about, key)
        except StarcatError as error:
            _logger.warning("a table cannot be shown by TAP: %s", error)
        return self._opened({path: told for path, told in about.items() if self._opens(path)}, key)

    def _opens(self, path: Path) -> bool:
        try:
            with self._query_pool.session([path]):
                return True
        except StarcatError:
            return False

    def _opened(self, about: dict[Path, str], key: str) -> TapState:
        own = own_schema()
        folder = self._paths.scratch / f"tap-{key}" / NAME
        schemas: tuple[Schema, ...] = ()
        if about:
            with self._query_pool.session(list(about)) as session:
                names = [target.name for target in session.targets]
                told = dict(zip(names, about.values(), strict=True))
                schemas = session_schemas(session, told)
        tables = Tables((*schemas, own))
        write_tap_schema(tables, folder)
        return TapState((*about, folder), tables)


def _digest(paths: list[Path]) -> str:
    """Return a name for a state of what there is."""
    told = [f"{path}\0{path.stat().st_mtime_ns}" for path in paths]
    return hashlib.sha256("\n".join(told).encode()).hexdigest()[:16]
