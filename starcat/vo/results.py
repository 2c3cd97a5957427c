"""Answers in the formats that clients of the Virtual Observatory ask for.

A format is asked for by a short name or a media type; the answer is a stream of bytes with a
media type. Formats that are written from their end are written into a file first.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path

import pyarrow as pa

from starcat.errors import ConfigError
from starcat.exchange.first_rows import FirstRows
from starcat.exchange.formats import SUFFIXES, write_batches
from starcat.exchange.label import UNLABELLED, Label
from starcat.exchange.text import csv_chunks, json_chunks, tsv_chunks
from starcat.exchange.votable_stream import votable_chunks

VOTABLE = "application/x-votable+xml"
_BINARY2 = f"{VOTABLE};serialization=binary2"
_TABLEDATA = f"{VOTABLE};serialization=tabledata"
_CHUNK_BYTES = 1 << 18


@dataclass(frozen=True)
class ResultFormat:
    """A format of answers.

    Attributes
    ----------
    name : str
        Short name; that of the writer, but for VOTable, where it is the serialization.
    media_type : str
        What the answer is sent as.
    suffix : str
        What the name of a file with it ends with.
    aliases : tuple of str
        What it may be asked for by, in small letters and without blanks.
    """

    name: str
    media_type: str
    suffix: str
    aliases: tuple[str, ...]

    @property
    def is_votable(self) -> bool:
        """Whether it is a VOTable, which can say that rows were left out."""
        return self.suffix == ".vot"


RESULT_FORMATS: tuple[ResultFormat, ...] = (
    ResultFormat("binary2", VOTABLE, ".vot", (VOTABLE, "votable")),
    ResultFormat("binary2", _BINARY2, ".vot", (_BINARY2, "votable/b2")),
    ResultFormat("tabledata", _TABLEDATA, ".vot", (_TABLEDATA, "votable/td")),
    ResultFormat("tabledata", "text/xml", ".vot", ("text/xml", "application/xml")),
    ResultFormat(
        "csv", "text/csv;header=present", ".csv", ("text/csv", "csv", "text/csv;header=present")
    ),
    ResultFormat("tsv", "text/tab-separated-values", ".tsv", ("text/tab-separated-values", "tsv")),
    ResultFormat("fits", "application/fits", ".fits", ("application/fits", "fits", "image/fits")),
    ResultFormat(
        "parquet",
        "application/vnd.apache.parquet",
        ".parquet",
        ("application/vnd.apache.parquet", "application/x-parquet", "parquet"),
    ),
    ResultFormat("json", "application/json", ".json", ("application/json", "json")),
)
"""The formats, the usual one first."""

_BY_ALIAS = {alias: one for one in RESULT_FORMATS for alias in one.aliases}
_TEXTS: dict[str, Callable[[pa.RecordBatchReader], Iterator[tuple[bytes, int]]]] = {
    "csv": csv_chunks,
    "tsv": tsv_chunks,
    "json": json_chunks,
}


@dataclass(frozen=True)
class Result:
    """An answer that has begun.

    Attributes
    ----------
    media_type : str
        What it is sent as.
    suffix : str
        What the name of a file with it ends with.
    chunks : iterator of bytes
        To be read once; what goes wrong with reading it breaks it off, but for a VOTable, which
        says so at its end.
    """

    media_type: str
    suffix: str
    chunks: Iterator[bytes] = field(repr=False)


def result_format(asked: str | None, usual: str = "votable") -> ResultFormat:
    """Return the format that a client asks for.

    Parameters
    ----------
    asked : str, optional
        A short name or a media type; capitals and blanks do not matter.
    usual : str
        What is meant where nothing is asked for.

    Returns
    -------
    ResultFormat
        One of `RESULT_FORMATS`.

    Raises
    ------
    ConfigError
        If there is no such format.

    Examples
    --------
    >>> result_format("application/x-votable+xml; serialization=TABLEDATA").name
    'tabledata'
    """
    text = re.sub(r"[\s\"]", "", asked or "").lower() or usual
    # Where a form is decoded twice, the plus of a media type arrives as a blank.
    found = _BY_ALIAS.get(text) or _BY_ALIAS.get(text.replace("x-votablexml", "x-votable+xml"))
    if found is None:
        names = ", ".join(alias for alias in _BY_ALIAS)
        raise ConfigError(
            f"the format {asked[:80] if asked else asked!r} is unknown; ask for one of {names}",
            key="RESPONSEFORMAT",
            value=asked,
        )
    return found


def result(
    batches: pa.RecordBatchReader,
    asked: ResultFormat,
    folder: Path,
    *,
    label: Label = UNLABELLED,
    maxrec: int | None = None,
    infos: Mapping[str, str] | None = None,
) -> Result:
    """Begin an answer.

    Parameters
    ----------
    batches : pyarrow.RecordBatchReader
        The rows; one more than `maxrec` where there are more.
    asked : ResultFormat
        The format.
    folder : Path
        Where FITS and Parquet files are made, which are gone when the chunks were read.
    label : Label
        What VOTable and FITS say of the table as a whole.
    maxrec : int, optional
        The largest number of rows to give.
    infos : mapping of str to str, optional
        What a VOTable says besides.

    Returns
    -------
    Result
        Its first rows were read, and what goes wrong with them was raised.

    Raises
    ------
    SchemaError
        If a column cannot be said in the format.
    StarcatError
        What goes wrong with reading the first rows.
    """
    chunks: Iterator[bytes]
    if asked.is_votable:
        chunks = votable_chunks(
            batches,
            serialization="binary2" if asked.name == "binary2" else "tabledata",
            label=label,
            maxrec=maxrec,
            infos=infos,
        )
    else:
        rows = _begun(FirstRows(batches, maxrec).reader())
        if asked.name in _TEXTS:
            chunks = (text for text, _ in _TEXTS[asked.name](rows))
        else:
            chunks = _through_file(rows, asked.name, folder, label)
    return Result(asked.media_type, asked.suffix, _primed(next(chunks), chunks))


def _begun(batches: pa.RecordBatchReader) -> pa.RecordBatchReader:
    """Return a reader whose first batch was read."""
    first = next(iter(batches), None)
    begun = [] if first is None else [first]
    return pa.RecordBatchReader.from_batches(batches.schema, chain(begun, batches))


def _through_file(
    batches: pa.RecordBatchReader, file_format: str, folder: Path, label: Label
) -> Iterator[bytes]:
    """Write a file, and yield what is in it."""
    with tempfile.TemporaryDirectory(dir=folder, prefix="result-") as place:
        path = Path(place) / f"table{SUFFIXES[file_format][0]}"
        write_batches(batches, path, file_format, label)
        with path.open("rb") as file:
            while chunk := file.read(_CHUNK_BYTES):
                yield chunk


def _primed(first: bytes, rest: Iterator[bytes]) -> Iterator[bytes]:
    yield first
    yield from rest
