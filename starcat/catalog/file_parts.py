"""One archive file in, its parts out: blocks parsed in order, with the checks of a whole file.

A file is read by itself, in the calling thread, so that a task of any scheduler can do it: what
it holds at a time is a few blocks. The joining of files is `starcat.catalog.ingest`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

from starcat.catalog.blocks import Part, Reading, parse_block
from starcat.catalog.readers.files import Block, DigestReader, InputFile, map_in_order, read_blocks
from starcat.catalog.readers.malformed import check_malformed, not_this_archive
from starcat.catalog.readers.records import Problem
from starcat.catalog.source import DataSource
from starcat.errors import SourceError
from starcat.progress import Progress

NAMED_PROBLEMS = 20
"""Malformed records of a file that are kept to be told; the others are counted."""


@dataclass(frozen=True)
class FileFacts:
    """One input file as the manifest records it.

    Attributes
    ----------
    name : str
        File name without its folder.
    sha256 : str
        Digest of the file as it lies on disk.
    bytes, rows : int
        Its size and the records read from it.
    """

    name: str
    sha256: str
    bytes: int
    rows: int


class BytesRead:
    """How much of the files of a source has been read."""

    def __init__(self, files: Sequence[InputFile], source_name: str, progress: Progress) -> None:
        self._stage, self._progress = f"read {source_name}", progress
        self._total = sum(file.path.stat().st_size for file in files)
        self._read = [0] * len(files)

    def note(self, number: int, count: int) -> None:
        """Remember how much of a file has been read; any thread may."""
        self._read[number] = count

    def tell(self) -> None:
        """Call the progress with what has been noted."""
        self._progress(self._stage, sum(self._read), self._total)

    def teller(self, number: int) -> Callable[[int], None]:
        """Return a function that notes how much of a file has been read, and tells it."""

        def note_and_tell(count: int) -> None:
            self.note(number, count)
            self.tell()

        return note_and_tell


class FileBlocks:
    """The blocks of one file, and what is known of the file once it has been read.

    Attributes
    ----------
    rows, malformed : int
        Records so far, and how many of them are malformed.
    problems : list of Problem
        The first `NAMED_PROBLEMS` malformed records.
    """

    def __init__(
        self, file: InputFile, source: DataSource, on_bytes: Callable[[int], None] | None = None
    ) -> None:
        self.file, self.source = file, source
        self.rows = self.malformed = 0
        self.problems: list[Problem] = []
        self._on_bytes = on_bytes or (lambda _: None)
        self._digest: DigestReader | None = None

    def __iter__(self) -> Iterator[Block]:
        """Read the file from its beginning to its end."""
        for block in read_blocks(self.file, self.source.name, self._end):
            self._on_bytes(block.bytes_read)
            yield block

    def _end(self, digest: DigestReader) -> None:
        self._digest = digest
        self._on_bytes(digest.bytes_read)

    def add(self, rows: int, problems: Sequence[Problem]) -> None:
        """Count the records of the next block."""
        if problems and not self.rows and rows == len(problems):
            raise not_this_archive(self.file, self.source, problems)
        self.rows += rows
        self.malformed += len(problems)
        self.problems += problems[: NAMED_PROBLEMS - len(self.problems)]

    @property
    def facts(self) -> FileFacts:
        """What the manifest says of the file, which has been read to its end."""
        if self._digest is None:
            raise SourceError(f"{self.file.path}: not read to its end", path=self.file.path)
        check_malformed(self.file, self.rows, self.malformed, self.problems, self.source)
        digest = self._digest
        return FileFacts(self.file.path.name, digest.sha256, digest.bytes_read, self.rows)


class FileReading:
    """The parts of one file of a star catalog, in file order.

    Attributes
    ----------
    facts : FileFacts
        What the manifest says of the file: there when all parts have been taken.
    blocks : FileBlocks
        Counts of its records so far.
    """

    def __init__(
        self,
        file: InputFile,
        number: int,
        source: DataSource,
        how: Reading,
        *,
        workers: int = 0,
        on_bytes: Callable[[int], None] | None = None,
    ) -> None:
        self.blocks = FileBlocks(file, source, on_bytes)
        self.facts: FileFacts
        self._parse = partial(parse_block, number, how=how)
        self._workers = workers

    def __iter__(self) -> Iterator[Part]:
        """Read the file."""
        for part in map_in_order(self._parse, iter(self.blocks), self._workers):
            self.blocks.add(part.rows, part.problems)
            yield part
        self.facts = self.blocks.facts

    @property
    def problems(self) -> tuple[str, ...]:
        """The first malformed records, each with file, line and bytes."""
        return tuple(f"{self.blocks.file.path.name} {each}" for each in self.blocks.problems)
