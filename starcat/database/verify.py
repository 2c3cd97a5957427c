"""Verification of a database against its manifest and its schemas."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from starcat.arguments import HasFolder, database_path
from starcat.catalog.stars.epochs import middle_of
from starcat.catalog.stars.region import footprint_of_recorded
from starcat.catalog.stars.star_table import directions_of
from starcat.catalog.stars.verdict import Reason
from starcat.database.database import LAYOUT_VERSION, column_datasets, dataset_attributes
from starcat.database.manifest import DATABASE_NAME, MANIFEST_NAME, manifest_digest, read_manifest
from starcat.database.products.index import row_offsets
from starcat.database.products.table import PRODUCTS
from starcat.database.products.tiling import spiral_points
from starcat.database.reader import DatabaseFolder
from starcat.database.writer import content_sha256
from starcat.errors import ProductError, SchemaError, StarcatError, count_of, no_database
from starcat.geometry.sphere import directions_from_radec, separation
from starcat.resources import PathLike
from starcat.storage.atomic import file_sha256, json_bytes
from starcat.storage.hdf5 import own_dataset, own_group
from starcat.storage.schema import ProductSchema

UNIT_TOLERANCE = 1e-14
"""Tolerance for the length and components of a direction: a few roundings of float64."""

SEPARATION_TOLERANCE_RAD = 1e-12
"""Two ways to compute a separation differ by a few roundings; 1e-12 rad is 0.2 uas."""


@dataclass(frozen=True)
class ProductContent:
    """The table of a product from its Parquet file, with its entry in the manifest."""

    table: pa.Table  # the product
    schema: ProductSchema  # its contract
    facts: Mapping[str, Any]  # its entry in the manifest
    # shape (N, 3): directions of the database's stars, ICRS; no rows if they are unknown
    directions: NDArray[np.float64]
    stars: pa.Table | None = None  # the database's stars; None if they are unknown


Check = Callable[[ProductContent], Iterator[str]]


def columns_follow_the_schema(product: ProductContent) -> Iterator[str]:
    """Yield the first column that differs from the schema."""
    try:
        product.schema.check(product.table)
    except SchemaError as error:
        yield str(error)


def content_is_the_manifests(product: ProductContent) -> Iterator[str]:
    """Yield differences of row count and content digest from the manifest."""
    rows = product.facts["rows"]
    if len(product.table) != rows:
        yield f"{len(product.table)} rows; the manifest says {rows}"
    elif content_sha256(product.table, product.schema) != product.facts["content_sha256"]:
        yield "the values are not those of the manifest's content_sha256"


def rows_are_in_order(product: ProductContent) -> Iterator[str]:
    """Yield the first row that is not in the order of the schema; nulls come last.

    Stars of several catalogs can have equal numbers; they are in the order of their catalogs.
    """
    rows = max(len(product.table) - 1, 0)
    tied, wrong = np.ones(rows, dtype=bool), np.zeros(rows, dtype=bool)
    order = product.schema.order
    if product.schema.product in ("stars", "rejected"):
        order = (*order, "catalog")
    for name in order:
        values, is_null = _with_nulls(product.table[name])
        has_both = ~is_null[:-1] & ~is_null[1:]
        rises = (has_both & (values[1:] > values[:-1])) | (~is_null[:-1] & is_null[1:])
        same = (has_both & (values[1:] == values[:-1])) | (is_null[:-1] & is_null[1:])
        wrong |= tied & ~rises & ~same
        tied &= same
        if not tied.any():
            break
    wrong |= tied
    if wrong.any():
        row = int(np.argmax(wrong))
        yield (
            f"row {row + 1} does not come after row {row} in the order of "
            f"{', '.join(product.schema.order)} "
            f"({int(wrong.sum())} such rows)"
        )


def _with_nulls(column: pa.ChunkedArray) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    is_null = column.is_null().to_numpy()
    if column.null_count:
        column = pc.fill_null(column, "" if pa.types.is_string(column.type) else 0)
    return column.to_numpy(), is_null


def star_rows_exist(product: ProductContent) -> Iterator[str]:
    """Yield the columns that refer to stars which the database does not have."""
    count = len(product.directions)
    for column in product.schema.columns:
        if column.refers_to != "stars":
            continue
        values = product.table[column.name]
        range_ = pc.min_max(pc.list_flatten(values) if column.is_list else values).as_py()
        if range_["min"] is not None and (range_["min"] < 0 or range_["max"] >= count):
            yield (
                f"{column.name} refers to rows {range_['min']} to {range_['max']} of stars, "
                f"which has {count}"
            )


def directions_are_units(product: ProductContent) -> Iterator[str]:
    """Yield a row whose x, y, z is not a unit vector, or not the direction of ra_deg, dec_deg."""
    if not {"x", "y", "z"} <= set(product.table.column_names):
        return
    u = np.stack([product.table[name].to_numpy() for name in ("x", "y", "z")], axis=-1)
    length = np.sqrt(np.sum(u * u, axis=-1))
    for row in _first_above(np.abs(length - 1.0), UNIT_TOLERANCE):
        yield f"x, y, z of row {row} is not a unit vector"
    ra_deg, dec_deg = (product.table[name].to_numpy() for name in ("ra_deg", "dec_deg"))
    off = np.abs(u - directions_from_radec(ra_deg, dec_deg)).max(axis=-1, initial=0.0)
    for row in _first_above(off, UNIT_TOLERANCE):
        yield f"x, y, z of row {row} is not the direction of its ra_deg, dec_deg"


def _first_above(off: NDArray[np.float64], limit: float) -> NDArray[np.intp]:
    """Return the first row above a limit (or NaN), or an empty array."""
    return np.flatnonzero(~(off <= limit))[:1]


def separations_are_those_of_the_stars(product: ProductContent) -> Iterator[str]:
    """Yield a row whose separation differs from the separation of its two stars."""
    ends = [c.name for c in product.schema.columns if c.refers_to == "stars" and not c.is_list]
    if len(ends) != 2 or "separation_rad" not in product.table.column_names:
        return
    first, second = (product.table[name].to_numpy() for name in ends)
    stated = product.table["separation_rad"].to_numpy()
    u = product.directions
    off = np.abs(stated - separation(u[first], u[second]))
    for row in _first_above(off, SEPARATION_TOLERANCE_RAD):
        yield f"separation_rad of row {row} is not that of its stars"


def content_agrees_with_the_stars(product: ProductContent) -> Iterator[str]:
    """Yield contradictions within a product or with the stars, as found by its module."""
    kind = PRODUCTS.get(product.schema.product)
    if kind is not None and kind.problems is not None and product.stars is not None:
        yield from kind.problems(product.table, product.stars)


TABLE_CHECKS: tuple[Check, ...] = (
    content_is_the_manifests,
    rows_are_in_order,
    directions_are_units,
)
"""The checks of every product whose columns follow its schema."""

REFERENCE_CHECKS: tuple[Check, ...] = (
    star_rows_exist,
    separations_are_those_of_the_stars,
    content_agrees_with_the_stars,
)
"""The checks with known stars; each requires that the previous check found no problem."""


def root_problems(file: h5py.File, manifest: Mapping[str, Any]) -> Iterator[str]:
    """Yield differences between the attributes and groups of the HDF5 file and the manifest."""
    facts = {name: manifest[name] for name in ("name", "version", "frame", "epoch_jyear")}
    yield from _attribute_problems(file, {"layout_version": LAYOUT_VERSION, **facts})
    expected = {name for name, facts in manifest["products"].items() if facts["in_database"]}
    for name in sorted(expected ^ set(file)):
        yield f"group {name} is {'missing' if name in expected else 'not in the manifest'}"


def group_problems(
    group: h5py.Group, table: pa.Table, schema: ProductSchema, star_count: int
) -> Iterator[str]:
    """Yield differences between a product's group and its Parquet file or its schema."""
    facts = {"schema": schema.name, "description": schema.description, "rows": len(table)}
    yield from _attribute_problems(group, facts)
    for column in schema.columns:
        if not column.in_database:
            continue
        values = table[column.name].combine_chunks()
        for name, expected in column_datasets(column, values, star_count).items():
            if name not in group:
                yield f"{group.name}/{name} is missing"
                continue
            stored = _dataset(group, name)
            if (stored.dtype, stored.shape) != (expected.dtype, expected.shape):
                yield (
                    f"{stored.name} holds {stored.shape} {stored.dtype}; expected "
                    f"{expected.shape} {expected.dtype}"
                )
            elif stored[()].tobytes() != expected.tobytes():
                yield f"{stored.name} differs from the Parquet file"
            yield from _attribute_problems(stored, dataset_attributes(column, name))


