"""The answer to a question as bytes: each format of TAP, no more rows than were asked for."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from starcat.exchange.formats import write_batches
from starcat.exchange.label import Label
from starcat.exchange.text import csv_chunks
from starcat.exchange.votable_stream import Serialization, votable_chunks
from starcat.service.confined import Confined
from starcat.vo.formats import Format

if TYPE_CHECKING:
    import pyarrow as pa

_SERIALIZATIONS: dict[str, Serialization] = {"votable": "binary2", "votable/td": "tabledata"}

_FILE_BYTES = 1 << 18

_LABEL = Label("result")


class Answers:
    """What makes bytes of answers.

    Parameters
    ----------
    scratch : Path
        Folder for what has to be a file before it can be sent.
    confined : Confined
        What makes files that are held in memory as a whole, in processes of their own.
    """

    def __init__(self, scratch: Path, confined: Confined) -> None:
        self._scratch = scratch
        self._confined = confined

    def chunks(self, batches: pa.RecordBatchReader, form: Format, max_rows: int) -> Iterator[bytes]:
        """Yield an answer in a format.

        Parameters
        ----------
        batches : pyarrow.RecordBatchReader
            The rows; one more than `max_rows` where there are more.
        form : Format
            How to write them.
        max_rows : int
            Rows to give at most; VOTable says where there were more.

        Yields
        ------
        bytes
            In order.

        Raises
        ------
        SchemaError
            If a column cannot be said in the format.
        QueryLimitError
            If the query takes too long; also while reading.
        """
        if form.name in _SERIALIZATIONS:
            kind = _SERIALIZATIONS[form.name]
            yield from votable_chunks(batches, serialization=kind, label=_LABEL, maxrec=max_rows)
        elif form.name == "csv":
            for text, _ in csv_chunks(_cut(batches, max_rows)):
                yield text
        else:
            yield from self._file(_cut(batches, max_rows), form)

    def _file(self, batches: pa.RecordBatchReader, form: Format) -> Iterator[bytes]:
        with tempfile.TemporaryDirectory(prefix="answer-", dir=self._scratch) as folder:
            path = Path(folder) / f"answer.{form.suffix}"
            if form.name == "parquet":
                write_batches(batches, path, form.name, _LABEL)
            else:
                rows = Path(folder) / "rows"
                _write_rows(batches, rows)
                given = {"source": str(rows), "target": str(path), "form": form.name}
                self._confined.call("convert", given)
            with path.open("rb") as stream:
                while part := stream.read(_FILE_BYTES):
                    yield part


def _write_rows(batches: pa.RecordBatchReader, path: Path) -> None:
    import pyarrow as pa

    with pa.OSFile(str(path), "wb") as sink, pa.ipc.new_stream(sink, batches.schema) as stream:
        for batch in batches:
            stream.write_batch(batch)


def _cut(batches: pa.RecordBatchReader, rows: int) -> pa.RecordBatchReader:
    import pyarrow as pa

    def first() -> Iterator[pa.RecordBatch]:
        left = rows
        for batch in batches:
            if left <= 0:
                return
            yield batch.slice(0, left)
            left -= batch.num_rows

    return pa.RecordBatchReader.from_batches(batches.schema, first())
