"""Columns of an Arrow table as VOTable has them: datatypes, and the cells of a batch."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from starcat.errors import SchemaError, quoted
from starcat.exchange.column_types import is_list, is_number
from starcat.exchange.numpy_columns import check_names, field_facts, list_items, plain_values
from starcat.exchange.units import unit_text

_DATATYPES = {
    pa.bool_(): "boolean",
    pa.uint8(): "unsignedByte",
    pa.int16(): "short",
    pa.int32(): "int",
    pa.int64(): "long",
    pa.float32(): "float",
    pa.float64(): "double",
    pa.string(): "unicodeChar",
}
_NOT_XML = re.compile("[^\t\n -\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that no XML 1.0 document can hold, and the carriage return, which readers change."""

_SPACE, _TAB, _NEWLINE, _NOT_ASCII = 0x20, 0x09, 0x0A, 0x80


@dataclass(frozen=True)
class VotableColumn:
    """A column as its FIELD says it.

    Attributes
    ----------
    name : str
        Name of the column.
    kind : pyarrow.DataType
        Type of its values, or of the items of its lists.
    is_list : bool
        Whether its rows are lists of numbers.
    xtype : str, optional
        What DALI calls values of that kind. Dates, and times with a date, are ``timestamp`` and
        become ISO 8601 text; the metadata of a field may name another.
    facts : dict of str to str
        ``unit``, ``description`` and ``ucd`` where the column has them.
    """

    name: str
    kind: pa.DataType
    is_list: bool
    xtype: str | None
    facts: dict[str, str]

    @property
    def is_text(self) -> bool:
        """Whether the values are texts."""
        return bool(pa.types.is_string(self.kind))

    @property
    def datatype(self) -> str:
        """VOTable's word for the type: ``char`` where texts are sure to be ASCII."""
        if self.is_text and self.xtype == "timestamp":
            return "char"
        return _DATATYPES[self.kind]

    @property
    def is_place(self) -> bool:
        """Whether it is a coordinate or a motion on the sky, which have a frame."""
        ucd = self.facts.get("ucd", "")
        return ucd.startswith(("pos.eq.", "pos.cartesian.", "pos.pm", "POS_EQ_"))

    @property
    def unit(self) -> str | None:
        """The unit in the spelling of VOUnits; raises SchemaError where they have none."""
        return unit_text(self.name, self.facts.get("unit"), "vounit")


@dataclass(frozen=True)
class Cells:
    """The cells of a column in a batch.

    Attributes
    ----------
    values : pyarrow.Array
        Of the column's kind: one a row, or all items of the lists one after the other.
    is_null : ndarray of bool, shape (N,), optional
        Rows without a value; None where there are none.
    offsets : ndarray of int64, shape (N + 1,), optional
        Where the list of each row begins and ends; None where rows are no lists.
    """

    values: pa.Array
    is_null: NDArray[np.bool_] | None
    offsets: NDArray[np.int64] | None


def votable_columns(schema: pa.Schema) -> list[VotableColumn]:
    """Return what the columns of a table are in a VOTable."""
    check_names(schema.names, "votable")
    return [_votable_column(field) for field in schema]


def cells_of(column: VotableColumn, values: pa.Array) -> Cells:
    """Return the cells of a column in a batch."""
    is_null = values.is_null().to_numpy(zero_copy_only=False) if values.null_count else None
    offsets = None
    if column.is_list:
        offsets, values = list_items(column.name, values)
    plain = plain_values(column.name, values, signed=True)
    if column.is_text:
        _check_text(column.name, plain)
    return Cells(plain, is_null, offsets)


def text_bytes(values: pa.Array) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
    """Return the UTF-8 bytes of texts."""
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
    """Return whether all of more than one value are the same."""
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
            raise SchemaError(
                f"column {name!r}: the text {quoted(text)} has a character that XML cannot "
                "hold; take it out, or choose another format than votable",
                field=name,
                found=text,
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
    has_lists = is_list(kind) and is_number(kind.value_type)
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
