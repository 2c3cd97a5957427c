"""The records of the service, in one SQLite file: jobs, tokens, and published releases."""

from __future__ import annotations

import sqlite3
import threading
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from starcat.errors import ProductError, SchemaVersionError
from starcat_service.problems import damaged_records

PUBLICATIONS = """
    CREATE TABLE publications (
        name TEXT NOT NULL,
        version TEXT NOT NULL,
        database TEXT NOT NULL,
        note TEXT NOT NULL,
        owner TEXT NOT NULL,
        published_s REAL NOT NULL,
        PRIMARY KEY (name, version)
    )
"""

MIGRATIONS: tuple[str, ...] = (
    """
    CREATE TABLE jobs (
        id TEXT PRIMARY KEY,
        kind TEXT NOT NULL,
        key TEXT NOT NULL,
        owner TEXT NOT NULL,
        title TEXT NOT NULL,
        state TEXT NOT NULL,
        request TEXT NOT NULL,
        created_s REAL NOT NULL,
        started_s REAL,
        ended_s REAL,
        attempt INTEGER NOT NULL DEFAULT 0,
        interrupted INTEGER NOT NULL DEFAULT 0,
        wants_end INTEGER NOT NULL DEFAULT 0,
        heard_s REAL,
        stage TEXT,
        done INTEGER,
        total INTEGER,
        error TEXT,
        result TEXT
    );
    CREATE INDEX jobs_by_key ON jobs (key);
    CREATE INDEX jobs_by_owner ON jobs (owner, state);
    CREATE INDEX jobs_by_state ON jobs (state, created_s);
    CREATE TABLE job_events (
        job TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
        number INTEGER NOT NULL,
        at_s REAL NOT NULL,
        kind TEXT NOT NULL,
        data TEXT NOT NULL,
        PRIMARY KEY (job, number)
    );
    CREATE TABLE file_digests (
        path TEXT PRIMARY KEY,
        size_bytes INTEGER NOT NULL,
        changed_ns INTEGER NOT NULL,
        sha256 TEXT NOT NULL
    );
    CREATE TABLE tokens (
        id TEXT PRIMARY KEY,
        name TEXT NOT NULL,
        role TEXT NOT NULL,
        digest TEXT NOT NULL UNIQUE,
        created_s REAL NOT NULL,
        expires_s REAL,
        revoked_s REAL
    );
    CREATE TABLE sessions (
        digest TEXT PRIMARY KEY,
        token TEXT NOT NULL REFERENCES tokens (id),
        created_s REAL NOT NULL,
        expires_s REAL NOT NULL
    );
    """,
    PUBLICATIONS,
    """
    CREATE TABLE tap_jobs (
        id TEXT PRIMARY KEY,
        owner TEXT NOT NULL,
        phase TEXT NOT NULL,
        parameters TEXT NOT NULL,
        files TEXT NOT NULL,
        run_id TEXT NOT NULL DEFAULT '',
        created_s REAL NOT NULL,
        queued_s REAL,
        started_s REAL,
        ended_s REAL,
        destroyed_s REAL NOT NULL,
        limit_s REAL NOT NULL,
        error TEXT NOT NULL DEFAULT '',
        media_type TEXT NOT NULL DEFAULT ''
    );
    CREATE INDEX tap_jobs_by_owner ON tap_jobs (owner, created_s);
    """,
    """
    ALTER TABLE jobs RENAME COLUMN wants_end TO cancel_requested;
    ALTER TABLE jobs DROP COLUMN heard_s;
    ALTER TABLE jobs ADD COLUMN queued_s REAL;
    ALTER TABLE jobs ADD COLUMN destroyed_s REAL;
    UPDATE jobs SET queued_s = created_s;
    DROP INDEX jobs_by_state;
    CREATE INDEX jobs_by_state ON jobs (state, queued_s);
    INSERT INTO jobs (
        id, kind, key, owner, title, state, request, created_s, queued_s, started_s, ended_s,
        destroyed_s, error, result
    )
    SELECT
        id, 'query', '', owner, '',
        CASE phase
            WHEN 'QUEUED' THEN 'queued' WHEN 'EXECUTING' THEN 'running'
            WHEN 'COMPLETED' THEN 'done' WHEN 'ERROR' THEN 'failed'
            WHEN 'ABORTED' THEN 'cancelled' ELSE 'pending'
        END,
        json_object(
            'parameters', json(parameters), 'files', json(files), 'run_id', run_id,
            'limit_s', limit_s
        ),
        created_s, queued_s, started_s, ended_s, destroyed_s,
        CASE WHEN error != '' THEN json_object('detail', error) END,
        CASE WHEN media_type != '' THEN json_object('media_type', media_type) END
    FROM tap_jobs;
    DROP TABLE tap_jobs
    """,
)
"""Statements that upgrade the file from each version to the next; a released one never changes."""

