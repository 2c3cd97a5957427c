"""What stands around the rows of a VOTable 1.4: infos, the coordinate system and the fields."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from xml.sax.saxutils import escape, quoteattr

from starcat.exchange.label import Label
from starcat.exchange.votable_columns import VotableColumn, said_in_xml

_VOTABLE = (
    '<?xml version="1.0" encoding="utf-8"?>\n'
    '<VOTABLE version="1.4" xmlns="http://www.ivoa.net/xml/VOTable/v1.3"\n'
    ' xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance"\n'
    ' xsi:schemaLocation="http://www.ivoa.net/xml/VOTable/v1.3'
    ' http://www.ivoa.net/xml/VOTable/VOTable-1.4.xsd">\n'
)
_RESULTS = ' <RESOURCE type="results">\n'
_BEFORE_ROWS = {
    "binary2": '   <DATA>\n    <BINARY2>\n     <STREAM encoding="base64">\n',
    "tabledata": "   <DATA>\n    <TABLEDATA>\n",
}
_AFTER_ROWS = {
    "binary2": "     </STREAM>\n    </BINARY2>\n   </DATA>\n",
    "tabledata": "    </TABLEDATA>\n   </DATA>\n",
}
_AFTER_TABLE = " </RESOURCE>\n</VOTABLE>\n"
_ICRS = "starcat.icrs"
"""What columns refer to the coordinate system by."""

_COOSYS = f'  <COOSYS ID="{_ICRS}" system="ICRS"'
EPOCH_PLACE = _COOSYS.encode()
"""What the attribute with the epoch stands after; it is nowhere else in a document."""

_TABLE = "starcat.table"
_IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z0-9_.-]*")


def head(
    columns: Sequence[VotableColumn],
    serialization: str,
    label: Label,
    infos: Mapping[str, str],
    epoch: str,
) -> str:
    """Return all that stands before the rows."""
    parts = [_VOTABLE, _RESULTS]
    for name, text in label.origin.items():
        parts.append(info(name, text, f"starcat.{name}"))
    parts += [info(name, text) for name, text in infos.items()]
    if has_places(columns):
        parts.append(f"{_COOSYS}{epoch}/>\n")
    name = f" name={_attribute(label.table)}" if label.table else ""
    parts.append(f'  <TABLE ID="{_TABLE}"{name}>\n')
    parts += [_field(column) for column in columns]
    return "".join([*parts, _BEFORE_ROWS[serialization]])


def foot(serialization: str, infos: Sequence[str] = ()) -> str:
    """Return all that stands after the rows."""
    return "".join([_AFTER_ROWS[serialization], "  </TABLE>\n", *infos, _AFTER_TABLE])


def info(name: str, value: str, identifier: str = "", text: str = "") -> str:
    """Return an ``INFO`` element."""
    begins = f"ID={_attribute(identifier)} " if identifier else ""
    start = f"  <INFO {begins}name={_attribute(name)} value={_attribute(value)}"
    return f"{start}>{escape(said_in_xml(text))}</INFO>\n" if text else f"{start}/>\n"


def error_document(text: str) -> str:
    """Return a VOTable that says why there is no answer."""
    said = info("Error", text) + _RESULTS + info("QUERY_STATUS", "ERROR", text=text)
    return f"{_VOTABLE}{said}{_AFTER_TABLE}"


def has_places(columns: Sequence[VotableColumn]) -> bool:
    """Return whether a table has coordinates, and so a coordinate system."""
    return any(column.is_place for column in columns)


def _field(column: VotableColumn) -> str:
    known = {
        # An identifier helps readers that go by it; not every name can be one.
        "ID": column.name if _may_be_identifier(column.name) else None,
        "name": column.name,
        "datatype": column.datatype,
        "arraysize": "*" if column.is_text or column.is_list else None,
        "unit": column.unit,
        "ucd": column.facts.get("ucd"),
        "xtype": column.xtype,
        "ref": _ICRS if column.is_place else None,
    }
    said = " ".join(f"{key}={_attribute(text)}" for key, text in known.items() if text is not None)
    description = column.facts.get("description")
    if not description:
        return f"   <FIELD {said}/>\n"
    told = escape(said_in_xml(description))
    return f"   <FIELD {said}>\n    <DESCRIPTION>{told}</DESCRIPTION>\n   </FIELD>\n"


def _may_be_identifier(name: str) -> bool:
    return bool(_IDENTIFIER.fullmatch(name)) and not name.startswith("starcat.")


def _attribute(text: str) -> str:
    return quoteattr(said_in_xml(text))
