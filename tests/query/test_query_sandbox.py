"""Queries that must not do more than read what was named: attempts to break out."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import duckdb
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from folder_bytes import bytes_of
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from query_conformance import TIGHT, KeepsWithinItsLimits, beside_secrets, rows_of

from starcat.errors import QueryError, QueryLimitError, SchemaVersionError
from starcat.query import engine as engine_module
from starcat.query.engine import Allowance, LocalEngine
from starcat.query.locked_duckdb import Views
from starcat.query.session import Limits, Session, open_session, preamble_of
from starcat.query.statement import REFUSED_FUNCTIONS, check_statement


@pytest.fixture(scope="module")
def folder(small_database: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the database, next to a file that no query names."""
    return beside_secrets(small_database, tmp_path_factory.mktemp("sandbox"))


@pytest.fixture(scope="module")
def session(folder: Path) -> Iterator[Session]:
    with open_session([str(folder)], Limits(time_s=20.0)) as opened:
        yield opened


@pytest.fixture(scope="module")
def limited(folder: Path) -> Iterator[Session]:
    with open_session([str(folder)], TIGHT) as opened:
        yield opened


class TestQueriesOfTheUser(KeepsWithinItsLimits):
    pass


@pytest.mark.slow
def test_what_is_larger_than_the_memory_is_sorted_on_disk(folder):
    limits = Limits(time_s=50.0, memory_gb=0.05)
    text = "SELECT range AS n FROM range(8000000) ORDER BY range % 7919, range"
    with open_session([str(folder)], limits) as session, session.ask(text) as answer:
        batches = answer.batches()
        assert sum(len(batch) for batch in batches) == 8_000_000


def test_a_session_leaves_nothing_behind(folder, monkeypatch, tmp_path):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with open_session([str(folder)]) as session:
        rows_of(session, "FROM stars")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "empty"),
        ("SELECT 1; SELECT 2", "2 statements"),
        ("SELECT * FROM nosuch", "nosuch does not exist"),
        ("SELECT '\ud800'", "character 9 of the query"),
        ("SELECT $count", r'values\["count"\]'),
        ("PIVOT stars ON band USING count(*)", "give the values of a pivot"),
        ("DROP TABLE stars", "DROP is refused: a query only reads"),
    ],
)
def test_a_text_that_is_not_a_query_is_reported(session, text, words):
    with pytest.raises(QueryError, match=words):
        rows_of(session, text)


READS = [
    "FROM stars LIMIT 2",
    "WITH a AS (SELECT mag FROM stars) SELECT max(mag) FROM a;",
    "VALUES (1), (2)",
    "TABLE stars",
    "SHOW TABLES",
    "SUMMARIZE stars",
    "DESCRIBE stars",
    "DESCRIBE SELECT $a AS text",
    "EXPLAIN SELECT 1",
    "EXPLAIN (SELECT 1)",
    "EXPLAIN /* why /* so */ */ (FORMAT json) SELECT 1 -- slow",
    "EXPLAIN ANALYZE SELECT count(*) FROM stars",
    "FROM stars PIVOT (count(*) FOR band IN ('V', 'G'))",
    "SELECT 'a; COPY b TO c' AS text -- a comment; and more",
    'SELECT $$a; \'/* $$ AS text, $é$ $$ $é$ AS "ü /* "";" /* /* */ */ FROM stars',
    "WITH RECURSIVE r(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM r WHERE n < 9) FROM r",
    "SELECT * FROM stars ASOF JOIN boresights USING (ra_deg)",
    "SELECT comment FROM duckdb_columns() WHERE table_name = 'pairs'",
    "SELECT x LIKE 'a%' ESCAPE '$', x NOT IN (SELECT 'b'), [v || 'c' FOR v IN [x]] FROM (VALUES "
    "('a')) AS t(x)",
    "SELECT * EXCLUDE (mag) REPLACE (ra_deg / 15 AS ra_deg) FROM cone(1, 2, 90, of := 'rejected')",
]


