"""Tables to files of other formats, in a confined process: some are held in memory as a whole."""

from __future__ import annotations

from pathlib import Path


def convert(source: str, target: str, form: str) -> int:
    """Write a table to a file."""
    import pyarrow as pa

    from starcat.exchange.writers import write_batches

    with pa.OSFile(source) as file, pa.ipc.open_stream(file) as stream:
        return write_batches(stream, Path(target), form)
