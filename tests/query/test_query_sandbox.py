"""Queries that must not do more than read what was named: attempts to break out."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
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
from programs import printed_by

from starcat.errors import QueryError, QueryLimitError, SchemaVersionError
from starcat.query.engine import Engine
from starcat.query.session import Limits, Session, open_session, preamble_of
from starcat.query.statement import (
    EXPLAIN_FORMATS,
    REFUSED_FUNCTIONS,
    TABLE_FUNCTIONS,
    check_statement,
)
from starcat.query.worker import BESIDE_BYTES


@pytest.fixture(scope="module")
def folder(small_artifact: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the database, next to a file that no query names."""
    copied = tmp_path_factory.mktemp("sandbox") / "artifact"
    shutil.copytree(small_artifact, copied, copy_function=shutil.copyfile)
    shutil.copy(copied / "stars.parquet", copied.parent / "secret.parquet")
    (copied.parent / "secret.csv").write_text("a,b\n1,2\n", encoding="utf-8")
    return copied


@pytest.fixture(scope="module")
def session(folder: Path) -> Iterator[Session]:
    with open_session([str(folder)], Limits(time_s=20.0)) as opened:
        yield opened


@pytest.fixture(scope="module")
def limited(folder: Path) -> Iterator[Session]:
    with open_session([str(folder)], Limits(time_s=0.5, memory_gb=0.2, disk_gb=0.1)) as opened:
        yield opened


EXCEEDED = r"stopped after 0\.5 s|needs more than 0\.2 GB"


def rows_of(session: Session, text: str, most: int = 1) -> list[tuple[object, ...]]:
    with session.ask(text) as answer:
        return answer.rows(most)


