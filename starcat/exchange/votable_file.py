"""Tables as VOTable 1.4, rows as text: exact for every number, and readable by every tool."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from starcat.errors import SchemaError
from starcat.exchange.label import UNLABELLED, Label
from starcat.exchange.numpy_columns import NumpyColumn
from starcat.exchange.units import unit_text

_DATATYPES = {
    "b": "boolean",
    "u1": "unsignedByte",
    "i2": "short",
    "i4": "int",
    "i8": "long",
    "f4": "float",
    "f8": "double",
}
_ICRS = "starcat.icrs"
"""What columns refer to the coordinate system by; no column can be named so in a product."""

_NOT_XML = re.compile("[^\t\n -\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that no XML 1.0 document can hold, and the carriage return, which readers change."""


def write_votable(
    columns: list[NumpyColumn], rows: int, path: Path, label: Label = UNLABELLED
) -> None:
    """Write columns as a VOTable.

    Parameters
    ----------
    columns : list of NumpyColumn
        With integers that VOTable has.
    rows : int
        Number of rows.
    path : Path
        Overwritten if it exists.
    label : Label
        The table's name; its artifact and version become ``INFO`` elements.

    Raises
    ------
    SchemaError
        If a text or unit cannot be said in XML.
    """
    from astropy.io.votable.tree import CooSys, Info, Resource, TableElement, VOTableFile

    file = VOTableFile(version="1.4")
    resource = Resource()
    # The identifiers of columns are their names, so that of the table is none of theirs.
    table = TableElement(file, ID="starcat.table", name=label.table or None)
    for name, text in label.origin.items():
        resource.infos.append(Info(ID=f"starcat.{name}", name=name, value=text))
    if any(map(_is_place, columns)):
        resource.coordinate_systems.append(CooSys(ID=_ICRS, system="ICRS", epoch=_epoch(columns)))
    file.resources.append(resource)
    resource.tables.append(table)
    for column in columns:
        table.fields.append(_field(file, column))
    table.create_arrays(rows)
    for place, column in zip(table.array.dtype.names or (), columns, strict=True):
        table.array.data[place] = _cells(column)
        table.array.mask[place] = column.is_null
    with path.open("wb") as stream:
        file.to_xml(stream, tabledata_format="tabledata")


def _field(file: Any, column: NumpyColumn) -> Any:
    from astropy.io.votable.tree import Field

    datatype = "unicodeChar" if column.is_text else _DATATYPES[_code(column)]
    field = Field(
        file,
        name=column.name,
        datatype=datatype,
        arraysize="*" if column.is_text or column.offsets is not None else None,
        unit=unit_text(column, "vounit"),
        ucd=column.facts.get("ucd"),
        ref=_ICRS if _is_place(column) else None,
    )
    field.description = column.facts.get("description")
    return field


def _is_place(column: NumpyColumn) -> bool:
    """Return whether a column is a coordinate or a motion on the sky, which have a frame."""
    ucd = column.facts.get("ucd", "")
    return ucd.startswith(("pos.eq.", "pos.cartesian.", "pos.pm"))


def _epoch(columns: list[NumpyColumn]) -> str | None:
    """Return the epoch of the positions, where it is the same in every row."""
    for column in columns:
        if column.name == "epoch_jyear" and column.values.dtype.kind == "f" and len(column.values):
            epochs = column.values[~column.is_null]
            if len(epochs) and (epochs == epochs[0]).all():
                return f"J{epochs[0]:g}"
    return None


def _code(column: NumpyColumn) -> str:
    return column.values.dtype.str[1:].replace("b1", "b")


def _cells(column: NumpyColumn) -> Any:
    if column.is_text:
        for text in column.values:
            if _NOT_XML.search(text):
                raise SchemaError(
                    f"column {column.name!r}: the text {text!r} has a character that XML cannot "
                    "hold; take it out, or choose another format than votable",
                    field=column.name,
                    found=text,
                )
        return column.values
    if column.offsets is None:
        return column.values
    cells = np.empty(len(column.is_null), dtype=np.object_)
    cells[:] = [np.ma.masked_array(items) for items in column.lists()]
    return cells
