"""Queries to begin with, as DALI has services show them: a page that people and programs read.

References
----------
DALI 1.1, section 2.3.
"""

from __future__ import annotations

from html import escape

from starcat.vo.tables import Table, Tables, adql_name, full_name
from starcat.vo.tap_schema import NAME

POSITION = ("ra_deg", "dec_deg")


def examples(tables: Tables) -> list[tuple[str, str, str]]:
    """Return queries that run on the tables that there are."""
    found = [
        (
            "tables",
            "All tables, with what a row of each is",
            f"SELECT table_name, description FROM {NAME}.tables ORDER BY table_name",
        )
    ]
    with_places = [table for table in tables if _has(table, *POSITION, "mag")]
    # What was rejected has places too.
    stars = min(with_places, key=lambda table: table.name != "stars", default=None)
    if stars is not None:
        name = full_name(stars)
        place = ", ".join(map(adql_name, POSITION))
        found += [
            (
                "cone",
                "Stars within 10 degrees of a place, the brightest first",
                f"SELECT *, DISTANCE(POINT('ICRS', {place}), POINT('ICRS', 83.6, -5.4)) "
                f"AS separation_deg FROM {name} "
                f"WHERE 1 = CONTAINS(POINT('ICRS', {place}), CIRCLE('ICRS', 83.6, -5.4, 10)) "
                "ORDER BY mag",
            ),
            (
                "polygon",
                "Stars within a polygon",
                f"SELECT TOP 100 * FROM {name} "
                f"WHERE 1 = CONTAINS(POINT('ICRS', {place}), "
                "POLYGON('ICRS', 70, -20, 110, -20, 90, 20))",
            ),
            (
                "counts",
                "Stars by whole magnitudes",
                f"SELECT magnitude, COUNT(*) AS stars FROM (SELECT FLOOR(mag) AS magnitude "
                f"FROM {name}) AS m GROUP BY magnitude ORDER BY magnitude",
            ),
        ]
    return found


def examples_page(tables: Tables) -> str:
    """Return a page with the examples."""
    parts = "\n".join(
        f'<div typeof="example" id="{name}" resource="#{name}">\n'
        f'<h2 property="name">{escape(told)}</h2>\n'
        f'<pre property="query">{escape(query)}</pre>\n</div>'
        for name, told, query in examples(tables)
    )
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<!DOCTYPE html>\n'
        '<html xmlns="http://www.w3.org/1999/xhtml" lang="en">\n'
        "<head><title>Examples of ADQL</title></head>\n"
        '<body vocab="http://www.ivoa.net/rdf/examples#">\n'
        f"<h1>Examples of ADQL</h1>\n{parts}\n</body>\n</html>\n"
    )


def _has(table: Table, *names: str) -> bool:
    return set(names) <= {column.name for column in table.columns}
