"""Read the rows of tables in blocks: text, ECSV, IPAC, FITS, VOTable, Parquet and Arrow.

The format is recognised by the content. Text files, FITS, Parquet and Arrow are read in blocks.
astropy reads a VOTable or a compressed FITS file as a whole, which needs memory for all of it.
"""

from __future__ import annotations

import csv
import io
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import islice, pairwise, takewhile
from pathlib import Path
from typing import Any, BinaryIO, cast
from xml.parsers.expat import ExpatError

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pacsv
import pyarrow.parquet as pq
from numpy.typing import NDArray

from starcat.catalog.readers.blocks import DigestReader, open_input
from starcat.catalog.readers.records import MalformedRecord, Rows, TableColumn
from starcat.catalog.source_files import InputFile
from starcat.catalog.table_map import AnyMap, TableMap
from starcat.errors import StarcatError, quoted

BLOCK_ROWS, BLOCK_BYTES = 1 << 16, 1 << 22
HEAD_BYTES, SAMPLE_ROWS = 1 << 20, 1000
BLANKS = r"^(|null|NULL|nan|NaN|NAN|N/A|\\N|-{2,})$"
"""Texts that mean no value in any file. The CDS writes dashes; a single dash can be a sign."""

MINUS = "[\u2212\u2010-\u2013\ufe63\uff0d]"
"""Characters that typesetting makes of a minus sign before a number."""

FORMATS = "CSV, ECSV, IPAC, FITS, VOTable, Parquet or Arrow"


@dataclass(frozen=True)
class OpenTable:
    """A table whose header was read."""

    form: str
    columns: dict[str, TableColumn]
    read: Callable[
        [Sequence[str]], Iterator[tuple[pa.Table, NDArray[np.int64] | None, list[MalformedRecord]]]
    ]

    def rows(self, names: Sequence[str]) -> Iterator[Rows]:
        """Read the columns of some names."""
        first = 1
        for table, number, problems in self.read(names):
            if number is None:
                number = np.arange(first, first + len(table))
            first += len(table)
            yield Rows(self.columns, table, number, problems)


def open_table(file: InputFile) -> OpenTable:
    """Read the header of a table."""
    try:
        raw, stream = open_input(file.path)
        with raw, stream:
            head = stream.read(HEAD_BYTES)
        how = next((how for magic, how in _OPENERS.items() if head.startswith(magic)), _open_text)
        opened = how(file, file.layout.table or ANY, head)
    except StarcatError:
        raise
    except _DAMAGE as error:
        raise damaged_table(file, error) from error
    if not opened.columns:
        raise file.error("has no column with one value per row; expected a table of stars")
    return opened


def read_tables(
    file: InputFile,
    choose_columns: Callable[[OpenTable], Sequence[str]],
    on_end: Callable[[DigestReader], None],
) -> Iterator[Rows]:
    """Read a table in at least one block of rows."""
    opened = open_table(file)
    names = choose_columns(opened)
    count = 0
    try:
        for rows in opened.rows(names):
            count += len(rows.number) + len(rows.problems)
            if len(rows.number) or rows.problems:
                yield rows
    except _DAMAGE as error:
        raise damaged_table(file, error) from error
    if not count:
        raise file.error(f"the table ({opened.form}) has no row; expected stars")
    buffer = memoryview(bytearray(1 << 20))
    with DigestReader(file.path) as raw:
        while raw.readinto(buffer):
            pass
        on_end(raw)


def damaged_table(file: InputFile, error: Exception) -> StarcatError:
    """Return the error for a table that a library cannot read."""
    if isinstance(error, UnicodeDecodeError):
        return file.error(
            f"byte {error.start + 1} is not {error.encoding}; if it is a text, state its "
            f"'encoding' in the map, such as latin-1, else expected {FORMATS}"
        )
    why = " ".join(str(error).split())[:200] or type(error).__name__
    return file.error(f"not a table that can be read ({why}); expected {FORMATS}. Get it again")


ANY = TableMap.model_validate(
    {
        "name": "any",
        "epoch": 2000,
        "columns": {"star_id": 0, "ra": 0, "dec": 0},
        "magnitudes": {"V": 0},
    }
)
"""The map for opening a table that has no map yet."""
_DAMAGE = (
    *(OSError, ValueError, KeyError, TypeError, IndexError, AttributeError, SyntaxError, EOFError),
    *(ExpatError, pa.ArrowException, csv.Error, LookupError),
)
_BLANK = re.compile(BLANKS)
_LEADING_MINUS = re.compile(f"^{MINUS}")
_Part = tuple[pa.Table, NDArray[np.int64] | None, list[MalformedRecord]]


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress astropy's warnings about the style of files."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def _no_columns(file: InputFile, table: int | str | None, names: Sequence[str]) -> StarcatError:
    which = "a table" if table is None else f"table {table!r}"
    return file.error(f"has no {which}; it has {', '.join(names) or 'none'}. Name one with 'table'")