ATTEMPTS = {
    "copy-to": "COPY stars TO '{near}/stolen.csv'",
    "copy-query-to": "COPY (SELECT 1) TO '{near}/stolen.parquet' (FORMAT parquet)",
    "copy-over-a-view": "COPY (SELECT 1) TO '{in}/stars.parquet' "
    "(FORMAT parquet, use_tmp_file false)",
    "copy-in-with": "WITH c AS (COPY stars TO '{near}/stolen.csv') SELECT 1 FROM c",
    "copy-over-a-view-in-with": "WITH c AS (COPY (SELECT 1) TO '{in}/stars.parquet' "
    "(FORMAT parquet, use_tmp_file false)) SELECT 1 FROM c",
    "copy-in-deep-with": "SELECT * FROM (WITH c AS MATERIALIZED (COPY stars TO '{near}/x.csv') "
    "SELECT 1 FROM c)",
    "copy-after-nested-comments": "EXPLAIN /* /* */ SELECT 1 -- */ ANALYZE COPY (SELECT 42) TO "
    "'{in}/stars.parquet' (FORMAT parquet, USE_TMP_FILE false)",
    "copy-after-nested-comments-and-options": "EXPLAIN /* /* */ (FORMAT json) SELECT 1 -- */ "
    "(ANALYZE) COPY (SELECT 42) TO '{in}/stars.parquet' (FORMAT parquet, USE_TMP_FILE false)",
    "explain-parenthesis-copy": "EXPLAIN (COPY (SELECT 1) TO '{near}/stolen.csv')",
    "explain-unknown-option": "EXPLAIN (ANALYZE, FORMAT text, BUFFERS '{near}/x') SELECT 1",
    "copy-after-nul": "SELECT 1 \0; COPY (SELECT 1) TO '{near}/stolen.csv'",
    "copy-from": "COPY stars FROM '{near}/secret.csv'",
    "explain-analyze-copy": "EXPLAIN ANALYZE COPY stars TO '{near}/stolen.csv'",
    "explain-options-copy": "EXPLAIN (ANALYZE, FORMAT json) COPY stars TO '{near}/stolen.csv'",
    "commented-explain-copy": "/* */ EXPLAIN -- x\n ANALYZE /* y */ COPY stars TO '{near}/x.csv'",
    "prepare-copy": "PREPARE p AS COPY stars TO '{near}/stolen.csv'",
    "execute": "EXECUTE p",
    "second-statement": "SELECT 1; COPY stars TO '{near}/stolen.csv'",
    "export": "EXPORT DATABASE '{near}/stolen'",
    "import": "IMPORT DATABASE '{near}'",
    "read-csv": "SELECT * FROM read_csv('/etc/passwd', sep = ':')",
    "read-csv-quoted": "SELECT * FROM \"read_csv\"('/etc/passwd')",
    "read-csv-qualified": "SELECT * FROM main.read_csv('/etc/passwd')",
    "read-csv-lateral": "SELECT * FROM stars, LATERAL (SELECT * FROM read_csv('/etc/passwd'))",
    "read-csv-subquery": "SELECT (SELECT count(*) FROM read_csv('/etc/passwd'))",
    "read-csv-described": "DESCRIBE SELECT * FROM read_csv('/etc/passwd')",
    "read-text": "SELECT * FROM read_text('/etc/passwd')",
    "read-blob": "SELECT * FROM read_blob('/proc/self/environ')",
    "read-json": "SELECT * FROM read_json('/etc/passwd')",
    "sniff": "SELECT * FROM sniff_csv('/etc/passwd')",
    "glob": "SELECT * FROM glob('/etc/*')",
    "other-parquet": "SELECT * FROM read_parquet('{near}/secret.parquet')",
    "other-parquet-by-name": "SELECT * FROM '{near}/secret.parquet'",
    "other-parquet-above": "SELECT * FROM '{in}/../secret.parquet'",
    "other-parquet-schema": "SELECT * FROM parquet_schema('{near}/secret.parquet')",
    "same-folder": "SELECT * FROM parquet_metadata('{in}/nothing.parquet')",
    "query-function": "SELECT * FROM query('COPY stars TO ''{near}/stolen.csv''')",
    "serialized-sql": "SELECT * FROM json_execute_serialized_sql(json_serialize_sql('SELECT 1'))",
    "http-by-name": "SELECT * FROM 'https://example.org/stars.parquet'",
    "http": "SELECT * FROM read_parquet('https://example.org/stars.parquet')",
    "s3": "SELECT * FROM read_parquet('s3://bucket/stars.parquet')",
    "attach": "ATTACH '{near}/other.db'",
    "attach-http": "ATTACH 'https://example.org/other.db'",
    "use": "USE other",
    "install": "INSTALL httpfs",
    "load": "LOAD httpfs",
    "load-file": "LOAD '{near}/evil.duckdb_extension'",
    "pragma": "PRAGMA enable_profiling",
    "pragma-function": "CALL pragma_version()",
    "set": "SET enable_external_access = true",
    "set-memory": "SET memory_limit = '100GB'",
    "reset": "RESET lock_configuration",
    "create-table": "CREATE TABLE t AS SELECT 1",
    "create-view": "CREATE VIEW v AS FROM read_csv('/etc/passwd')",
    "create-macro": "CREATE MACRO m() AS TABLE FROM read_csv('/etc/passwd')",
    "create-secret": "CREATE SECRET s (TYPE s3)",
    "drop-view": "DROP VIEW stars",
    "insert-in-with": "WITH c AS (INSERT INTO stars VALUES (1)) SELECT 1",
    "delete-in-with": "WITH c AS (DELETE FROM stars RETURNING *) SELECT * FROM c",
    "update": "UPDATE stars SET mag = 0",
    "checkpoint": "CHECKPOINT",
    "logging": "CALL enable_logging('QueryLog', storage = 'file')",
    "python-object": "SELECT * FROM session",
    "memory-address": "SELECT * FROM arrow_scan(1::POINTER, 2::POINTER, 3::POINTER)",
    "python-function": "SELECT * FROM python_map_function(1)",
    "environment": "SELECT getenv('HOME')",
    "directory": "SELECT * FROM duckdb_secrets()",
    "sleep": "SELECT sleep_ms(25000)",
    "sleep-of-a-column": "SELECT max(range.sleep_ms()) FROM range(100)",
    "sleep-as-in-postgres": "SELECT PG_Sleep(100)",
    "sleep-where": "FROM stars ORDER BY system.main.sleep_ms(mag::INTEGER)",
    "settings": "SELECT * FROM duckdb_settings()",
    "settings-as-in-postgres": "SELECT * FROM pg_catalog.pg_settings",
    "one-setting": "SELECT current_setting('allowed_paths')",
    "variable": "SELECT getvariable('x')",
}


@pytest.mark.parametrize("attempt", ATTEMPTS)
def test_no_query_gets_out(session, folder, attempt):
    text = ATTEMPTS[attempt].replace("{near}", str(folder.parent)).replace("{in}", str(folder))
    before = bytes_of(folder.parent)
    with pytest.raises(QueryError) as raised:
        rows_of(session, text, 10)
    assert str(raised.value), "the error names the refused file"
    assert "root:" not in str(raised.value), "and nothing from inside the file"
    assert bytes_of(folder.parent) == before
    assert rows_of(session, "SELECT count(*) > 100 FROM stars") == [(True,)]


