"""What the confined process of queries sends: every type arrives as it was, and nothing else runs.

The values that DuckDB's Python client gives are frozen here. A process that was taken over may send
anything: the session refuses it, runs nothing of it and takes no more memory than it allows.
"""

from __future__ import annotations

import pickle
import struct
import sys
import time
import tracemalloc
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pyarrow as pa
import pytest
from query_conformance import KnowsEveryType, rows_of

from starcat.errors import AnswerTooLarge, QueryError
from starcat.query.engine import Allowance
from starcat.query.session import Session, open_session
from starcat_service.sandbox import arrow_stream, process, query_engine
from starcat_service.sandbox.messages import HEAD, MalformedMessage
from starcat_service.sandbox.query_engine import ConfinedEngine


@pytest.fixture(scope="module")
def session(small_database: Path) -> Iterator[Session]:
    with open_session([str(small_database)], new_engine=ConfinedEngine) as opened:
        yield opened


class TestQueriesOfAProcess(KnowsEveryType):
    pass


def test_an_answer_above_the_limit_is_refused_and_the_process_kept(small_database):
    limited = partial(ConfinedEngine, message_bytes=1 << 20, rows_bytes=3 << 20)
    with open_session([str(small_database)], new_engine=limited) as session:
        before = session._engine._process
        with pytest.raises(AnswerTooLarge, match="more than 3 MB; ask for fewer rows"):
            rows_of(session, "SELECT repeat('x', 1000) FROM range(10000)", 100_000)
        with pytest.raises(AnswerTooLarge):
            rows_of(session, "SELECT repeat('x', 2000000)", 100_000)
        with pytest.raises(AnswerTooLarge), session.ask("SELECT repeat('x', 2000000)") as answer:
            list(answer.batches())
        # Parts of an answer are so small that each can be sent.
        rows = rows_of(session, "SELECT repeat('x', 1000) FROM range(2500)", 100_000)
        assert len(rows) == 2500
        assert session._engine._process is before


def arrow(array: pa.Array, **options: object) -> bytes:
    batch = pa.record_batch([array], names=["v"])
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, batch.schema, options=pa.ipc.IpcWriteOptions(**options)) as out:
        out.write_batch(batch)
    return bytes(sink.getvalue())


def array_of(kind: pa.DataType, *parts: bytes, count: int = 2) -> pa.Array:
    return pa.Array.from_buffers(kind, count, [None, *map(pa.py_buffer, parts)])