def _serialized(lines: Sequence[str]) -> tuple[dict[str, TableColumn], dict[str, Any]]:
    """Return the columns in a YAML header, as astropy writes it, and the header."""
    from astropy.table.meta import YamlParseError, get_header_from_yaml

    try:
        header = get_header_from_yaml(lines)
    except YamlParseError as error:
        raise ValueError("its header in YAML is damaged") from error
    return {
        column["name"]: TableColumn(
            column["name"],
            str(column.get("datatype", "")) in ("string", "bool"),
            str(column.get("unit") or ""),
            str((column.get("meta") or {}).get("ucd", "")),
            str(column.get("description") or ""),
        )
        for column in header["datatype"]
    }, header


def _open_text(file: InputFile, how: AnyMap, head: bytes) -> OpenTable:
    text = head.decode(how.encoding, errors="replace" if len(head) == HEAD_BYTES else "strict")
    lines = text.removeprefix("\ufeff").splitlines()
    if "\0" in text:
        raise file.error(f"has an unknown format; expected {FORMATS}")
    if (ipac := _ipac_header(lines)) is not None:
        return _open_ipac(file, how, ipac)
    start = next((n for n, line in enumerate(lines) if line.strip() and line[0] != "#"), len(lines))
    described: dict[str, TableColumn] = {}
    delimiter = how.delimiter
    if lines and lines[0].startswith("# %ECSV"):
        comments = [line[2:] for line in lines[1:start]]
        described, header = _serialized(comments)
        delimiter = delimiter or header.get("delimiter", " ")
    first = lines[start] if start < len(lines) else ""
    if not first:
        raise file.error("the file is empty; expected a table of stars")
    delimiter = delimiter or max(",;\t|", key=first.count)
    names = list(how.names) or [
        name.strip() for name in next(csv.reader([first], delimiter=delimiter))
    ]
    units, after = _lines_below(lines[start + 1 : start + 3], delimiter, len(names))
    _check_names(file, names, has_header=not how.names)
    options = _TextOptions(start, after, delimiter, names, how)
    below = io.StringIO("\n".join(lines[start + (not how.names) + after :]))
    sample = list(islice(csv.reader(below, delimiter=delimiter), SAMPLE_ROWS))
    columns = {}
    for index, name in enumerate(names):
        values = [row[index].strip() for row in sample if len(row) > index]
        plain = _sampled(TableColumn(name, unit=units[index].strip() if units else ""), values)
        columns[name] = described.get(name, plain)
    form = "ECSV" if described else "text"
    if not sample:
        return OpenTable(form, columns, lambda _: iter(()))
    return OpenTable(form, columns, lambda requested: options.read(file, requested))


def _sampled(column: TableColumn, values: Sequence[str]) -> TableColumn:
    """Return a column of texts, which states whether its first values are numbers."""
    present = [value for value in values if not _BLANK.match(value) and value != "-"]
    has_numbers = any(map(_is_number, present))
    is_text = not all(map(_is_number, present)) or (not present and "-" in values)
    return replace(column, is_text=is_text, has_numbers=has_numbers)


def _lines_below(lines: Sequence[str], delimiter: str, count: int) -> tuple[list[str], int]:
    """Return the units, and the number of VizieR's lines between header and first row."""
    rows = [line.split(delimiter) for line in lines]
    if len(rows) == 2 and len(rows[1]) == count and all(set(x) == {"-"} for x in rows[1]):
        return rows[0], 2
    return [], 0


def _check_names(file: InputFile, names: Sequence[str], *, has_header: bool) -> None:
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise file.error(
            f"two columns are called {', '.join(map(quoted, twice))}; rename one of each"
        )
    if has_header and 2 * sum(_is_number(name) for name in names) >= len(names):
        raise file.error(
            f"the first line has no names of columns but {quoted(', '.join(names))}; give them "
            "with 'names' in the map"
        )


def _is_number(text: str) -> bool:
    try:
        float(_LEADING_MINUS.sub("-", text))
    except ValueError:
        return False
    return True


