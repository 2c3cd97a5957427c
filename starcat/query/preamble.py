"""The SQL that makes the views and macros of some targets, for any DuckDB."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

from starcat.errors import QueryError
from starcat.query.engine import Engine
from starcat.query.macros import macros
from starcat.query.names import quoted, short_names
from starcat.query.places import place_macros, place_statements, places_schema, reading
from starcat.query.result import Facts
from starcat.query.targets import Target, View, open_targets

PREAMBLE_GB = 1.0
"""Memory for looking into the footers of Parquet files."""


def schemas_of(targets: Sequence[Target]) -> dict[str, Target]:
    """Return the schemas of some targets."""
    short = ["main"] if len(targets) == 1 else short_names(len(targets))
    named = {target.name: target for target in targets}
    return {**dict(zip(short, targets, strict=True)), **named}


def preamble(targets: Sequence[Target]) -> str:
    """Return the SQL that makes the views and the macros of some targets."""
    tables = [macro for macro in macros() if macro.is_table]
    lines = [macro.text + ";" for macro in macros() if not macro.is_table]
    lines.append(place_macros())
    for target in targets:
        lines += place_statements(target)
    for schema, target in schemas_of(targets).items():
        lines.append(f"CREATE SCHEMA IF NOT EXISTS {schema};")
        for view in target.views:
            lines += _view_statements(f"{schema}.{view.name}", view)
        lines += [macro.statement(schema, places_schema(target)) + ";" for macro in tables]
    return "\n".join(lines)


def preamble_of(given: Sequence[str]) -> str:
    """Return the preamble of targets by name, for use outside of starcat."""
    with tempfile.TemporaryDirectory(prefix="starcat-sql-") as folder:
        engine = Engine(Path(folder), PREAMBLE_GB, PREAMBLE_GB)
        try:
            targets = open_targets(given, Path(folder), engine)
        finally:
            engine.close()
        for target in targets:
            if any(Path(folder) in p.parents for view in target.views for p in view.paths):
                raise QueryError(
                    f"{target.name}: an archive file has no tables that another DuckDB could "
                    "read; write them with 'starcat ingest' and give the Parquet file"
                )
        return preamble(targets)


def _view_statements(name: str, view: View) -> list[str]:
    made = [f"CREATE VIEW {name} AS {reading(view)};"]
    if view.schema is None:
        return made
    facts = {c.name: str(Facts(c.unit, c.description)) for c in view.schema.columns}
    made.append(f"COMMENT ON VIEW {name} IS {quoted(view.schema.description)};")
    return made + [
        f"COMMENT ON COLUMN {name}.{c} IS {quoted(told)};"
        for c, told in facts.items()
        if c in view.columns
    ]
