"""Tables that come with a query: VOTables of any serialisation to Parquet files.

astropy reads them. Before that, a pass over the XML refuses content that would make astropy fetch
something or take more memory than the size of the file explains.
"""

from __future__ import annotations

import re
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from starcat.errors import ConfigError, quoted
from starcat.query import identifier
from starcat.storage import ARROW_DATATYPES
from starcat_service.protocols.tables import UPLOADS, TapColumn, TapTable

MAX_COLUMNS = 1000

MAX_UNPACKED = 16  # largest size of an upload in memory, over its own size
MIN_UNPACKED_BYTES = 64 << 20

_BYTES = {
    "boolean": 1, "bit": 1, "unsignedByte": 1, "short": 2, "int": 4, "long": 8, "char": 1,
    "unicodeChar": 4, "float": 4, "double": 8, "floatComplex": 8, "doubleComplex": 16,
}  # fmt: skip


def upload_facts(path: str, name: str, folder: str) -> dict[str, Any]:
    """Write an uploaded table as a Parquet file, and describe it in JSON values."""
    _Inspection(Path(path), name).check()
    table = _parsed(Path(path), name)
    arrays, columns = [], []
    for array_name, field in zip(table.array.dtype.names, table.fields, strict=True):
        values = _arrow(table.array[array_name], field.name, name)
        if field.xtype == "timestamp":
            values = _times(values)
        kind = values.type
        is_list = pa.types.is_list(kind)
        datatype = ARROW_DATATYPES.get(kind.value_type if is_list else kind, "char")
        size = "*" if is_list or datatype in ("char", "unicodeChar") else ""
        arrays.append(values)
        description = " ".join(str(field.description or "").split())
        unit = str(field.unit) if field.unit is not None else ""
        columns.append(
            TapColumn(
                field.name, datatype, size, field.xtype or "", unit, field.ucd or "", description
            )
        )
    names = [column.name for column in columns]
    _check_names(names, name)
    pq.write_table(pa.table(arrays, names=names), Path(folder) / f"{name}.parquet")
    description = f"The uploaded table {name}"
    return asdict(TapTable(UPLOADS, name, tuple(columns), description, view=identifier(name)))


def table_of_facts(facts: dict[str, Any]) -> TapTable:
    """Return the table that `upload_facts` described."""
    columns = tuple(TapColumn(**column) for column in facts["columns"])
    return TapTable(**{**facts, "columns": columns, "keys": ()})


def _parsed(path: Path, name: str) -> Any:
    import warnings

    from astropy.io.votable import parse_single_table
    from astropy.io.votable.exceptions import W51

    try:
        with warnings.catch_warnings():
            # Small errors of other writers are no reason to refuse a table.
            warnings.simplefilter("ignore")
            # Except this one: astropy would replace the value by the largest integer.
            warnings.simplefilter("error", W51)
            with path.open("rb") as stream:
                table = parse_single_table(stream, verify="warn")
    except W51 as error:
        match = re.search(r"Value '(.{1,60}).*' is out of range for a (\S+)", str(error))
        what = f"{match[1]}, which a {match[2]} integer cannot hold" if match else str(error)
        raise _refusal(
            name, f"has the value {what}", "give its FIELD a wider datatype: long, double or char"
        ) from error
    except Exception as error:  # astropy can raise anything for a file of a user
        message = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
        raise _refusal(name, f"cannot be read as a VOTable ({message})") from error
    if not table.fields:
        raise _refusal(name, "has no columns")
    return table


