"""Columns of an Arrow table as VOTable 1.4 has them: fields, cells, and what is around the rows."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from xml.sax.saxutils import escape, quoteattr

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from starcat.errors import quoted
from starcat.exchange.columns import (
    Label,
    check_names,
    column_error,
    field_facts,
    is_list,
    is_numeric_column,
    unit_text,
)
from starcat.exchange.text import Cells, cells_of, plain_values
from starcat.storage.parquet import ARROW_DATATYPES

_NOT_XML = re.compile("[^\t\n -\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that no XML 1.0 document can hold, and the carriage return, which readers change."""

_SPACE, _TAB, _NEWLINE, _NOT_ASCII = 0x20, 0x09, 0x0A, 0x80

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
_ICRS = "starcat.icrs"  # what columns refer to the coordinate system by
_COOSYS = f'  <COOSYS ID="{_ICRS}" system="ICRS"'
EPOCH_PLACE = _COOSYS.encode()
"""What the attribute with the epoch stands after; it is nowhere else in a document."""

_TABLE = "starcat.table"
_IDENTIFIER = re.compile(r"(?!starcat\.)[A-Za-z_][A-Za-z0-9_.-]*")


@dataclass(frozen=True)
class VotableColumn:
    """A column as its FIELD says it."""

    name: str
    kind: pa.DataType  # of its values, or of the items of its lists
    is_list: bool  # whether its rows are lists of numbers
    # What DALI calls values of that kind. Dates, and times with a date, are "timestamp" and become
    # ISO 8601 text; the metadata of a field may name another.
    xtype: str | None
    facts: dict[str, str]  # unit, description and ucd where the column has them

    @property
    def is_text(self) -> bool:
        """Whether the values are texts."""
        return bool(pa.types.is_string(self.kind))

    @property
    def datatype(self) -> str:
        """VOTable's word for the type: ``char`` where texts are sure to be ASCII."""
        if self.is_text and self.xtype == "timestamp":
            return "char"
        return ARROW_DATATYPES[self.kind]

    @property
    def is_place(self) -> bool:
        """Whether it is a coordinate or a motion on the sky, which have a frame."""
        ucd = self.facts.get("ucd", "")
        return ucd.startswith(("pos.eq.", "pos.cartesian.", "pos.pm", "POS_EQ_"))

    @property
    def unit(self) -> str | None:
        """The unit in the spelling of VOUnits; raises SchemaError where they have none."""
        return unit_text(self.name, self.facts.get("unit"), "vounit")


def votable_columns(schema: pa.Schema) -> list[VotableColumn]:
    """Return the columns of a plain schema as a VOTable has them."""
    check_names(schema.names, "votable")
    return [_votable_column(field) for field in schema]


def votable_cells(column: VotableColumn, values: pa.Array) -> Cells:
    """Return the cells of a column in a batch; SchemaError where a value does not fit."""
    cells = cells_of(column.name, values, signed=True)
    if column.is_text:
        _check_text(column.name, cells.values)
    return cells


def text_bytes(values: pa.Array) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
    """Return N + 1 offsets of N texts, and their UTF-8 bytes one after the other.

    Null counts as an empty text.
    """
    if values.null_count:
        values = pc.fill_null(values, "")
    _, places, content = values.buffers()
    if not len(values) or content is None:
        return np.zeros(len(values) + 1, np.int64), np.empty(0, np.uint8)
    begin = values.offset
    offsets = np.frombuffer(places, np.int32)[begin : begin + len(values) + 1].astype(np.int64)
    letters = np.frombuffer(content, np.uint8)[offsets[0] : offsets[-1]]
    return offsets - offsets[0], letters