def _dataset(group: h5py.Group, name: str) -> h5py.Dataset:
    return own_dataset(group, name, group.file.id.get_filesize())


def _attribute_problems(item: Any, expected: Mapping[str, object]) -> Iterator[str]:
    for name, value in expected.items():
        stored = item.attrs.get(name)
        if stored != value:
            yield f"{item.name}: attribute {name} is {_plain(stored)!r}; expected {value!r}"


def _plain(value: object) -> object:
    return value.item() if isinstance(value, np.generic) else value


def index_problems(
    group: h5py.Group, table: pa.Table, schema: ProductSchema, star_count: int
) -> Iterator[str]:
    """Yield contradictions between the indices of a product and its rows."""
    kind = PRODUCTS.get(schema.product)
    for name in kind.layout.indices if kind else ():
        if name not in group:
            yield f"{group.name}/{name} is missing"
        elif name == "kvector_counts":
            yield from _kvector_problems(group, table[schema.order[0]].to_numpy())
        elif name == "star_offsets":
            if not np.array_equal(
                _dataset(group, name), row_offsets(table["star"].to_numpy(), star_count)
            ):
                yield f"{group.name}/{name} does not say where the rows of each star are"
        elif name.endswith("_offsets"):
            yield from _bin_problems(group, name.removesuffix("_offsets"), len(table))


