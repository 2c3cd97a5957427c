"""Targets of a query: databases, star tables, stores, archive files, and the views on them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from starcat.database.manifest import MANIFEST_NAME, read_manifest
from starcat.errors import ProductError, QueryError, TargetMissing
from starcat.progress import Progress, no_progress
from starcat.query.engine import Engine
from starcat.query.names import distinct, identifier, short_names
from starcat.storage.schema import ProductSchema, SchemaColumn, product_schema

if TYPE_CHECKING:
    from starcat.catalog.store.layout import Pixel, Store

POSITION = ("ra_deg", "dec_deg")
_FLOATING = re.compile(r"\b(FLOAT|DOUBLE)\b")


@dataclass(frozen=True)
class View:
    """A table as a query sees it."""

    name: str  # the name of the product, or of the file where starcat did not write it
    paths: tuple[Path, ...]  # its Parquet files: one, or many of a store
    columns: tuple[str, ...]
    # The schema of the product, with units and meanings of its columns.
    schema: ProductSchema | None = None
    position: tuple[str, str] = POSITION  # columns with right ascension and declination
    # For each file the part of the sky that its rows are in; empty if not known.
    pixels: tuple[Pixel, ...] = ()
    # Columns that can have NaN, with DuckDB's types; starcat itself writes null.
    floating: tuple[tuple[str, str], ...] = ()
    # Whether the view has the number of each row as a column, which the file lacks.
    has_row_numbers: bool = False

    @property
    def described(self) -> tuple[SchemaColumn, ...]:
        """Descriptions of its columns; empty for tables that starcat did not write."""
        return self.schema.columns if self.schema else ()

    @cached_property
    def files(self) -> tuple[str, ...]:
        """Full paths of its files, links resolved."""
        return tuple(str(path.resolve()) for path in self.paths)


@dataclass(frozen=True)
class Target:
    """A target of a query."""

    # The schema of its views: ``name_1_2_3`` for a database, else the name of the source or the
    # file. It stays the same, whatever other targets there are.
    name: str
    version: str  # the version of a database; empty for anything else
    views: tuple[View, ...]
    # A second schema: the name of the database alone, for the newest version that there is.
    alias: str = ""

    @property
    def short_name(self) -> str:
        """The shortest schema of its own."""
        return self.alias or self.name


def open_targets(
    target_names: Sequence[str], scratch: Path, engine: Engine, progress: Progress = no_progress
) -> tuple[Target, ...]:
    """Find the tables of the named targets."""
    targets = [
        _open_target(text, scratch / str(k), engine, progress)
        for k, text in enumerate(target_names)
    ]
    full = [
        identifier(f"{target.name}_{target.version}") if target.version else target.name
        for target in targets
    ]
    taken = short_names(len(targets)) if len(targets) > 1 else []
    named = [
        replace(target, name=name, alias=target.name if target.version else "")
        for target, name in zip(targets, distinct(full, taken), strict=True)
    ]
    newest: dict[str, Target] = {}
    for target in (candidate for candidate in named if candidate.alias):
        previous = newest.get(target.alias)
        if previous is None or _is_older(previous.version, target.version):
            newest[target.alias] = target
    reserved = {*taken, *(target.name for target in named)}
    return tuple(
        target
        if newest.get(target.alias) is target and target.alias not in reserved
        else replace(target, alias="")
        for target in named
    )


def _is_older(version: str, other: str) -> bool:
    # Importing it takes a tenth of the time of a short query, and most have a single version.
    from starcat.sections import version_numbers

    return version_numbers(version) < version_numbers(other)


def _open_target(text: str, scratch: Path, engine: Engine, progress: Progress) -> Target:
    path = Path(text)
    if path.is_dir() and (path / MANIFEST_NAME).exists():
        return _database_of_folder(path)
    if path.is_dir() and (store := _store_in(path)):
        return _store(store, engine)
    if path.is_dir() and (files := sorted(path.glob("*.parquet"))):
        return _folder(path, files, engine)
    if path.is_file() and path.suffix == ".parquet":
        return _tables(path, engine)
    source, inputs = _source_of(text, path)
    if source is None:
        is_there = path.exists()
        what = "its kind is unknown" if is_there else "no such database, file or source"
        if is_there and path.suffix.lower() in (
            ".csv",
            ".tsv",
            ".fits",
            ".ecsv",
            ".tbl",
            ".vot",
            ".xml",
        ):
            what = f"a table is read through a map: 'starcat sources --draft {text}' proposes one"
        raise (QueryError if is_there else TargetMissing)(
            f"{text}: {what}; give the folder of a database or a HATS catalog, a Parquet file, an "
            "archive file (SOURCE=PATH if its name is not the archive's), or a source that "
            "'starcat sources' lists"
        )
    return _archive(source, inputs, scratch, progress)


def _database_of_folder(folder: Path) -> Target:
    manifest = read_manifest(folder)
    views = []
    for product, facts in manifest["products"].items():
        name, _, version = str(facts["schema"]).rpartition("-")
        path = folder / str(facts["parquet"])
        # A manifest names files of its own folder, and nothing else may be read.
        if path.parent != folder or path.is_symlink() or not product.isidentifier():
            raise ProductError(
                f"the manifest names {facts['parquet']!r} for {product}, which is not a "
                "file of the database",
                where=folder,
                product=product,
                hint="fetch or build it again",
            )
        _check_file(path)
        view = _product_view(product, path, product_schema(name, version))
        views.append(_with_row_numbers(view) if product == "stars" else view)
    return Target(identifier(manifest["name"]), manifest["version"], tuple(views))


def _check_file(path: Path) -> None:
    try:
        with path.open("rb") as file:
            begins = file.read(4)
            file.seek(-4, 2)
            is_parquet = begins == file.read(4) == b"PAR1"
    except OSError as error:
        raise ProductError(
            f"cannot be read ({error.strerror})", where=path, hint="fetch or build it again"
        ) from error
    if not is_parquet:
        raise ProductError(
            "not a whole Parquet file (PAR1 at both ends)",
            where=path,
            hint="fetch or build it again",
        )


def _tables(path: Path, engine: Engine) -> Target:
    """Return a Parquet file, with the rejected rows next to it if there are any."""
    from starcat.catalog.stars.verdict import rejected_path

    files = [path, *filter(Path.is_file, [rejected_path(path)])]
    return Target(identifier(path.stem), "", tuple(_table(file, engine) for file in files))


def _folder(path: Path, files: Sequence[Path], engine: Engine) -> Target:
    """Return a folder of Parquet files, each a table with the name of the file."""
    views = [_many_files(identifier(file.stem), path, [file], engine) for file in files]
    names = distinct([view.name for view in views])
    return Target(
        identifier(path.resolve().name),
        "",
        tuple(replace(view, name=name) for view, name in zip(views, names, strict=True)),
    )


def _store_in(folder: Path) -> Store | None:
    from starcat.catalog.store.layout import is_store, open_store

    return open_store(folder) if is_store(folder) else None


def _store(store: Store, engine: Engine) -> Target:
    """Return a store: the stars in many files, one per part of the sky, and the rejected rows."""
    from starcat.catalog.store.layout import REJECTED, REPEATED

    parts = [(path, part.pixel) for part in store.catalog.partitions for path in part.paths]
    if not parts:
        raise ProductError(
            "a HATS catalog without a partition", where=store.catalog.folder, hint="get it again"
        )
    stars = _many_files("stars", store.folder, [path for path, _ in parts], engine)
    properties = store.catalog.properties
    named = (
        properties.get("hats_col_ra", POSITION[0]),
        properties.get("hats_col_dec", POSITION[1]),
    )
    stars = replace(
        stars,
        name=stars.schema.product if stars.schema else "stars",
        position=named,
        pixels=tuple(pixel for _, pixel in parts),
    )
    beside = {
        name: sorted((store.folder / name).rglob("*.parquet")) for name in (REJECTED, REPEATED)
    }
    views = [
        _many_files(name, store.folder, paths, engine) for name, paths in beside.items() if paths
    ]
    return Target(identifier(store.folder.resolve().name), "", (stars, *views))


def _many_files(name: str, folder: Path, paths: Sequence[Path], engine: Engine) -> View:
    """Return the view of a table in many files of a folder, which all look like Parquet."""
    inside = folder.resolve()
    for path in paths:
        if not path.resolve().is_relative_to(inside):
            raise ProductError(
                f"a link to {path.resolve()}, which is not in the store; a query reads "
                "what is in the folder only",
                where=path,
                hint="Put the file there",
            )
        _check_file(path)
    return replace(_table(paths[0], engine), name=name, paths=tuple(paths))


def _table(path: Path, engine: Engine) -> View:
    _check_file(path)
    try:
        schema_name, types = engine.footer(str(path.resolve()))
    except QueryError as error:
        message = str(error).splitlines()[0]
        raise ProductError(
            f"cannot be read ({message})", where=path, hint="get the file again"
        ) from error
    name, _, version = schema_name.rpartition("-")
    schema = product_schema(name, version) if schema_name else None
    if schema is not None:
        return View(schema.product, (path,), tuple(types), schema)
    floating = tuple((column, kind) for column, kind in types.items() if _FLOATING.search(kind))
    return View(identifier(path.stem), (path,), tuple(types), floating=floating)


def _product_view(name: str, path: Path, schema: ProductSchema) -> View:
    return View(name, (path,), tuple(column.name for column in schema.columns), schema)


ROW = SchemaColumn(
    "row",
    "int32",
    "Number of the row, from 0: columns of the other products, such as i and j of pairs, refer to "
    "it. Of the view only, not of the file",
)


def _with_row_numbers(stars: View) -> View:
    """Return the view of guide stars with the number of each row as its last column."""
    assert stars.schema is not None
    return replace(
        stars,
        columns=(*stars.columns, ROW.name),
        schema=replace(stars.schema, columns=(*stars.schema.columns, ROW)),
        has_row_numbers=True,
    )


def _source_of(text: str, path: Path) -> tuple[str | None, list[Path]]:
    from starcat.catalog.source import source_given, source_names
    from starcat.catalog.source_files import source_of_file

    name, separator, file_name = text.partition("=")
    if separator and not path.exists():
        return source_given(name).name, [Path(file_name)]
    if path.is_file():
        return source_of_file(path), [path]
    return (text, []) if text in source_names() else (None, [])


def _archive(source: str, inputs: list[Path], scratch: Path, progress: Progress) -> Target:
    from starcat.catalog.ingest import ingest_catalog
    from starcat.catalog.source_files import locate
    from starcat.storage.parquet import write_parquet

    read = ingest_catalog(source, locate(source, {source: inputs}), progress=progress)
    scratch.mkdir(parents=True)
    views = []
    for name, table in (("stars", read.stars), ("rejected", read.rejected)):
        path = scratch / f"{name}.parquet"
        write_parquet(table, path)
        views.append(_product_view(name, path, product_schema(name)))
    return Target(identifier(source), "", tuple(views))