def _arrow(values: Any, field: str, name: str) -> pa.Array:
    data = np.asarray(values.data if isinstance(values, np.ma.MaskedArray) else values)
    mask = np.ma.getmaskarray(values)
    if data.dtype.kind in "SUO" and not _is_list(data):
        is_null = mask if mask.ndim == 1 else mask.reshape(len(mask), -1).all(axis=1)
        texts = (None if value is None else _text(value) for value in data)
        return pa.array(texts, pa.string(), mask=is_null)
    if data.dtype.kind not in "biufO":
        raise _refusal(name, f"column {quoted(field)} has values of type {data.dtype}")
    if data.ndim > 1 or data.dtype.kind == "O":
        lists = [np.ma.filled(np.ma.asarray(row), 0).ravel() for row in data]
        item = pa.from_numpy_dtype(lists[0].dtype) if lists else pa.float64()
        return pa.array([row.tolist() for row in lists], pa.list_(_item(item)))
    array = pa.array(np.ascontiguousarray(data.astype(data.dtype.newbyteorder("="))), mask=mask)
    return array.cast(_item(array.type))


def _times(values: pa.Array) -> pa.Array:
    try:
        return values.cast(pa.timestamp("us"))
    except pa.ArrowInvalid:
        return values


def _item(kind: pa.DataType) -> pa.DataType:
    wider = {pa.int8(): pa.int16(), pa.uint16(): pa.int32(), pa.uint32(): pa.int64()}
    return wider.get(kind, kind)


def _is_list(data: Any) -> bool:
    """Return whether objects are arrays of numbers, not texts."""
    return data.dtype.kind == "O" and any(isinstance(value, np.ndarray) for value in data[:100])


def _text(value: object) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def _check_names(names: list[str], table: str) -> None:
    lower = [name.lower() for name in names]
    twice = next((name for name in names if lower.count(name.lower()) > 1), None)
    if twice is not None:
        raise _refusal(table, f"has two columns {quoted(twice)} (capitals make no difference)")


@dataclass
class _Inspection:
    """A pass over the XML of an upload, in little memory."""

    path: Path
    name: str
    width: int = 0
    fields: int = 0
    rows: int = 0
    stated_rows: int = 0

    def check(self) -> None:
        parser = expat.ParserCreate()
        parser.StartElementHandler = self._begin
        parser.EntityDeclHandler = self._refuse_entity
        try:
            with self.path.open("rb") as stream:
                parser.ParseFile(stream)
        # ValueError: an encoding of several bytes. LookupError: an unknown encoding.
        except (expat.ExpatError, ValueError, LookupError) as error:
            if isinstance(error, ConfigError):
                raise
            raise _refusal(self.name, f"is not readable XML ({error})") from error
        rows = max(self.rows, self.stated_rows)
        most = max(MIN_UNPACKED_BYTES, MAX_UNPACKED * self.path.stat().st_size)
        if rows * self.width > most:
            raise _refusal(
                self.name,
                f"says {rows:,} rows of {self.width:,} bytes, more than {MAX_UNPACKED} times its "
                "size; give fields an arraysize that fits",
            )

    def _begin(self, tag: str, attributes: dict[str, str]) -> None:
        tag = tag.rpartition(":")[2]
        if tag == "TR":
            self.rows += 1
        elif tag == "STREAM" and "href" in attributes:
            raise _refusal(self.name, "has its rows elsewhere (STREAM with href); put them inline")
        elif tag == "FIELD":
            self.fields += 1
            self.width += _width(attributes)
            if self.fields > MAX_COLUMNS:
                raise _refusal(self.name, f"has more than {MAX_COLUMNS} columns")
        elif tag == "TABLE":
            stated = attributes.get("nrows", "0")
            self.stated_rows += int(stated) if stated.isascii() and stated.isdigit() else 0

    def _refuse_entity(self, *_: object) -> None:
        raise _refusal(self.name, "declares an entity; write the text itself")


def _width(attributes: dict[str, str]) -> int:
    """Return the smallest number of bytes of a cell."""
    total = _BYTES.get(attributes.get("datatype", ""), 8)
    for part in attributes.get("arraysize", "1").rstrip("*").split("x"):
        if part.isascii() and part.isdigit():
            total *= max(1, int(part))
    return total


def _refusal(name: str, problem: str, advice: str = "send a VOTable") -> ConfigError:
    return ConfigError(f"UPLOAD {name}: the table {problem}", key="UPLOAD", hint=advice)
