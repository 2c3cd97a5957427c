"""VOTables written as a stream: their metadata, and their ends.

test_every_format checks the rows of all formats at once with other readers.
"""

from __future__ import annotations

import io
import time
from collections.abc import Iterator
from datetime import UTC, date, datetime
from decimal import Decimal
from typing import Any, get_args

import numpy as np
import pyarrow as pa
import pytest
from astropy.io.votable import parse
from astropy.io.votable.tree import VOTableFile
from table_formats import column_of

from starcat.errors import QueryLimitError, SchemaError
from starcat.ship.exchange import columns as shared_columns
from starcat.ship.exchange.columns import Label
from starcat.ship.exchange.votable import Serialization, votable_chunks

DAY = "2026-01-31"
SERIALIZATIONS: tuple[Serialization, ...] = get_args(Serialization)
both = pytest.mark.parametrize("serialization", SERIALIZATIONS)


def document(table: pa.Table, rows_a_batch: int = 1000, **options: Any) -> bytes:
    """Return the whole stream of a table."""
    reader = pa.RecordBatchReader.from_batches(table.schema, table.to_batches(rows_a_batch))
    return b"".join(votable_chunks(reader, **options))


def parsed(content: bytes) -> VOTableFile:
    return parse(io.BytesIO(content), verify="exception")


def rows_of(content: bytes) -> list[tuple[Any, ...]]:
    """Return rows as astropy reads them, with None for masked values."""
    found = parsed(content).get_first_table()
    columns = [column_of(found.to_table(), field.ID) for field in found.fields]
    return list(zip(*columns, strict=True))


def statuses(content: bytes) -> list[tuple[str, str]]:
    """Return the values of QUERY_STATUS and their texts, in the order of the document."""
    infos = parsed(content).resources[0].infos
    return [(i.value, (i.content or "").strip()) for i in infos if i.name == "QUERY_STATUS"]


# Rows --------------------------------------------------------------------------------------


@both
def test_times_decimals_and_records_become_what_votable_has(serialization):
    table = pa.table({
        "t": pa.array([datetime(2026, 1, 31, 12, 0, 0, 5), None], pa.timestamp("us")),
        "z": pa.array([datetime(2026, 1, 31, tzinfo=UTC), None], pa.timestamp("us", "UTC")),
        "d": pa.array([date(2026, 1, 31), None]), "r": [{"p": 1}, None],
        "n": pa.array([Decimal("1.50"), None], pa.decimal128(5, 2)), "b": [[True, False], None],
    })  # fmt: skip
    content = document(table, serialization=serialization)
    values = (f"{DAY}T12:00:00.000005", f"{DAY}T00:00:00.000000Z", DAY, '{"p": 1}')
    assert rows_of(content) == [(*values, 1.5, "[true,false]"), ("", "", "", "", None, "")]
    fields = {field.name: field for field in parsed(content).get_first_table().fields}
    for name in "tzd":
        assert (fields[name].datatype, fields[name].xtype) == ("char", "timestamp")
    assert (fields["r"].datatype, fields["r"].xtype) == ("unicodeChar", None)


@both
def test_an_xtype_of_the_metadata_is_passed_on(serialization):
    field = pa.field("p", pa.list_(pa.float64()), metadata={"xtype": "point"})
    table = pa.Table.from_arrays([pa.array([[1.0, 2.0]])], schema=pa.schema([field]))
    [again] = parsed(document(table, serialization=serialization)).get_first_table().fields
    assert (again.xtype, again.datatype, again.arraysize) == ("point", "double", "*")


@both
@pytest.mark.parametrize("count", [0, 1, 2, 3, 64, 65, 1000])
def test_rows_go_on_from_step_to_step(serialization, count, monkeypatch):
    monkeypatch.setattr(shared_columns, "STEP_ROWS", 64)
    # Texts of 0 to 6 letters, so that base64 is cut at all three places.
    texts = ["abcdef"[: k % 7] for k in range(count)]
    table = pa.table({"k": np.arange(count), "t": pa.array(texts, pa.string())})
    for rows_a_batch in (10_000, 99):
        content = document(table, rows_a_batch, serialization=serialization)
        array = parsed(content).get_first_table().array
        assert len(array) == count
        if count:
            assert (array["k"].data == np.arange(count)).all()
            assert array["t"].data.tolist() == texts


# Metadata of the document ------------------------------------------------------------------


@both
def test_infos_and_the_name_are_escaped(serialization):
    odd = "a \"b\" 'c' <d> & \n e"
    table = pa.table({"a": [1]})
    content = document(
        table, serialization=serialization, label=Label(odd, odd, "1"), infos={"query": odd}
    )
    found = parsed(content)
    assert {info.name: info.value for info in found.resources[0].infos} == {
        "QUERY_STATUS": "OK", "artifact": odd, "version": "1", "query": odd
    }  # fmt: skip
    assert found.get_first_table().name == odd


