"""A session: queries about the views of some targets, and about nothing else.

They run in a DuckDB that sees only the views and macros (`starcat.query.engine`). Forbidden queries
are refused before they run (`starcat.query.statement`); queries that take too long or too much
memory are ended.
"""

from __future__ import annotations

import os
import shutil
import stat
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import astuple, dataclass, field
from pathlib import Path
from typing import Any

from starcat.errors import ProductError, QueryError
from starcat.progress import Progress, no_progress
from starcat.query.engine import Allowance, Engine, LocalEngine
from starcat.query.gallery import macros
from starcat.query.locked_duckdb import Views
from starcat.query.names import short_names, sql_quoted
from starcat.query.result import RunningQuery, facts_by_name, result_column
from starcat.query.spatial_macros import (
    moving_statements,
    place_macros,
    place_statements,
    places_schema,
    reading,
)
from starcat.query.statement import Statement, check_number
from starcat.query.targets import Target, View, open_targets
from starcat.storage.atomic import locked

SCRATCH_PREFIX = "starcat-sql-"
ABANDONED_S = 60.0
"""A folder older than this that no process has locked was left by a process that was killed."""
PREAMBLE_GB = 1.0  # memory for looking into the footers of Parquet files
MAX_COLUMNS = 100_000  # largest number of columns that a DESCRIBE returns
MAX_CHECKED = 200
"""Number of checked queries that are kept; the least recently used ones are dropped."""


@dataclass(frozen=True)
class Limits:
    """The limits of a query.

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
    """Views of targets, and the queries about them."""

    targets: tuple[Target, ...]
    limits: Limits
    _engine: Engine = field(repr=False)
    _checked: dict[str, Statement] = field(default_factory=dict, repr=False)
    # Time that all queries together may take; None if each has the time of the limits.
    allowance: Allowance | None = field(default=None, repr=False)

    @property
    def views(self) -> tuple[View, ...]:
        """The views of all targets."""
        return tuple(view for target in self.targets for view in target.views)

    @property
    def is_running(self) -> bool:
        """Whether its engine answers the next query as it answered the last one."""
        return self._engine.is_running

    def statements(self, text: str) -> list[str]:
        """Return the queries of a text."""
        return self._engine.statements(text)

    def check(self, text: str, allowance: Allowance | None = None) -> Statement:
        """Check that a text is a query that may run."""
        statement = self._checked.pop(text, None)
        if statement is None:
            statement = self._engine.check(text, allowance or self._allowance())
        self._checked[text] = statement
        if len(self._checked) > MAX_CHECKED:
            del self._checked[next(iter(self._checked))]
        return statement

    @contextmanager
    def ask(
        self, text: str, values: Mapping[str, Any] | None = None, progress: Progress = no_progress
    ) -> Iterator[RunningQuery]:
        """Ask a query; its rows are read within the context."""
        allowance = self._allowance()
        statement = self.check(text, allowance)
        arguments = values or {}
        for name in statement.parameters:
            if name not in arguments:
                raise QueryError(
                    f"the query has ${name}", hint=f"give its value with {{values[{name}]}}"
                )
        for name, argument in statement.numbers.items():
            check_number(argument, arguments[name])
        used = {name: arguments[name] for name in statement.parameters} or None
        runs = statement.text
        if statement.is_description:
            runs = self._described(statement, used, allowance)
            used = None
        named_facts = facts_by_name(self.views)
        yield RunningQuery(self._engine, runs, used, named_facts, allowance, progress)

    def _allowance(self) -> Allowance:
        return self.allowance or Allowance(self.limits.time_s)

    def _described(
        self, statement: Statement, values: dict[str, Any] | None, allowance: Allowance
    ) -> str:
        """Return a query for the result of DESCRIBE, with the meanings of the columns."""
        asked = f"SELECT column_name, column_type FROM ({statement.text})"
        rows = RunningQuery(self._engine, asked, values, {}, allowance).rows(MAX_COLUMNS)
        named_facts = facts_by_name(self._view_of(statement) or self.views)
        values_of = ", ".join(
            f"({', '.join(map(sql_quoted, astuple(result_column(name, kind, named_facts))))})"
            for name, kind in rows
        )
        return f"SELECT * FROM (VALUES {values_of}) AS t(column_name, column_type, unit, meaning)"

    def _view_of(self, statement: Statement) -> list[View]:
        """Return the one view that a DESCRIBE is about, if it is about one."""
        schema, name = statement.view or ("", "")
        target = schemas_of(self.targets).get(schema or "main")
        return [view for view in target.views if view.name == name] if target else []


@contextmanager
def open_session(
    target_names: Sequence[str],
    limits: Limits | None = None,
    progress: Progress = no_progress,
    within: Path | None = None,
    new_engine: Callable[[Path, float, float], Engine] = LocalEngine,
) -> Iterator[Session]:
    """Open a session about some targets.

    Data that do not fit into memory are written to a new folder in ``within``, or in the system's
    folder for temporary files. ``new_engine`` gets that folder, and the gigabytes of memory and of
    disk.
    """
    allowed = limits or Limits()
    with _scratch_folder(within) as scratch:
        engine = new_engine(scratch, allowed.memory_gb, allowed.disk_gb)
        try:
            targets = open_targets(target_names, scratch, engine, progress)
            _make_views(engine, targets)
            yield Session(targets, allowed, engine)
        finally:
            engine.close()


@contextmanager
def _scratch_folder(within: Path | None = None) -> Iterator[Path]:
    """Give a new folder, which is removed afterwards, or by the next session if this is killed.

    The folder is locked meanwhile. The lock ends with this process, however it ends.
    """
    parent = Path(tempfile.gettempdir() if within is None else within)
    _remove_abandoned(parent)
    folder = Path(tempfile.mkdtemp(prefix=SCRATCH_PREFIX, dir=parent))
    try:
        with locked(folder, wait=False):
            yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _remove_abandoned(parent: Path) -> None:
    """Remove the folders of this user's processes that were killed."""
    if os.name != "posix":  # Windows has no such locks
        return
    for folder in parent.glob(f"{SCRATCH_PREFIX}*"):
        with suppress(OSError):  # another process removes it, or it is in use
            facts = folder.lstat()
            is_own = stat.S_ISDIR(facts.st_mode) and facts.st_uid == os.getuid()
            # A new folder is not locked yet.
            if not is_own or time.time() - facts.st_mtime < ABANDONED_S:
                continue
            with locked(folder, wait=False) as is_locked:
                if is_locked:
                    shutil.rmtree(folder, ignore_errors=True)