@pytest.mark.parametrize("text", READS)
def test_what_reads_is_allowed(session, text):
    with session.ask(text, {"a": "b"}) as answer:
        assert answer.columns
        assert answer.rows(5)


@pytest.fixture(scope="module")
def plain_duckdb(folder: Path) -> Iterator[duckdb.DuckDBPyConnection]:
    """A DuckDB of the views, without the sandbox."""
    with duckdb.connect(config={"threads": 1}) as connection:  # rows come in one order
        connection.execute(preamble_of([str(folder)]))
        yield connection


@pytest.mark.parametrize("text", [text for text in READS if not text.startswith("EXPLAIN")])
def test_what_duckdb_writes_from_the_tree_means_what_was_asked(plain_duckdb, text):
    """Nothing of the sandbox takes part: DuckDB runs the text as given, and as rebuilt."""
    tables = frozenset({"cone", "box", "field"})
    values = {"a": "b"} if "SELECT $a" in text else None
    given = plain_duckdb.execute(text, values)
    expected = [column[0] for column in given.description], given.fetchall()
    written = plain_duckdb.execute(check_statement(text, plain_duckdb, tables).text, values)
    assert ([column[0] for column in written.description], written.fetchall()) == expected


HARMLESS = {
    "current_connection_id", "current_query", "current_query_id", "current_transaction_id", "error",
    "gen_random_uuid", "random", "uuid", "uuidv4", "uuidv7", "vector_type",
}  # fmt: skip


def test_functions_that_do_something_are_known():
    """If a new DuckDB has another function, this test fails, so that a person decides about it."""
    asked = "SELECT function_name FROM duckdb_functions() WHERE has_side_effects"
    with duckdb.connect() as connection:
        found = {str(name) for (name,) in connection.execute(asked).fetchall()}
    assert found == HARMLESS | (found & set(REFUSED_FUNCTIONS))


PIECES = st.sampled_from(
    [
        "EXPLAIN", "ANALYZE", "(ANALYZE)", "(FORMAT json)", "SELECT 1", "FROM stars", "COPY",
        "(SELECT 42)", "TO", "'{in}/stars.parquet'", "(FORMAT parquet, USE_TMP_FILE false)",
        "COPY (SELECT 42) TO '{in}/stars.parquet' (FORMAT parquet, USE_TMP_FILE false)", "/*", "*/",
        "--", "\n", ";", "$$", "$é$", "'", '"', "é", "☃ ", "\u2028", "\xa0", "\0", "WITH c AS (",
        ") FROM c", "LIMIT 1", "WHERE", "= 1", ",", "DESCRIBE", "SUMMARIZE", "VALUES (1)",
    ]
)  # fmt: skip


@pytest.mark.slow
@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(pieces=st.lists(PIECES, min_size=1, max_size=12), glue=st.sampled_from([" ", "", "\t"]))
@example(
    pieces=["EXPLAIN", "/*", "/*", "*/", "SELECT 1", "--", "*/", "ANALYZE", "COPY", "(SELECT 42)",
            "TO", "'{in}/stars.parquet'", "(FORMAT parquet, USE_TMP_FILE false)"],
    glue=" ",
)  # fmt: skip
def test_what_is_accepted_is_one_query_that_changes_no_file(session, folder, pieces, glue):
    text = glue.join(pieces).replace("{in}", str(folder))
    before = bytes_of(folder.parent)
    try:
        runs = session.check(text).text
        rows_of(session, text, 3)
    except QueryError:
        pass
    else:
        kinds = [statement.type for statement in duckdb.extract_statements(runs)]
        assert kinds in ([duckdb.StatementType.SELECT], [duckdb.StatementType.EXPLAIN])
        assert "COPY" not in duckdb_words(runs)
    assert bytes_of(folder.parent) == before


def duckdb_words(text: str) -> list[str]:
    """Return the words of a text that are neither comments nor texts in quotes."""
    data = text.encode()
    tokens = duckdb.tokenize(text)
    ends = [*(start for start, _ in tokens[1:]), len(data)]
    return [
        data[start:end].decode(errors="replace").strip().upper()
        for (start, kind), end in zip(tokens, ends, strict=True)
        if kind in (duckdb.token_type.keyword, duckdb.token_type.identifier)
    ]


