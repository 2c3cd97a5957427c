"""Views with the places of rows, which the macros ``cone``, ``box`` and ``field`` use.

Each target has a schema of them in addition to its own; SHOW TABLES leaves it out. A view there is
the table with ``_place_ra_deg`` and ``_place_dec_deg``, whatever the names of these columns, and
with the file of a row in ``_place_file`` if the table is spread over the sky in many files. A
variable with the view's name holds the areas of these files. A macro compares it with a constant
place once, before DuckDB opens a file. ``crossmatch`` uses tables of several targets, by names in
one schema.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from starcat.query.names import quoted_name, sql_quoted
from starcat.query.targets import POSITION, Target, View

_MACROS = Path(__file__).parent / "sql" / "spatial_macros.sql"

MOTION = ("epoch_jyear", "pm_ra_cosdec_mas_yr", "pm_dec_mas_yr")

_MOVING_VIEW = """CREATE VIEW _moving."{name}" AS
SELECT * EXCLUDE (_place_file, _place_ra_deg, _place_dec_deg, _at_east, _at_north),
    cosd(_place_dec_deg) * cosd(_place_ra_deg) AS _at_x,
    cosd(_place_dec_deg) * sind(_place_ra_deg) AS _at_y,
    sind(_place_dec_deg) AS _at_z,
    -_at_north * sind(_place_dec_deg) * cosd(_place_ra_deg) - _at_east * sind(_place_ra_deg)
        AS _at_vx,
    -_at_north * sind(_place_dec_deg) * sind(_place_ra_deg) + _at_east * cosd(_place_ra_deg)
        AS _at_vy,
    _at_north * cosd(_place_dec_deg) AS _at_vz
