"""Exports: tables in a format of other tools, one file per product, in a folder.

All files are first written next to the folder, and are renamed when all of them are complete. For
formats that cannot store units, ``columns.csv`` describes the columns. HATS catalogs are star
tables by HEALPix pixel that LSDB opens directly; the table must fit into memory, and gets no
margin. ``starcat ingest --to hats`` makes catalogs of any size, with the same pixels and the same
files next to the partitions.
"""

from __future__ import annotations

import csv
import filecmp
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from dataclasses import replace as changed
from functools import partial
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from starcat.arguments import HasFolder, check_type, database_path, path_of, paths_of, whole_number
from starcat.catalog.stars.star_table import floats_of
from starcat.catalog.store.layout import (
    HEALPIX_COLUMN,
    MAX_ORDER,
    catalog_files,
    healpix_29,
    pixel_field,
)
from starcat.catalog.store.metadata import Described, describe_catalog, write_slices
from starcat.catalog.store.plan import partition_pixels
from starcat.database.reader import open_database_folder
from starcat.errors import ConfigError, OutputError, SourceError, SourceMissing, count_of, suggest
from starcat.resources import PathLike
from starcat.results import entry, in_record
from starcat.ship.exchange.columns import Label, field_facts
from starcat.ship.exchange.formats import (
    EXPORT_FORMATS,
    FORMATS,
    ONBOARD_FORMATS,
    SOLVER_FORMATS,
    suffix_format,
)
from starcat.ship.exchange.onboard import ExportedImage, export_image
from starcat.ship.exchange.solvers.write import ExportedSolver, export_solver
from starcat.ship.exchange.writers import write_batches
from starcat.storage.atomic import check_final, replace_folder, whole_folder
from starcat.storage.parquet import read_parquet

COLUMNS_NAME = "columns.csv"
NEEDED = ("star_id", "ra_deg", "dec_deg")  # columns of a star table that HATS requires
MAX_ROWS = 1_000_000
PROPERTIES_NAME = "hats.properties"
COLUMNS_HEADER = ("product", "column", "dtype", "unit", "description")


@dataclass(frozen=True)
class NamedTables:
    """Tables by product, from a database or a file; each is read when needed."""

    name: str  # name for all of them, such as the database's name and version
    readers: Mapping[str, Callable[[], pa.Table]]
    database: str = ""  # name of the database; empty for a file
    version: str = ""

    def select(self, products: Sequence[str] | None) -> list[str]:
        """Return the selected names, by default all, in the order of the tables."""
        for product in products or ():
            if product not in self.readers:
                hint = suggest(product, self.readers)
                raise ConfigError(
                    f"{self.name} has no product {product!r}",
                    key="product",
                    value=product,
                    hint=f"{hint}it has {', '.join(self.readers)}",
                )
        return [name for name in self.readers if not products or name in products]


@dataclass(frozen=True)
class ExportedFile:
    """One product that was written."""

    product: str
    name: str  # name of its file or folder
    rows: int
    bytes: int
    left_out: int = 0  # rows without a position, which HATS cannot store


@dataclass(frozen=True, repr=False)
class Exported:
    """The result of an export: one file per product.

    Attributes
    ----------
    source : str
        Name of the database or file that was exported.
    file_format : str
        Format of the files.
    folder : Path
        Folder of the files.
    files : tuple[ExportedFile, ...]
        One file per product, with its rows and bytes.
    has_columns : bool
        True if columns.csv describes the columns.
    """

    source: str
    file_format: str = field(metadata=entry(key="format"))
    folder: Path
    files: tuple[ExportedFile, ...]
    has_columns: bool = field(repr=False)

    def __repr__(self) -> str:
        size = sum(file.bytes for file in self.files)
        files = f"{count_of(len(self.files), 'file')}, {self.file_format}, {size:,} bytes"
        return f"<Exported {self.source} to {self.folder}: {files}>"

    @property
    @in_record()
    def columns(self) -> str | None:
        """Name of the file that describes the columns, if there is one."""
        return COLUMNS_NAME if self.has_columns else None


def tables_of(path: Path) -> NamedTables:
    """Return the tables of a database, or the table of a Parquet file."""
    if path.is_dir():
        database = open_database_folder(path)
        readers = {name: partial(database.table, name) for name in database.products}
        name, version = database.manifest["name"], database.manifest["version"]
        return NamedTables(f"{name}-{version}", readers, name, version)
    if not path.exists():
        raise SourceMissing(
            "no such database or file",
            where=path,
            hint="give the folder of a database or a Parquet file",
        )
    return NamedTables(path.stem, {path.stem: partial(_read_file, path)})


def _read_file(path: Path) -> pa.Table:
    try:
        return read_parquet(path)
    except (OSError, pa.ArrowException) as error:
        raise SourceError(
            f"not a readable Parquet file ({error})",
            where=path,
            hint="give the folder of a database or a Parquet file",
        ) from error


OPTIONS_OF_EXPORT = (
    "products", "max_partition_rows", "profile", "method", "endian", "max_bytes", "patch_from",
    "sign", "camera", "replace",
)  # fmt: skip
"""All options of `export`; each format accepts some of them."""