def schemas_of(targets: Sequence[Target]) -> dict[str, Target]:
    """Return targets by their schemas.

    A target alone is ``main`` and its own names; several are ``a``, ``b`` ... and their names.
    """
    short = ["main"] if len(targets) == 1 else short_names(len(targets))
    named = {name: target for target in targets for name in (target.name, target.alias) if name}
    return {**dict(zip(short, targets, strict=True)), **named}


def preamble(targets: Sequence[Target]) -> str:
    """Return the SQL that makes the views and the macros of some targets."""
    moving = moving_statements(_named_views(targets))
    return "\n".join([_views_and_macros(targets), *_comments(targets), *moving])


def _views_and_macros(targets: Sequence[Target]) -> str:
    """Return the part of the preamble that every query needs."""
    tables = [macro for macro in macros() if macro.is_table]
    # Those that stand for no target in particular are made once.
    shared = [macro for macro in tables if "{places}" not in macro.text]
    lines = [macro.text + ";" for macro in macros() if not macro.is_table]
    lines.append(place_macros())
    for target in targets:
        lines += place_statements(target)
    for schema, target in schemas_of(targets).items():
        lines.append(f"CREATE SCHEMA IF NOT EXISTS {schema};")
        for view in target.views:
            lines.append(f"CREATE VIEW {schema}.{view.name} AS {reading(view)};")
        per_target = [macro for macro in tables if macro not in shared]
        lines += [macro.statement(schema, places_schema(target)) + ";" for macro in per_target]
    lines += [macro.text + ";" for macro in shared]
    return "\n".join(lines)


def _named_views(targets: Sequence[Target]) -> dict[str, tuple[str, View]]:
    """Return views by the names that ``crossmatch`` accepts, each with its schema of places.

    ``a.stars`` is also ``a``, and ``stars`` if there is only one target.
    """
    views_by_name: dict[str, tuple[str, View]] = {}
    for schema, target in schemas_of(targets).items():
        places = places_schema(target)
        stars = next((v for v in target.views if v.name == "stars"), target.views[0])
        views_by_name[schema] = places, stars
        for view in target.views:
            views_by_name[f"{schema}.{view.name}"] = places, view
    if len(targets) == 1:
        views = [(places_schema(targets[0]), view) for view in targets[0].views]
        views_by_name |= {view.name: (places, view) for places, view in views}
    return views_by_name


def preamble_of(target_names: Sequence[str]) -> str:
    """Return the preamble of databases and Parquet files by name, for any DuckDB."""
    with _scratch_folder() as folder:
        engine = LocalEngine(folder, PREAMBLE_GB, PREAMBLE_GB)
        try:
            targets = open_targets(target_names, folder, engine)
        finally:
            engine.close()
        for target in targets:
            if any(folder in p.parents for view in target.views for p in view.paths):
                raise QueryError(
                    "an archive file has no tables that another DuckDB could read",
                    where=target.name,
                    hint="write them with 'starcat ingest' and give the Parquet file",
                )
        return preamble(targets)


def _comments(targets: Sequence[Target]) -> Iterator[str]:
    """Give the SQL that describes views and their columns in DuckDB's own tables."""
    for schema, target in schemas_of(targets).items():
        for view in target.views:
            name = f"{schema}.{view.name}"
            if view.schema is not None:
                yield f"COMMENT ON VIEW {name} IS {sql_quoted(view.schema.description)};"
                for c in view.described:
                    if c.name in view.columns:
                        text = f"{c.description} [{c.unit}]" if c.unit else c.description
                        yield f"COMMENT ON COLUMN {name}.{c.name} IS {sql_quoted(text)};"


def _make_views(engine: Engine, targets: Sequence[Target]) -> None:
    views = [view for target in targets for view in target.views]
    files = [file for view in views for file in view.files]
    names = sorted(macro.name for macro in macros() if macro.is_table)
    numbers = {macro.name: macro.numbers for macro in macros()}
    # Most queries need neither; half of the time of opening would be spent on them.
    comments = "\n".join(_comments(targets))
    rare = {
        "crossmatch": "\n".join(moving_statements(_named_views(targets))),
        "duckdb_": comments,
        "information_schema": comments,
    }
    try:
        engine.open(Views(_views_and_macros(targets), files, names, numbers, rare))
    except QueryError as error:
        guilty = None if engine.is_running else _which_fails(engine, views)
        where = str(guilty.paths[0]) if guilty else ", ".join(target.name for target in targets)
        raise ProductError(
            f"a table cannot be opened ({str(error).splitlines()[0]})",
            where=where,
            hint="'starcat verify' checks a database and shows its damage",
        ) from error


def _which_fails(engine: Engine, views: Sequence[View]) -> View | None:
    """Return the first view whose files make DuckDB fail when it only looks at their columns."""
    for view in views:
        try:
            engine.look_at(view.files)
        except QueryError:
            return view
    return None