# What one query takes ---------------------------------------------------------------------------


@pytest.mark.parametrize("calls", [400, 900])
def test_calls_within_calls_are_answered(session, calls):
    assert rows_of(session, "SELECT " + "abs(" * calls + "-1" + ")" * calls) == [(1,)]


@pytest.mark.parametrize(
    "text", ["(" * 20000 + "1" + ")" * 20000, "[" * 5000 + "1" + "]" * 5000, "1" + "+1" * 5000]
)
def test_what_is_nested_too_deeply_is_reported(session, text):
    with pytest.raises(QueryError, match=r"depth|deeply|within each other"):
        rows_of(session, f"SELECT {text}")


def test_a_question_that_is_dropped_is_not_answered_to_the_next(session):
    def stop(stage: str, done: int, total: int | None) -> None:
        raise KeyboardInterrupt

    with (
        pytest.raises(KeyboardInterrupt),
        session.ask("SELECT sum(sin(range)) FROM range(10000000000)", progress=stop) as answer,
    ):
        answer.rows(1)
    assert rows_of(session, "SELECT 9") == [(9,)]


def test_batches_of_a_dropped_answer_are_reported(session):
    with session.ask("FROM range(1000000)") as answer:
        batches = answer.batches()
        rows_of(session, "SELECT 1")
        with pytest.raises(QueryError, match="after another query"):
            batches.read_all()


# Parquet files of others -----------------------------------------------------------------------


@pytest.mark.parametrize(
    "schema",
    ["**-1.0.0", "/etc/*-1.0.0", "../schemas/stars-1.0.0", "manifest-1.0.0", "manifest-1.1.0", "-",
     "stars-", "stars-١.٠.٠", "stars-1.0", "[a-z]*-1.0.0", "x" * 100_000, "a\nb-1.0.0"],
)  # fmt: skip
def test_a_schema_name_in_a_footer_is_no_path(tmp_path, schema):
    path = tmp_path / "theirs.parquet"
    table = pa.table({"n": [1]}).replace_schema_metadata({"starcat.schema": schema})
    pq.write_table(table, path)
    with (
        pytest.raises(SchemaVersionError, match="schema version") as raised,
        open_session([str(path)]),
    ):
        pass
    assert len(str(raised.value)) < 400
    assert "\n" not in str(raised.value)


def test_times_with_a_zone_are_times_in_utc(tmp_path):
    noon = datetime(2026, 3, 1, 12, tzinfo=timezone(timedelta(hours=2)))
    path = tmp_path / "times.parquet"
    pq.write_table(pa.table({"at": [noon, None], "more": [[noon], []], "n": [1, 2]}), path)
    with open_session([str(path)]) as session, session.ask("FROM times ORDER BY n") as answer:
        assert answer.rows(5) == [
            (noon.astimezone(UTC), "['2026-03-01 10:00:00+00']", 1),
            (None, "[]", 2),
        ]
        assert answer.columns[0][1] == "TIMESTAMP WITH TIME ZONE"
        assert answer.batches().read_all()["at"].to_pylist() == [noon.astimezone(UTC), None]


def test_a_query_takes_no_more_disk_than_it_may(small_database):
    """Ten million numbers in order take 300 MB of disk, with so little memory."""
    limits = Limits(time_s=100.0, memory_gb=0.1, disk_gb=0.02)
    sort = "SELECT i, hash(i) AS h FROM range(10000000) AS t(i) ORDER BY h OFFSET 9999990"
    with open_session([str(small_database)], limits) as session:
        with pytest.raises(QueryLimitError, match=r"0\.02 GB of disk"), session.ask(sort) as found:
            found.rows(1)
        with session.ask("SELECT 1") as found:
            assert found.rows(1) == [(1,)]


