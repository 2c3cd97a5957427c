"""A session: a DuckDB that sees the views of some targets, and nothing else.

It is in memory, opens no file but those of the views, loads no extension, and its settings are
locked before the first query. What it may not do is refused before it runs
(`starcat.query.statement`); what takes too long is interrupted.
"""

from __future__ import annotations

import re
import shutil
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import duckdb
from duckdb import DuckDBPyConnection

from starcat.errors import ProductError, QueryError, QueryLimitError
from starcat.progress import Progress, no_progress
from starcat.query.answer import Answer
from starcat.query.columns import column_facts, facts_by_name
from starcat.query.macros import macros
from starcat.query.preamble import preamble, quoted, schemas_of
from starcat.query.statement import Statement, check_statement
from starcat.query.targets import Target, View, open_targets

WATCH_S = 0.2
"""How often a running query is looked at."""

_DESCRIBED = re.compile(r"(?:describe|desc|show)\s+(?:(\w+)\.)?(\w+)\s*;?", re.IGNORECASE)


@dataclass(frozen=True)
class Limits:
    """What a query may take.

    Attributes
    ----------
    time_s : float
        Seconds until it is stopped.
    memory_gb : float
        Gigabytes of memory; a query that needs more uses the disk.
    disk_gb : float
        Gigabytes of disk, in a folder that is removed afterwards.
    """

    time_s: float = 60.0
    memory_gb: float = 2.0
    disk_gb: float = 20.0


@dataclass(frozen=True)
class Session:
    """Views of targets, and the queries about them.

    Attributes
    ----------
    targets : tuple of Target
        What the views are of.
    limits : Limits
        Of each query.
    connection : duckdb.DuckDBPyConnection
        With all settings locked.
    """

    targets: tuple[Target, ...]
    limits: Limits
    connection: DuckDBPyConnection
    _checked: dict[str, Statement] = field(default_factory=dict, repr=False)

    @property
    def views(self) -> tuple[View, ...]:
        """The views of all targets."""
        return tuple(view for target in self.targets for view in target.views)

    def statements(self, text: str) -> list[str]:
        """Return the queries of a text.

        Parameters
        ----------
        text : str
            SQL, queries with semicolons between them.

        Returns
        -------
        list of str
            Not checked; a text that is no SQL is one query, which `ask` refuses with the place.
        """
        try:
            return [statement.query for statement in self.connection.extract_statements(text)]
        except duckdb.Error:
            return [text]

    def check(self, text: str) -> Statement:
        """Check that a text is a query that may run.

        Parameters
        ----------
        text : str
            SQL.

        Returns
        -------
        Statement
            What is known of it.

        Raises
        ------
        QueryError
            If it may not.
        """
        if text not in self._checked:
            names = frozenset(macro.name for macro in macros() if macro.is_table)
            self._checked[text] = check_statement(text, self.connection, names)
        return self._checked[text]

    @contextmanager
    def ask(
        self,
        text: str,
        values: Mapping[str, Any] | None = None,
        progress: Progress = no_progress,
    ) -> Iterator[Answer]:
        """Ask a query; its rows are read within the context.

        Parameters
        ----------
        text : str
            SQL, one statement that reads.
        values : mapping of str to object, optional
            Of the ``$name`` in it.
        progress : Progress
            Called with ("query", percent, 100) while it runs.

        Yields
        ------
        Answer
            The columns; the query runs when the rows are asked for.

        Raises
        ------
        QueryError
            If the text is no query that may run, or asks for what is not there.
        QueryLimitError
            If it takes longer, or more memory and disk, than it may; also while reading.
        """
        statement = self.check(text)
        given = values or {}
        for name in statement.parameters:
            if name not in given:
                raise QueryError(f"the query has ${name}: give its value with --set {name}=VALUE")
        used = {name: given[name] for name in statement.parameters} or None
        with self._watched(progress):
            query = self._described(statement) if statement.is_description else statement.text
            yield Answer(self.connection, query, used, facts_by_name(self.views))

    def _described(self, statement: Statement) -> str:
        """Return a query for what DESCRIBE gives, and what the columns mean."""
        text = statement.text.rstrip().rstrip(";")
        described = self.connection.execute(f"SELECT column_name, column_type FROM ({text})")
        known = facts_by_name(self._view_of(text) or self.views)
        rows = [
            ", ".join(map(quoted, (name, kind, facts.unit, facts.description)))
            for name, kind in described.fetchall()
            for facts in (column_facts(name, known),)
        ]
        values = ", ".join(f"({row})" for row in rows)
        return f"SELECT * FROM (VALUES {values}) AS t(column_name, column_type, unit, meaning)"

    def _view_of(self, text: str) -> list[View]:
        """Return the one view that a DESCRIBE is about, if it is about one."""
        found = _DESCRIBED.fullmatch(text)
        target = schemas_of(self.targets).get(found[1] or "main") if found else None
        return [v for v in target.views if v.name == found[2]] if found and target else []

    @contextmanager
    def _watched(self, progress: Progress) -> Iterator[None]:
        """Tell how far a query is, stop it when it takes too long, say why DuckDB refuses."""
        done = threading.Event()
        watcher = threading.Thread(target=self._watch, args=(done, progress), daemon=True)
        watcher.start()
        try:
            yield
        except duckdb.InterruptException as error:
            raise QueryLimitError(
                f"stopped after {self.limits.time_s:g} s; ask for less, or allow more with "
                "--time-limit-s"
            ) from error
        except duckdb.OutOfMemoryException as error:
            raise QueryLimitError(
                f"the query needs more than {self.limits.memory_gb:g} GB of memory and "
                f"{self.limits.disk_gb:g} GB of disk; ask for less, or allow more with "
                "--memory-limit-gb"
            ) from error
        except duckdb.Error as error:
            raise QueryError(_told(error)) from error
        finally:
            done.set()
            watcher.join()

    def _watch(self, done: threading.Event, progress: Progress) -> None:
        end = time.monotonic() + self.limits.time_s
        while not done.wait(min(WATCH_S, self.limits.time_s)):
            if time.monotonic() >= end:
                self.connection.interrupt()
            percent = self.connection.query_progress()
            if percent >= 0.0:
                progress("query", int(percent), 100)