@dataclass(frozen=True)
class _TextOptions:
    """Options for reading a text file."""

    skipped: int  # lines before the header
    after: int  # lines between the header and the first row
    delimiter: str
    names: list[str]
    how: AnyMap

    def read(self, file: InputFile, requested: Sequence[str]) -> Iterator[_Part]:
        """Read columns as texts, in blocks; lines with another number of fields are problems."""
        bad: list[MalformedRecord] = []

        def note(row: pacsv.InvalidRow) -> str:
            number = (row.number or 0) - before
            actual, expected = f"{row.actual_columns}", f"{row.expected_columns}"
            bad.append(MalformedRecord(number, "fields", None, actual, expected, what="row"))
            return "skip"

        before = self.skipped + self.after + (0 if self.how.names else 1)
        raw, stream = open_input(file.path)
        with raw, stream:
            reading = self._begin(stream, requested, note)
            first, n_reported = 1, 0
            for batch in reading:
                table = pa.Table.from_batches([batch])
                number, first = self._numbers(first, len(table), [problem.line for problem in bad])
                now = [problem for problem in bad[n_reported:] if problem.line < first]
                n_reported += len(now)
                yield table, number, now
            if bad[n_reported:]:
                none = pa.Table.from_batches([], reading.schema)
                yield none, np.empty(0, np.int64), bad[n_reported:]

    def _begin(
        self, stream: io.BufferedIOBase, requested: Sequence[str], note: Callable[[Any], str]
    ) -> pacsv.CSVStreamingReader:
        header = 0 if self.how.names else 1
        skipped = self.skipped + header + self.after
        return pacsv.open_csv(
            pa.PythonFile(stream, "r"),
            pacsv.ReadOptions(
                use_threads=False, block_size=BLOCK_BYTES, skip_rows=skipped,
                column_names=self.names, encoding=self.how.encoding,
            ),
            pacsv.ParseOptions(delimiter=self.delimiter, invalid_row_handler=note),
            pacsv.ConvertOptions(
                column_types=dict.fromkeys(self.names, pa.string()),
                include_columns=list(requested), strings_can_be_null=False,
            ),
        )  # fmt: skip

    @staticmethod
    def _numbers(first: int, count: int, bad: Sequence[int]) -> tuple[NDArray[np.int64], int]:
        """Return the numbers of the next good rows, and the number of the row after them."""
        beyond = sorted(line for line in bad if line >= first)
        numbers = np.setdiff1d(np.arange(first, first + count + len(beyond)), beyond)[:count]
        return numbers, int(numbers[-1]) + 1 if count else first


@dataclass(frozen=True)
class _IpacHeader:
    """The lines of an IPAC table that begin with ``|``: names, types, units, texts of nulls."""

    columns: list[TableColumn]
    fields: list[slice]  # characters of the columns
    nulls: list[str]
    lines: int  # lines up to the first row


_IPAC_NUMBERS = ("integer", "long", "double", "float", "real")
_IPAC_TYPES = (*_IPAC_NUMBERS, "char", "date")  # can be shortened: d, int
MAX_IPAC_LINES = 4


def _ipac_header(lines: Sequence[str]) -> _IpacHeader | None:
    """Return the header of an IPAC table; None for another text.

    References
    ----------
    https://irsa.ipac.caltech.edu/applications/DDGEN/Doc/ipac_tbl.html
    """
    start = next((n for n, line in enumerate(lines) if not line.startswith("\\")), len(lines))
    head = list(takewhile(lambda line: line.startswith("|"), lines[start : start + 5]))
    # If rows begin with the delimiter, too, the text is of another kind.
    if not 1 <= len(head) <= MAX_IPAC_LINES or not head[0].rstrip().endswith("|"):
        return None
    bars = [n for n, sign in enumerate(head[0]) if sign == "|"]
    fields = [slice(first + 1, last) for first, last in pairwise(bars)]
    cells = [[line[field].strip() for field in fields] for line in head]
    kinds = cells[1] if len(cells) > 1 else []
    if not all(
        any(type_name.startswith(kind.lower()) for type_name in _IPAC_TYPES) for kind in kinds
    ):
        return None
    names, kinds, units, nulls = cells + [[""] * len(fields)] * (MAX_IPAC_LINES - len(cells))
    columns = [
        TableColumn(
            name, not any(type_name.startswith(kind.lower()) for type_name in _IPAC_NUMBERS), unit
        )
        for name, kind, unit in zip(names, kinds, (u.strip("-") for u in units), strict=True)
    ]
    if len(head) == 1:  # without types
        rows = [line for line in lines[start + 1 :][:SAMPLE_ROWS] if _is_ipac_row(line)]
        columns = [
            _sampled(column, [row[field].strip() for row in rows])
            for column, field in zip(columns, fields, strict=True)
        ]
    return _IpacHeader(columns, fields, nulls, start + len(head))


