"""Rows of a VOTable as BINARY2: a bit a column for null, then the values, big end first.

Runs of columns of fixed width are filled as one numpy record; lists and texts stand between them
as bytes, each with its length at the end of the record before. One call joins the rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from starcat.exchange.votable_columns import Cells, VotableColumn, is_ascii, text_bytes

_TRUE, _FALSE, _UNKNOWN = ord("T"), ord("F"), ord("?")
_FOUR_BYTES = 0xF0
"""The least first byte of a letter that UTF-8 says in four bytes, and UTF-16 in two units."""


@dataclass(frozen=True)
class _Run:
    """Columns of fixed width, and the one of variable width that ends them, if there is one."""

    record: np.dtype[np.void]
    columns: tuple[int, ...]
    last: int | None


class Binary2:
    """What writes batches of a table as BINARY2.

    Parameters
    ----------
    columns : sequence of VotableColumn
        The columns of the table.
    """

    def __init__(self, columns: Sequence[VotableColumn]) -> None:
        self._columns = tuple(columns)
        self._runs = _runs(self._columns)

    def rows(self, cells: Sequence[Cells], count: int) -> bytes:
        """Return rows.

        Parameters
        ----------
        cells : sequence of Cells
            The cells of each column.
        count : int
            How many rows.

        Returns
        -------
        bytes
            Before base64.
        """
        parts: list[pa.Array] = []
        for number, run in enumerate(self._runs):
            record = np.zeros(count, run.record)
            if number == 0:
                record["null"] = _null_bits(cells, count)
            for place in run.columns:
                record[f"c{place}"] = _fixed(self._columns[place], cells[place])
            following: pa.Array | None = None
            if run.last is not None:
                lengths, following = _variable(self._columns[run.last], cells[run.last])
                record["length"] = lengths
            parts.append(_as_binary(record))
            if following is not None:
                parts.append(following)
        joined = pc.binary_join_element_wise(*parts, b"")
        _, content = text_bytes(joined)
        return content.tobytes()


def _runs(columns: Sequence[VotableColumn]) -> list[_Run]:
    """Return the columns in runs, of which the first begins with the bits of null."""
    runs = []
    fields: list[tuple[str, str]] = [("null", f"V{(len(columns) + 7) // 8}")]
    places: list[int] = []
    for place, column in enumerate(columns):
        if column.is_list or column.is_text:
            runs.append(_Run(np.dtype([*fields, ("length", ">u4")]), tuple(places), place))
            fields, places = [], []
            continue
        fields.append((f"c{place}", _big_endian(column)))
        places.append(place)
    if fields:
        runs.append(_Run(np.dtype(fields), tuple(places), None))
    return runs


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


def _variable(column: VotableColumn, cells: Cells) -> tuple[NDArray[np.int64], pa.Array]:
    """Return how many items each row has, and the bytes of each row."""
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
    """Return texts in UTF-8 as units of UTF-16, big end first."""
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


def _as_binary(record: NDArray[np.void]) -> pa.Array:
    offsets = np.arange(len(record) + 1, dtype=np.int64) * record.dtype.itemsize
    return _binary(offsets, record.view(np.uint8) if len(record) else np.empty(0, np.uint8))
