"""Shim."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from starcat.catalog.blocks import Part, Reading, parse_block
from starcat.catalog.ingest import FileFacts
from starcat.catalog.readers.files import InputFile, read_blocks
from starcat.catalog.readers.malformed import check_malformed, not_this_archive


class FileReading:
    """Shim."""

    def __init__(self, file: InputFile, number: int, source: Any, how: Reading) -> None:
        self.file, self.number, self.source, self.how = file, number, source, how
        self.problems: list[Any] = []
        self.facts: Any = None

    def __iter__(self) -> Iterator[Part]:
        """Shim."""
        rows = 0
        seen: list[Any] = []
        for block in read_blocks(self.file, self.source.name, seen.append):
            part = parse_block(self.number, block, self.how)
            if part.problems and not rows and part.rows == len(part.problems):
                raise not_this_archive(self.file, self.source, part.problems)
            rows += part.rows
            self.problems += part.problems
            yield part
        raw = seen[0]
        check_malformed([self.file], [rows], [(0, p) for p in self.problems], self.source)
        self.facts = FileFacts(self.file.path.name, raw.sha256, raw.bytes_read, rows)
