"""Simple cone searches: requests, the query that answers them, and the format of errors.

References
----------
Simple Cone Search 1.03, IVOA Recommendation, February 2008.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from starcat.errors import ConfigError, TargetMissing
from starcat.query import Session, View, quoted_name
from starcat.query import sql_quoted as sql_text
from starcat.ship.exchange import Format, described, field_facts, response_format
from starcat_service.protocols.parameters import parameter_error

if TYPE_CHECKING:
    import pyarrow as pa

SEPARATION = "separation_deg"
MEDIA_TYPE = "text/xml;content=x-votable"
"""Media type of errors and, if the request names no format, of answers."""

NAMES = ("designation", "star_id")  # columns that identify a star, the best first

_ID, _RA, _DEC = "ID_MAIN", "POS_EQ_RA_MAIN", "POS_EQ_DEC_MAIN"
_BESIDE = ("band",)  # columns without a UCD that belong to a column with one

_BRIEF, _USUAL, _ALL = 1, 2, 3
_RANGES = {"RA": (0.0, 360.0), "DEC": (-90.0, 90.0), "SR": (0.0, 180.0)}


@dataclass(frozen=True)
class ConeRequest:
    """A circle on the sky, and the requested columns and rows of its stars."""

    # Centre, ICRS.
    ra_deg: float
    dec_deg: float
    radius_deg: float  # radius; 0 asks only for the columns
    verbosity: int  # 1 for identity and place, 2 for all columns with a UCD, 3 for all
    maxrec: int | None  # most rows; None if not stated
    form: Format
    media_type: str  # media type of the answer


def cone_request(parameters: Iterable[tuple[str, str]]) -> ConeRequest:
    """Check the parameters of a request."""
    values: dict[str, str] = {}
    names = {*_RANGES, "VERB", "MAXREC", "RESPONSEFORMAT"}
    for name, value in parameters:
        key = name.upper()
        if key in values:
            raise ConfigError(f"{key} is given twice", key=key, value=value, hint="give it once")
        if key in names:
            values[key] = value
    ra_deg, dec_deg, radius_deg = (_degrees(values, key) for key in _RANGES)
    return ConeRequest(
        ra_deg,
        dec_deg,
        radius_deg,
        _whole(values, "VERB", _USUAL, _BRIEF, _ALL) or _USUAL,
        _whole(values, "MAXREC", None, 0, None),
        *_form(values.get("RESPONSEFORMAT", "")),
    )


def star_view(session: Session) -> View:
    """Return the view of a session that has the stars."""
    placed = [view for view in session.views if set(view.position) <= set(view.columns)]
    for view in sorted(placed, key=lambda view: view.name != "stars"):
        return view
    raise TargetMissing("no table has ra_deg and dec_deg to search")


def cone_query(view: View, asked: ConeRequest, maxrec: int) -> str:
    """Return the SQL of a search."""
    selected = [_selected(view, name) for name in _columns(view, asked.verbosity)]
    centre = f"{asked.ra_deg!r}, {asked.dec_deg!r}, {asked.radius_deg!r}"
    order = ", ".join([SEPARATION, *(quoted_name(n) for n in NAMES if n in view.columns)])
    limit = maxrec + 1 if asked.radius_deg else 0
    return (
        f"SELECT {', '.join([*selected, SEPARATION])} "
        f"FROM cone({centre}, of := {sql_text(view.name)}) ORDER BY {order} LIMIT {limit}"
    )


def with_ucds(batches: pa.RecordBatchReader, view: View) -> pa.RecordBatchReader:
    """Return rows with the UCDs of columns that the standard requires."""
    ra, dec = view.position
    ucds = {_name_of(view): _ID, ra: _RA, dec: _DEC, SEPARATION: "pos.angDistance"}
    facts = (
        {**field_facts(field), "ucd": ucds[field.name]} if field.name in ucds else None
        for field in batches.schema
    )
    return described(batches, facts)


def _columns(view: View, verbosity: int) -> list[str]:
    """Return the columns of an answer; identity and position come first."""
    first = [_name_of(view), *(view.position)]
    ucds = {column.name: column.ucd for column in view.described}
    columns = {
        _BRIEF: [],
        _USUAL: [name for name in view.columns if ucds.get(name) or name in _BESIDE],
        _ALL: list(view.columns),
    }[verbosity]
    # A table without descriptions of its columns has no usual ones.
    rest = columns if ucds or verbosity == _BRIEF else list(view.columns)
    return [*first, *(name for name in rest if name not in first and name != SEPARATION)]


def _name_of(view: View) -> str:
    """Return the column that identifies a star: one of `NAMES`, else the first."""
    return next((name for name in NAMES if name in view.columns), view.columns[0])


def _selected(view: View, name: str) -> str:
    """Return a column in the type of the standard: the identity is a text."""
    column = quoted_name(name)
    return f"CAST({column} AS VARCHAR) AS {column}" if name == _name_of(view) else column


def _degrees(values: Mapping[str, str], key: str) -> float:
    least, most = _RANGES[key]
    if key not in values:
        raise ConfigError(
            f"{key} is missing",
            key=key,
            hint="give RA, DEC and SR in decimal degrees, such as RA=83.6&DEC=-5.4&SR=1",
        )
    try:
        value = float(values[key]) if "_" not in values[key] else math.nan
    except ValueError:
        value = math.nan
    if not least <= value <= most:
        advice = f"give decimal degrees from {least:g} to {most:g}"
        raise parameter_error(key, values[key], advice)
    return value


def _form(text: str) -> tuple[Format, str]:
    """Return a format and its media type; the default is readable by old clients too."""
    if text.strip().lower() in ("", "text/xml"):
        return response_format("votable/td"), MEDIA_TYPE
    form = response_format(text)
    return form, form.tap_type


def _whole(
    values: Mapping[str, str], key: str, usual: int | None, least: int, most: int | None
) -> int | None:
    if not values.get(key):
        return usual
    text = values[key]
    is_number = text.isascii() and text.isdigit() and len(text) < 19
    if not is_number or int(text) < least or (most is not None and int(text) > most):
        upto = "" if most is None else f" to {most}"
        raise parameter_error(key, text, f"give a whole number from {least}{upto}")
    return int(text)
