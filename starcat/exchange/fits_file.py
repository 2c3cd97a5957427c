"""Tables as binary tables of FITS 4.0.

FITS text is ASCII, and an empty text is its null. Nulls are NaN in floating-point columns, TNULL
(the smallest number that the column does not use) in integer ones, and an empty list in ragged
ones. A column of truth values with nulls becomes bytes 0 and 1 with TNULL, since readers take
the null of a logical column for False. Texts of the header that are longer than a card go on in
the next, which ``LONGSTRN`` announces.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from starcat.errors import SchemaError
from starcat.exchange.label import UNLABELLED, Label
from starcat.exchange.numpy_columns import NumpyColumn
from starcat.exchange.units import unit_text

_CODES = {"b1": "L", "u1": "B", "i2": "I", "i4": "J", "i8": "K", "f4": "E", "f8": "D"}
_NAME_LETTERS = 68
"""What a card of a FITS header has room for; a quotation mark counts twice."""

_HEAP_LIMIT_BYTES = 2**31 - 1
"""What a descriptor of 32 bits reaches; beyond it FITS has one of 64 bits."""


def write_fits(
    columns: list[NumpyColumn], rows: int, path: Path, label: Label = UNLABELLED
) -> None:
    """Write columns as a FITS file with one binary table."""
    from astropy.io import fits

    _check_names(columns)
    heap = sum(column.values.nbytes for column in columns if column.offsets is not None)
    descriptor = "P" if heap <= _HEAP_LIMIT_BYTES else "Q"
    table = fits.BinTableHDU.from_columns(
        [_column(column, descriptor) for column in columns], nrows=rows
    )
    named = {"EXTNAME": label.table, "ARTIFACT": label.artifact, "VERSION": label.version}
    for key, text in named.items():
        if text:
            table.header[key] = _header_text(text)
    table.header["LONGSTRN"] = ("OGIP 1.0", "long texts go on in CONTINUE")
    for number, column in enumerate(columns, start=1):
        for key, fact in (("TCOMM", "description"), ("TUCD", "ucd")):
            if column.facts.get(fact):
                table.header[f"{key}{number}"] = _header_text(column.facts[fact])
    fits.HDUList([fits.PrimaryHDU(), table]).writeto(path, overwrite=True)


def _header_text(text: str) -> str:
    """Return a text as a header may have it: printable ASCII."""
    return "".join(letter if letter.isascii() and letter.isprintable() else "?" for letter in text)


def _check_names(columns: list[NumpyColumn]) -> None:
    seen: dict[str, str] = {}
    for column in columns:
        name = column.name
        if not (name.isascii() and name.isprintable()):
            raise SchemaError(
                f"column {name!r}: names are ASCII in FITS; rename it with AS", field=name
            )
        if len(name.replace("'", "''")) > _NAME_LETTERS:
            raise SchemaError(
                f"column {name[:20]}... has a name of {len(name)} letters, and FITS has room for "
                f"{_NAME_LETTERS}; rename it with AS",
                field=name,
            )
        if name.lower() in seen:
            raise SchemaError(
                f"columns {seen[name.lower()]!r} and {name!r}: FITS does not tell capitals from "
                "small letters in names; rename one with AS",
                field=name,
            )
        seen[name.lower()] = name


def _column(column: NumpyColumn, descriptor: str) -> Any:
    from astropy.io import fits

    null = None
    array: NDArray[Any]
    if column.is_text:
        array = _ascii(column)
        code = f"{max(1, array.dtype.itemsize)}A"
    elif column.offsets is not None:
        array = np.empty(len(column.is_null), dtype=np.object_)
        array[:] = column.lists()
        code = f"{descriptor}{_CODES[column.values.dtype.str[1:]]}()"
    else:
        array, null = _with_null(column)
        code = _CODES[array.dtype.str[1:]]
    unit = unit_text(column.name, column.facts.get("unit"), "fits")
    return fits.Column(name=column.name, format=code, array=array, null=null, unit=unit)


def _ascii(column: NumpyColumn) -> NDArray[np.bytes_]:
    for text in column.values:
        if not text.isascii() or "\0" in text:
            raise SchemaError(
                f"column {column.name!r}: text is ASCII in FITS, and {text!r} is not; leave the "
                "column out, or export to votable",
                field=column.name,
                found=text,
            )
    return column.values.astype(np.bytes_) if len(column.values) else np.empty(0, "S1")


def _with_null(column: NumpyColumn) -> tuple[NDArray[Any], int | None]:
    """Return the values of a column, and which of them means null."""
    values = column.values
    if values.dtype.kind == "f" or not column.is_null.any():
        return values, None
    if values.dtype.kind == "b":
        return np.where(column.is_null, 255, values).astype(np.uint8), 255
    if values.dtype == np.uint8:
        values = values.astype(np.int16)  # all 256 values may be in use
    used = values[~column.is_null]
    null = int(np.iinfo(values.dtype).min)
    while np.isin(null, used):
        null += 1
    return np.where(column.is_null, values.dtype.type(null), values), null
