"""Write tables as FITS, ECSV and npz, from arrays of the whole table.

FITS 4.0 has a binary table. Its text is ASCII, and an empty text means null. Nulls are NaN in
floating-point columns, TNULL (the smallest number that the column does not use) in integer columns,
and an empty list in ragged columns. A column of truth values with nulls becomes bytes 0 and 1 with
TNULL, since readers interpret the null of a logical column as False. Header texts longer than a
card continue in the next card, as ``LONGSTRN`` announces.

ECSV 1.0 is text with a header that states types, units and meanings.

npz has one array per column, for numpy: ``<column>`` contains the values. Null is NaN, 0, False or
an empty text; if there are nulls, ``<column>.is_null`` marks them. A ragged column has all items in
``<column>``, and ``<column>.offsets``: row i is ``values[offsets[i]:offsets[i + 1]]``.
"""

from __future__ import annotations

import re
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from starcat.arrays import Mask
from starcat.errors import SchemaError
from starcat.ship.exchange.columns import (
    Label,
    check_names,
    column_error,
    field_facts,
    plain_schema,
    unit_text,
)
from starcat.ship.exchange.text import cells_of

if TYPE_CHECKING:
    from astropy.table import Table

_CODES = {"b1": "L", "u1": "B", "i2": "I", "i4": "J", "i8": "K", "f4": "E", "f8": "D"}
_NAME_LETTERS = 68  # most letters in a card of a FITS header; a quotation mark counts twice
_HEAP_LIMIT_BYTES = 2**31 - 1
"""Largest size for a descriptor of 32 bits; larger columns get a descriptor of 64 bits."""

_BREAKS = re.compile(r"\0|[^\S \t\n]")
"""White space other than blank, tab and newline: Python ends lines at most of these."""

_ENTRY_NAME_BYTES = (1 << 16) - 1  # longest name of an entry in a zip file


@dataclass(frozen=True)
class NumpyColumn:
    """One column of N rows as numpy arrays."""

    name: str
    # Numbers, truth values, or texts as objects; for a ragged column the items of all rows joined.
    # Null is NaN, 0, False or an empty text.
    values: NDArray[Any]
    is_null: Mask
    # Shape (N + 1,): start and end of the list of each row; None if rows are not lists.
    offsets: NDArray[np.int64] | None
    facts: dict[str, str]  # unit, description and ucd, if the column has them

    @property
    def is_text(self) -> bool:
        """Whether the values are texts."""
        return self.values.dtype == np.object_

    def lists(self) -> NDArray[np.object_]:
        """Return the items of each row of a ragged column."""
        rows = np.empty(len(self.is_null), dtype=np.object_)
        if self.offsets is not None and len(rows):
            rows[:] = np.split(self.values, self.offsets[1:-1])
        return rows


def numpy_columns(table: pa.Table, *, signed: bool) -> list[NumpyColumn]:
    """Return the columns of a table as numpy arrays, with integers of the types of `cells_of`."""
    table = table.cast(plain_schema(table.schema))
    return [
        _numpy_column(field, table[field.name].combine_chunks(), signed=signed)
        for field in table.schema
    ]


def _numpy_column(field: pa.Field, values: pa.Array, *, signed: bool) -> NumpyColumn:
    cells = cells_of(field.name, values, signed=signed)
    is_null = np.zeros(len(values), np.bool_) if cells.is_null is None else cells.is_null
    array = _to_numpy(cells.values)
    return NumpyColumn(field.name, array, is_null, cells.offsets, field_facts(field))


def write_fits(batches: pa.RecordBatchReader, path: Path, label: Label) -> None:
    """Write a table as a FITS file with one binary table."""
    from astropy.io import fits

    columns = _arrays(batches, "fits")
    _check_fits_names(columns)
    heap = sum(column.values.nbytes for column in columns if column.offsets is not None)
    descriptor = "P" if heap <= _HEAP_LIMIT_BYTES else "Q"
    table = fits.BinTableHDU.from_columns([_fits_column(column, descriptor) for column in columns])
    named = {"EXTNAME": label.table, "ARTIFACT": label.database, "VERSION": label.version}
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
    return "".join(letter if letter.isascii() and letter.isprintable() else "?" for letter in text)


def _check_fits_names(columns: list[NumpyColumn]) -> None:
    seen: dict[str, str] = {}
    for column in columns:
        name = column.name
        if not (name.isascii() and name.isprintable()):
            raise column_error(name, ": names are ASCII in FITS; rename it with AS")
        if len(name.replace("'", "''")) > _NAME_LETTERS:
            raise SchemaError(
                f"column {name[:20]}... has a name of {len(name)} letters, and FITS allows "
                f"{_NAME_LETTERS}",
                field=name,
                hint="rename it with AS",
            )
        if name.lower() in seen:
            raise SchemaError(
                f"columns {seen[name.lower()]!r} and {name!r}: names in FITS are not "
                "case-sensitive",
                field=name,
                hint="rename one with AS",
            )
        seen[name.lower()] = name


