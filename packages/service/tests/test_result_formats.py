"""Answers in the formats that clients ask for; tests/ship tests the rows of each format."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from starcat.errors import ConfigError, QueryLimitError
from starcat.ship.exchange.formats import TAP_FORMATS, Format, response_format
from starcat.ship.exchange.writers import result_chunks

EVERY = pytest.mark.parametrize("asked", TAP_FORMATS, ids=lambda tap_format: tap_format.name)


@pytest.mark.parametrize(
    ("text", "name"),
    [
        (None, "votable"), ("text/xml", "votable"), ("application/x-votable xml", "votable"),
        ("application/x-votable+xml;serialization=BINARY2", "votable"),
        ('Application/X-VOTable+XML; serialization = "TableData"', "votable/td"),
        ("FITS", "fits"), ("text/csv; header=present", "csv"), ("application/json", "json"),
    ],
)  # fmt: skip
def test_a_format_is_asked_for_by_name_or_media_type(text: str | None, name: str) -> None:
    assert response_format(text).name == name


@pytest.mark.parametrize(
    "text", ["xlsx", "../votable", "application/x-votable+xml;serialization=BINARY", "x" * 999]
)
def test_an_unknown_format_is_refused_with_those_that_there_are(text: str) -> None:
    with pytest.raises(ConfigError, match=r"is unknown; choose one of votable.*csv") as caught:
        response_format(text)
    assert len(str(caught.value)) < 300
    aliases = [
        alias
        for tap_format in TAP_FORMATS
        for alias in (tap_format.name, tap_format.tap_type, *tap_format.aliases)
    ]
    assert len(set(aliases)) == len(aliases), "two formats have one alias"


def failing(batches: int) -> pa.RecordBatchReader:
    def read() -> Iterator[pa.RecordBatch]:
        for _ in range(batches):
            yield pa.record_batch({"a": [1]})
        raise QueryLimitError("stopped after 2 s")

    return pa.RecordBatchReader.from_batches(pa.schema({"a": pa.int64()}), read())


@EVERY
def test_what_fails_is_never_taken_for_the_whole(tmp_path: Path, asked: Format) -> None:
    """An error at once is raised before anything is sent; a VOTable contains a later error."""
    with pytest.raises(QueryLimitError):
        result_chunks(failing(0), asked, tmp_path)
    if asked.is_votable:
        content = b"".join(result_chunks(failing(3), asked, tmp_path))
        assert b'value="ERROR">stopped after 2 s<' in content
    else:
        with pytest.raises(QueryLimitError):
            list(result_chunks(failing(3), asked, tmp_path))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["fits", "parquet"])
def test_a_file_is_removed_if_its_reader_stops(tmp_path: Path, name: str) -> None:
    large = pa.table({"a": np.random.default_rng(1).normal(size=100_000)})
    chunks = result_chunks(large.to_reader(), response_format(name), tmp_path)
    next(chunks)
    assert list(tmp_path.iterdir())
    chunks.close()  # type: ignore[attr-defined]
    assert not list(tmp_path.iterdir())
    unread = result_chunks(large.to_reader(), response_format(name), tmp_path)
    del unread
    assert not list(tmp_path.iterdir())


def test_tsv_has_one_line_a_row_and_no_quotation_marks(tmp_path: Path) -> None:
    columns = {"a\tb": ['say "no"', "x\r\ny", None, ""], "c": [[1, 2], None, [], [3]],
               "d": [True, None, False, True]}  # fmt: skip
    table = pa.table(columns)
    content = b"".join(result_chunks(table.to_reader(), response_format("tsv"), tmp_path))
    assert content.decode() == (
        'a b\tc\td\nsay "no"\t[1,2]\ttrue\nx  y\t\t\n\t[]\tfalse\n\t[3]\ttrue\n'
    )
    empty = b"".join(result_chunks(table[:0].to_reader(), response_format("tsv"), tmp_path))
    assert empty.decode() == "a b\tc\td\n"