@pytest.mark.parametrize(
    ("epochs", "rows_a_batch", "expected"),
    [([2026.0] * 4, 10, "J2026"), ([1991.25] * 4, 10, "J1991.25"), ([2026.0, 2000.5], 10, None),
     ([2026.0] * 4, 2, None), ([2015.123456789], 10, "J2015.123456789"), ([], 10, None)],
)  # fmt: skip
def test_an_epoch_is_said_where_it_is_sure_to_be_that_of_all_rows(epochs, rows_a_batch, expected):
    fields = [
        pa.field("ra_deg", pa.float64(), metadata={"ucd": "pos.eq.ra;meta.main"}),
        pa.field("epoch_jyear", pa.float64()),
    ]
    columns = [pa.array([1.0] * len(epochs), pa.float64()), pa.array(epochs, pa.float64())]
    table = pa.Table.from_arrays(columns, schema=pa.schema(fields))
    [system] = parsed(document(table, rows_a_batch)).resources[0].coordinate_systems
    assert (system.system, system.epoch) == ("ICRS", expected)


@pytest.mark.parametrize(
    "name", ["a b", "1a", "é", "<a&'\"b", "starcat.table", "starcat.icrs", "xml:id"]
)
def test_a_name_that_is_not_an_identifier_is_still_a_name(name):
    found = parse(io.BytesIO(document(pa.table({name: [1], "b": [2]}))), verify="ignore")
    assert [field.name for field in found.get_first_table().fields] == [name, "b"]


# The status --------------------------------------------------------------------------------


@both
@pytest.mark.parametrize(
    ("maxrec", "kept", "is_over"),
    [(None, 10, False), (11, 10, False), (10, 10, False), (9, 9, True), (4, 4, True),
     (3, 3, True), (1, 1, True), (0, 0, True)],
)  # fmt: skip
def test_overflow_is_reported_when_rows_were_left_out(serialization, maxrec, kept, is_over):
    table = pa.table({"k": range(10), "t": [str(k) for k in range(10)]})
    for rows_a_batch in (1, 3, 4, 10):
        content = document(table, rows_a_batch, serialization=serialization, maxrec=maxrec)
        assert [row[0] for row in rows_of(content)] == list(range(kept))
        assert [status for status, _ in statuses(content)] == ["OK", "OVERFLOW"][: 1 + is_over]
        # DALI: the first status before the table, the other after it.
        assert content.index(b'"OK"') < content.index(b"<TABLE")
        assert not is_over or content.index(b"</TABLE>") < content.index(b'"OVERFLOW"')


def test_no_rows_are_read_where_none_are_wanted():
    def never() -> Iterator[pa.RecordBatch]:
        raise AssertionError("read")
        yield

    reader = pa.RecordBatchReader.from_batches(pa.schema({"a": pa.int64()}), never())
    assert b'"OVERFLOW"' in b"".join(votable_chunks(reader, maxrec=0))


def failing(batches: int, error: Exception) -> pa.RecordBatchReader:
    """Return a reader of 3 rows a batch that fails after some batches."""

    def read() -> Iterator[pa.RecordBatch]:
        for _ in range(batches):
            yield pa.record_batch({"a": [1, 2, 3]})
        raise error

    return pa.RecordBatchReader.from_batches(pa.schema({"a": pa.int64()}), read())


@both
def test_a_query_that_fails_midway_is_reported_at_the_end(serialization):
    late = QueryLimitError("stopped after 2 s; ask for <less>\x01")
    content = b"".join(votable_chunks(failing(5, late), serialization=serialization))
    assert [row[0] for row in rows_of(content)] == [1, 2, 3] * 5
    assert statuses(content) == [("OK", ""), ("ERROR", "stopped after 2 s; ask for <less>?")]
    broken = b"".join(votable_chunks(failing(2, OSError("/a/secret")), serialization=serialization))
    assert statuses(broken)[1] == ("ERROR", "the rest of the rows cannot be read")
    assert b"secret" not in broken


@both
def test_a_text_that_no_xml_can_hold_ends_the_rows(serialization):
    batches = [pa.record_batch({"a": [text]}) for text in ("x", "y", "\x01", "z")]
    reader = pa.RecordBatchReader.from_batches(batches[0].schema, batches)
    content = b"".join(votable_chunks(reader, serialization=serialization))
    assert [row[0] for row in rows_of(content)] == ["x", "y"]
    assert "a character that XML cannot hold" in statuses(content)[1][1]
    for bad in ("\ufffe", "a\rb", "\x00"):
        with pytest.raises(SchemaError, match=r"column 'a'.*XML cannot hold"):
            document(pa.table({"a": [bad]}), serialization=serialization)
        with pytest.raises(SchemaError, match="XML cannot hold"):
            document(pa.table({f"a{bad}": [1]}), serialization=serialization)


# Threads, order -----------------------------------------------------------------------------


@both
def test_a_reader_who_stops_leaves_nothing_running(serialization):
    import threading

    threads = threading.active_count()
    reader = pa.table({"a": np.arange(200_000)}).to_reader(max_chunksize=1000)
    chunks = votable_chunks(reader, serialization=serialization)
    assert next(chunks).startswith(b"<?xml")
    next(chunks)
    chunks.close()  # type: ignore[attr-defined]
    for _ in range(100):  # what a thread is at comes to its end
        if threading.active_count() == threads:
            break
        time.sleep(0.05)
    assert threading.active_count() == threads