ENDS = struct.Struct("<3i")  # of two texts
HOSTILE_ROWS = {
    "not Arrow": (pa.string(), b"\xff" * 100),
    "compressed": (pa.string(), arrow(pa.array(["x" * 1_000_000]), compression="zstd")),
    "compressed dictionary": (
        pa.dictionary(pa.int8(), pa.string()),
        arrow(pa.array(["x" * 1_000_000]).dictionary_encode(), compression="lz4"),
    ),
    "another schema": (pa.string(), arrow(pa.array([1]))),
    "no UTF-8": (pa.string(), arrow(array_of(pa.string(), ENDS.pack(0, 1, 2), b"\xff\xfe"))),
    "offsets outside": (pa.string(), arrow(array_of(pa.string(), ENDS.pack(0, 9, 2), b"ab"))),
    "nulls without end": (pa.null(), arrow(pa.nulls(10_000_000))),
    "views": (pa.string_view(), arrow(pa.array(["x" * 100], pa.string_view()))),
    "a dictionary of long texts": (
        pa.dictionary(pa.int32(), pa.string()),
        arrow(pa.DictionaryArray.from_arrays(pa.array([0] * 20_000, pa.int32()), ["x" * 100_000])),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE_ROWS)
def test_rows_of_a_hostile_process_are_refused(name):
    kind, content = HOSTILE_ROWS[name]
    with pytest.raises(MalformedMessage, match="cannot be read"):
        _read(content, pa.schema([("v", kind)]))


def _read(content: bytes, schema: pa.Schema) -> None:
    arrow_stream.batches_of(content, arrow_stream.schema_of(arrow_stream.stream_of(schema)))


class Evil:
    """Called when the object is unpickled."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        return Path.touch, (self._path,)


def message(kind: str, content: bytes) -> bytes:
    return HEAD.pack(kind.encode(), len(content)) + content


def replies(ran: Path) -> dict[str, bytes]:
    evil = pickle.dumps(("done", Evil(ran)))
    return {
        "a pickle": evil,
        "a pickle in a message": message("d", evil),
        "garbage": b"\x80" * 1000,
        "a length without end": HEAD.pack(b"d", 2**63),
        "no known kind": message("x", b"1"),
        "JSON nested without end": message("d", b"[" * 1_000_000),
        "a number of too many digits": message("d", b"9" * 10_000),
        "an error that is none": message("e", b"[1]"),
        "an error of a strange class": message(
            "e", b'{"kind":"eval","problem":"1","key":null,"advice":[],"errno":null}'
        ),
        "rows of different lengths": message("p", b'[1,[["any",[1]],["any",[1,2]]],[]]'),
        "rows of no known form": message("p", b'[1,[["code",["os.system"]]],[]]'),
        "rows with a value of no type": message("p", b'[1,[["any",[["eval","1"]]]],[]]'),
        "rows that are cut off": message("p", b'[1,[["q",[]]],[80]]\n123'),
        "rows with nulls elsewhere": message("p", b'[1,[["?",[99]]],[1]]\n\x00'),
        "progress that is none": message("%", b'"half"'),
        "rows without end": message("p", b'[1,[["any",["' + b"x" * 900_000 + b'"]]],[]]') * 9,
        "the end of the process": b"",
    }


@pytest.mark.parametrize("name", replies(Path()))
def test_a_process_that_was_taken_over_runs_nothing_here(name, tmp_path, monkeypatch):
    """It answers a question with bytes of its own choice, and its answer is refused."""
    ran, content = tmp_path / "ran", tmp_path / "content"
    content.write_bytes(replies(ran)[name])
    monkeypatch.setattr(
        process,
        "PROGRAM",
        f"import sys; sys.stdin.buffer.read(1); out = sys.stdout.buffer; "
        f"out.write(open({str(content)!r}, 'rb').read()); out.flush()",
    )
    monkeypatch.setattr(query_engine, "_waiting", [])
    asked = ConfinedEngine(tmp_path, 0.1, 0.1, message_bytes=1 << 20, rows_bytes=2_000_000)
    tracemalloc.start()
    try:
        with pytest.raises(QueryError):
            asked.ask("rows", "SELECT 1", None, 1)
        assert tracemalloc.get_traced_memory()[1] < 50_000_000
    finally:
        tracemalloc.stop()
        asked.close()
    assert not ran.exists()
    assert not asked.is_running, "a process that sent such bytes is not asked again"


def test_a_child_that_keeps_the_pipe_open_does_not_block(tmp_path, monkeypatch):
    """The process is killed when its time is over; what it started goes on writing."""
    monkeypatch.setattr(
        process,
        "PROGRAM",
        "import os, sys, time\n"
        "if os.fork() == 0:\n"
        "    until_s = time.monotonic() + 20\n"
        "    while time.monotonic() < until_s:\n"
        f"        os.write(1, {message('%', b'1')!r})\n"
        "        time.sleep(0.1)\n"
        "    os._exit(0)\n"
        "time.sleep(60)",
    )
    monkeypatch.setattr(query_engine, "_waiting", [])
    asked = ConfinedEngine(tmp_path, 0.1, 0.1)
    began_s = time.monotonic()
    with pytest.raises(QueryError, match=r"stopped after 0\.5 s"):
        asked.ask("rows", "SELECT 1", None, 1, allowance=Allowance(0.5))
    assert time.monotonic() - began_s < 10
    asked.close()


@pytest.mark.parametrize("package", ["starcat", "starcat_service"])
def test_no_module_of_the_package_unpickles(package):
    root = Path(sys.modules[package].__file__ or "").parent
    unpickling = [path.name for path in root.rglob("*.py") if "import pickle" in path.read_text()]
    assert unpickling == []
