"""The answer to a query in ADQL: rows of a session, with what is known of the columns."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from starcat.progress import Progress, no_progress
from starcat.query.names import quoted_name
from starcat.query.session import Session
from starcat.vo.adql import Translation
from starcat.vo.tables import Column
from starcat.vo.types import cast

if TYPE_CHECKING:
    import pyarrow as pa


def ask(
    session: Session,
    asked: Translation,
    max_rows: int | None = None,
    progress: Progress = no_progress,
) -> pa.RecordBatchReader:
    """Return the rows that a query finds."""
    import pyarrow as pa

    with session.ask(asked.sql) as described:
        found = list(zip(described.columns, described.types, strict=True))
    columns = _known(asked.columns, [name for name, _ in found])
    chosen = ", ".join(
        f"{cast(f'#{k}', kind)} AS {quoted_name(column.name)}"
        for k, ((_, kind), column) in enumerate(zip(found, columns, strict=True), start=1)
    )
    limit = "" if max_rows is None else f" LIMIT {max_rows + 1}"
    with session.ask(
        f"SELECT {chosen} FROM ({asked.sql}) AS found{limit}", progress=progress
    ) as it:
        batches = it.batches()
    schema = pa.schema(
        field.with_metadata(column.facts)
        for field, column in zip(batches.schema, columns, strict=True)
    )
    first = next(iter(batches), None)

    def rest() -> Iterator[pa.RecordBatch]:
        if first is not None:
            yield pa.record_batch(first.columns, schema=schema)
        for batch in batches:
            yield pa.record_batch(batch.columns, schema=schema)

    return pa.RecordBatchReader.from_batches(schema, rest())


def _known(columns: tuple[Column, ...] | None, names: list[str]) -> list[Column]:
    """Return the columns of an answer, each with a name of its own."""
    if columns is None or len(columns) != len(names):
        columns = tuple(map(Column.unknown, names))
    given: list[Column] = []
    taken: set[str] = set()
    for column in columns:
        name, number = column.name, 1
        while name.lower() in taken:
            number += 1
            name = f"{column.name}_{number}"
        taken.add(name.lower())
        given.append(column.named(name))
    return given
