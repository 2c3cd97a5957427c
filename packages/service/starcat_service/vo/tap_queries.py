"""The tables of TAP, and the way of a question from its parameters to the bytes of its answer."""

from __future__ import annotations

import hashlib
import logging
import threading
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from starcat.catalog.store import is_store
from starcat.errors import ConfigError, StarcatError
from starcat.progress import Progress, no_progress
from starcat.ship.exchange import WHOLE_FORMATS, Format, Label, result_chunks
from starcat_service.library import Library
from starcat_service.paths import ServicePaths
from starcat_service.protocols.adql import translate, translate_adql
from starcat_service.protocols.documents import ServiceLimits
from starcat_service.protocols.parameters import TapQuestion, Upload
from starcat_service.protocols.tables import (
    NAME,
    UPLOADS,
    Schema,
    Tables,
    TapTable,
    own_schema,
    session_schemas,
    write_tap_schema,
)
from starcat_service.protocols.uploads import table_of_facts
from starcat_service.sandbox.pool import QueryPool
from starcat_service.sandbox.sandbox import Sandbox
from starcat_service.settings import ServiceSettings
from starcat_service.transfers import file_chunks, scratch_folder, within_disk, write_rows

if TYPE_CHECKING:
    import pyarrow as pa

DAY_S = 86_400

_LABEL = Label("result")

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class TapState:
    """The data that queries can use."""

    targets: tuple[Path, ...]  # targets of a session, TAP_SCHEMA and uploads last
    tables: Tables  # all tables, including TAP_SCHEMA and uploads


class Tap:
    """Capabilities of TAP, the current tables of a service, and answers about them."""

    def __init__(
        self,
        settings: ServiceSettings,
        paths: ServicePaths,
        library: Library,
        query_pool: QueryPool,
        sandbox: Sandbox,
    ) -> None:
        self.limits = ServiceLimits(
            run_s=int(settings.job_time_s),
            keep_s=int(settings.keep_results_days * DAY_S),
            rows=settings.max_rows,
            upload_bytes=int(settings.upload_mib * 2**20),
        )
        self._settings = settings
        self._paths = paths
        self._library = library
        self._query_pool = query_pool
        self._sandbox = sandbox
        self._looking = threading.Lock()
        self._state: tuple[str, TapState] | None = None

    def state(self) -> TapState:
        """Return the current tables."""
        about = self._names_by_path()
        key = _digest(list(about))
        with self._looking:
            cached = self._state
            # Old files in scratch are removed.
            if (
                cached is None
                or cached[0] != key
                or not any(cached[1].targets[-1].glob("*.parquet"))
            ):
                cached = self._state = key, self._looked_at(about, key)
            return cached[1]

    def _names_by_path(self) -> dict[Path, str]:
        """Return the existing databases and catalogs on disk, and their names."""
        # Of two databases with one name and version, the older one keeps its schema.
        databases = sorted(self._library.databases(), key=lambda database: database.built_ns)
        names = {
            database.folder: f"Guide-star database {database.name}, version {database.version}"
            for database in databases
        }
        for path in sorted(self._paths.catalogs.iterdir()):
            is_table = path.suffix == ".parquet" and not path.stem.endswith("rejected")
            if path.is_file() and is_table:
                names[path] = f"Stars of the catalog {path.stem}"
            elif path.is_dir() and (is_store(path) or any(path.glob("*.parquet"))):
                names[path] = f"Stars of the catalog {path.name}"
        return names

    def _looked_at(self, about: dict[Path, str], key: str) -> TapState:
        try:
            return self._opened(about, key)
        except StarcatError as error:
            _logger.warning("a table cannot be shown by TAP: %s", error)
        return self._opened({path: name for path, name in about.items() if self._opens(path)}, key)

    def _opens(self, path: Path) -> bool:
        try:
            with self._query_pool.session([path]):
                return True
        except StarcatError:
            return False

    def _opened(self, about: dict[Path, str], key: str) -> TapState:
        folder = self._paths.scratch / f"tap-{key}" / NAME
        schemas: tuple[Schema, ...] = ()
        if about:
            with self._query_pool.session(list(about)) as session:
                names = [target.name for target in session.targets]
                names_of_targets = dict(zip(names, about.values(), strict=True))
                schemas = session_schemas(session, names_of_targets)
        tables = Tables((*schemas, own_schema()))
        write_tap_schema(tables, folder)
        return TapState((*about, folder), tables)

    def answer(
        self,
        asked: TapQuestion,
        files: Mapping[str, Path],
        time_s: float | None = None,
        progress: Progress | Callable[..., None] = no_progress,
    ) -> Generator[bytes, None, None]:
        """Yield the answer to a question."""
        with self._state_with(asked.uploads, files) as state:
            translated = translate(asked.query, state.tables)
            with self._query_pool.session(state.targets, time_s) as session:
                batches = translate_adql(session, translated, asked.max_rows, progress)
                yield from self.chunks(batches, asked.form, asked.max_rows, _LABEL)

    def chunks(
        self, batches: pa.RecordBatchReader, form: Format, max_rows: int, label: Label
    ) -> Iterator[bytes]:
        """Yield an answer in a format.

        Formats that need the whole table in memory are made by a process of the sandbox.
        """
        batches = within_disk(batches, self._settings)
        if form.name not in WHOLE_FORMATS:
            scratch = self._paths.scratch
            yield from result_chunks(batches, form, scratch, label=label, maxrec=max_rows)
            return
        with scratch_folder(self._paths) as folder:
            rows, result = folder / "rows.arrow", folder / f"result{form.suffix}"
            write_rows(batches, rows, max_rows)
            self._sandbox.convert(rows, result, form.name, label)
            chunks = file_chunks(result.open("rb"))
        yield from chunks

    @contextmanager
    def _state_with(
        self, uploads: tuple[Upload, ...], files: Mapping[str, Path]
    ) -> Iterator[TapState]:
        """Yield the current tables, with the tables that a question uploads."""
        if not uploads:
            yield self.state()
            return
        for upload in uploads:
            if upload.part and upload.part not in files:
                raise ConfigError(
                    f"UPLOAD of {upload.table}: the request has no file {upload.part!r}",
                    key="UPLOAD",
                    hint="send it as a part of multipart/form-data with that name",
                )
        with scratch_folder(self._paths) as scratch:
            folder = scratch / UPLOADS
            folder.mkdir()
            tables = tuple(
                self._read(files[upload.part or upload.job_id], upload, folder)
                for upload in uploads
            )
            uploaded = Schema(UPLOADS, "Tables that came with the query", tables)
            state = self.state()
            yield TapState((*state.targets, folder), state.tables.with_schema(uploaded))

    def _read(self, file: Path, upload: Upload, folder: Path) -> TapTable:
        arguments = {"path": str(file), "name": upload.table, "folder": str(folder)}
        return table_of_facts(self._sandbox.call("upload", arguments))


def _digest(paths: list[Path]) -> str:
    """Return a name for a state of the tables."""
    stamps = [f"{path}\0{path.stat().st_mtime_ns}" for path in paths]
    return hashlib.sha256("\n".join(stamps).encode()).hexdigest()[:16]
