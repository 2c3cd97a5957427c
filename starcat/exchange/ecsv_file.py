"""Tables as ECSV 1.0: text with a header that says types, units and meanings."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from starcat.errors import SchemaError
from starcat.exchange.label import UNLABELLED, Label
from starcat.exchange.numpy_columns import NumpyColumn
from starcat.exchange.units import unit_text

if TYPE_CHECKING:
    from astropy.table import Table

_BREAKS = re.compile(r"\0|[^\S \t\n]")
"""White space that is neither blank, tab nor newline: Python ends lines at most of it."""


def write_ecsv(columns: list[NumpyColumn], path: Path, label: Label = UNLABELLED) -> None:
    """Write columns as ECSV."""
    _check_texts(columns)
    table = astropy_table(columns)
    table.meta |= {**({"name": label.table} if label.table else {}), **label.origin}
    table.write(path, format="ascii.ecsv", overwrite=True)


def astropy_table(columns: list[NumpyColumn]) -> Table:
    """Return columns as an astropy table."""
    from astropy.table import Table

    table = Table()
    for column in columns:
        table[column.name] = _column(column)
    return table


def _column(column: NumpyColumn) -> Any:
    from astropy.table import Column, MaskedColumn

    facts = column.facts
    values: Any = column.values
    if column.is_text:
        values = values.astype(np.str_)
    elif column.offsets is not None:
        values = np.empty(len(column.is_null), dtype=np.object_)
        values[:] = column.lists()
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
        # An empty cell means null to readers, unless the mask is a column of its own.
        masked.info.serialize_method["ecsv"] = "data_mask"
    return masked


def _check_texts(columns: list[NumpyColumn]) -> None:
    """Refuse texts that a reader would take for the end of a line, or for a comment."""
    for place, column in enumerate(columns):
        for text in [column.name, *(column.values if column.is_text else ())]:
            if _BREAKS.search(text) or (place == 0 and text.startswith("#")):
                raise SchemaError(
                    f"column {column.name!r}: readers of ECSV would misread the text {text!r} "
                    "there; take the character out, or choose another format",
                    field=column.name,
                    found=text,
                )
