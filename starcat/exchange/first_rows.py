"""The first rows of a table that is read batch by batch, and whether there were more."""

from __future__ import annotations

from collections.abc import Iterator

import pyarrow as pa


class FirstRows:
    """No more rows than are asked for."""

    def __init__(self, batches: pa.RecordBatchReader, count: int | None) -> None:
        self._batches = batches
        self._left = count
        self.were_more = count == 0

    def __iter__(self) -> Iterator[pa.RecordBatch]:
        """Yield the batches; `were_more` is known when the last one was given."""
        if self.were_more:
            return
        for batch in self._batches:
            if self._left is None:
                yield batch
            elif batch.num_rows <= self._left:
                self._left -= batch.num_rows
                yield batch
            else:
                self.were_more = True
                yield batch.slice(0, self._left)
                return

    def reader(self) -> pa.RecordBatchReader:
        """Return the rows as a reader."""
        return pa.RecordBatchReader.from_batches(self._batches.schema, iter(self))
