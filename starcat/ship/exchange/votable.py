"""VOTables: fields, rows, and documents, written as a stream."""

from __future__ import annotations

import re
from binascii import b2a_base64
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import Any, Literal
from xml.sax.saxutils import escape, quoteattr

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from starcat.errors import StarcatError, quoted
from starcat.ship.exchange.columns import (
    UNLABELLED,
    FirstRows,
    Label,
    check_names,
    column_error,
    field_facts,
    is_list,
    is_numeric_column,
    plain_batch,
    plain_schema,
    steps,
    unit_text,
)
from starcat.ship.exchange.text import Cells, cells_of, plain_values
from starcat.storage.parquet import ARROW_DATATYPES
from starcat.threads import map_in_order

_NOT_XML = re.compile("[^\t\n -\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that XML 1.0 forbids, and the carriage return, which readers change."""

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
_ICRS = "starcat.icrs"  # identifier by which columns refer to the coordinate system
_COOSYS = f'  <COOSYS ID="{_ICRS}" system="ICRS"'
EPOCH_PLACE = _COOSYS.encode()
"""Text before the attribute with the epoch; it occurs only once in a document."""

_TABLE = "starcat.table"
_IDENTIFIER = re.compile(r"(?!starcat\.)[A-Za-z_][A-Za-z0-9_.-]*")


@dataclass(frozen=True)
class VotableColumn:
    """A column, with the facts for its FIELD."""

    name: str
    kind: pa.DataType  # type of its values, or of the items of its lists
    is_list: bool  # True if its rows are lists of numbers
    # Type name in DALI. Dates, and times with a date, are "timestamp" and become ISO 8601 text; the
    # metadata of a field can set another xtype.
    xtype: str | None
    facts: dict[str, str]  # unit, description and ucd, if the column has them

    @property
    def is_text(self) -> bool:
        """Whether the values are texts."""
        return bool(pa.types.is_string(self.kind))

    @property
    def datatype(self) -> str:
        """Name of the type in VOTable: ``char`` if texts are certainly ASCII."""
        if self.is_text and self.xtype == "timestamp":
            return "char"
        return ARROW_DATATYPES[self.kind]

    @property
    def is_place(self) -> bool:
        """Whether it is a coordinate or a proper motion, and so has a frame."""
        ucd = self.facts.get("ucd", "")
        return ucd.startswith(("pos.eq.", "pos.cartesian.", "pos.pm", "POS_EQ_"))

    @property
    def unit(self) -> str | None:
        """The unit in the spelling of VOUnits; raises SchemaError if VOUnits lacks it."""
        return unit_text(self.name, self.facts.get("unit"), "vounit")


def votable_columns(schema: pa.Schema) -> list[VotableColumn]:
    """Return the columns of a plain schema for a VOTable."""
    check_names(schema.names, "votable")
    return [_votable_column(field) for field in schema]


def votable_cells(column: VotableColumn, values: pa.Array) -> Cells:
    """Return the cells of a column in a batch; SchemaError if a value does not fit."""
    cells = cells_of(column.name, values, signed=True)
    if column.is_text:
        _check_text(column.name, cells.values)
    return cells


def text_bytes(values: pa.Array) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
    """Return N + 1 offsets of N texts, and their joined UTF-8 bytes.

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
    """Return whether several values all have the same bytes, and none is null."""
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
    # For most columns the first values already differ.
    return bool((numbers[:16] == numbers[0]).all() and (numbers == numbers[0]).all())


def is_ascii(letters: NDArray[np.uint8]) -> bool:
    """Return whether UTF-8 bytes are all ASCII."""
    return not len(letters) or bool(letters.max() < _NOT_ASCII)


def check_xml(name: str, texts: Iterable[str | None]) -> None:
    """Refuse texts with a character that XML forbids."""
    for text in texts:
        if text and _NOT_XML.search(text):
            raise column_error(
                name,
                f": the text {quoted(text)} has a character that XML cannot "
                "hold; take it out, or choose another format than votable",
                text,
            )


def said_in_xml(text: str) -> str:
    """Return a text with a question mark for each character that XML forbids."""
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
    # For most texts a test of the smallest and of the largest byte is enough.
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
    """Return the part of a document before the rows."""
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
    """Return the part of a document after the rows."""
    return "".join([_AFTER_ROWS[serialization], "  </TABLE>\n", *infos, _AFTER_TABLE])


def info_element(name: str, value: str, identifier: str = "", text: str = "") -> str:
    """Return an ``INFO`` element."""
    begins = f"ID={_attribute(identifier)} " if identifier else ""
    start = f"  <INFO {begins}name={_attribute(name)} value={_attribute(value)}"
    return f"{start}>{escape(said_in_xml(text))}</INFO>\n" if text else f"{start}/>\n"


def error_document(text: str) -> bytes:
    """Return a VOTable with an error instead of an answer."""
    said = info_element("Error", text) + _RESULTS + info_element("QUERY_STATUS", "ERROR", text=text)
    return f"{_VOTABLE}{said}{_AFTER_TABLE}".encode()


def has_places(columns: Sequence[VotableColumn]) -> bool:
    """Return whether a table has coordinates and so needs a coordinate system."""
    return any(column.is_place for column in columns)


def _field(column: VotableColumn) -> str:
    attributes = {
        # Some readers use the identifier; not every name is a valid one.
        "ID": column.name if _IDENTIFIER.fullmatch(column.name) else None,
        "name": column.name,
        "datatype": column.datatype,
        "arraysize": "*" if column.is_text or column.is_list else None,
        "unit": column.unit,
        "ucd": column.facts.get("ucd"),
        "xtype": column.xtype,
        "ref": _ICRS if column.is_place else None,
    }
    said = " ".join(
        f"{key}={_attribute(text)}" for key, text in attributes.items() if text is not None
    )
    description = column.facts.get("description")
    if not description:
        return f"   <FIELD {said}/>\n"
    escaped = escape(said_in_xml(description))
    return f"   <FIELD {said}>\n    <DESCRIPTION>{escaped}</DESCRIPTION>\n   </FIELD>\n"


def _attribute(text: str) -> str:
    return quoteattr(said_in_xml(text))


_TRUE, _FALSE, _UNKNOWN = ord("T"), ord("F"), ord("?")
_FOUR_BYTES = 0xF0
"""Smallest first byte of a letter that takes four bytes in UTF-8, and two units in UTF-16."""

_BETWEEN = "</TD><TD>"
_ROW_BEGINS, _ROW_ENDS = "<TR><TD>", "</TD></TR>\n"
_ESCAPES = (("&", "&amp;"), ("<", "&lt;"), (">", "&gt;"))
_NULL_IS_EMPTY = {"null_handling": "replace", "null_replacement": ""}


def binary2_rows(columns: Sequence[VotableColumn], cells: Sequence[Cells], count: int) -> bytes:
    """Return the rows of a batch as BINARY2."""
    if not count:
        return b""
    parts: list[pa.Array] = []
    run = _Run()
    run.add(f"V{(len(cells) + 7) // 8}", _null_bits(cells, count))
    for column, column_cells in zip(columns, cells, strict=True):
        if not (column.is_text or column.is_list):
            run.add(_big_endian(column), _fixed(column, column_cells))
            continue
        same = _constant(column, column_cells)
        lengths, content = _variable(column, same or column_cells)
        run.add(">u4", lengths)
        if same is not None:
            # A text that is the same in all rows has a fixed width.
            text = content[0].as_py()
            run.add(f"V{len(text)}", np.void(text))
            continue
        parts += [run.bytes(count), content]
        run = _Run()
    parts.append(run.bytes(count))
    _, joined = text_bytes(pc.binary_join_element_wise(*parts, b""))
    return bytes(joined.data)


class _Run:
    """Columns of fixed width, combined into one record per row."""

    def __init__(self) -> None:
        self._filled: list[tuple[str, Any]] = []

    def add(self, kind: str, values: Any) -> None:
        """Add a column of a numpy type: one value per row, or a single value for all rows."""
        if kind != "V0":
            self._filled.append((kind, values))

    def bytes(self, count: int) -> pa.Array:
        """Return the bytes of each row."""
        record = np.zeros(count, [(f"c{k}", kind) for k, (kind, _) in enumerate(self._filled)])
        for name, (_, values) in zip(record.dtype.names or (), self._filled, strict=True):
            record[name] = values
        offsets = np.arange(count + 1, dtype=np.int64) * record.dtype.itemsize
        is_empty = record.dtype.itemsize == 0
        return _binary(offsets, np.empty(0, np.uint8) if is_empty else record.view(np.uint8))


def _big_endian(column: VotableColumn) -> str:
    kind = np.dtype(column.kind.to_pandas_dtype())
    return "u1" if kind.kind == "b" else kind.newbyteorder(">").str


def _null_bits(cells: Sequence[Cells], count: int) -> NDArray[np.void]:
    width = (len(cells) + 7) // 8
    is_null = np.zeros((count, len(cells)), np.bool_)
    for index, column in enumerate(cells):
        if column.is_null is not None:
            is_null[:, index] = column.is_null
    return np.ascontiguousarray(np.packbits(is_null, axis=1)).view(f"V{width}")[:, 0]


def _fixed(column: VotableColumn, cells: Cells) -> NDArray[np.generic]:
    """Return values of fixed width, with NaN, 0 or a question mark for null."""
    values = cells.values
    if pa.types.is_floating(column.kind):
        return np.asarray(values.to_numpy(zero_copy_only=False))
    if not pa.types.is_boolean(column.kind):
        filled = pc.fill_null(values, 0) if values.null_count else values
        return np.asarray(filled.to_numpy(zero_copy_only=False))
    truth = pc.fill_null(values, False).to_numpy(zero_copy_only=False)
    letters = np.where(truth, np.uint8(_TRUE), np.uint8(_FALSE))
    if cells.is_null is not None:
        letters[cells.is_null] = _UNKNOWN
    return letters


def _constant(column: VotableColumn, cells: Cells) -> Cells | None:
    """Return the first row if the texts are the same in all rows, else None."""
    values = cells.values
    if column.is_list or not (values.null_count == len(values) or is_constant(values)):
        return None
    return Cells(values.slice(0, 1), None, None)


def _variable(column: VotableColumn, cells: Cells) -> tuple[NDArray[np.int64], pa.Array]:
    if cells.offsets is not None:
        items = _fixed(column, cells).astype(_big_endian(column))
        content = np.ascontiguousarray(items).view(np.uint8)
        return np.diff(cells.offsets), _binary(cells.offsets * items.dtype.itemsize, content)
    offsets, letters = text_bytes(cells.values)
    if column.datatype == "char":
        return np.diff(offsets), _binary(offsets, letters)
    offsets, units = _utf_16(offsets, letters)
    return np.diff(offsets), _binary(offsets * 2, units.view(np.uint8))


def _utf_16(
    offsets: NDArray[np.int64], letters: NDArray[np.uint8]
) -> tuple[NDArray[np.int64], NDArray[np.generic]]:
    if is_ascii(letters):
        return offsets, letters.astype(">u2")
    # The first byte of a letter counts one or two units; its other bytes count none.
    units = ((letters & 0xC0) != 0x80).astype(np.int64) + (letters >= _FOUR_BYTES)
    ends = np.concatenate(([0], np.cumsum(units)))
    encoded = letters.tobytes().decode().encode("utf-16-be")
    return ends[offsets], np.frombuffer(encoded, ">u2")


def _binary(offsets: NDArray[np.int64], content: NDArray[np.uint8]) -> pa.Array:
    places = pa.py_buffer(offsets.astype(np.int32))
    content_buffer = pa.py_buffer(np.ascontiguousarray(content))
    return pa.BinaryArray.from_buffers(
        pa.binary(), len(offsets) - 1, [None, places, content_buffer]
    )


def tabledata_rows(columns: Sequence[VotableColumn], cells: Sequence[Cells], count: int) -> bytes:
    """Return the rows of a batch as TABLEDATA."""
    if not count:
        return b""
    parts: list[pa.Array | str] = []
    for column, column_cells in zip(columns, cells, strict=True):
        text = _texts(column, column_cells)
        # Adjacent constant texts are joined, and put between the columns that vary.
        if isinstance(text, str) and parts and isinstance(parts[-1], str):
            parts[-1] += _BETWEEN + text
        else:
            parts.append(text)
    last = parts.pop()
    if isinstance(last, str):
        last = pa.repeat(last, count)
    # The last cell also contains the end of its row and the beginning of the next row.
    last = pc.binary_join_element_wise(last, _ROW_ENDS + _ROW_BEGINS, "", **_NULL_IS_EMPTY)
    joined = pc.binary_join_element_wise(*parts, last, _BETWEEN, **_NULL_IS_EMPTY)
    _, content = text_bytes(joined)
    return b"".join([_ROW_BEGINS.encode(), content.data[: -len(_ROW_BEGINS)]])


def _texts(column: VotableColumn, cells: Cells) -> pa.Array | str:
    """Return the texts of cells (any text for null); a single text if all are the same."""
    if cells.offsets is not None:
        return _lists(cells.offsets, _numbers(cells.values))
    values = cells.values
    if values.null_count == len(values):
        return ""
    if values.null_count == 0 and is_constant(values):
        values = values.slice(0, 1)
    texts = _escaped(values) if column.is_text else _numbers(values)
    return texts[0].as_py() if len(texts) < len(cells.values) else texts


def _numbers(values: pa.Array) -> pa.Array:
    if pa.types.is_boolean(values.type):
        return pc.if_else(values, "T", "F")
    texts = values.cast(pa.string())
    if pa.types.is_floating(values.type) and not pc.all(pc.is_finite(values)).as_py():
        texts = pc.if_else(pc.is_nan(values), "NaN", texts)
        endless = pc.if_else(pc.greater(values, 0), "+Inf", "-Inf")
        texts = pc.if_else(pc.is_inf(values), endless, texts)
    return texts


def _lists(offsets: NDArray[np.int64], items: pa.Array) -> pa.Array:
    texts = pc.fill_null(items, "NaN")
    return pc.binary_join(pa.ListArray.from_arrays(offsets.astype(np.int32), texts), " ")


def _escaped(texts: pa.Array) -> pa.Array:
    _, letters = text_bytes(texts)
    for letter, escaped in _ESCAPES:
        if (letters == ord(letter)).any():
            texts = pc.replace_substring(texts, letter, escaped)
    return texts


Serialization = Literal["binary2", "tabledata"]

_EPOCH = "epoch_jyear"
_EPOCH_ROOM = 32
"""Letters reserved in a file for the epoch, which is known only after all rows are written."""

_BASE64_BYTES = 3  # base64 converts 3 bytes to 4 letters; only the end of a stream may be shorter


def votable_chunks(
    batches: pa.RecordBatchReader,
    *,
    serialization: Serialization = "binary2",
    label: Label = UNLABELLED,
    maxrec: int | None = None,
    infos: Mapping[str, str] | None = None,
) -> Iterator[bytes]:
    """Yield a table as a VOTable with a status, as DALI 1.1, section 4.4 requires of services.

    At most `maxrec` rows are written; to notice that rows are left out, the batches must contain
    one row more. An error in the first rows is raised before anything is yielded. A later error
    ends the document with ``QUERY_STATUS`` ``ERROR``.
    """
    schema = plain_schema(batches.schema)
    columns = votable_columns(schema)
    cut = FirstRows(batches, maxrec)
    read = iter(cut)
    epoch = ""
    if _has_epoch(schema, columns):
        begun = list(islice(read, 2))
        read = chain(begun, read)
        # The head is sent before the later rows are known, so only short tables state the epoch.
        epoch = _epoch_attribute(_epochs_of(begun)) if len(begun) < 2 else ""
    head_infos = {"QUERY_STATUS": "OK", **(infos or {})}
    rows = _row_chunks(read, schema, columns, serialization)
    first = next(rows, b"")
    yield head(columns, serialization, label, head_infos, epoch).encode()
    yield first
    last = []
    try:
        yield from rows
        if cut.were_more:
            last = [info_element("QUERY_STATUS", "OVERFLOW")]
    except StarcatError as error:
        last = [info_element("QUERY_STATUS", "ERROR", text=str(error))]
    except (OSError, pa.ArrowException):
        last = [info_element("QUERY_STATUS", "ERROR", text="the rest of the rows cannot be read")]
    yield foot(serialization, last).encode()


def write_votable(batches: pa.RecordBatchReader, path: Path, label: Label) -> None:
    """Write a table as a VOTable file with rows as text."""
    schema = plain_schema(batches.schema)
    columns = votable_columns(schema)
    with_epoch = _has_epoch(schema, columns)
    epochs: set[float] = set()

    def watched() -> Iterator[pa.RecordBatch]:
        for batch in batches:
            if with_epoch and len(epochs) < 2:
                epochs.update(_epochs_of([batch]))
            yield batch

    top = head(columns, "tabledata", label, {}, " " * _EPOCH_ROOM if with_epoch else "").encode()
    with path.open("wb") as stream:
        stream.write(top)
        for chunk in _row_chunks(watched(), schema, columns, "tabledata"):
            stream.write(chunk)
        stream.write(foot("tabledata").encode())
        if with_epoch:
            stream.seek(top.index(EPOCH_PLACE) + len(EPOCH_PLACE))
            stream.write(_epoch_attribute(epochs).encode())


def _row_chunks(
    batches: Iterable[pa.RecordBatch],
    schema: pa.Schema,
    columns: Sequence[VotableColumn],
    serialization: Serialization,
) -> Iterator[bytes]:
    rows = binary2_rows if serialization == "binary2" else tabledata_rows

    def encode(batch: pa.RecordBatch) -> bytes:
        plain = plain_batch(batch, schema)
        cells = [
            votable_cells(column, values) for column, values in zip(columns, plain, strict=True)
        ]
        return rows(columns, cells, plain.num_rows) if columns else b""

    texts = map_in_order(encode, steps(batches))
    if serialization == "tabledata":
        yield from texts
        return
    remainder = b""
    failure = None
    try:
        for content in texts:
            content = remainder + content
            whole = len(content) - len(content) % _BASE64_BYTES
            remainder = content[whole:]
            yield b2a_base64(memoryview(content)[:whole])
    except Exception as error:
        failure = error
    if remainder:
        yield b2a_base64(remainder)
    if failure is not None:
        raise failure


def _has_epoch(schema: pa.Schema, columns: Sequence[VotableColumn]) -> bool:
    index = schema.get_field_index(_EPOCH)
    return index >= 0 and pa.types.is_floating(schema.field(index).type) and has_places(columns)


def _epochs_of(batches: Iterable[pa.RecordBatch]) -> set[float]:
    """Return at most two epochs of each batch; several mean that there is no common epoch."""
    epochs: set[float] = set()
    for batch in batches:
        extremes = pc.min_max(batch.column(_EPOCH)).as_py()
        epochs |= {epoch for epoch in extremes.values() if epoch is not None}
    return epochs


def _epoch_attribute(epochs: set[float]) -> str:
    if len(epochs) != 1:
        return ""
    [epoch] = epochs
    return f' epoch="J{str(epoch).removesuffix(".0")}"'
