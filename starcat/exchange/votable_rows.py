"""Rows of a VOTable as BINARY2 and as TABLEDATA.

BINARY2 has a bit a column for null, then the values, big end first. Runs of columns of fixed width
are filled as one numpy record; lists and texts stand between them as bytes, each with its length at
the end of the record before. One call joins the rows. TABLEDATA is text in ``TR`` and ``TD``, with
all digits of every number.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from starcat.exchange.text import Cells
from starcat.exchange.votable_fields import VotableColumn, is_ascii, is_constant, text_bytes

_TRUE, _FALSE, _UNKNOWN = ord("T"), ord("F"), ord("?")
_FOUR_BYTES = 0xF0
"""The least first byte of a letter that UTF-8 says in four bytes, and UTF-16 in two units."""

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
    for column, found in zip(columns, cells, strict=True):
        if not (column.is_text or column.is_list):
            run.add(_big_endian(column), _fixed(column, found))
            continue
        same = _constant(column, found)
        lengths, content = _variable(column, same or found)
        run.add(">u4", lengths)
        if same is not None:
            # A text that is the same in all rows is of fixed width.
            text = content[0].as_py()
            run.add(f"V{len(text)}", np.void(text))
            continue
        parts += [run.bytes(count), content]
        run = _Run()
    parts.append(run.bytes(count))
    _, joined = text_bytes(pc.binary_join_element_wise(*parts, b""))
    return bytes(joined.data)


class _Run:
    """Columns of fixed width, to be one record a row."""

    def __init__(self) -> None:
        self._filled: list[tuple[str, Any]] = []

    def add(self, kind: str, values: Any) -> None:
        """Add a column of a numpy type: a value for each row, or one for all."""
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
    for place, column in enumerate(cells):
        if column.is_null is not None:
            is_null[:, place] = column.is_null
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
    """Return the first row of texts that are the same in all rows; None where they are not."""
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
    # A byte that begins a letter stands for one unit, or for two; one that goes on, for none.
    units = ((letters & 0xC0) != 0x80).astype(np.int64) + (letters >= _FOUR_BYTES)
    ends = np.concatenate(([0], np.cumsum(units)))
    encoded = letters.tobytes().decode().encode("utf-16-be")
    return ends[offsets], np.frombuffer(encoded, ">u2")


def _binary(offsets: NDArray[np.int64], content: NDArray[np.uint8]) -> pa.Array:
    places = pa.py_buffer(offsets.astype(np.int32))
    held = pa.py_buffer(np.ascontiguousarray(content))
    return pa.BinaryArray.from_buffers(pa.binary(), len(offsets) - 1, [None, places, held])


def tabledata_rows(columns: Sequence[VotableColumn], cells: Sequence[Cells], count: int) -> bytes:
    """Return the rows of a batch as TABLEDATA."""
    if not count:
        return b""
    parts: list[pa.Array | str] = []
    for column, found in zip(columns, cells, strict=True):
        text = _texts(column, found)
        # What is the same in all rows is put between the columns that differ, as one text.
        if isinstance(text, str) and parts and isinstance(parts[-1], str):
            parts[-1] += _BETWEEN + text
        else:
            parts.append(text)
    last = parts.pop()
    if isinstance(last, str):
        last = pa.repeat(last, count)
    # The end of a row and the beginning of the next go with the last cell.
    last = pc.binary_join_element_wise(last, _ROW_ENDS + _ROW_BEGINS, "", **_NULL_IS_EMPTY)
    joined = pc.binary_join_element_wise(*parts, last, _BETWEEN, **_NULL_IS_EMPTY)
    _, content = text_bytes(joined)
    return b"".join([_ROW_BEGINS.encode(), content.data[: -len(_ROW_BEGINS)]])


def _texts(column: VotableColumn, cells: Cells) -> pa.Array | str:
    """Return the texts of cells, of which null may be any; one text where all are the same."""
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
    for letter, escape in _ESCAPES:
        if (letters == ord(letter)).any():
            texts = pc.replace_substring(texts, letter, escape)
    return texts
