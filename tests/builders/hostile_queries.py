"""Queries that try to do more than read what was named, or take more than they may.

In a text ``{in}`` stands for the folder of the database, ``{near}`` for the folder around it.
"""

from __future__ import annotations

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
"""Attempts to read or write something else, to wait, or to change the session."""

RUNAWAY = {
    "huge-join": "SELECT count(*) FROM pairs a, pairs b, pairs c WHERE sin(a.i + b.i * c.j) > 2",
    "endless-recursion": "WITH RECURSIVE r(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM r) "
    "SELECT max(n) FROM r",
    "huge-sort": "SELECT a.range FROM range(100000000) a "
    "ORDER BY a.range % 7, a.range % 11, a.range",
}
"""Queries that take more time or memory than any limit."""

ONE_CALL = {
    "repeat": "SELECT length(repeat('x', 4000000000))",
    "lpad-of-a-column": "SELECT max(length(lpad('x', range::INTEGER, 'y'))) "
    "FROM range(2000000000, 2000000002)",
    "format": "SELECT length(format('{:>2000000000}', 1))",
    "rows": "SELECT repeat('x', 50000000) FROM range(100)",
}
"""Queries in which a single call of a function takes more than any limit."""
