"""Views with the places of rows, which the macros ``cone``, ``box`` and ``field`` look at.

Each target has a schema of them beside its own, which SHOW TABLES leaves out. A view there is the
table with ``_place_ra_deg`` and ``_place_dec_deg``, whatever these columns are called in it, and
with the file of a row in ``_place_file`` where the table is spread over the sky in many files. What
is known of these files is a variable of the view's name. A macro compares it with a constant place
once, before DuckDB opens a file.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from starcat.query.names import quoted, quoted_name
from starcat.query.targets import POSITION, Target, View

_MACROS = Path(__file__).parent / "sql" / "places.sql"

_NO_FILE = (
    "[]::STRUCT(file VARCHAR, ra DOUBLE, dec DOUBLE, reach DOUBLE, "
    "ra_from DOUBLE, ra_to DOUBLE, dec_from DOUBLE, dec_to DOUBLE)[]"
)


def place_macros() -> str:
    """Return the SQL that makes what the macros with places share.

    Returns
    -------
    str
        Statements; they use ``separation``.
    """
    return _MACROS.read_text(encoding="utf-8").strip()


def places_schema(target: Target) -> str:
    """Return the schema of the views with places of a target.

    Parameters
    ----------
    target : Target
        The target.

    Returns
    -------
    str
        A name that no target and no short name has: those begin with no underscore and a letter.
    """
    return f"_places_{target.name}"


def place_statements(target: Target) -> Iterator[str]:
    """Give the SQL that makes the views with places of a target.

    Parameters
    ----------
    target : Target
        The target.

    Yields
    ------
    str
        A statement.
    """
    schema = places_schema(target)
    yield f"CREATE SCHEMA IF NOT EXISTS {schema};"
    for view in target.views:
        place = ", ".join(
            f"{value} AS _place_{name}"
            for value, name in zip(_position(view), POSITION, strict=True)
        )
        if view.pixels:
            rows = f"SELECT *, {place} {reading(view, ', filename = ' + quoted('_place_file'))}"
        else:
            rows = f"SELECT *, {place}, '' AS _place_file {reading(view)}"
        yield f"CREATE VIEW {schema}.{view.name} AS {rows};"
        yield f"SET VARIABLE {quoted_name(f'{schema}.{view.name}')} = {_known_of_files(view)};"


def reading(view: View, more: str = "") -> str:
    """Return the SQL that reads the files of a view.

    Parameters
    ----------
    view : View
        The view.
    more : str
        More arguments of ``read_parquet``.

    Returns
    -------
    str
        From FROM on.
    """
    files = ", ".join(map(quoted, view.files))
    return f"FROM read_parquet([{files}], hive_partitioning = false{more})"


def _position(view: View) -> tuple[str, str]:
    """Return SQL for right ascension and declination of a row, degrees."""
    named = view.position or POSITION
    by_lower = {column.lower(): column for column in view.columns}
    missing = [name for name in named if name.lower() not in by_lower]
    if missing:
        told = quoted(
            f"{view.name} has no column {' and no '.join(missing)}; cone, box and field are for "
            "tables with places, name another with of := 'TABLE'"
        )
        return f"error({told})::DOUBLE", f"error({told})::DOUBLE"
    ra, dec = (quoted_name(by_lower[name.lower()]) for name in named)
    if view.position is None:
        return ra, dec
    # Of a catalog of others it is not known whether right ascensions are from 0 or from -180 on.
    return f"({ra}::DOUBLE - 360 * floor({ra}::DOUBLE / 360))", f"{dec}::DOUBLE"


def _known_of_files(view: View) -> str:
    """Return a list, as SQL writes it, of circles and boxes on the sky that hold the files."""
    if not view.pixels:
        return _NO_FILE
    from starcat.query.partitions import extents

    found = extents(view.pixels)
    columns = (
        found.ra_deg, found.dec_deg, found.reach_deg,
        found.ra_from_deg, found.ra_to_deg, found.dec_from_deg, found.dec_to_deg,
    )  # fmt: skip
    rows = ", ".join(
        f"({quoted(file)}, {', '.join(map(repr, numbers))})"
        for file, *numbers in zip(view.files, *(column.tolist() for column in columns), strict=True)
    )
    names = "file, ra, dec, reach, ra_from, ra_to, dec_from, dec_to"
    row = ", ".join(f"{name!r}: {name}" for name in names.split(", "))
    return f"(SELECT list({{{row}}}) FROM (VALUES {rows}) AS t({names}))"
