"""Rows of the star table a second as VOTable, both serialisations, beside astropy's writer.

Run with ``make bench``. The table is all columns of 482,176 stars of the embedded sky, once from
memory, and once as ``starcat sql`` and TAP give it, out of the process of a query. astropy writes
the first rows of the same table. Asked: 500,000 rows a second.
"""

from __future__ import annotations

import io
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import get_args

import pyarrow as pa
import pyarrow.compute as pc
from astropy.io.votable import parse
from astropy.io.votable.tree import VOTableFile

from starcat.catalog.archives.gaia import embedded_sky
from starcat.catalog.ingest import ingest
from starcat.exchange.votable_stream import Serialization, votable_chunks
from starcat.query.session import open_session
from starcat.storage.parquet import write_parquet

ROUNDS = 5
ASTROPY_ROWS = 5_000


def timed(name: str, rows: int, run: Callable[[], int]) -> None:
    """Print the best of some rounds: the clock and the processors of this process."""
    rounds = []
    for _ in range(ROUNDS):
        wall_s, cpu_s = time.perf_counter(), time.process_time()
        size = run()
        rounds.append((time.perf_counter() - wall_s, time.process_time() - cpu_s, size))
    wall_s, cpu_s, size = min(rounds)
    print(
        f"{name:34} {rows:>9,} rows {rows / wall_s:>11,.0f} rows/s  {wall_s:6.2f} s "
        f"({cpu_s:5.2f} s of processors) {size / 1e6:6.1f} MB"
    )


def size_of(batches: pa.RecordBatchReader, serialization: Serialization) -> int:
    """Return the bytes of a whole stream."""
    return sum(map(len, votable_chunks(batches, serialization=serialization)))


def read_by_astropy(table: pa.Table) -> VOTableFile:
    """Return the first rows as astropy has them, without null, which its BINARY2 refuses."""
    first = table.slice(0, ASTROPY_ROWS)
    columns = [
        pc.fill_null(column, 0) if pa.types.is_integer(column.type) else column
        for column in first.columns
    ]
    filled = pa.Table.from_arrays(columns, schema=first.schema)
    return parse(io.BytesIO(b"".join(votable_chunks(filled.to_reader()))))


def write_by_astropy(file: VOTableFile, serialization: Serialization) -> int:
    """Return the bytes that astropy writes."""
    target = io.BytesIO()
    file.to_xml(target, tabledata_format=serialization)
    return len(target.getvalue())


def main() -> None:
    """Time both writers."""
    table = ingest("gaia", [embedded_sky()]).stars.combine_chunks()
    print(f"{len(table.column_names)} columns: {', '.join(table.column_names)}")
    known = read_by_astropy(table)
    serializations: tuple[Serialization, ...] = get_args(Serialization)
    for one in serializations:
        timed(f"stream, {one}", len(table), lambda one=one: size_of(_reader(table), one))
        timed(f"astropy, {one}", ASTROPY_ROWS, lambda one=one: write_by_astropy(known, one))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "stars.parquet"
        write_parquet(table, path)
        with open_session([str(path)]) as session:

            def asked(one: Serialization) -> int:
                with session.ask("SELECT * FROM stars") as running:
                    return size_of(running.batches(), one)

            for one in serializations:
                timed(f"query and stream, {one}", len(table), lambda one=one: asked(one))


def _reader(table: pa.Table) -> pa.RecordBatchReader:
    return pa.RecordBatchReader.from_batches(table.schema, table.to_batches(1 << 16))


if __name__ == "__main__":
    main()