@pytest.mark.parametrize(
    "text",
    [
        "SELECT count(*) FROM pairs a, pairs b, pairs c WHERE sin(a.i + b.i * c.j) > 2",
        "WITH RECURSIVE r(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM r) SELECT max(n) FROM r",
        "SELECT a.range FROM range(100000000) a ORDER BY a.range % 7, a.range % 11, a.range",
    ],
    ids=["huge-join", "endless-recursion", "huge-sort"],
)
@pytest.mark.parametrize("form", ["rows", pytest.param("batches", marks=pytest.mark.slow)])
def test_what_takes_too_much_is_stopped(limited, text, form):
    with pytest.raises(QueryLimitError, match=EXCEEDED), limited.ask(text) as answer:
        answer.rows(1) if form == "rows" else sum(len(batch) for batch in answer.batches())


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


@pytest.mark.parametrize("text", [text for text in READS if not text.startswith("EXPLAIN")])
def test_what_duckdb_writes_from_the_tree_means_what_was_asked(folder, text):
    """Nothing of the sandbox takes part: DuckDB runs the text as given, and as rebuilt."""
    with duckdb.connect(config={"threads": 1}) as connection:  # rows come in one order
        connection.execute(preamble_of([str(folder)]))
        tables = frozenset({"cone", "box", "field"})
        values = {"a": "b"} if "SELECT $a" in text else None
        given = connection.execute(text, values)
        expected = [column[0] for column in given.description], given.fetchall()
        written = connection.execute(check_statement(text, connection, tables).text, values)
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
            told = str(rows_of(session, text, 10_000))
            answered += 1
        except QueryError as error:
            told = str(error)
        for place in (folder.parent, os.getcwd(), Path.home(), tempfile.gettempdir()):
            assert str(place) not in told, text
    assert answered > 40


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
    engine = Engine(scratch, 0.5, 0.1)
    try:
        victim.chmod(0o666)
        engine.open("SELECT 1", str(folder), [str(victim)], frozenset(), {}, {})
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
        "from starcat.workers.confinement import forbid_writing\n"
        "print(forbid_writing(Path(tempfile.gettempdir())))"
    )
    return printed_by("-c", code).strip() == "True"


# What a single call of a function takes --------------------------------------------------------

ONE_CALL = {
    "repeat": "SELECT length(repeat('x', 4000000000))",
    "lpad-of-a-column": "SELECT max(length(lpad('x', range::INTEGER, 'y'))) "
    "FROM range(2000000000, 2000000002)",
    "format": "SELECT length(format('{:>2000000000}', 1))",
    "rows": "SELECT repeat('x', 50000000) FROM range(100)",
}


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
with open_session([sys.argv[1]], Limits(time_s=1.0, memory_gb=0.1)) as session:
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


@pytest.mark.parametrize("calls", [400, 900])
def test_calls_within_calls_are_answered(session, calls):
    assert rows_of(session, "SELECT " + "abs(" * calls + "-1" + ")" * calls) == [(1,)]


@pytest.mark.parametrize(
    "text", ["(" * 20000 + "1" + ")" * 20000, "[" * 5000 + "1" + "]" * 5000, "1" + "+1" * 5000]
)
def test_what_is_nested_too_deeply_is_reported(session, text):
    with pytest.raises(QueryError, match=r"depth|deeply|within each other"):
        rows_of(session, f"SELECT {text}")


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


@pytest.mark.skipif(os.name != "posix", reason="a process outlives its parent until it reads")
def test_no_process_outlives_the_one_that_asked(folder):
    code = (
        "import os, sys; from starcat.query.session import open_session\n"
        "with open_session([sys.argv[1]]) as session:\n"
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


def test_a_query_takes_no_more_disk_than_it_may(small_artifact):
    """Ten million numbers in order take 300 MB of disk, with so little memory."""
    limits = Limits(time_s=100.0, memory_gb=0.1, disk_gb=0.02)
    sort = "SELECT i, hash(i) AS h FROM range(10000000) AS t(i) ORDER BY h OFFSET 9999990"
    with open_session([str(small_artifact)], limits) as session:
        with pytest.raises(QueryLimitError, match=r"0\.02 GB of disk"), session.ask(sort) as found:
            found.rows(1)
        with session.ask("SELECT 1") as found:
            assert found.rows(1) == [(1,)]


def test_brackets_are_counted_before_a_query_is_parsed(small_artifact):
    with open_session([str(small_artifact)]) as session:
        for begin, end in ("()", "[]"):
            text = f"SELECT {begin * 49_000}1{end * 49_000}"
            with pytest.raises(QueryError, match="more than 1,000 brackets within each other"):
                session.check(text)
        assert session.check(f"SELECT {'(' * 500}1{')' * 500}").text == "SELECT 1"
        assert session.check(f"SELECT '{'(' * 5_000}'")


def test_what_writes_behind_with_is_called_by_its_name(small_artifact):
    refused = pytest.raises(QueryError, match=r"^INSERT is refused: a query only reads")
    with open_session([str(small_artifact)]) as session, refused:
        session.check("WITH x AS (SELECT 1) INSERT INTO t SELECT * FROM x")