FROM (
    SELECT *, {jyear} AS _at_jyear,
        radians(coalesce({east} + 0 * {north}, 0) / 3600e3) AS _at_east,
        radians(coalesce({north} + 0 * {east}, 0) / 3600e3) AS _at_north
    FROM {schema}.{view}
);"""

_NEAR = "_may_be_near(found, file, known, ra, dec, radius)"
_BETWEEN = "_may_be_between(file, known, ra_min, ra_max, dec_min, dec_max)"

_IN_FILES = {
    _NEAR: "_is_beside(found, ra - 360 * floor(ra / 360), _half_width(dec, radius)) "
    "AND _is_wanted(file, _files_near(known, ra, dec, radius))",
    _BETWEEN: "_is_wanted(file, _files_between(known, ra_min, ra_max, dec_min, dec_max))",
}
"""First conditions for rows of a store; other targets have none, which takes less time."""


def place_macros() -> str:
    """Return the SQL that makes what the macros with places share."""
    return _MACROS.read_text(encoding="utf-8").strip()


def places_schema(target: Target) -> str:
    """Return the schema of the views with places of a target."""
    return f"_places_{target.name}"


def place_statements(target: Target) -> Iterator[str]:
    """Give the SQL that makes the views with places of a target."""
    schema = places_schema(target)
    yield f"CREATE SCHEMA IF NOT EXISTS {schema};"
    is_store = any(view.pixels for view in target.views)
    for macro, asked in _IN_FILES.items():
        yield f"CREATE MACRO {schema}.{macro} AS ({asked if is_store else 'true'});"
    for view in target.views:
        position_columns = ", ".join(
            f"{value} AS _place_{name}"
            for value, name in zip(_position(view), POSITION, strict=True)
        )
        if view.pixels:
            rows = reading(
                view, f", {position_columns}", f", filename = {sql_quoted('_place_file')}"
            )
        else:
            rows = reading(view, f", {position_columns}, '' AS _place_file")
        yield f"CREATE VIEW {schema}.{view.name} AS {rows};"
        if is_store:
            variable = quoted_name(f"{schema}.{view.name}")
            yield f"SET VARIABLE {variable} = {_extents_of_files(view)};"


def moving_statements(views: Mapping[str, tuple[str, View]]) -> Iterator[str]:
    """Give the SQL that makes the views which ``crossmatch`` reads, by their names in it.

    Each is a view with places of a schema, with the unit vectors of its rows and their change per
    year, which is 0 if no motion or no epoch is known.
    """
    yield "CREATE SCHEMA IF NOT EXISTS _moving;"
    for name, (schema, view) in views.items():
        is_moving = {column.lower() for column in view.columns}.issuperset(MOTION)
        jyear, east, north = MOTION if is_moving else ("NULL::DOUBLE", "0", "0")
        yield _MOVING_VIEW.format(
            name=name, schema=schema, view=view.name, jyear=jyear, east=east, north=north
        )


def reading(view: View, more: str = "", options: str = "") -> str:
    """Return the query that reads the files of a view, with more columns, and options of reading.

    NaN becomes null. The least and the greatest value of a column in the footer of a Parquet file
    do not show that it has NaN, and DuckDB takes them for all values unless it is told: it would
    not find the NaN, or take it for one of the others (duckdb/duckdb#25521). If it is told, it
    takes NaN for the greatest value of every column of a file. An expression in the place of the
    column prevents both. ``more`` can name the columns of the file, whose footers then tell which
    parts of a file a condition needs.
    """
    files = ", ".join(map(sql_quoted, view.files))
    source = f"read_parquet([{files}], hive_partitioning = false{options}"
    columns = "*"
    if view.floating:
        replaced = (
            f"{_without_nan(*column)} AS {quoted_name(column[0])}" for column in view.floating
        )
        columns, source = f"* REPLACE ({', '.join(replaced)})", f"{source}, can_have_nan = true"
    if view.has_row_numbers:
        columns = f"{columns}, file_row_number::INTEGER AS row"
        rows = f"SELECT {columns} FROM {source}, file_row_number = true)"
        return f"SELECT * EXCLUDE (file_row_number){more} FROM ({rows})"
    return f"SELECT {columns}{more} FROM {source})"


def _without_nan(name: str, kind: str) -> str:
    """Return SQL for a column without NaN; NaN within a list or a struct stays."""
    column = quoted_name(name)
    unknown = f"isnan({column})" if kind in ("FLOAT", "DOUBLE") else f"{column} IS NULL"
    return f"CASE WHEN {unknown} THEN NULL ELSE {column} END"


def _position(view: View) -> tuple[str, str]:
    """Return SQL for right ascension and declination of a row, degrees."""
    by_lower = {column.lower(): column for column in view.columns}
    missing = [name for name in view.position if name.lower() not in by_lower]
    if missing:
        message = sql_quoted(
            f"{view.name} has no column {' and no '.join(missing)}; cone, box, field "
            "and crossmatch are for tables with places, name another with of := 'TABLE'"
        )
        return f"error({message})::DOUBLE", f"error({message})::DOUBLE"
    names = [by_lower[name.lower()] for name in view.position]
    kinds = dict(view.floating)
    # The declination is the column itself: footers tell where it is. NaN is in no range of it.
    ra = _without_nan(names[0], kinds[names[0]]) if names[0] in kinds else quoted_name(names[0])
    dec = quoted_name(names[1])
    if view.position == POSITION:
        return ra, dec
    # In other catalogs right ascensions can begin at 0 or at -180.
    return f"(({ra})::DOUBLE - 360 * floor(({ra})::DOUBLE / 360))", f"{dec}::DOUBLE"


def _extents_of_files(view: View) -> str:
    """Return a list, as SQL writes it, of circles and boxes on the sky that hold the files."""
    from starcat.query.partitions import EXTENT, extents

    if not view.pixels:
        kinds = ", ".join(f"{name} DOUBLE" for name in EXTENT)
        return f"[]::STRUCT(file VARCHAR, {kinds}, files BIGINT)[]"
    rows = ", ".join(
        f"({sql_quoted(file)}, {', '.join(map(repr, numbers))})"
        for file, numbers in zip(view.files, extents(view.pixels).tolist(), strict=True)
    )
    row = ", ".join(f"'{name}': {name}" for name in ("file", *EXTENT))
    names = ", ".join(("file", *EXTENT))
    return (
        f"(SELECT list({{{row}, 'files': {len(view.files)}}}) FROM (VALUES {rows}) AS t({names}))"
    )