def _kvector_problems(group: h5py.Group, values: NDArray[Any]) -> Iterator[str]:
    counts, path = _dataset(group, "kvector_counts")[()], f"{group.name}/kvector_counts"
    line = [float(group.attrs[f"kvector_{name}"]) for name in ("intercept", "slope")]
    n = len(values)
    if len(counts) != n:
        yield f"{path} has {len(counts)} entries for {n} rows"
        return
    if np.any(counts[1:] < counts[:-1]):
        yield f"{path} is not ascending"
    if n and counts[-1] != n:
        yield f"{path} ends with {counts[-1]}; expected {n}"
    steps = line[0] + line[1] * np.arange(n)
    expected = np.searchsorted(values.astype(np.float64), steps, side="right")
    if n > 1 and not np.array_equal(counts, expected):
        entry = int(np.argmax(counts != expected))
        yield (
            f"{path}[{entry}] is {counts[entry]}, but {expected[entry]} values lie on or below "
            f"the line there"
        )


def _bin_problems(group: h5py.Group, stem: str, row_count: int) -> Iterator[str]:
    """Yield errors in a look-up of rows by bin: its ends, its order, its rows."""
    path = f"{group.name}/{stem}"
    if f"{stem}_rows" not in group:
        return  # another check reports its absence
    offsets, rows = (_dataset(group, f"{stem}_{part}")[()] for part in ("offsets", "rows"))
    ends = (offsets[0], offsets[-1]) if len(offsets) else (-1, -1)
    if ends != (0, len(rows)) or np.any(offsets[1:] < offsets[:-1]):
        yield f"{path}_offsets does not ascend from 0 to the {len(rows)} of {stem}_rows"
        return
    if len(rows) and (rows.min() < 0 or rows.max() >= row_count):
        yield f"{path}_rows has rows {rows.min()} to {rows.max()}; the product has {row_count}"
    falls = np.flatnonzero(rows[1:] <= rows[:-1]) + 1
    inside = falls[~np.isin(falls, offsets)]
    if len(inside):
        yield f"{path}_rows[{inside[0]}] does not ascend within its bin"


