"""Tables in every format that starcat writes, and what other tools find in them."""

from __future__ import annotations

import csv
import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from astropy import units
from astropy.io.votable import parse
from astropy.table import Table

from starcat.ship.exchange.formats import FILE_FORMATS, FORMATS
from starcat.ship.exchange.writers import result_chunks, write_batches

SERVED = {"votable/b2": FORMATS["votable"], "tsv": FORMATS["tsv"]}
"""What no file is written in: answers of the service."""

EVERY_FORMAT = (*FILE_FORMATS, *SERVED)
VOTABLES = ("votable", "votable/b2")
ASTROPY = (*VOTABLES, "fits", "ecsv")
Columns = dict[str, list[Any]]


def written(table: pa.Table, folder: Path, form: str, rows_a_batch: int = 1000) -> Path:
    """Write a table in batches of this many rows, and return its path."""
    path = folder / f"table{SERVED.get(form, FORMATS.get(form)).suffix}"  # type: ignore[union-attr]
    reader = pa.RecordBatchReader.from_batches(table.schema, table.to_batches(rows_a_batch))
    if form in SERVED:
        path.write_bytes(b"".join(result_chunks(reader, SERVED[form], folder)))
    else:
        assert write_batches(reader, path, form) == len(table)
    assert [entry.name for entry in folder.iterdir() if "partial" in entry.name] == []
    return path


def is_nothing(value: Any) -> bool:
    return value is None or (isinstance(value, float) and math.isnan(value))


def plain(value: Any) -> Any:
    """A value as a Python object, with None for masked values."""
    if np.ma.is_masked(value) and not isinstance(value, np.ma.MaskedArray):
        return None
    if isinstance(value, np.ma.core.MaskedConstant):
        return None
    if isinstance(value, np.ndarray):
        return [plain(item) for item in value]
    return value.item() if isinstance(value, np.generic) else value


def column_of(table: Table, name: str) -> list[Any]:
    masked = np.ma.getmaskarray(table[name]) if hasattr(table[name], "mask") else ()
    values = [plain(value) for value in table[name]]
    # The mask of an object column is separate from its values.
    return [None if k < len(masked) and masked[k] else value for k, value in enumerate(values)]


def shortest(kind: pa.DataType, value: Any) -> Any:
    """A value of 4 bytes as the shortest decimal number that means it, others as they are."""
    if pa.types.is_list(kind):
        return None if value is None else [shortest(kind.value_type, item) for item in value]
    known = kind == pa.float32() and not is_nothing(value)
    return float(str(np.float32(value))) if known else value


def same(found: Any, wanted: Any) -> bool:
    if isinstance(wanted, list):
        return len(found) == len(wanted) and all(map(same, found, wanted))
    if is_nothing(found) or is_nothing(wanted):
        return is_nothing(found) and is_nothing(wanted)
    return bool(found == wanted)


def finite(value: Any) -> Any:
    """A value as JSON has it."""
    if isinstance(value, list):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def expected_in(file_format: str, kind: pa.DataType, value: Any) -> Any:
    """What a format makes of a value of Arrow: the losses that docs/formats.md names."""
    if file_format == "tsv" and pa.types.is_string(kind):
        return re.sub("[\t\r\n]", " ", value or "")
    if file_format in ("csv", "tsv", "json"):
        value = shortest(kind, value)
        return finite(value) if file_format == "json" or isinstance(value, list) else value
    if pa.types.is_list(kind) and file_format in ASTROPY:
        items = [] if value is None else value
        if value is None and file_format in ("ecsv", "votable/b2"):
            return None
        if file_format == "votable" and kind.value_type == pa.float32():
            # astropy reads the items of a list of them in 8 bytes, from their decimal digits.
            items = [shortest(pa.float32(), item) for item in items]
        return [expected_in(file_format, kind.value_type, item) for item in items]
    if pa.types.is_string(kind) and file_format in VOTABLES:
        # Of a text between tags, as of one in ECSV, astropy drops the blanks at both ends.
        return (value or "").strip() if file_format == "votable" else value or ""
    if pa.types.is_string(kind) and file_format == "ecsv":
        return value and value.strip()
    return value or None if pa.types.is_string(kind) and file_format == "fits" else value


def astropy_columns(path: Path) -> Columns:
    read = Table.read(path)
    if path.suffix == ".fits":
        read.convert_bytestring_to_unicode()
    return {name: column_of(read, name) for name in read.colnames}


def npz_columns(path: Path) -> Columns:
    found = {}
    with np.load(path, allow_pickle=False) as file:
        for name in [name for name in file.files if not name.endswith((".offsets", ".is_null"))]:
            values = file[name]
            if f"{name}.offsets" in file.files:
                ends = file[f"{name}.offsets"]
                values = np.split(values, ends[1:-1])[: len(ends) - 1]
            null = file.get(f"{name}.is_null", np.zeros(len(values), bool))
            found[name] = [None if n else plain(v) for v, n in zip(values, null, strict=True)]
    return found


def json_columns(path: Path) -> Columns:
    rows = json.loads(path.read_text(encoding="utf-8"))
    return {name: [row[name] for row in rows] for name in (rows[0] if rows else {})}


def csv_columns(path: Path) -> Columns:
    with path.open(encoding="utf-8", newline="") as stream:
        if path.suffix == ".tsv":
            names, *rows = (line.split("\t") for line in stream.read()[:-1].split("\n"))
        else:
            names, *rows = csv.reader(stream)
    return {name: [row[k] for row in rows] for k, name in enumerate(names)}


READERS: dict[str, Callable[[Path], Columns]] = {
    **dict.fromkeys(ASTROPY, astropy_columns),
    "parquet": lambda path: pq.read_table(path).to_pydict(),
    "npz": npz_columns,
    "json": json_columns,
    "csv": csv_columns,
    "tsv": csv_columns,
}


def cell_value(cell: str, like: Any) -> Any:
    if like is None:
        assert cell == ""
        return None
    return json.loads(cell) if isinstance(like, bool | list | dict) else type(like)(cell)


def check_read(table: pa.Table, path: Path, file_format: str) -> None:
    """A reader of the format finds the values, and the units if the format has units."""
    columns = READERS[file_format](path)
    if len(table) or file_format != "json":
        assert list(columns) == table.column_names
    for name, found in columns.items():
        kind = table.schema.field(name).type
        wanted = [expected_in(file_format, kind, value) for value in table[name].to_pylist()]
        if file_format in ("csv", "tsv"):
            found = list(map(cell_value, found, wanted))
        assert len(found) == len(wanted)
        wrong = [pair for pair in zip(found, wanted, strict=True) if not same(*pair)]
        assert not wrong, f"{name}: {wrong[:3]}"
    if file_format in ASTROPY:
        read = Table.read(path)
        for field in table.schema:
            unit = (field.metadata or {}).get(b"unit")
            assert read[field.name].unit == (units.Unit(unit.decode()) if unit else None)
    if file_format in VOTABLES:
        fields = parse(path, verify="exception").get_first_table().fields
        for field, again in zip(table.schema, fields, strict=True):
            said = {key.decode(): text.decode() for key, text in (field.metadata or {}).items()}
            assert (again.description, again.ucd) == (said.get("description"), said.get("ucd"))