def _told(error: duckdb.Error) -> str:
    """Return what DuckDB says, and where it opens no file, why."""
    text = str(error).strip()
    if isinstance(error, duckdb.PermissionException):
        return f"refused: {text.splitlines()[0]}; a query reads the named targets only"
    return text


@contextmanager
def open_session(
    given: Sequence[str], limits: Limits | None = None, progress: Progress = no_progress
) -> Iterator[Session]:
    """Open a session about some targets.

    Parameters
    ----------
    given : sequence of str
        As for `open_targets`.
    limits : Limits, optional
        Of each query.
    progress : Progress
        Called while archive files are read.

    Yields
    ------
    Session
        One target has its views in the main schema and in one of its own name; several have a
        schema each, and are ``a``, ``b``, ``c`` … in their order too.

    Raises
    ------
    QueryError, ProductError, SourceError
        If a target cannot be read.
    """
    allowed = limits or Limits()
    scratch = Path(tempfile.mkdtemp(prefix="starcat-sql-"))
    try:
        targets = open_targets(given, scratch, progress)
        spill = scratch / "spill"
        spill.mkdir()
        with duckdb.connect(":memory:", config=_settings(allowed, spill)) as connection:
            _make_views(connection, targets)
            views = (view for target in targets for view in target.views)
            _lock(connection, [path for view in views for path in view.paths])
            yield Session(targets, allowed, connection)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def _settings(limits: Limits, spill: Path) -> dict[str, Any]:
    return {
        "memory_limit": f"{limits.memory_gb}GB",
        "temp_directory": str(spill),
        "max_temp_directory_size": f"{limits.disk_gb}GB",
        "autoinstall_known_extensions": False,
        "autoload_known_extensions": False,
        "allow_community_extensions": False,
        "python_enable_replacements": False,
    }


def _make_views(connection: DuckDBPyConnection, targets: Sequence[Target]) -> None:
    try:
        connection.execute(preamble(targets))
    except duckdb.Error as error:
        names = ", ".join(target.name for target in targets)
        raise ProductError(
            f"{names}: a table cannot be opened ({str(error).splitlines()[0]}); 'starcat verify' "
            "says what is wrong with an artifact"
        ) from error


def _lock(connection: DuckDBPyConnection, files: Sequence[Path]) -> None:
    """Allow no other file and no other setting from here on."""
    # Progress is kept, and printed by who asks for it.
    connection.execute("SET enable_progress_bar = true; SET enable_progress_bar_print = false")
    connection.execute("SET allowed_paths = $files", {"files": [str(p.resolve()) for p in files]})
    connection.execute("SET enable_external_access = false")
    connection.execute("SET lock_configuration = true")