T = TypeVar("T")

_NOT_CHECKED = "Nothing else was checked, as nothing else says what the files should be"

MAX_NAMED = 5
"""Most findings in an error message."""


@dataclass(frozen=True)
class Finding:
    """One problem of a database."""

    file: str  # path within the database
    # product in the file; ``database`` for the whole HDF5 file, empty for a file without a product
    product: str
    problem: str  # finding and expectation

    def __str__(self) -> str:
        product = f" ({self.product})" if self.product else ""
        return f"{self.file}{product}: {self.problem}"


@dataclass(frozen=True)
class Verification:
    """The result of a verification.

    Attributes
    ----------
    folder : Path
        The database.
    checks : int
        Number of checks that were run.
    findings : tuple[Finding, ...]
        Every problem; none for a sound database.
    """

    folder: Path
    checks: int
    findings: tuple[Finding, ...]

    def __repr__(self) -> str:
        counts = f"{count_of(self.checks, 'check')}, {count_of(len(self.findings), 'finding')}"
        return f"<Verification {self.folder.name}: {counts}>"


def verify(database: HasFolder | PathLike) -> Verification:
    """Check a database: digests, schemas, rows, orders, indices, references, counts.

    Parameters
    ----------
    database : Database, str or path-like
        The database, or its folder ``<name>-<version>``.

    Returns
    -------
    Verification
        The list of findings; it is empty if the database is sound.

    Raises
    ------
    ProductError
        If the folder is not a database.
    """
    folder = database_path("database", database)
    if not folder.is_dir():
        raise no_database(folder)
    log = _Log()
    # With a damaged manifest, intact files would appear to be damaged.
    if log.run(MANIFEST_NAME, "", _manifest_problems, folder / MANIFEST_NAME):
        manifest = log.get(MANIFEST_NAME, "", read_manifest, folder)
        if manifest:
            log.get(MANIFEST_NAME, "", _check_all, DatabaseFolder(folder, manifest), log)
    return Verification(folder, log.checks, tuple(log.findings))


def check_database(folder: Path) -> DatabaseFolder:
    """Check that a database is complete and undamaged."""
    findings = verify(folder).findings
    if findings:
        raise ProductError(
            f"{first_of(findings)}",
            where=folder,
            product=findings[0].product or None,
            path=folder / findings[0].file,
            hint="Build the database again, or fetch it again",
        )
    return DatabaseFolder(folder, read_manifest(folder))


def first_of(findings: Sequence[Finding]) -> str:
    """Return the first findings in one line, with the number of further ones."""
    more = f"; and {len(findings) - MAX_NAMED} more" if len(findings) > MAX_NAMED else ""
    return "; ".join(str(finding) for finding in findings[:MAX_NAMED]) + more


@dataclass
class _Log:
    """Runs checks, counts them and keeps their findings; exceptions become findings."""

    checks: int = 0
    findings: list[Finding] = field(default_factory=list)

    def get(self, file: str, product: str, function: Callable[..., T], *args: Any) -> T | None:
        """Return the result of a function; if it raises, add a finding and return None."""
        self.checks += 1
        try:
            return function(*args)
        except StarcatError as error:
            self.findings.append(Finding(file, product, str(error)))
        except Exception as error:  # damage can cause any exception in a library
            why = f"cannot be read: {type(error).__name__}: {error}"
            self.findings.append(Finding(file, product, why))
        return None

    def run(self, file: str, product: str, check: Callable[..., Iterable[str]], *args: Any) -> bool:
        """Keep the problems that a check yields, and return whether there were none."""
        problems = self.get(file, product, lambda: list(check(*args)))
        self.findings += [Finding(file, product, problem) for problem in problems or ()]
        return problems == []


