"""Queries that must not do more than read what was named: attempts to break out."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from starcat.errors import QueryError, QueryLimitError
from starcat.query.session import Limits, Session, open_session

OUTSIDE = "/etc/passwd"


@pytest.fixture(scope="module")
def folder(small_artifact: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the artifact, with a file beside it that nobody named."""
    copied = tmp_path_factory.mktemp("sandbox") / "artifact"
    shutil.copytree(small_artifact, copied, copy_function=shutil.copyfile)
    shutil.copy(copied / "stars.parquet", copied.parent / "secret.parquet")
    (copied.parent / "secret.csv").write_text("a,b\n1,2\n", encoding="utf-8")
    return copied


@pytest.fixture(scope="module")
def session(folder: Path) -> Iterator[Session]:
    with open_session([str(folder)], Limits(time_s=1.0, memory_gb=0.2, disk_gb=0.1)) as opened:
        yield opened


def all_files(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


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
}


@pytest.mark.parametrize("attempt", ATTEMPTS)
def test_no_query_gets_out(session, folder, attempt):
    text = ATTEMPTS[attempt].replace("{near}", str(folder.parent)).replace("{in}", str(folder))
    before = all_files(folder.parent)
    with pytest.raises(QueryError) as raised, session.ask(text) as answer:
        answer.rows(10)
    assert str(raised.value), "the error says what was refused"
    assert "root:" not in str(raised.value), "and nothing of what is in the file"
    assert all_files(folder.parent) == before


def test_after_all_attempts_the_session_still_answers(session, folder):
    for text in ATTEMPTS.values():
        with pytest.raises(QueryError), session.ask(text.replace("{near}", "/tmp")) as answer:
            answer.rows(1)
    with session.ask("SELECT count(*) FROM stars") as answer:
        [(count,)] = answer.rows(1)
    assert count > 100


@pytest.mark.parametrize(
    "text",
    [
        "SELECT count(*) FROM pairs a, pairs b, pairs c WHERE sin(a.i + b.i * c.j) > 2",
        "WITH RECURSIVE r(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM r) SELECT max(n) FROM r",
        "SELECT a.range FROM range(100000000) a ORDER BY a.range % 7, a.range % 11, a.range",
    ],
    ids=["huge-join", "endless-recursion", "huge-sort"],
)
@pytest.mark.parametrize("form", ["rows", "batches"])
def test_what_takes_too_much_is_stopped(session, text, form):
    with (
        pytest.raises(QueryLimitError, match=r"stopped after 1 s|needs more than"),
        session.ask(text) as answer,
    ):
        answer.rows(1) if form == "rows" else sum(len(batch) for batch in answer.batches())


def test_what_needs_too_much_memory_is_stopped(folder):
    limits = Limits(time_s=30.0, memory_gb=0.05, disk_gb=0.001)
    text = "SELECT list(range) FROM range(30000000)"
    with (
        open_session([str(folder)], limits) as session,
        pytest.raises(QueryLimitError, match=r"more than 0\.05 GB of memory"),
        session.ask(text) as answer,
    ):
        answer.rows(1)


def test_what_is_larger_than_the_memory_is_sorted_on_disk(folder):
    limits = Limits(time_s=50.0, memory_gb=0.05)
    text = "SELECT range AS n FROM range(8000000) ORDER BY range % 7919, range"
    with open_session([str(folder)], limits) as session, session.ask(text) as answer:
        batches = answer.batches()
        assert sum(len(batch) for batch in batches) == 8_000_000


def test_a_session_leaves_nothing_behind(folder, monkeypatch, tmp_path):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with open_session([str(folder)]) as session, session.ask("FROM stars") as answer:
        answer.rows(1)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "empty"),
        ("SELEC 1", "no valid SQL.*\n  SELEC 1\n  \\^"),
        ("SELECT 1; SELECT 2", "2 statements"),
        ("SELECT nosuch FROM stars", "nosuch"),
        ("SELECT * FROM nosuch", "nosuch does not exist"),
        ("SELECT $count", r"--set count=VALUE"),
        ("PIVOT stars ON band USING count(*)", "give the values of a pivot"),
        ("DROP TABLE stars", "DROP is refused: a query only reads"),
    ],
)
def test_what_is_no_query_is_told(session, text, words):
    with pytest.raises(QueryError, match=words), session.ask(text) as answer:
        answer.rows(1)


@pytest.mark.parametrize(
    "text",
    [
        "FROM stars LIMIT 2",
        "WITH a AS (SELECT mag FROM stars) SELECT max(mag) FROM a;",
        "VALUES (1), (2)",
        "TABLE stars",
        "SHOW TABLES",
        "SUMMARIZE stars",
        "DESCRIBE stars",
        "EXPLAIN SELECT 1",
        "EXPLAIN ANALYZE SELECT count(*) FROM stars",
        "FROM stars PIVOT (count(*) FOR band IN ('V', 'G'))",
        "SELECT 'a; COPY b TO c' AS text -- a comment; and more",
        "WITH RECURSIVE r(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM r WHERE n < 9) FROM r",
        "SELECT * FROM stars ASOF JOIN boresights USING (ra_deg)",
        "SELECT comment FROM duckdb_columns() WHERE table_name = 'pairs'",
    ],
)
def test_what_reads_is_allowed(session, text):
    with session.ask(text) as answer:
        assert answer.columns
        assert answer.rows(5)