def _open_ipac(file: InputFile, how: AnyMap, header: _IpacHeader) -> OpenTable:
    columns = header.columns
    names = [column.name for column in columns]
    _check_names(file, names, has_header=True)

    def read(requested: Sequence[str]) -> Iterator[_Part]:
        raw, stream = open_input(file.path)
        with raw, stream, io.TextIOWrapper(cast(BinaryIO, stream), how.encoding) as text:
            lines = (line for line in islice(text, header.lines, None) if _is_ipac_row(line))
            while block := list(islice(lines, BLOCK_ROWS)):
                yield _ipac_rows(header, names, requested, block), None, []

    return OpenTable("IPAC", dict(zip(names, columns, strict=True)), read)


def _is_ipac_row(line: str) -> bool:
    return bool(line.strip()) and not line.startswith("\\")


def _ipac_rows(
    header: _IpacHeader, names: Sequence[str], requested: Sequence[str], lines: Sequence[str]
) -> pa.Table:
    arrays = {}
    for name in requested:
        field, null = header.fields[names.index(name)], header.nulls[names.index(name)]
        texts = (line[field].strip() for line in lines)
        values = [None if text == null else text for text in texts] if null else list(texts)
        arrays[name] = pa.array(values, pa.string())
    return _table(arrays, len(lines))


def _open_fits(file: InputFile, how: AnyMap, _: bytes) -> OpenTable:
    from astropy.io import fits

    with _quiet(), fits.open(file.path, memmap=True) as hdus:
        tables = {
            n: hdu
            for n, hdu in enumerate(hdus)
            if isinstance(hdu, fits.BinTableHDU | fits.TableHDU)
        }
        names = [f"{n} {hdu.name}".strip() for n, hdu in tables.items()]
        numbers = [
            n for n, hdu in tables.items() if how.table is None or how.table in (n, hdu.name)
        ]
        if not numbers:
            raise _no_columns(file, how.table, names)
        hdu = tables[numbers[0]]
        columns = {}
        for column in hdu.columns:
            kind, width = column.dtype.base.kind, column.dtype.shape
            if not width and kind in "biufSU":
                ucd = str(
                    hdu.header.get(f"TUCD{list(hdu.columns.names).index(column.name) + 1}", "")
                )
                columns[column.name] = TableColumn(
                    column.name, column.format.endswith("A") or kind in "SU", column.unit or "", ucd
                )
    return OpenTable(
        "FITS", columns, lambda requested: _read_fits(file.path, numbers[0], requested)
    )


def _read_fits(path: Path, number: int, requested: Sequence[str]) -> Iterator[_Part]:
    from astropy.io import fits

    with fits.open(path, memmap=True) as hdus:
        with _quiet():
            data, columns = hdus[number].data, hdus[number].columns
        for start in range(0, len(data), BLOCK_ROWS):
            part = data[start : start + BLOCK_ROWS]
            arrays = {}
            for name in requested:
                is_null = _fits_nulls(part, name, columns[name].null)
                arrays[name] = _arrow(np.asarray(part[name]), is_null)
            yield _table(arrays, len(part)), None, []


def _fits_nulls(part: NDArray[Any], name: str, null: int | str | None) -> NDArray[np.bool_] | None:
    """Return the mask of rows whose stored value is TNULL; None for a column without TNULL.

    TNULL is compared with the values as they are stored: before TSCAL and TZERO, and in a table of
    characters before astropy turns null values into zeros.
    """
    if null is None:
        return None
    stored = part.view(np.ndarray)[name]
    if stored.dtype.kind == "S":
        return np.asarray(np.char.strip(stored) == str(null).strip().encode("latin-1"))
    return np.asarray(stored == null) if isinstance(null, int) else None


def _arrow(values: NDArray[Any], is_blank: NDArray[np.bool_] | None = None) -> pa.Array:
    if values.dtype.kind == "S":
        values = np.char.decode(values, "latin-1")
    if values.dtype.kind in "UO":
        return pa.array([str(value).strip() for value in values], pa.string(), mask=is_blank)
    return pa.array(values.astype(values.dtype.newbyteorder("=")), mask=is_blank)


def _table(arrays: dict[str, pa.Array], count: int) -> pa.Table:
    return pa.table(arrays) if arrays else pa.table({"": pa.nulls(count)})