def export(
    database: HasFolder | PathLike, form: str, output: PathLike | None = None, **options: Any
) -> Exported | ExportedImage | ExportedSolver:
    """Write tables of a database, its image for flight software, or another solver's database.

    Parameters
    ----------
    database : Database, str or path-like
        The result of `starcat.open`, or the folder of a database.
    form : str
        A format of ``starcat export --to``: csv, fits, votable, ... onboard, c, or a solver.
    output : str or path-like, optional
        Folder for tables (default ``export``) or for a solver's files; file name for an image.
    **options
        ``products``, ``replace``, ``max_partition_rows`` for tables; ``profile`` (full or small),
        ``method``, ``endian``, ``max_bytes``, ``patch_from``, ``replace``, ``sign`` (files of
        keys), ``camera`` (a file) for an image; ``replace`` for a solver.

    Returns
    -------
    Exported, ExportedImage or ExportedSolver
        The files that were written.

    Raises
    ------
    ConfigError, ProductError, OutputError, OnboardSizeError
        In the same cases as ``starcat export``.
    """
    folder = database_path("database", database)
    target = None if output is None else path_of("output", output)
    run: Callable[..., Exported | ExportedImage | ExportedSolver]
    if form in ONBOARD_FORMATS:
        run = partial(export_image, folder, form, target)
    elif form in SOLVER_FORMATS:
        run = partial(export_solver, folder, form, target)
    else:
        run = partial(export_tables, tables_of(folder), form, target or Path("export"))
    unknown = sorted(set(options) - set(signature(run).parameters))
    if unknown:
        accepted = ", ".join(
            name for name in OPTIONS_OF_EXPORT if name in signature(run).parameters
        )
        text = f"export to {form!r} has no option {unknown[0]!r}; its options are {accepted}"
        raise TypeError(text)
    for name in ("max_partition_rows", "max_bytes"):
        if options.get(name) is not None:
            options[name] = whole_number(name, options[name], 1)
    if "sign" in options:
        options["sign"] = paths_of("sign", options["sign"])
    if options.get("products") is not None:
        products = options["products"]
        check_type("products", products, Iterable, "a sequence of names")
        options["products"] = [products] if isinstance(products, str) else list(products)
    return run(**options)


def export_tables(
    tables: NamedTables,
    file_format: str,
    folder: Path,
    *,
    products: Sequence[str] | None = None,
    replace: bool = False,
    max_partition_rows: int = MAX_ROWS,
) -> Exported:
    """Write tables in one of `EXPORT_FORMATS`, one file per product; other files are kept.

    The default are all products, and for HATS all star tables. If ``folder`` has the suffix of a
    format, it is the file of the only product.
    """
    is_file = suffix_format(folder) is not None
    _check_asked(file_format, folder, tables.select(products), is_file=is_file)
    columns: list[tuple[str, ...]] = []
    with whole_folder(folder) as part:
        files = []
        for product in tables.select(products):
            table = tables.readers[product]()
            if file_format != "hats":
                label = Label(product, tables.database, tables.version)
                files.append(_write_file(table, part, label, file_format))
                columns += _described(product, table.schema)
            elif products or set(NEEDED) <= set(table.column_names):
                name = f"{tables.name}-{product}" if product != tables.name else product
                files.append(_write_hats(table, part / product, name, max_partition_rows))
        if not files:
            raise ConfigError(f"{tables.name} has no star table; HATS needs one")
        if is_file:
            (part / files[0].name).rename(part / folder.name)
            files, folder = [changed(files[0], name=folder.name)], folder.parent
        has_columns = not (is_file or file_format == "hats" or FORMATS[file_format].has_units)
        if has_columns:
            _write_columns(part / COLUMNS_NAME, folder / COLUMNS_NAME, columns)
        _publish(part, folder, replace=replace)
    return Exported(tables.name, file_format, folder, tuple(files), has_columns)


def _check_asked(file_format: str, folder: Path, products: Sequence[str], *, is_file: bool) -> None:
    """Refuse impossible combinations before anything is read."""
    if file_format not in EXPORT_FORMATS:
        raise ConfigError(
            "expected one of " + ", ".join((*EXPORT_FORMATS, *ONBOARD_FORMATS, *SOLVER_FORMATS)),
            parameter="form",
            value=file_format,
        )
    if is_file and file_format != suffix_format(folder):
        raise ConfigError(
            f"the suffix is for a {suffix_format(folder)} file, but the format is {file_format}",
            where=folder,
            key="output",
            hint="give only one of them",
        )
    if is_file and len(products) != 1:
        raise ConfigError(
            f"is the name of one file, but there are {len(products)} products: "
            f"{', '.join(products)}",
            where=folder,
            key="output",
            hint=("choose one of them with {products}", "a folder"),
        )
    if folder.exists() and folder.is_dir() == is_file:
        actual, expected = ("folder", "file") if is_file else ("file", "folder")
        raise OutputError(
            f"is a {actual}", where=folder, hint=f"choose a {expected} with {{output}}"
        )