def _manifest_problems(path: Path) -> Iterator[str]:
    if not path.is_file():
        yield f"missing. {_NOT_CHECKED}"
        return
    data = path.read_bytes()
    try:
        manifest = json.loads(data)
        if data != json_bytes(manifest):
            yield f"changed since it was built: not as starcat writes it. {_NOT_CHECKED}"
        elif manifest["manifest_sha256"] != manifest_digest(manifest):
            yield f"changed since it was built: manifest_sha256 is not its digest. {_NOT_CHECKED}"
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        yield f"not a manifest of starcat ({type(error).__name__}: {error}). {_NOT_CHECKED}"


def _check_all(database: DatabaseFolder, log: _Log) -> None:
    damaged = _check_files(database, log)
    contents = _check_products(database, damaged, log)
    log.run(MANIFEST_NAME, "", _count_problems, database.manifest, contents)
    if DATABASE_NAME not in damaged:
        log.get(DATABASE_NAME, "database", _check_database, database, contents, log)


def _check_files(database: DatabaseFolder, log: _Log) -> set[str]:
    """Return the names of the files that differ from the manifest."""
    folder, listed = database.folder, database.manifest["files"]
    damaged = {
        name
        for name, facts in listed.items()
        if not log.run(name, _product_of(name), _file_problems, folder / name, facts)
    }
    log.checks += 1
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        is_folder = path.is_dir() and not path.is_symlink()
        if not is_folder and name not in listed and name != MANIFEST_NAME:
            log.findings.append(Finding(name, _product_of(name), "not listed in the manifest"))
    return damaged


def _product_of(name: str) -> str:
    path = Path(name)
    if path.name == DATABASE_NAME:
        return "database"
    return path.stem if path.suffix == ".parquet" else ""


def _file_problems(path: Path, facts: dict[str, Any]) -> Iterator[str]:
    if not path.is_file():
        yield "missing; the manifest lists it"
        return
    size = path.stat().st_size
    if size != facts["bytes"]:
        yield f"{size} bytes; the manifest says {facts['bytes']}"
        return
    digest = file_sha256(path)
    if digest != facts["sha256"]:
        yield (
            f"changed since it was built: its sha256 begins with {digest[:12]}; the manifest says "
            f"{facts['sha256'][:12]}"
        )


def _check_products(
    database: DatabaseFolder, damaged: set[str], log: _Log
) -> dict[str, ProductContent]:
    """Check the contents of products; return the products whose columns follow their schemas."""
    sound: dict[str, ProductContent] = {}
    stars: pa.Table | None = None
    for product in sorted(database.products, key=lambda name: name != "stars"):
        file = database.manifest["products"][product]["parquet"]
        if file in damaged:
            continue
        content = log.get(file, product, _content_of, database, product, stars)
        if content is None or not log.run(file, product, columns_follow_the_schema, content):
            continue
        sound[product] = content
        for check in TABLE_CHECKS:
            log.run(file, product, check, content)
        if product == "stars":
            stars = content.table
        elif "stars" in sound:
            all(log.run(file, product, check, content) for check in REFERENCE_CHECKS)
    return sound


def _content_of(database: DatabaseFolder, product: str, stars: pa.Table | None) -> ProductContent:
    facts = database.manifest["products"][product]
    directions = np.empty((0, 3)) if stars is None else directions_of(stars)
    return ProductContent(
        database.table(product), database.schema(product), facts, directions, stars
    )


