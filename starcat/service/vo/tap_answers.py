"""The answer to a question as bytes: each format of TAP, no more rows than were asked for."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from starcat.exchange.columns import Label
from starcat.exchange.formats import Format
from starcat.exchange.writers import result_chunks
from starcat.service.answer_files import file_of_rows, keep_rows
from starcat.service.paths import ServicePaths
from starcat.service.sandbox.sandbox import Sandbox
from starcat.service.uploading import scratch_folder

if TYPE_CHECKING:
    import pyarrow as pa

_LABEL = Label("result")


class Answers:
    """What makes bytes of answers."""

    def __init__(self, paths: ServicePaths, sandbox: Sandbox) -> None:
        self._paths = paths
        self._sandbox = sandbox

    def chunks(self, batches: pa.RecordBatchReader, form: Format, max_rows: int) -> Iterator[bytes]:
        """Yield an answer in a format."""
        if form.name == "fits":
            yield from self._fits(batches, max_rows)
        else:
            scratch = self._paths.scratch
            yield from result_chunks(batches, form, scratch, label=_LABEL, maxrec=max_rows)

    def _fits(self, batches: pa.RecordBatchReader, max_rows: int) -> Iterator[bytes]:
        """Have a FITS file made, which is held in memory as a whole, by another process."""
        with scratch_folder(self._paths) as folder:
            rows = folder / "rows.arrow"
            keep_rows(batches, rows, max_rows)
            chunks, _ = file_of_rows(self._sandbox, rows, folder / "answer.fits", "fits")
        yield from chunks
