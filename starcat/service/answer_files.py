"""Answers that have to be files before they can be sent: kept as rows, then made elsewhere."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from starcat.errors import QueryLimitError
from starcat.exchange.columns import FirstRows
from starcat.service.sandbox.sandbox import Sandbox
from starcat.service.uploading import sent_once

if TYPE_CHECKING:
    import pyarrow as pa

MAX_BYTES = 4 << 30
"""Size of an answer that is kept until it is sent."""


def keep_rows(batches: pa.RecordBatchReader, path: Path, most: int) -> tuple[int, bool]:
    """Write the first rows of an answer to a file, as an Arrow stream."""
    import pyarrow as pa

    count = size = 0
    first = FirstRows(batches, most)
    with pa.OSFile(str(path), "wb") as file, pa.ipc.new_stream(file, batches.schema) as stream:
        for part in first:
            stream.write_batch(part)
            count, size = count + part.num_rows, size + part.nbytes
            if size > MAX_BYTES and not first.were_more:
                raise QueryLimitError(
                    f"the answer is larger than {MAX_BYTES >> 30} GiB; ask for fewer rows"
                )
    return count, first.were_more


def file_of_rows(
    sandbox: Sandbox, rows: Path, target: Path, form: str
) -> tuple[Iterator[bytes], int]:
    """Have a file made of rows that were kept, by a process that may hold a table in memory."""
    sandbox.call("convert", {"source": str(rows), "target": str(target), "form": form})
    return sent_once(target)
