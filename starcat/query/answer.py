"""The answer to a query: its columns with their units, and its rows."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any

import duckdb

from starcat.query.columns import Facts, column_facts

if TYPE_CHECKING:
    import pyarrow as pa
    from duckdb import DuckDBPyConnection

BATCH_ROWS = 1 << 16


class Answer:
    """What a query finds; nothing runs before something is asked for.

    Parameters
    ----------
    connection : duckdb.DuckDBPyConnection
        Where it runs.
    text : str
        SQL, checked.
    values : dict of str to object, optional
        Of the ``$name`` in it.
    known : mapping of str to Facts
        Of the columns of the views, by name.
    """

    def __init__(
        self,
        connection: DuckDBPyConnection,
        text: str,
        values: dict[str, Any] | None,
        known: Mapping[str, Facts],
    ) -> None:
        self._connection = connection
        self._text = text
        self._values = values
        self._known = known

    @cached_property
    def _described(self) -> list[tuple[str, str]]:
        """Names and types of the columns."""
        bound = self._connection.sql(self._text, params=self._values)
        return [(name, str(kind)) for name, kind in zip(bound.columns, bound.types, strict=True)]

    @property
    def columns(self) -> list[str]:
        """Names, in order."""
        return [name for name, _ in self._described]

    @property
    def types(self) -> list[str]:
        """DuckDB's names of their types."""
        return [kind for _, kind in self._described]

    @property
    def facts(self) -> list[Facts]:
        """Unit and meaning of each column."""
        return [column_facts(name, self._known) for name, _ in self._described]

    def rows(self, count: int) -> list[tuple[Any, ...]]:
        """Return the first rows.

        Parameters
        ----------
        count : int
            How many at most.

        Returns
        -------
        list of tuple
            Fewer where there are no more.
        """
        running = self._connection.execute(self._text, self._values)
        # Known now, without looking at the files once more.
        self._described = [(str(column[0]), str(column[1])) for column in running.description]
        found = list(running.fetchmany(count))
        running.abort()
        return found

    def batches(self) -> pa.RecordBatchReader:
        """Return all rows as Arrow batches, with units and meanings in the field metadata.

        Returns
        -------
        pyarrow.RecordBatchReader
            To be read before the next query.
        """
        import pyarrow as pa

        relation = self._connection.sql(self._text, params=self._values)
        reader = relation.to_arrow_reader(BATCH_ROWS)
        schema = pa.schema(
            field.with_metadata(column_facts(field.name, self._known).as_metadata())
            for field in reader.schema
        )
        return pa.RecordBatchReader.from_batches(schema, _described(reader, schema))


def _described(reader: pa.RecordBatchReader, schema: pa.Schema) -> Iterator[pa.RecordBatch]:
    """Give the batches another schema; what goes wrong comes as DuckDB's own exceptions."""
    import pyarrow as pa

    try:
        for batch in reader:
            yield pa.record_batch(batch.columns, schema=schema)
    except (OSError, pa.ArrowException) as error:
        # Arrow passes on the words alone.
        words = str(error)
        kinds = {
            "INTERRUPT": duckdb.InterruptException,
            "Out of Memory": duckdb.OutOfMemoryException,
        }
        kind = next((kinds[name] for name in kinds if words.startswith(name)), duckdb.Error)
        raise kind(words) from error