def test_brackets_are_counted_before_a_query_is_parsed(small_database):
    with open_session([str(small_database)]) as session:
        for begin, end in ("()", "[]"):
            text = f"SELECT {begin * 49_000}1{end * 49_000}"
            with pytest.raises(QueryError, match="more than 1,000 brackets within each other"):
                session.check(text)
        assert session.check(f"SELECT {'(' * 500}1{')' * 500}").text == "SELECT 1"
        assert session.check(f"SELECT '{'(' * 5_000}'")


def test_what_writes_behind_with_is_called_by_its_name(small_database):
    refused = pytest.raises(QueryError, match=r"^INSERT is refused: a query only reads")
    with open_session([str(small_database)]) as session, refused:
        session.check("WITH x AS (SELECT 1) INSERT INTO t SELECT * FROM x")


# DuckDB in this process ------------------------------------------------------------------------

LOCKED = {
    "read": "SELECT * FROM read_csv('{near}/secret.csv')",
    "list": "SELECT * FROM glob('{near}/*')",
    "write": "COPY (SELECT 1) TO '{near}/stolen.csv'",
    "attach": "ATTACH '{near}/other.db'",
    "install": "INSTALL httpfs",
    "load": "LOAD httpfs",
    "unlock": "SET enable_external_access = true",
    "more memory": "SET memory_limit = '100GB'",
    "another path": "SET allowed_paths = ['/etc/passwd']",
    "export": "EXPORT DATABASE '{near}/stolen'",
}


@pytest.mark.parametrize("name", LOCKED)
def test_duckdb_itself_refuses_what_was_not_checked(folder, tmp_path, name):
    engine = LocalEngine(tmp_path, 0.5, 0.1)
    before = bytes_of(folder.parent)
    text = LOCKED[name].replace("{near}", str(folder.parent))
    try:
        stars = str(folder / "stars.parquet")
        engine.open(Views(f"CREATE VIEW stars AS FROM '{stars}'", [stars]))
        with pytest.raises(QueryError, match=r"disabled|locked|[Pp]ermission|Extension"):
            engine.rows(text, None, 10, Allowance(20.0))
        [(count,)] = engine.rows("SELECT count(*) FROM stars", None, 1, Allowance(20.0))[1]
    finally:
        engine.close()
    assert count > 100
    assert bytes_of(folder.parent) == before


def test_a_query_that_does_not_stop_is_left_to_itself(folder, monkeypatch):
    """A call of a function cannot be interrupted; the next query has another DuckDB."""
    stopped = threading.Event()
    with open_session([str(folder)], Limits(time_s=0.2)) as session:
        rows_of(session, "SELECT 1")
        monkeypatch.setattr(engine_module, "STOPPING_S", 0.3)
        duckdb_of_it = session._engine._duckdb
        monkeypatch.setattr(duckdb_of_it, "rows", lambda *_: stopped.wait(30.0))
        began_s = time.monotonic()
        with pytest.raises(QueryLimitError, match=r"stopped after 0\.2 s"):
            rows_of(session, "SELECT 1")
        assert time.monotonic() - began_s < 10.0
        assert rows_of(session, "SELECT count(*) > 100 FROM stars") == [(True,)]
        assert session._engine._duckdb is not duckdb_of_it
        stopped.set()


def test_a_limit_of_memory_ends_the_query_and_not_the_session(folder):
    with open_session([str(folder)], Limits(memory_gb=0.2, disk_gb=0.1)) as session:
        for _ in range(2):
            with pytest.raises(QueryLimitError, match=r"needs more than 0\.2 GB of memory"):
                rows_of(session, "SELECT list(range) FROM range(2000000000)")
            assert rows_of(session, "SELECT count(*) > 100 FROM stars") == [(True,)]


@pytest.mark.skipif(os.name != "posix", reason="signals are sent in another way")
def test_ctrl_c_stops_a_query(folder):
    text = "SELECT sum(sin(range)) FROM range(100000000000)"
    asking = subprocess.Popen(
        [sys.executable, "-m", "starcat", "sql", str(folder), text],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    time.sleep(2.0)
    assert asking.poll() is None
    asking.send_signal(signal.SIGINT)
    written, _ = asking.communicate(timeout=15.0)
    assert asking.returncode == 130
    assert written == b""