def _fits_column(column: NumpyColumn, descriptor: str) -> Any:
    from astropy.io import fits

    null = None
    array: NDArray[Any]
    if column.is_text:
        array = _ascii(column)
        code = f"{max(1, array.dtype.itemsize)}A"
    elif column.offsets is not None:
        array = column.lists()
        code = f"{descriptor}{_CODES[column.values.dtype.str[1:]]}()"
    else:
        array, null = _with_null(column)
        code = _CODES[array.dtype.str[1:]]
    unit = unit_text(column.name, column.facts.get("unit"), "fits")
    return fits.Column(name=column.name, format=code, array=array, null=null, unit=unit)


def _ascii(column: NumpyColumn) -> NDArray[np.bytes_]:
    for text in column.values:
        if not text.isascii() or "\0" in text:
            problem = (
                f": text is ASCII in FITS, and {text!r} is not; leave the column out, or export to"
            )
            raise column_error(column.name, f"{problem} votable", text)
    return column.values.astype(np.bytes_) if len(column.values) else np.empty(0, "S1")


def _with_null(column: NumpyColumn) -> tuple[NDArray[Any], int | None]:
    """Return the values of a column, and the value that means null."""
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


def write_ecsv(batches: pa.RecordBatchReader, path: Path, label: Label) -> None:
    """Write a table as ECSV."""
    columns = _arrays(batches, "ecsv")
    _check_ecsv_texts(columns)
    table = astropy_table(columns)
    table.meta |= {**({"name": label.table} if label.table else {}), **label.origin}
    table.write(path, format="ascii.ecsv", overwrite=True)


def astropy_table(columns: list[NumpyColumn]) -> Table:
    """Return columns as an astropy table."""
    from astropy.table import Table

    table = Table()
    for column in columns:
        table[column.name] = _astropy_column(column)
    return table


def _astropy_column(column: NumpyColumn) -> Any:
    from astropy.table import Column, MaskedColumn

    facts = column.facts
    values: Any = column.values
    if column.is_text:
        values = values.astype(np.str_)
    elif column.offsets is not None:
        values = column.lists()
    said = {
        "unit": unit_text(column.name, facts.get("unit"), "generic"),
        "description": facts.get("description"),
        "meta": {"ucd": facts["ucd"]} if "ucd" in facts else None,
    }
    has_empty = column.is_text and bool(np.any((values == "") & ~column.is_null))
    if not column.is_null.any() and not has_empty:
        return Column(values, **said)
    masked = MaskedColumn(values, mask=column.is_null, **said)
    if has_empty:
        # Readers interpret an empty cell as null, unless the mask is a separate column.
        masked.info.serialize_method["ecsv"] = "data_mask"
    return masked


def _check_ecsv_texts(columns: list[NumpyColumn]) -> None:
    """Refuse texts that a reader would misread as the end of a line or as a comment."""
    for index, column in enumerate(columns):
        for text in [column.name, *(column.values if column.is_text else ())]:
            if _BREAKS.search(text) or (index == 0 and text.startswith("#")):
                problem = (
                    f": readers of ECSV would misread the text {text!r} there; take the character"
                )
                raise column_error(column.name, f"{problem} out, or choose another format", text)


def write_npz(batches: pa.RecordBatchReader, path: Path, label: Label) -> None:
    """Write a table as an npz file, which cannot store a label."""
    columns = _arrays(batches, "npz")
    # Do not use numpy.savez: a column named "file" would be its own argument.
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for column in columns:
            values = _fixed_texts(column) if column.is_text else column.values
            add_array(archive, column.name, values)
            if column.offsets is not None:
                add_array(archive, f"{column.name}.offsets", column.offsets)
            if column.is_null.any():
                add_array(archive, f"{column.name}.is_null", column.is_null)


def _to_numpy(values: pa.Array) -> NDArray[Any]:
    if pa.types.is_string(values.type):
        return np.array(pc.fill_null(values, "").to_pylist(), dtype=np.object_)
    if pa.types.is_floating(values.type):
        return np.asarray(values.to_numpy(zero_copy_only=False))
    nothing = False if pa.types.is_boolean(values.type) else 0
    return np.asarray(pc.fill_null(values, nothing).to_numpy(zero_copy_only=False))


def _arrays(batches: pa.RecordBatchReader, file_format: str) -> list[NumpyColumn]:
    columns = numpy_columns(batches.read_all(), signed=file_format == "fits")
    check_names([column.name for column in columns], file_format)
    return columns


def _fixed_texts(column: NumpyColumn) -> NDArray[np.str_]:
    for text in column.values:
        if text.endswith("\0"):
            problem = (
                f": numpy would lose the end of the text {text!r}; take the null character out"
            )
            raise column_error(column.name, f"{problem}, or choose another format", text)
    return column.values.astype(np.str_)


def add_array(archive: zipfile.ZipFile, name: str, values: NDArray[Any]) -> None:
    """Add an array to an npz file; the same array gives the same bytes."""
    if len(f"{name}.npy".encode()) > _ENTRY_NAME_BYTES:
        raise SchemaError(
            f"column {name[:20]}... has a name of {len(name)} letters, which is too long for npz",
            field=name,
            hint="rename it with AS",
        )
    if f"{name}.npy" in archive.namelist():
        raise column_error(
            name,
            ": the file has an array of that name already, for a column's lists "
            "or nulls; rename the column with AS",
        )
    # An entry opened by its name is dated 1980, so that the bytes are the same every time.
    with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
        np.lib.format.write_array(stream, np.asarray(values, order="C"), allow_pickle=False)
