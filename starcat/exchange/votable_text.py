"""Rows of a VOTable as TABLEDATA: text in ``TR`` and ``TD``, with all digits of every number."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from starcat.exchange.votable_columns import Cells, VotableColumn, is_constant, text_bytes

_BETWEEN = "</TD><TD>"
_ROW_BEGINS, _ROW_ENDS = "<TR><TD>", "</TD></TR>\n"
_ESCAPES = (("&", "&amp;"), ("<", "&lt;"), (">", "&gt;"))


class Tabledata:
    """What writes batches of a table as TABLEDATA."""

    def __init__(self, columns: Sequence[VotableColumn]) -> None:
        self._columns = tuple(columns)

    def rows(self, cells: Sequence[Cells], count: int) -> bytes:
        """Return rows."""
        if not count:
            return b""
        parts: list[pa.Array | str] = []
        for column, found in zip(self._columns, cells, strict=True):
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


_NULL_IS_EMPTY = {"null_handling": "replace", "null_replacement": ""}


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
    """Return numbers and truth values as text, null as null."""
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
