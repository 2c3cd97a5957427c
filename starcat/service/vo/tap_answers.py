"""The answer to a question as bytes: each format of TAP, no more rows than were asked for."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from starcat.exchange.first_rows import FirstRows
from starcat.exchange.label import Label
from starcat.service.confined import Confined
from starcat.vo.formats import Format
from starcat.vo.results import result_chunks

if TYPE_CHECKING:
    import pyarrow as pa

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
        if form.name == "fits":
            yield from self._fits(FirstRows(batches, max_rows).reader())
        else:
            yield from result_chunks(batches, form, self._scratch, label=_LABEL, maxrec=max_rows)

    def _fits(self, batches: pa.RecordBatchReader) -> Iterator[bytes]:
        """Have a FITS file made, which is held in memory as a whole, by another process."""
        with tempfile.TemporaryDirectory(prefix="answer-", dir=self._scratch) as folder:
            rows, path = Path(folder) / "rows", Path(folder) / "answer.fits"
            _write_rows(batches, rows)
            given = {"source": str(rows), "target": str(path), "form": "fits"}
            self._confined.call("convert", given)
            with path.open("rb") as stream:
                while part := stream.read(_FILE_BYTES):
                    yield part


def _write_rows(batches: pa.RecordBatchReader, path: Path) -> None:
    import pyarrow as pa

    with pa.OSFile(str(path), "wb") as sink, pa.ipc.new_stream(sink, batches.schema) as stream:
        for batch in batches:
            stream.write_batch(batch)