def _write_file(table: pa.Table, folder: Path, label: Label, file_format: str) -> ExportedFile:
    path = folder / f"{label.table}{FORMATS[file_format].suffix}"
    rows = write_batches(table.to_reader(), path, file_format, label)
    return ExportedFile(label.table, path.name, rows, path.stat().st_size)


def _write_hats(table: pa.Table, folder: Path, name: str, max_rows: int) -> ExportedFile:
    rows = write_hats(table, folder, name, max_rows)
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    return ExportedFile(folder.name, folder.name, rows, size, len(table) - rows)


def write_hats(stars: pa.Table, folder: Path, name: str, max_rows: int = MAX_ROWS) -> int:
    """Write the stars with a position as a HATS catalog; return their number."""
    table = _with_pixels(stars, name)
    pixels, counts = np.unique(table[HEALPIX_COLUMN].to_numpy(), return_counts=True)
    partitions = partition_pixels(pixels, counts, MAX_ORDER, max_rows, name)
    written = write_slices(table, partitions, folder, max_rows)
    describe_catalog(folder, Described(name, "object", written, max_rows, {}), table.schema)
    return len(table)


def _with_pixels(stars: pa.Table, name: str) -> pa.Table:
    """Return the stars that have a position, sorted by pixel and star."""
    missing = [column for column in NEEDED if column not in stars.column_names]
    if missing:
        raise ConfigError(
            f"not a star table, it has no column {', '.join(missing)}",
            where=name,
            hint="HATS is for star tables, choose another format",
        )
    ra_deg, dec_deg = floats_of(stars, "ra_deg"), floats_of(stars, "dec_deg")
    is_placed = np.isfinite(ra_deg) & np.isfinite(dec_deg)
    if not is_placed.any():
        raise ConfigError(f"none of its {len(stars)} rows has a position on the sky", where=name)
    pixels = healpix_29(ra_deg[is_placed], dec_deg[is_placed])
    placed = stars.filter(pa.array(is_placed))
    table = placed.add_column(0, pixel_field(), pa.array(pixels)).replace_schema_metadata(None)
    return table.sort_by([(HEALPIX_COLUMN, "ascending"), ("star_id", "ascending")])


def _described(product: str, schema: pa.Schema) -> list[tuple[str, ...]]:
    fields = [(field, field_facts(field)) for field in schema]
    return [
        (
            product,
            column.name,
            _dtype(column.type),
            facts.get("unit", ""),
            facts.get("description", ""),
        )
        for column, facts in fields
    ]


def _dtype(kind: pa.DataType) -> str:
    if pa.types.is_list(kind):
        return f"list<{_dtype(kind.value_type)}>"
    return {"double": "float64", "float": "float32"}.get(str(kind), str(kind))


def _write_columns(path: Path, before: Path, columns: list[tuple[str, ...]]) -> None:
    """Write descriptions of columns, and keep an earlier export's for other products."""
    products = {row[0] for row in columns}
    header, *rows = _read_columns(before) or [()]
    others = (
        [row for row in rows if row and row[0] not in products] if header == COLUMNS_HEADER else []
    )
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerows([COLUMNS_HEADER, *others, *columns])


def _read_columns(path: Path) -> list[tuple[str, ...]]:
    if not path.is_file():
        return []
    with path.open(encoding="utf-8", errors="replace", newline="") as stream:
        return [tuple(row) for row in csv.reader(stream)]


def _publish(part: Path, folder: Path, *, replace: bool) -> None:
    entries = sorted(path.name for path in part.iterdir())
    for name in entries:
        old, new = folder / name, part / name
        if not old.exists() or _is_same(old, new) or _is_columns(old):
            continue
        if not replace:
            raise OutputError(
                f"{old} already exists and differs",
                path=old,
                hint=("choose another {output}", "pass {replace:True}"),
            )
        if old.is_dir() != new.is_dir() or (old.is_dir() and not (old / PROPERTIES_NAME).is_file()):
            raise OutputError(f"{old} is something else", path=old, hint="choose another {output}")
        if old.is_dir():
            check_final(old, catalog_files)
    folder.mkdir(parents=True, exist_ok=True)
    for name in entries:
        old, new = folder / name, part / name
        if old.is_dir():
            replace_folder(new, old)
        else:
            new.replace(old)


def _is_columns(path: Path) -> bool:
    """Return whether a file describes columns, so that the new descriptions can extend it."""
    return path.name == COLUMNS_NAME and _read_columns(path)[:1] == [COLUMNS_HEADER]


def _is_same(old: Path, new: Path) -> bool:
    if old.is_dir() and new.is_dir():
        names = [sorted(p.relative_to(top) for p in top.rglob("*")) for top in (old, new)]
        files = [name for name in names[0] if (old / name).is_file()]
        return names[0] == names[1] and all(
            filecmp.cmp(old / name, new / name, shallow=False) for name in files
        )
    return old.is_file() and new.is_file() and filecmp.cmp(old, new, shallow=False)
