"""A question of TAP from its parameters to the bytes of its answer."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from starcat.errors import ConfigError
from starcat.exchange.columns import Label
from starcat.exchange.formats import Format
from starcat.exchange.writers import result_chunks
from starcat.progress import Progress, no_progress
from starcat.service.paths import ServicePaths
from starcat.service.query_pool import QueryPool
from starcat.service.sandbox.sandbox import Sandbox
from starcat.service.transfers import chunks_of, scratch_folder, write_rows
from starcat.service.vo.tap_tables import TapTables
from starcat.vo.adql import ask, translate
from starcat.vo.parameters import Question, Upload
from starcat.vo.tables import Schema, Table
from starcat.vo.tap_schema import UPLOADS
from starcat.vo.uploads import table_of_facts

if TYPE_CHECKING:
    import pyarrow as pa

_LABEL = Label("result")


class TapQueries:
    """What answers questions."""

    def __init__(
        self,
        paths: ServicePaths,
        tables: TapTables,
        query_pool: QueryPool,
        sandbox: Sandbox,
        most_rows: int,
    ) -> None:
        self._sandbox = sandbox
        self.most_rows = most_rows
        self._paths = paths
        self._tables = tables
        self._query_pool = query_pool

    def answer(
        self,
        asked: Question,
        files: Mapping[str, Path],
        time_s: float | None = None,
        progress: Progress | Callable[..., None] = no_progress,
    ) -> Generator[bytes, None, None]:
        """Yield the answer to a question."""
        with self._uploaded(asked.uploads, files) as (folder, uploaded):
            state = self._tables.state()
            tables, targets = state.tables, list(state.targets)
            if uploaded is not None and folder is not None:
                tables = tables.with_schema(uploaded)
                targets.append(folder)
            translated = translate(asked.query, tables)
            with self._query_pool.session(targets, time_s) as session:
                batches = ask(session, translated, asked.max_rows, progress)
                yield from self._chunks(batches, asked.form, asked.max_rows)

    def _chunks(
        self, batches: pa.RecordBatchReader, form: Format, max_rows: int
    ) -> Iterator[bytes]:
        """Yield an answer in a format; FITS, held in memory as a whole, is another process's."""
        if form.name != "fits":
            scratch = self._paths.scratch
            yield from result_chunks(batches, form, scratch, label=_LABEL, maxrec=max_rows)
            return
        with scratch_folder(self._paths) as folder:
            rows, result = folder / "rows.arrow", folder / "result.fits"
            write_rows(batches, rows, max_rows)
            self._sandbox.convert(rows, result, "fits")
            chunks = chunks_of(result.open("rb"))
        yield from chunks

    @contextmanager
    def _uploaded(
        self, uploads: tuple[Upload, ...], files: Mapping[str, Path]
    ) -> Iterator[tuple[Path | None, Schema | None]]:
        """Give the folder and the schema of what came with a question, while it is answered."""
        if not uploads:
            yield None, None
            return
        for one in uploads:
            if one.part and one.part not in files:
                raise ConfigError(
                    f"UPLOAD of {one.table}: the request has no file {one.part!r}; send it as a "
                    "part of multipart/form-data with that name",
                    key="UPLOAD",
                )
        top = Path(tempfile.mkdtemp(prefix="upload-", dir=self._paths.scratch))
        try:
            folder = top / UPLOADS
            folder.mkdir()
            tables = tuple(
                self._read(files[one.part or one.job_id], one, folder) for one in uploads
            )
            yield folder, Schema(UPLOADS, "Tables that came with the query", tables)
        finally:
            shutil.rmtree(top, ignore_errors=True)

    def _read(self, file: Path, upload: Upload, folder: Path) -> Table:
        given = {"path": str(file), "name": upload.table, "folder": str(folder)}
        return table_of_facts(self._sandbox.call("upload", given))
