"""Answers in the formats that clients ask for: what is sent is what was asked for, and exact."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from astropy.io.votable import parse
from astropy.table import Table

from starcat.errors import ConfigError, QueryLimitError, SchemaError
from starcat.exchange.label import Label
from starcat.vo.results import RESULT_FORMATS, ResultFormat, result, result_format

EVERY = pytest.mark.parametrize("asked", RESULT_FORMATS, ids=lambda one: one.aliases[-1])
ROWS = [
    {"star_id": 4472832130942575872, "mag": 9.5, "name": "Barnard's star"},
    {"star_id": 2, "mag": None, "name": "a\tb"},
    {"star_id": 3, "mag": 0.1, "name": None},
]


@pytest.fixture
def table() -> pa.Table:
    """Three stars."""
    units = {"mag": {"unit": "mag", "ucd": "phot.mag"}}
    schema = pa.schema(
        [
            pa.field(name, kind, metadata=units.get(name))
            for name, kind in (
                ("star_id", pa.int64()), ("mag", pa.float64()), ("name", pa.string())
            )
        ]
    )  # fmt: skip
    return pa.Table.from_pylist(ROWS, schema)


def rows_of(content: bytes, asked: ResultFormat, folder: Path) -> list[tuple[int, float | None]]:
    """Return the numbers of a star and its magnitude, as a reader of the format finds them."""
    path = folder / f"read{asked.suffix}"
    path.write_bytes(content)
    if asked.suffix == ".parquet":
        read = pq.read_table(path).to_pylist()
    elif asked.suffix == ".json":
        read = json.loads(content)
    elif asked.suffix in (".csv", ".tsv"):
        delimiter = "," if asked.suffix == ".csv" else "\t"
        lines = csv.DictReader(io.StringIO(content.decode()), delimiter=delimiter)
        read = [
            {
                **row,
                "mag": float(row["mag"]) if row["mag"] else None,
                "star_id": int(row["star_id"]),
            }
            for row in lines
        ]
    else:
        found = Table.read(path, format="fits" if asked.suffix == ".fits" else "votable")
        mags = np.ma.filled(found["mag"], np.nan)
        pairs = zip(found["star_id"], mags, strict=True)
        read = [{"star_id": int(star_id), "mag": float(mag)} for star_id, mag in pairs]
    return [(row["star_id"], None if row["mag"] != row["mag"] else row["mag"]) for row in read]


@EVERY
@pytest.mark.parametrize("maxrec", [None, 3, 2, 0])
def test_every_format_has_the_rows(
    table: pa.Table, tmp_path: Path, asked: ResultFormat, maxrec: int | None
) -> None:
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    given = result(table.to_reader(), asked, scratch, label=Label("stars"), maxrec=maxrec)
    content = b"".join(given.chunks)
    assert rows_of(content, asked, tmp_path) == [
        (row["star_id"], row["mag"]) for row in ROWS[:maxrec]
    ]
    assert (given.media_type, given.suffix) == (asked.media_type, asked.suffix)
    assert not list(scratch.iterdir())
    if asked.is_votable:
        is_over = maxrec is not None and maxrec < len(ROWS)
        assert (b'value="OVERFLOW"' in content) == is_over
        first = parse(io.BytesIO(content)).get_first_table()
        assert ("<BINARY2>" in content.decode()) == (asked.name == "binary2")
        assert str(first.get_field_by_id("mag").unit) == "mag"


@pytest.mark.parametrize(
    ("text", "name", "media_type"),
    [
        (None, "binary2", "application/x-votable+xml"),
        ("", "binary2", "application/x-votable+xml"),
        ("votable", "binary2", "application/x-votable+xml"),
        ("application/x-votable xml", "binary2", "application/x-votable+xml"),
        ("application/x-votable+xml;serialization=BINARY2", "binary2",
         "application/x-votable+xml;serialization=binary2"),
        ("Application/X-VOTable+XML; serialization = \"TableData\"", "tabledata",
         "application/x-votable+xml;serialization=tabledata"),
        ("votable/td", "tabledata", "application/x-votable+xml;serialization=tabledata"),
        ("text/xml", "tabledata", "text/xml"),
        ("FITS", "fits", "application/fits"),
        ("csv", "csv", "text/csv;header=present"),
        ("text/csv; header=present", "csv", "text/csv;header=present"),
        ("tsv", "tsv", "text/tab-separated-values"),
        ("parquet", "parquet", "application/vnd.apache.parquet"),
        ("application/json", "json", "application/json"),
    ],
)  # fmt: skip
def test_a_format_is_asked_for_by_name_or_media_type(
    text: str | None, name: str, media_type: str
) -> None:
    found = result_format(text)
    assert (found.name, found.media_type) == (name, media_type)


def test_no_two_formats_are_asked_for_alike() -> None:
    aliases = [alias for one in RESULT_FORMATS for alias in one.aliases]
    assert len(set(aliases)) == len(aliases)
    for one in RESULT_FORMATS:
        assert result_format(one.media_type) == one


@pytest.mark.parametrize(
    "text", ["xlsx", "../votable", "application/x-votable+xml;serialization=BINARY", "x" * 999]
)
def test_an_unknown_format_is_refused_with_those_that_there_are(text: str) -> None:
    with pytest.raises(ConfigError, match=r"is unknown; ask for one of .*votable.*csv") as caught:
        result_format(text)
    assert len(str(caught.value)) < 700


def failing(batches: int) -> pa.RecordBatchReader:
    def read() -> Iterator[pa.RecordBatch]:
        for _ in range(batches):
            yield pa.record_batch({"a": [1]})
        raise QueryLimitError("stopped after 2 s")

    return pa.RecordBatchReader.from_batches(pa.schema({"a": pa.int64()}), read())


@EVERY
def test_what_fails_at_once_is_raised_before_anything_is_sent(
    tmp_path: Path, asked: ResultFormat
) -> None:
    with pytest.raises(QueryLimitError):
        result(failing(0), asked, tmp_path)
    assert not list(tmp_path.iterdir())


@EVERY
def test_what_fails_midway_is_never_taken_for_the_whole(
    tmp_path: Path, asked: ResultFormat
) -> None:
    if asked.is_votable:
        content = b"".join(result(failing(3), asked, tmp_path).chunks)
        assert b'value="ERROR">stopped after 2 s<' in content
    else:
        with pytest.raises(QueryLimitError):
            list(result(failing(3), asked, tmp_path).chunks)
    assert not list(tmp_path.iterdir())


def test_a_table_that_a_format_cannot_hold_is_refused(tmp_path: Path) -> None:
    table = pa.table({"a": ["é"]})
    with pytest.raises(SchemaError, match="ASCII in FITS"):
        result(table.to_reader(), result_format("fits"), tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["fits", "parquet"])
def test_a_file_is_gone_when_nobody_reads_on(tmp_path: Path, name: str) -> None:
    large = pa.table({"a": np.random.default_rng(1).normal(size=100_000)})
    given = result(large.to_reader(), result_format(name), tmp_path)
    next(given.chunks)
    assert list(tmp_path.iterdir())
    given.chunks.close()  # type: ignore[attr-defined]
    assert not list(tmp_path.iterdir())
    unread = result(large.to_reader(), result_format(name), tmp_path)
    del unread
    assert not list(tmp_path.iterdir())


def test_tsv_has_one_line_a_row_and_no_quotation_marks(tmp_path: Path) -> None:
    table = pa.table(
        {
            "a\tb": ['say "no"', "x\r\ny", None, ""],
            "c": [[1, 2], None, [], [3]],
            "d": [True, None, False, True],
        }
    )
    content = b"".join(result(table.to_reader(), result_format("tsv"), tmp_path).chunks)
    assert content.decode() == (
        'a b\tc\td\nsay "no"\t[1,2]\ttrue\nx  y\t\t\n\t[]\tfalse\n\t[3]\ttrue\n'
    )
    empty = b"".join(result(table[:0].to_reader(), result_format("tsv"), tmp_path).chunks)
    assert empty.decode() == "a b\tc\td\n"