def is_constant(values: pa.Array) -> bool:
    """Return whether all of more than one value have the same bytes, and none is null."""
    if len(values) < 2 or values.null_count:
        return False
    if pa.types.is_string(values.type):
        offsets, letters = text_bytes(values)
        length = offsets[1]
        if (np.diff(offsets) != length).any():
            return False
        table = letters.reshape(len(values), length)
        return bool((table == table[0]).all())
    if pa.types.is_boolean(values.type):
        return values.true_count in (0, len(values))
    width = values.type.bit_width // 8
    numbers = np.frombuffer(values.buffers()[1], f"u{width}")
    numbers = numbers[values.offset : values.offset + len(values)]
    # A look at the first ones spares most columns the look at all.
    return bool((numbers[:16] == numbers[0]).all() and (numbers == numbers[0]).all())


def is_ascii(letters: NDArray[np.uint8]) -> bool:
    """Return whether UTF-8 bytes are all ASCII."""
    return not len(letters) or bool(letters.max() < _NOT_ASCII)


def check_xml(name: str, texts: Iterable[str | None]) -> None:
    """Refuse texts with a character that XML cannot hold."""
    for text in texts:
        if text and _NOT_XML.search(text):
            raise column_error(
                name,
                f": the text {quoted(text)} has a character that XML cannot "
                "hold; take it out, or choose another format than votable",
                text,
            )


def said_in_xml(text: str) -> str:
    """Return a text with a question mark for each character that XML cannot hold."""
    return _NOT_XML.sub("?", text)


def _votable_column(field: pa.Field) -> VotableColumn:
    check_xml(field.name, [field.name])
    kind = field.type
    xtype = (field.metadata or {}).get(b"xtype", b"").decode() or None
    if pa.types.is_timestamp(kind) or pa.types.is_date(kind):
        xtype = "timestamp"
    has_lists = is_list(kind) and is_numeric_column(kind.value_type)
    if has_lists:
        kind = kind.value_type
    plain = plain_values(field.name, pa.array([], kind), signed=True).type
    return VotableColumn(field.name, plain, has_lists, xtype, field_facts(field))


def _check_text(name: str, values: pa.Array) -> None:
    _, letters = text_bytes(values)
    if not len(letters):
        return
    # Most texts need one look at their smallest byte, and one at the largest.
    is_plain = (
        letters.min() >= _SPACE
        or not ((letters < _SPACE) & (letters != _TAB) & (letters != _NEWLINE)).any()
    )
    if not is_plain or not is_ascii(letters):
        check_xml(name, values.to_pylist())


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
        parts.append(info_element(name, text, f"starcat.{name}"))
    parts += [info_element(name, text) for name, text in infos.items()]
    if has_places(columns):
        parts.append(f"{_COOSYS}{epoch}/>\n")
    name = f" name={_attribute(label.table)}" if label.table else ""
    parts.append(f'  <TABLE ID="{_TABLE}"{name}>\n')
    parts += [_field(column) for column in columns]
    return "".join([*parts, _BEFORE_ROWS[serialization]])


def foot(serialization: str, infos: Sequence[str] = ()) -> str:
    """Return all that stands after the rows."""
    return "".join([_AFTER_ROWS[serialization], "  </TABLE>\n", *infos, _AFTER_TABLE])


def info_element(name: str, value: str, identifier: str = "", text: str = "") -> str:
    """Return an ``INFO`` element."""
    begins = f"ID={_attribute(identifier)} " if identifier else ""
    start = f"  <INFO {begins}name={_attribute(name)} value={_attribute(value)}"
    return f"{start}>{escape(said_in_xml(text))}</INFO>\n" if text else f"{start}/>\n"


def error_document(text: str) -> bytes:
    """Return a VOTable that says why there is no answer."""
    said = info_element("Error", text) + _RESULTS + info_element("QUERY_STATUS", "ERROR", text=text)
    return f"{_VOTABLE}{said}{_AFTER_TABLE}".encode()


def has_places(columns: Sequence[VotableColumn]) -> bool:
    """Return whether a table has coordinates, and so a coordinate system."""
    return any(column.is_place for column in columns)


def _field(column: VotableColumn) -> str:
    known = {
        # An identifier helps readers that go by it; not every name can be one.
        "ID": column.name if _IDENTIFIER.fullmatch(column.name) else None,
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


def _attribute(text: str) -> str:
    return quoteattr(said_in_xml(text))
