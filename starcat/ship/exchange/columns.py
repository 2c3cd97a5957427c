"""Convert columns of any query to the few types that files of other tools support.

Products have numbers, texts, truth values and lists of them. A query can give more: dates,
decimals, records. These are converted to a plainer type if possible, otherwise refused by name.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain, islice

import pyarrow as pa
import pyarrow.compute as pc

from starcat.errors import SchemaError

STEP_ROWS = 1 << 14
STEP_BYTES = 8 << 20

_LISTS = (
    pa.ListType, pa.LargeListType, pa.FixedSizeListType, pa.ListViewType, pa.LargeListViewType
)  # fmt: skip
_CASTS = {
    "interval": "epoch(column) for seconds",
    "duration": "epoch(column) for seconds",
    "binary": "hex(column) for text",
    "map": "map_entries(column) for a list of records",
    "union": "one of its types",
}


@dataclass(frozen=True)
class Label:
    """Facts about a whole table in its file; unknown facts are empty."""

    table: str = ""  # name of the product, or of the file that was exported
    database: str = ""  # the database of the product
    version: str = ""

    @property
    def origin(self) -> dict[str, str]:
        """Database and version, if they are known."""
        texts = {"artifact": self.database, "version": self.version}
        return {name: text for name, text in texts.items() if text}


UNLABELLED = Label()


class FirstRows:
    """The first rows of a table that is read batch by batch, and whether there were more.

    To find out, the batches must contain at least `count` + 1 rows. With None all rows are
    returned; with 0 nothing is read.
    """

    def __init__(self, batches: pa.RecordBatchReader, count: int | None) -> None:
        self._batches = batches
        self._rows_left = count
        self.were_more = count == 0

    def __iter__(self) -> Iterator[pa.RecordBatch]:
        """Yield the batches; `were_more` is valid after the last one."""
        if self.were_more:
            return
        for batch in self._batches:
            part = batch.slice(0, self._rows_left)
            self.were_more = part.num_rows < batch.num_rows
            yield part
            if self.were_more:
                return
            if self._rows_left is not None:
                self._rows_left -= part.num_rows

    def reader(self) -> pa.RecordBatchReader:
        """Return the rows as a reader."""
        return pa.RecordBatchReader.from_batches(self._batches.schema, iter(self))


def steps(batches: Iterable[pa.RecordBatch]) -> Iterator[pa.RecordBatch]:
    """Yield the rows in steps whose text fits into memory, for batches of any size."""
    for batch in batches:
        per_row = max(1, batch.nbytes // max(1, batch.num_rows))
        rows = min(STEP_ROWS, max(1, STEP_BYTES // per_row))
        for start in range(0, batch.num_rows, rows):
            yield batch.slice(start, rows)


def begun(batches: pa.RecordBatchReader) -> pa.RecordBatchReader:
    """Return a reader after reading its first batch, so that errors occur now."""
    first = list(islice(batches, 1))
    return pa.RecordBatchReader.from_batches(batches.schema, chain(first, batches))


def column_error(name: str, predicate: str, value: object = None) -> SchemaError:
    """Return the error for a column; `predicate` follows its name in the message."""
    return SchemaError(f"column {name!r}{predicate}", field=name, found=value)


def plain_schema(schema: pa.Schema) -> pa.Schema:
    """Return a schema with plain types; SchemaError advises a cast for other types."""
    twice = [name for name, times in Counter(schema.names).items() if times > 1]
    if twice:
        raise column_error(
            twice[0], " is there twice; give one of them another name with AS", schema.names
        )
    return pa.schema([f.with_type(_plain(f.type, f.name)) for f in schema], schema.metadata)


def plain_batch(batch: pa.RecordBatch, schema: pa.Schema) -> pa.RecordBatch:
    """Return a batch with the types of a plain schema."""
    columns = [
        column if column.type == field.type else column.cast(field.type)
        for column, field in zip(batch.columns, schema, strict=True)
    ]
    return pa.RecordBatch.from_arrays(columns, schema=schema)


def described(
    batches: pa.RecordBatchReader, facts: Iterable[dict[str, str] | None]
) -> pa.RecordBatchReader:
    """Return rows with new facts in the metadata of fields; None keeps a field unchanged."""
    schema = pa.schema(
        field if metadata is None else field.with_metadata(metadata)
        for field, metadata in zip(batches.schema, facts, strict=True)
    )
    rows = (pa.record_batch(batch.columns, schema=schema) for batch in batches)
    return pa.RecordBatchReader.from_batches(schema, rows)


def field_facts(field: pa.Field) -> dict[str, str]:
    """Return ``unit``, ``description`` and ``ucd`` of a field, if its metadata has them."""
    metadata = field.metadata or {}
    return {
        key: metadata[key.encode()].decode()
        for key in ("unit", "description", "ucd")
        if metadata.get(key.encode())
    }


def check_names(names: Iterable[str], file_format: str) -> None:
    """Refuse a column without a name, which only text formats and Parquet can hold."""
    for number, name in enumerate(names, start=1):
        if not name:
            raise SchemaError(
                f"column {number} has an empty name, which {file_format} cannot hold",
                field=name,
                hint="give it one with AS",
            )


def unit_text(name: str, unit: str | None, standard: str) -> str | None:
    """Return the unit of a column in the spelling of a standard: generic, fits or vounit.

    The units of our schemas are plain, such as ``mas/yr``.
    """
    if not unit:
        return None
    from astropy import units

    try:
        return str(units.Unit(unit).to_string(standard))
    except (ValueError, TypeError) as error:
        raise column_error(
            name,
            f": unit {unit!r} does not exist in {standard}; "
            "correct the unit, or export to CSV or JSON",
            unit,
        ) from error


def is_list(kind: pa.DataType) -> bool:
    """Return whether a plain type is a list."""
    return bool(pa.types.is_list(kind))


def is_numeric_column(kind: pa.DataType) -> bool:
    """Return whether a type is an integer or a floating-point number."""
    return bool(pa.types.is_integer(kind) or pa.types.is_floating(kind))


def time_texts(values: pa.Array) -> pa.Array:
    """Return dates and times as ISO 8601 text, in UTC if they have a time zone."""
    if pa.types.is_timestamp(values.type):
        if values.type.tz is not None:
            values = values.cast(pa.timestamp(values.type.unit, "UTC"))
        return pc.replace_substring(values.cast(pa.string()), " ", "T", max_replacements=1)
    return values.cast(pa.string())


def _plain(kind: pa.DataType, name: str) -> pa.DataType:
    if isinstance(kind, pa.BaseExtensionType):
        return _plain(kind.storage_type, name)
    if pa.types.is_dictionary(kind):
        return _plain(kind.value_type, name)
    if pa.types.is_null(kind) or pa.types.is_large_string(kind) or pa.types.is_string_view(kind):
        return pa.string()
    if pa.types.is_float16(kind):
        return pa.float32()
    if pa.types.is_struct(kind):
        return pa.struct([f.with_type(_plain(f.type, f"{name}.{f.name}")) for f in kind])
    if isinstance(kind, _LISTS):
        item = kind.value_field
        return pa.list_(item.with_type(_plain(item.type, name)))
    for word, way_out in _CASTS.items():
        if word in str(kind):
            raise column_error(
                name,
                f" is of type {kind}, which files cannot store; "
                f"select {way_out.replace('column', name)}",
                str(kind),
            )
    return kind