WAIT_S = 20.0
"""Seconds that a writer waits for another writer."""


class _Opened:
    """A connection that is closed when the thread that opened it has ended."""

    def __init__(self, connection: sqlite3.Connection) -> None:
        self.connection = connection
        # The registry of finalizers holds the connection, so that it is closed before it is freed,
        # also if this object is part of a cycle.
        weakref.finalize(self, connection.close)


class Records:
    """The SQLite file, opened once by each thread."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._of_thread = threading.local()
        self._migrate()

    def rows(self, statement: str, *values: object) -> list[sqlite3.Row]:
        """Return all rows that a statement selects."""
        return self.connection().execute(statement, values).fetchall()

    @contextmanager
    def writing(self) -> Iterator[sqlite3.Connection]:
        """Give the connection of this thread within a transaction, the only writer of the file."""
        connection = self.connection()
        connection.execute("BEGIN IMMEDIATE")
        try:
            yield connection
        except BaseException:
            connection.execute("ROLLBACK")
            raise
        connection.execute("COMMIT")

    def close(self) -> None:
        """Close the connection of this thread."""
        self._of_thread.opened = None

    def connection(self) -> sqlite3.Connection:
        """Return the connection of this thread."""
        opened: _Opened | None = getattr(self._of_thread, "opened", None)
        if opened is None:
            # The last reference to a connection can be dropped by any thread, which then closes it.
            connection = sqlite3.connect(
                self.path, timeout=WAIT_S, isolation_level=None, check_same_thread=False
            )
            try:
                connection.row_factory = sqlite3.Row
                connection.execute("PRAGMA journal_mode = WAL")
                connection.execute("PRAGMA synchronous = FULL")
                connection.execute("PRAGMA foreign_keys = ON")
            except BaseException:
                connection.close()
                raise
            opened = self._of_thread.opened = _Opened(connection)
        return opened.connection

    def check(self) -> None:
        """Check that the file is intact and can be written; raise `sqlite3.Error` if not."""
        with self.writing() as connection:
            [result] = connection.execute("PRAGMA quick_check(1)").fetchone()
        if result != "ok":
            raise sqlite3.DatabaseError(result)

    def _migrate(self) -> None:
        try:
            self._migrated()
        except sqlite3.DatabaseError as error:
            raise ProductError(damaged_records(str(self.path), error), path=self.path) from error

    def _migrated(self) -> None:
        with self.writing() as connection:
            [stored_version] = connection.execute("PRAGMA user_version").fetchone()
            if stored_version > len(MIGRATIONS):
                raise SchemaVersionError(
                    f"{self.path}: records version {stored_version}; this starcat writes "
                    f"{len(MIGRATIONS)}",
                    found=str(stored_version),
                    expected=str(len(MIGRATIONS)),
                    hint="Install a newer starcat",
                )
            for version in range(stored_version, len(MIGRATIONS)):
                for statement in MIGRATIONS[version].split(";"):
                    connection.execute(statement)
                connection.execute(f"PRAGMA user_version = {version + 1}")
