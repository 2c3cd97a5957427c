"""Exports: tables in a format of other tools, one file a product, in a folder.

All files are written beside the folder first; only when each of them is whole do they get their
names. Formats without room for units get ``columns.csv`` beside them, which says what the
columns are.
"""

from __future__ import annotations

import csv
import filecmp
import io
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from starcat.errors import ConfigError, OutputError
from starcat.exchange.formats import FORMATS, SUFFIXES, write_batches
from starcat.exchange.hats import MAX_ROWS, NEEDED, PROPERTIES_NAME, write_hats
from starcat.exchange.label import Label
from starcat.exchange.numpy_columns import field_facts
from starcat.exchange.tables import NamedTables
from starcat.storage.atomic import whole_folder

EXPORT_FORMATS = (*FORMATS, "hats")
COLUMNS_NAME = "columns.csv"
COLUMNS_HEADER = ("product", "column", "dtype", "unit", "description")
WITHOUT_UNITS = ("csv", "npz")


@dataclass(frozen=True)
class ExportedFile:
    """One product as it was written.

    Attributes
    ----------
    product, name : str
        Name of the table, and that of its file or folder.
    rows, bytes : int
        Written.
    left_out : int
        Rows without a position, which HATS has no place for.
    """

    product: str
    name: str
    rows: int
    bytes: int
    left_out: int = 0


@dataclass(frozen=True)
class Exported:
    """An export.

    Attributes
    ----------
    source : str
        Name of what was exported.
    file_format : str
        One of `EXPORT_FORMATS`.
    folder : Path
        The folder that was written into.
    files : tuple of ExportedFile
        One a product.
    has_columns : bool
        Whether ``columns.csv`` says what the columns are.
    """

    source: str
    file_format: str
    folder: Path
    files: tuple[ExportedFile, ...]
    has_columns: bool

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "source": self.source,
            "format": self.file_format,
            "folder": str(self.folder),
            "columns": COLUMNS_NAME if self.has_columns else None,
            "files": [asdict(file) for file in self.files],
        }


def export_tables(
    tables: NamedTables,
    file_format: str,
    folder: Path,
    *,
    products: Sequence[str] | None = None,
    replace: bool = False,
    max_partition_rows: int = MAX_ROWS,
) -> Exported:
    """Write tables in a format, one file a product."""
    _check_asked(file_format, folder)
    columns: list[tuple[str, ...]] = []
    with whole_folder(folder) as partial:
        files = []
        for product in tables.chosen(products):
            table = tables.readers[product]()
            if file_format != "hats":
                files.append(_write_file(table, partial, tables.label(product), file_format))
                columns += _described(product, table.schema)
            elif products or set(NEEDED) <= set(table.column_names):
                name = f"{tables.name}-{product}" if product != tables.name else product
                files.append(_write_hats(table, partial / product, name, max_partition_rows))
        if not files:
            raise ConfigError(f"{tables.name} has no star table, which HATS is for")
        has_columns = file_format in WITHOUT_UNITS
        if has_columns:
            _write_columns(partial / COLUMNS_NAME, folder / COLUMNS_NAME, columns)
        _publish(partial, folder, replace=replace)
    return Exported(tables.name, file_format, folder, tuple(files), has_columns)


def _check_asked(file_format: str, folder: Path) -> None:
    """Refuse what cannot be done before anything is read."""
    if file_format not in EXPORT_FORMATS:
        raise ConfigError(
            f"format {file_format!r} is unknown; choose one of {', '.join(EXPORT_FORMATS)}, or "
            "onboard or c",
            key="to",
            value=file_format,
        )
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder}: is a file; choose a folder with --output", path=folder)


def _write_file(table: pa.Table, folder: Path, label: Label, file_format: str) -> ExportedFile:
    path = folder / f"{label.table}{SUFFIXES[file_format][0]}"
    rows = write_batches(table.to_reader(), path, file_format, label)
    return ExportedFile(label.table, path.name, rows, path.stat().st_size)


def _write_hats(table: pa.Table, folder: Path, name: str, max_rows: int) -> ExportedFile:
    made = write_hats(table, folder, name, max_rows)
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    return ExportedFile(folder.name, folder.name, made.rows, size, made.left_out)


def _described(product: str, schema: pa.Schema) -> list[tuple[str, ...]]:
    described: list[tuple[str, ...]] = []
    for field in schema:
        facts = field_facts(field)
        known = (facts.get("unit", ""), facts.get("description", ""))
        described.append((product, field.name, _dtype(field.type), *known))
    return described


def _dtype(kind: pa.DataType) -> str:
    if pa.types.is_list(kind):
        return f"list<{_dtype(kind.value_type)}>"
    return {"double": "float64", "float": "float32"}.get(str(kind), str(kind))


def _write_columns(path: Path, before: Path, columns: list[tuple[str, ...]]) -> None:
    """Write what the columns are, and keep what an earlier export said of other products."""
    known = {row[0] for row in columns}
    kept: Iterable[tuple[str, ...]] = ()
    if before.is_file():
        header, *rows = _read_columns(before) or [()]
        if header == COLUMNS_HEADER:
            kept = [row for row in rows if row and row[0] not in known]
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerows([COLUMNS_HEADER, *kept, *columns])
    path.write_text(text.getvalue(), encoding="utf-8", newline="")


def _read_columns(path: Path) -> list[tuple[str, ...]]:
    with path.open(encoding="utf-8", errors="replace", newline="") as stream:
        return [tuple(row) for row in csv.reader(stream)]


def _publish(partial: Path, folder: Path, *, replace: bool) -> None:
    """Give what was written its names in the folder, if all of it may have them."""
    entries = sorted(path.name for path in partial.iterdir())
    for name in entries:
        old, new = folder / name, partial / name
        if not old.exists() or _is_same(old, new) or _is_columns(old):
            continue
        if not replace:
            raise OutputError(
                f"{old} already exists and differs; choose another --output, or pass --replace",
                path=old,
            )
        if old.is_dir() != new.is_dir() or (old.is_dir() and not _is_hats(old)):
            raise OutputError(f"{old} is something else; choose another --output", path=old)
    folder.mkdir(parents=True, exist_ok=True)
    for name in entries:
        old, new = folder / name, partial / name
        if old.is_dir():
            shutil.move(old, partial / f".{name}.old")
        new.replace(old)


def _is_hats(folder: Path) -> bool:
    return (folder / PROPERTIES_NAME).is_file()


def _is_columns(path: Path) -> bool:
    """Return whether a file is a description of columns, which the new one goes on from."""
    return path.name == COLUMNS_NAME and _read_columns(path)[:1] == [COLUMNS_HEADER]


def _is_same(old: Path, new: Path) -> bool:
    if old.is_dir() and new.is_dir():
        names = [sorted(p.relative_to(top) for p in top.rglob("*")) for top in (old, new)]
        files = [name for name in names[0] if (old / name).is_file()]
        return names[0] == names[1] and all(
            filecmp.cmp(old / name, new / name, shallow=False) for name in files
        )
    return old.is_file() and new.is_file() and filecmp.cmp(old, new, shallow=False)