def _open_votable(file: InputFile, how: AnyMap, _: bytes) -> OpenTable:
    from astropy.io.votable import parse

    with _quiet():
        tables = list(parse(file.path, verify="ignore").iter_tables())
    names = [str(table.ID or table.name or n) for n, table in enumerate(tables)]
    matching = [t for n, t in enumerate(tables) if how.table is None or how.table in (n, names[n])]
    if not matching:
        raise _no_columns(file, how.table, names)
    content = matching[0].to_table(use_names_over_ids=True)
    columns = {}
    for field, shown in zip(matching[0].fields, content.colnames, strict=True):
        if content[shown].ndim == 1:
            is_text = field.datatype in ("char", "unicodeChar")
            meaning = (field.ucd or "", " ".join(str(field.description or "").split()))
            columns[shown] = TableColumn(shown, is_text, str(field.unit or ""), *meaning)

    def read(requested: Sequence[str]) -> Iterator[_Part]:
        for start in range(0, len(content), BLOCK_ROWS):
            part = content[start : start + BLOCK_ROWS]
            arrays = {
                name: _arrow(np.asarray(part[name]), np.ma.getmaskarray(np.ma.asarray(part[name])))
                for name in requested
            }
            yield _table(arrays, len(part)), None, []

    return OpenTable("VOTable", columns, read)


def _arrow_columns(schema: pa.Schema) -> dict[str, TableColumn]:
    """Return the columns with one value per row, with their metadata of astropy or of the field."""
    by_name: dict[str, TableColumn] = {}
    described = (schema.metadata or {}).get(b"table_meta_yaml")
    if described:
        by_name, _ = _serialized(described.decode().splitlines())
    columns = {}
    for field in schema:
        kind = field.type.value_type if pa.types.is_dictionary(field.type) else field.type
        more = {key.decode(): value.decode() for key, value in (field.metadata or {}).items()}
        is_text = (
            pa.types.is_string(kind) or pa.types.is_large_string(kind) or pa.types.is_binary(kind)
        )
        if is_text or pa.types.is_primitive(kind) or pa.types.is_decimal(kind):
            stated = by_name.get(field.name) or TableColumn(field.name)
            columns[field.name] = TableColumn(
                field.name, is_text, more.get("unit", stated.unit), more.get("ucd", stated.ucd),
                more.get("description", stated.description),
            )  # fmt: skip
    return columns


def _plain(batch: pa.RecordBatch) -> pa.Table:
    arrays = []
    for column in batch.columns:
        kind = column.type.value_type if pa.types.is_dictionary(column.type) else column.type
        is_text = pa.types.is_large_string(kind) or pa.types.is_binary(kind)
        if pa.types.is_decimal(kind):
            # Other systems export whole numbers of 64 bits, which doubles would round, like this.
            target_type = pa.string() if kind.scale == 0 else pa.float64()
        else:
            target_type = pa.string() if is_text else kind
        arrays.append(pc.cast(column, target_type))
    return pa.Table.from_arrays(arrays, names=batch.schema.names)


def _open_parquet(file: InputFile, _: AnyMap, __: bytes) -> OpenTable:
    with pq.ParquetFile(file.path) as parquet:
        columns = _arrow_columns(parquet.schema_arrow)

    def read(requested: Sequence[str]) -> Iterator[_Part]:
        with pq.ParquetFile(file.path) as opened:
            for batch in opened.iter_batches(
                BLOCK_ROWS, columns=list(requested), use_threads=False
            ):
                yield _plain(batch), None, []

    return OpenTable("Parquet", columns, read)


def _open_arrow(file: InputFile, _: AnyMap, head: bytes) -> OpenTable:
    begin = pa.ipc.open_file if head.startswith(b"ARROW1") else pa.ipc.open_stream
    with pa.memory_map(str(file.path)) as source:
        columns = _arrow_columns(begin(source).schema)

    def read(requested: Sequence[str]) -> Iterator[_Part]:
        with pa.memory_map(str(file.path)) as source:
            reader = begin(source)
            count = getattr(reader, "num_record_batches", None)
            every = reader if count is None else (reader.get_batch(n) for n in range(count))
            for batch in every:
                for start in range(0, len(batch), BLOCK_ROWS):
                    yield _plain(batch.slice(start, BLOCK_ROWS).select(list(requested))), None, []

    return OpenTable("Arrow", columns, read)


_OPENERS: dict[bytes, Callable[[InputFile, AnyMap, bytes], OpenTable]] = {
    b"SIMPLE  =": _open_fits,
    b"<?xml": _open_votable,
    b"<VOTABLE": _open_votable,
    b"PAR1": _open_parquet,
    b"ARROW1": _open_arrow,
    b"\xff\xff\xff\xff": _open_arrow,
}
