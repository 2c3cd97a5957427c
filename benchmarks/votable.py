"""Rows of the star table per second as VOTable, both serialisations, against astropy's writer.

Run with ``make bench``. The table is all columns of 482,176 stars of the embedded sky, once from
memory, and once as ``starcat sql`` and TAP give it, out of the process of a query. astropy writes
the first rows of the same table. Required: 500,000 rows per second, and astropy reads all rows.
"""

from __future__ import annotations

import io
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import get_args

import pyarrow as pa
import pyarrow.compute as pc
from astropy.io.votable import parse
from astropy.io.votable.tree import VOTableFile
from rows import Options, Rows, ended

from starcat.catalog.archives.gaia import embedded_sky
from starcat.catalog.ingest import ingest_catalog
from starcat.query.session import open_session
from starcat.ship.exchange.votable import Serialization, votable_chunks
from starcat.storage.parquet import write_parquet

ASKED_ROWS_S = 500_000
ASTROPY_ROWS = 5_000


def timed(name: str, rows: int, rounds: int, run: Callable[[], int]) -> float:
    """Print the best of some rounds, clock and processors of this process; return rows a second."""
    taken = []
    for _ in range(rounds):
        wall_s, cpu_s = time.perf_counter(), time.process_time()
        size = run()
        taken.append((time.perf_counter() - wall_s, time.process_time() - cpu_s, size))
    wall_s, cpu_s, size = min(taken)
    print(
        f"{name:34} {rows:>9,} rows {rows / wall_s:>11,.0f} rows/s  {wall_s:6.2f} s "
        f"({cpu_s:5.2f} s of processors) {size / 1e6:6.1f} MB"
    )
    return rows / wall_s


def size_of(batches: pa.RecordBatchReader, serialization: Serialization) -> int:
    """Return the bytes of a whole stream."""
    return sum(map(len, votable_chunks(batches, serialization=serialization)))


def read_by_astropy(table: pa.Table, serialization: Serialization) -> VOTableFile:
    """Return the first rows as astropy has them, without null, which its BINARY2 refuses."""
    first = table.slice(0, ASTROPY_ROWS)
    columns = [
        pc.fill_null(column, 0) if pa.types.is_integer(column.type) else column
        for column in first.columns
    ]
    filled = pa.Table.from_arrays(columns, schema=first.schema)
    written = b"".join(votable_chunks(filled.to_reader(), serialization=serialization))
    read = parse(io.BytesIO(written))
    found = read.get_first_table().to_table()
    same = [len(found) == len(filled), found.colnames == filled.column_names]
    if not all(same) or list(found["ra_deg"]) != filled["ra_deg"].to_pylist():
        raise ValueError(f"astropy reads {len(found)} rows of {len(filled)}, or other values")
    return read


def write_by_astropy(file: VOTableFile, serialization: Serialization) -> int:
    """Return the bytes that astropy writes."""
    target = io.BytesIO()
    file.to_xml(target, tabledata_format=serialization)
    return len(target.getvalue())


def main(rows: Rows) -> None:
    """Time both writers."""
    options = Options(__doc__)
    options.size("--rounds", 5, 1, "of which the best counts")
    options.size("--rows", 482_176, 20_000, "of the embedded sky")
    given = options.asked()
    table = ingest_catalog("gaia", [embedded_sky()]).stars.slice(0, given.rows).combine_chunks()
    print(f"{len(table.column_names)} columns: {', '.join(table.column_names)}")

    def judge(name: str, run: Callable[[], int]) -> None:
        rate = timed(name, len(table), given.rounds, run)
        rows.expect(given.quick or rate >= ASKED_ROWS_S, f"{name}: {rate:,.0f} rows/s")

    def stream(one: Serialization) -> int:
        return size_of(_reader(table), one)

    serializations: tuple[Serialization, ...] = get_args(Serialization)
    for one in serializations:
        with rows.row(one):
            known = read_by_astropy(table, one)
            judge(f"stream, {one}", partial(stream, one))
            write = partial(write_by_astropy, known, one)
            timed(f"astropy, {one}", len(known.get_first_table().array), given.rounds, write)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "stars.parquet"
        write_parquet(table, path)
        with open_session([str(path)]) as session:

            def asked(one: Serialization) -> int:
                with session.ask("SELECT * FROM stars") as running:
                    return size_of(running.batches(), one)

            for one in serializations:
                with rows.row(f"query, {one}"):
                    judge(f"query and stream, {one}", partial(asked, one))


def _reader(table: pa.Table) -> pa.RecordBatchReader:
    return pa.RecordBatchReader.from_batches(table.schema, table.to_batches(1 << 16))


if __name__ == "__main__":
    ended(main)
