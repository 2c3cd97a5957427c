"""The process that runs queries: nothing gets out of it, and it takes no more than it may."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import duckdb
import pytest
from folder_bytes import bytes_of
from hostile_queries import ONE_CALL
from programs import printed_by
from query_conformance import EXCEEDED, TIGHT, KeepsWithinItsLimits, beside_secrets, rows_of

from starcat.errors import QueryError, QueryLimitError
from starcat.query.locked_duckdb import Views
from starcat.query.session import Limits, Session, open_session
from starcat.query.statement import EXPLAIN_FORMATS, TABLE_FUNCTIONS
from starcat_service.sandbox.query_engine import ConfinedEngine
from starcat_service.sandbox.query_worker import BESIDE_BYTES

confined = partial(open_session, new_engine=ConfinedEngine)


@pytest.fixture(scope="module")
def folder(small_database: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the database, next to a file that no query names."""
    return beside_secrets(small_database, tmp_path_factory.mktemp("sandbox"))


@pytest.fixture(scope="module")
def session(folder: Path) -> Iterator[Session]:
    with confined([str(folder)], Limits(time_s=20.0)) as opened:
        yield opened


@pytest.fixture(scope="module")
def limited(folder: Path) -> Iterator[Session]:
    with confined([str(folder)], TIGHT) as opened:
        yield opened


class TestQueriesOfAProcess(KeepsWithinItsLimits):
    pass


def test_nothing_tells_where_the_files_are(session, folder):
    """Each table of DuckDB, each function that describes tables, and each way to explain."""
    with duckdb.connect() as connection:
        views = connection.execute(
            "SELECT schema_name || '.' || view_name FROM duckdb_views() WHERE internal"
        ).fetchall()
    asked = [f"FROM {name}" for (name,) in views]
    asked += [f"FROM {name}()" for name in TABLE_FUNCTIONS if name.startswith("duckdb_")]
    asked += [f"EXPLAIN (ANALYZE, FORMAT {form}) FROM stars" for form in EXPLAIN_FORMATS]
    asked += ["EXPLAIN ANALYZE FROM stars", "SHOW ALL TABLES", "DESCRIBE stars", "FROM nowhere.x"]
    answered = 0
    for text in asked:
        try:
            answer = str(rows_of(session, text, 10_000))
            answered += 1
        except QueryError as error:
            answer = str(error)
        for path in (folder.parent, os.getcwd(), Path.home(), tempfile.gettempdir()):
            assert str(path) not in answer, text
    assert answered > 40


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has Landlock")
def test_a_copy_that_came_through_could_write_nothing(folder, tmp_path):
    """The second wall: the query is not checked here, and all files are writable."""
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    if not landlock_is_there():
        pytest.skip("this kernel has no Landlock")
    victim = folder / "stars.parquet"
    mode = victim.stat().st_mode
    before = bytes_of(folder.parent)
    engine = ConfinedEngine(scratch, 0.5, 0.1)
    try:
        victim.chmod(0o666)
        engine.open(Views("SELECT 1", [str(victim)]))
        for text in (
            f"COPY (SELECT 1) TO '{victim}' (FORMAT parquet, USE_TMP_FILE false)",
            f"COPY (SELECT 1) TO '{victim}'",
        ):
            with pytest.raises(QueryError, match=r"[Pp]ermission|denied"):
                engine.ask("rows", text, None, 1)
    finally:
        victim.chmod(mode)
        engine.close()
    assert bytes_of(folder.parent) == before


def landlock_is_there() -> bool:
    code = (
        "import sys, tempfile; from pathlib import Path\n"
        "from starcat_service.sandbox.confinement import forbid_writing\n"
        "print(forbid_writing(Path(tempfile.gettempdir())))"
    )
    return printed_by("-c", code).strip() == "True"


@pytest.mark.parametrize("name", ONE_CALL)
def test_limits_hold_inside_one_call(limited, name):
    began = time.monotonic()
    with pytest.raises(QueryLimitError, match=EXCEEDED):
        rows_of(limited, ONE_CALL[name], 100)
    assert time.monotonic() - began < 20.0


MEASURE = """
import resource, sys
from starcat.errors import QueryLimitError
from starcat.query.session import Limits, open_session
from starcat_service.sandbox.query_engine import ConfinedEngine
limits = Limits(time_s=1.0, memory_gb=0.1)
with open_session([sys.argv[1]], limits, new_engine=ConfinedEngine) as session:
    for text in sys.argv[2:]:
        try:
            with session.ask(text) as answer:
                answer.rows(100)
        except QueryLimitError:
            continue
        raise SystemExit(f"no limit held: {text}")
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere memory is counted in other ways")
def test_a_query_takes_no_more_memory_than_it_may(folder):
    texts = ONE_CALL["repeat"], ONE_CALL["rows"]
    largest_bytes = 1024 * int(printed_by("-c", MEASURE, folder, *texts))
    assert largest_bytes < 0.1e9 + BESIDE_BYTES + 0.2e9, "what a process has, and what it may take"


def test_a_process_that_dies_is_reported_and_started_again(session):
    before = session._engine._process.pid
    os.kill(before, signal.SIGABRT)
    session._engine._process.wait()
    assert rows_of(session, "SELECT 7") == [(7,)]
    assert session._engine._process.pid != before

    def killed(stage: str, done: int, total: int | None) -> None:
        os.kill(session._engine._process.pid, signal.SIGABRT)

    with (
        pytest.raises(QueryError, match=r"ended by itself \(SIGABRT.*other queries are answered"),
        session.ask("SELECT sum(sin(range)) FROM range(10000000000)", progress=killed) as answer,
    ):
        answer.rows(1)
    assert rows_of(session, "SELECT 8") == [(8,)]


@pytest.mark.skipif(os.name != "posix", reason="a process outlives its parent until it reads")
def test_no_process_outlives_the_one_that_asked(folder):
    code = (
        "import sys; from starcat.query.session import open_session\n"
        "from starcat_service.sandbox.query_engine import ConfinedEngine\n"
        "with open_session([sys.argv[1]], new_engine=ConfinedEngine) as session:\n"
        "    print(session._engine._process.pid, flush=True)\n"
        "    with session.ask('SELECT sum(sin(range)) FROM range(10000000000)') as answer:\n"
        "        answer.rows(1)"
    )
    asking = subprocess.Popen([sys.executable, "-c", code, str(folder)], stdout=subprocess.PIPE)
    assert asking.stdout is not None
    worker = int(asking.stdout.readline())
    os.kill(worker, 0)
    time.sleep(0.5)
    asking.kill()
    asking.communicate()
    end = time.monotonic() + 20.0
    while is_running(worker) and time.monotonic() < end:
        time.sleep(0.1)
    assert not is_running(worker)


def is_running(process: int) -> bool:
    """Return whether a process runs; one that waits to be collected does not."""
    try:
        os.kill(process, 0)
        state = Path(f"/proc/{process}/stat").read_text(encoding="ascii").rpartition(") ")[2][0]
    except OSError:
        return False
    return state != "Z"
