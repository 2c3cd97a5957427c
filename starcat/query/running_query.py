"""A query that runs: its columns with their units, and its rows as they come."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cached_property, partial
from itertools import chain
from typing import TYPE_CHECKING, Any

from starcat.progress import Progress, no_progress
from starcat.query.columns import Facts, column_facts
from starcat.query.engine import Allowance, Engine

if TYPE_CHECKING:
    import pyarrow as pa


class RunningQuery:
    """What a query finds; nothing runs before something is asked for."""

    def __init__(
        self,
        engine: Engine,
        text: str,
        values: dict[str, Any] | None,
        known: Mapping[str, Facts],
        allowance: Allowance,
        progress: Progress = no_progress,
    ) -> None:
        self._ask = partial(engine.ask, allowance=allowance, progress=progress)
        self._text = text
        self._values = values
        self._known = known

    @cached_property
    def _described(self) -> list[tuple[str, str]]:
        """Names and types of the columns."""
        [found] = self._ask("columns", self._text, self._values)
        return list(found)

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
        """Return the first rows."""
        *parts, (described, last) = self._ask("rows", self._text, self._values, count)
        # Known now, without looking at the files once more.
        self._described = described
        return list(chain(*parts, last))

    def batches(self) -> pa.RecordBatchReader:
        """Return all rows as Arrow batches, with units and meanings in the field metadata."""
        import pyarrow as pa

        [begun] = self._ask("batches", self._text, self._values)
        schema = pa.schema(
            field.with_metadata(column_facts(field.name, self._known).as_metadata())
            for field in pa.ipc.open_stream(begun).schema
        )
        return pa.RecordBatchReader.from_batches(schema, self._batches(schema))

    def _batches(self, schema: pa.Schema) -> Iterator[pa.RecordBatch]:
        """Give the batches that follow, with a schema that has the metadata."""
        import pyarrow as pa

        while (found := self._ask("next_batch")[0]) is not None:
            for batch in pa.ipc.open_stream(found):
                yield pa.record_batch(batch.columns, schema=schema)