def _rejected_of(
    source: dict[str, Any], manifest: dict[str, Any], contents: dict[str, ProductContent]
) -> pa.ChunkedArray:
    """Return the reasons of the rejected records of one catalog."""
    table = contents["rejected"].table
    if [other["role"] for other in manifest["sources"]].count("stars") > 1:
        table = table.filter(pc.equal(table["catalog"], source["source"]))
    return table["reason"]


def _count_problems(manifest: dict[str, Any], contents: dict[str, ProductContent]) -> Iterator[str]:
    """Yield contradictions between the counts of sources, products and spec."""
    spec, products = manifest["spec"], manifest["products"]
    for key in ("name", "version", "epoch_jyear"):
        said = middle_of(spec[key]) if key == "epoch_jyear" else spec[key]
        if manifest[key] != said:
            yield f"{key} is {manifest[key]!r}; its spec says {said!r}"
    if [source["role"] for source in manifest["sources"]][:1] != ["stars"]:
        yield "sources: no star catalog"
    stars = [source for source in manifest["sources"] if source["role"] == "stars"]
    all_kept = sum(source["kept"] for source in stars)
    if stars and all_kept != products["stars"]["rows"]:
        names = " and ".join(source["source"] for source in stars)
        yield f"{names}: {all_kept} kept, but {products['stars']['rows']} stars"
    for source in manifest["sources"]:
        read, kept = source["rows_read"], source["kept"]
        rejected = sum(source["rejected"].values())
        in_files = sum(file["rows"] for file in source["files"])
        if not read == kept + rejected == in_files:
            yield (
                f"{source['source']}: {read} rows read, {in_files} in its files, {kept} kept and "
                f"{rejected} rejected"
            )
        if source["role"] == "stars" and "rejected" in contents:
            counts = pc.value_counts(_rejected_of(source, manifest, contents)).to_pylist()
            stored = {entry["values"]: entry["counts"] for entry in counts}
            listed = dict(source["rejected"])
            # Only a spec with a read limit has records beyond it: counted, but not listed.
            if spec["catalog"].get("read_limit_mag") is not None:
                listed.pop(Reason.beyond_read_limit.name, None)
            if stored != listed:
                yield (
                    f"{source['source']}: rejected {listed}, but the product rejected holds "
                    f"{stored}"
                )
        kind = PRODUCTS.get(source["role"])
        if kind is not None and kind.joined is not None and kind.name in contents:
            count_of, have = kind.joined
            name, joined = source["source"], source.get("joined")
            if (count := count_of(contents[kind.name].table, name)) != joined:
                yield f"{name}: {joined} stars {have}, but the product {kind.name} holds {count}"
        elif source["role"] == "motions" and "motions" not in products:
            yield f"{source['source']}: motions are from it, but there is no product motions"
    for product, facts in products.items():
        if facts["parquet"] not in manifest["files"]:
            yield f"product {product}: {facts['parquet']} is not among the files"
    fields, rows = spec["boresights"]["count"], products["boresights"]["rows"]
    # Databases of regions that earlier versions made have the fields of the whole sphere.
    if rows != fields:
        try:
            fields = len(spiral_points(fields, footprint_of_recorded(spec)))
        except ProductError as error:
            yield str(error)
    if rows != fields:
        yield f"{rows} boresights; the spec says {fields}"


def _check_database(
    database: DatabaseFolder, contents: dict[str, ProductContent], log: _Log
) -> None:
    stars = database.manifest["products"]["stars"]["rows"]
    with h5py.File(database.folder / DATABASE_NAME, "r") as file:
        log.run(DATABASE_NAME, "database", root_problems, file, database.manifest)
        for name, product in contents.items():
            group = log.get(DATABASE_NAME, name, own_group, file, name) if name in file else None
            if group is not None:
                for check in (group_problems, index_problems):
                    parts = (group, product.table, product.schema, stars)
                    log.run(DATABASE_NAME, name, check, *parts)
