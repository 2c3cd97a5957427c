"""The products of a database in the matcher: arrays mapped from its HDF5 file.

Only what a method needs is opened. Datasets are not read but mapped; every one is checked against
its layout when the database is opened, because an index that leads out of its table would
end in an error far from its cause. A database may come from anywhere, so nothing that leads out of
its file is followed (`starcat.storage.hdf5`).
"""

from __future__ import annotations

import hashlib
import json
import math
import mmap
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import h5py
import numpy as np
from numpy.typing import NDArray

from starcat.arguments import database_path
from starcat.arrays import Array, Directions
from starcat.database.onboard.reading import OnboardImage, read_onboard_image
from starcat.database.products.layouts import (
    LARGEST,
    LAYOUTS,
    RANGES,
    SMALLEST,
    Numbers,
    columns_in_database,
    datasets_of,
)
from starcat.errors import (
    ConfigError,
    ProductError,
    SchemaVersionError,
    StarcatError,
    no_database,
    quoted,
)
from starcat.geometry.camera import Camera
from starcat.geometry.kvector import KVector
from starcat.storage.hdf5 import own_dataset, own_group
from starcat.storage.regular_files import check_regular_file, read_regular_file
from starcat.storage.schema import SchemaColumn

Made = TypeVar("Made")

DATABASE_NAME = "database.h5"
MANIFEST_NAME = "manifest.json"

MAX_MANIFEST_BYTES = 1 << 26
"""Largest manifest that is read."""

READABLE_LAYOUT = 1
"""Major version of the HDF5 layout that this matcher reads."""

MAX_ROWS = 1 << 40
"""Largest number of rows of a product."""

NEWEST_SCHEMAS = {"stars": 2}
"""Newest major version of a product's schema that this matcher reads, if it is not 1."""


@dataclass(frozen=True)
class ProductArrays:
    """One product: its columns and indices by dataset, and its attributes."""

    arrays: Mapping[str, NDArray[Any]]
    numbers: Numbers = field(default_factory=dict)

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self.arrays[name]

    def kvector(self, column: str) -> KVector:
        """Return the index of the column that the rows ascend by."""
        line = self.numbers["kvector_intercept"], self.numbers["kvector_slope"]
        return KVector(self.arrays[column], self.arrays["kvector_counts"], *line)


@dataclass(frozen=True)
class MatcherDatabase:
    """The part of a database that a matcher has in memory: ``matcher.database``.

    Attributes
    ----------
    name : str
        Name and version, ``<name>-<version>``.
    camera : Camera
        Camera that the database was built for.
    epoch_jyear : float
        Epoch of the directions, Julian year.
    star_id : ndarray of int64, shape (N,)
        Permanent numbers of the guide stars.
    directions : ndarray of float64, shape (N, 3)
        Unit vectors, ICRS.
    mag : ndarray of float64, shape (N,)
        Magnitudes in the band of the database.
    designation : ndarray of bytes, shape (N,)
        Names of the stars.
    """

    name: str
    camera: Camera
    epoch_jyear: float
    star_id: NDArray[np.int64]
    directions: Directions
    mag: Array
    designation: NDArray[np.bytes_]
    products: Mapping[str, ProductArrays] = field(default_factory=dict)
    folder: Path | None = field(default=None, compare=False)  # of the database
    # The onboard image, if the database was read from one; it has no products.
    image: OnboardImage | None = None
    # SHA-256 of the ``database.h5`` that this was read from, if it is as the manifest states; None
    # otherwise, and for a changed copy of this.
    sha256: str | None = field(default=None, init=False, repr=False, compare=False)
    # The whole file that this was read from; None for a changed copy, and in another process.
    _file: mmap.mmap | None = field(default=None, init=False, repr=False, compare=False)
    _cache: dict[Any, Any] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __repr__(self) -> str:
        opened = ", ".join(self.products) or "no product"
        stars = f"{len(self.mag):,} stars at J{self.epoch_jyear:g}"
        return f"<MatcherDatabase {self.name}: {stars}, {opened}>"

    def check_has_products(self, why: str, **fact: Any) -> None:
        """Check that this is not an onboard image, which has no products."""
        if self.image is not None:
            raise ConfigError(f"{why}", **fact, hint="open the database that it is of")

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for another process, without what can be made again there."""
        return {**vars(self), "_cache": {}, "_file": None}

    def file_digest(self) -> str | None:
        """Return the SHA-256 of the file that this was read from; None if that is not known."""
        if self.sha256 is None and self._file is not None:
            return hashlib.sha256(self._file).hexdigest()
        return self.sha256

    def cached(self, make: Callable[..., Made], *arguments: float) -> Made:
        """Return ``make(self, *arguments)``, which is called once for the same arguments."""
        key = make, arguments
        if key not in self._cache:
            self._cache[key] = make(self, *arguments)
        value: Made = self._cache[key]
        return value


def open_database(
    folder: Path, products: Iterable[str] = (), *, verify: bool = False
) -> MatcherDatabase:
    """Open a database, given its folder or ``database.h5``, and some products.

    The arrays are read-only views of the file, which has to stay in place. ``verify`` is whether
    its digest is compared with the manifest's. `ProductError` if the database or a product is
    missing, or a part of it is not as a build writes it; `SchemaVersionError` if its layout or a
    product's schema is of another major version.
    """
    path = _database_file(folder)
    check_regular_file(path)
    with _readable(path) as file, path.open("rb") as raw:
        mapped = mmap.mmap(raw.fileno(), 0, access=mmap.ACCESS_READ)
        database = _read(file, mapped, path, tuple(products))
    object.__setattr__(database, "_file", mapped)
    if verify:  # last: a missing product or another version has its own error
        object.__setattr__(database, "sha256", _checked_digest(path))
    return database


def _checked_digest(path: Path) -> str | None:
    """Return the digest of a ``database.h5``; `ProductError` if the manifest states another one.

    A ``database.h5`` without a manifest is not compared.
    """
    manifest = path.with_name(MANIFEST_NAME)
    if path.name != DATABASE_NAME or not manifest.exists():
        return None
    try:
        content = json.loads(read_regular_file(manifest, MAX_MANIFEST_BYTES))
        expected = content["files"][DATABASE_NAME]["sha256"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise ProductError(
            f"{manifest}: does not state the digest of {DATABASE_NAME} ({type(error).__name__}: "
            f"{error})",
            path=manifest,
            hint="build the database again, or fetch it again",
        ) from error
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    if digest != expected:
        raise ProductError(
            f"{path}: its SHA-256 is {digest}; the manifest states {quoted(str(expected), 64)}. "
            "The file was changed after the build: build the database again, or fetch it again",
            path=path,
        )
    return digest


def as_database(name: str, value: Any) -> MatcherDatabase:
    """Return the database of an argument: a `MatcherDatabase`, or what `database_path` takes."""
    return (
        value if isinstance(value, MatcherDatabase) else open_database(database_path(name, value))
    )


def open_image(path: Path) -> MatcherDatabase:
    """Open an onboard image as a database for the C library, without names and products."""
    image = read_onboard_image(path)
    header, stars = image.header, image.star_id
    return MatcherDatabase(
        name=image.name,
        camera=image.camera,
        epoch_jyear=float(header["epoch_jyear"]),
        star_id=stars,
        directions=image.directions,
        mag=image.mag,
        designation=np.full(len(stars), b""),
        image=image,
    )


def products_in(database: Path) -> tuple[str, ...]:
    """Return the names of the products that a database holds, sorted."""
    with _readable(_database_file(database)) as file:
        return tuple(sorted(name for name in file if name in LAYOUTS))


def _database_file(database: Path) -> Path:
    path = database / DATABASE_NAME if database.is_dir() else database
    if not path.is_file():
        raise no_database(database)
    return path


@contextmanager
def _readable(path: Path) -> Iterator[h5py.File]:
    try:
        with h5py.File(path, "r") as file:
            yield file
    except ProductError as error:
        raise ProductError(
            str(error) if str(path) in str(error) else f"{path}: {error}",
            product=error.product,
            path=path,
        ) from error
    except StarcatError:
        raise
    except Exception as error:  # whatever damage makes the library raise
        is_database = path.name == DATABASE_NAME
        raise ProductError(
            f"{path}: not a readable starcat database ({error})",
            path=path,
            hint="build it again" if is_database else "give the folder of a database, or its image",
        ) from error


def _read(
    file: h5py.File, mapped: mmap.mmap, path: Path, products: tuple[str, ...]
) -> MatcherDatabase:
    _check_version(str(file.attrs["layout_version"]), READABLE_LAYOUT, "database", path)
    stars = _product(file, mapped, "stars", path)
    camera = json.loads(file.attrs["camera"])
    name = f"{file.attrs['name']}-{file.attrs['version']}"
    # A name that is not valid text is damage; raise the error here, not where the name is used.
    name.encode()
    count = len(stars["star_id"])
    return MatcherDatabase(
        name=name,
        camera=Camera(
            _whole(camera["width_px"]),
            _whole(camera["height_px"]),
            _finite(camera["focal_length_px"]),
            readout_s=_finite(camera["readout_s"]) if "readout_s" in camera else None,
        ),
        epoch_jyear=_finite(file.attrs["epoch_jyear"]),
        star_id=stars["star_id"],
        directions=np.stack([stars[axis] for axis in ("x", "y", "z")], axis=-1),
        mag=stars["mag"],
        designation=stars["designation"],
        products={name: _product(file, mapped, name, path, count) for name in products},
        folder=path.parent if path.name == DATABASE_NAME else path,
    )


def _whole(value: Any) -> int:
    if not isinstance(value, int) or not 0 < value < 1 << 20:
        raise ValueError(f"a size of {str(value)[:40]} pixels")
    return value


def _finite(value: Any) -> float:
    if not math.isfinite(value):
        raise ValueError(f"a number that is {value}")
    return float(value)


def _product(
    file: h5py.File, mapped: mmap.mmap, name: str, path: Path, star_count: int | None = None
) -> ProductArrays:
    """Return a product, its indices checked against its rows and the stars."""
    if name not in file or name not in LAYOUTS:
        raise ProductError(
            f"{path}: has no product {name!r}",
            product=name,
            path=path,
            hint=f"set 'products.{name}.enabled = true' in its spec and build it again, or choose "
            f"a method that works with {', '.join(sorted(file))}",
        )
    group = own_group(file, name)
    schema = group.attrs.get("schema")
    if not isinstance(schema, str):
        raise ProductError(
            f"{path}: {name} does not name its schema",
            product=name,
            path=path,
            hint="build it again",
        )
    _check_version(schema.rpartition("-")[2], NEWEST_SCHEMAS.get(name, 1), name, path)
    numbers = {
        key: float(value)
        for key, value in group.attrs.items()
        if isinstance(value, (int, float, np.number))
    }
    arrays: dict[str, NDArray[Any]] = {}
    for key in datasets_of(name):
        if key not in group:
            raise ProductError(
                f"{path}: {name}/{key} is missing", product=name, path=path, hint="build it again"
            )
        arrays[key] = _map(own_dataset(group, key, len(mapped)), mapped)
    rows = _row_count(name, numbers)
    check_product(name, arrays, numbers, rows, rows if star_count is None else star_count)
    return ProductArrays(arrays, numbers)


def _row_count(product: str, numbers: Numbers) -> int:
    rows = numbers.get("rows", math.nan)
    if not 0 <= rows <= MAX_ROWS:
        raise damaged(product, "attribute rows", f"is {rows}")
    return int(rows)


def _map(dataset: h5py.Dataset, mapped: mmap.mmap) -> NDArray[Any]:
    count = dataset.shape[0]
    offset = dataset.id.get_offset() if count else 0
    return np.frombuffer(mapped, dataset.dtype, count, offset)


def _check_version(version: str, newest: int, product: str, path: Path) -> None:
    readable = [str(major) for major in range(1, newest + 1)]
    if version.split(".")[0] not in readable:
        expected = " and ".join(f"{major}.x" for major in readable)
        raise SchemaVersionError(
            f"{path}: {product} is of version {version}; this matcher reads {expected}",
            product=product,
            found=version,
            expected=expected,
        )


def check_product(
    name: str, arrays: Mapping[str, NDArray[Any]], numbers: Numbers, rows: int, star_count: int
) -> None:
    """Check that a product has its layout; `ProductError` names the first difference."""
    layout = LAYOUTS[name]
    checks = _Checks(name, arrays, star_count)
    for attribute in (*layout.numbers, *(("kvector_intercept", "kvector_slope") * layout.kvector)):
        if not math.isfinite(numbers[attribute]) or abs(numbers[attribute]) > LARGEST:
            raise damaged(name, f"attribute {attribute}", f"is {numbers[attribute]}")
    for attribute in layout.numbers:
        if numbers[attribute] < SMALLEST:
            raise damaged(name, f"attribute {attribute}", f"is {numbers[attribute]}")
    for column in columns_in_database(name):
        if column.is_list:
            offsets, values = column.datasets
            checks.offsets(offsets, rows, len(arrays[values]))
            of_stars = column.refers_to == "stars"
            checks.below(values, star_count if of_stars else layout.lists[column.name](numbers))
        else:
            checks.values(column, rows)
    for key in layout.per_star:
        checks.reals(key, star_count, with_unknown=True)
    if layout.by_star:
        checks.offsets("star_offsets", star_count, rows)
    for table, bins in layout.bins.items():
        checks.offsets(f"{table}_offsets", bins(numbers), len(arrays[f"{table}_rows"]))
        checks.below(f"{table}_rows", rows)
    if layout.kvector:
        checks.counts("kvector_counts", rows)
        if numbers["kvector_slope"] < 0.0:
            raise damaged(name, "attribute kvector_slope", "is negative")
    if name == "stars":
        checks.directions()


@dataclass(frozen=True)
class _Checks:
    """The checks of one product's datasets; each raises if the dataset is not so."""

    product: str
    arrays: Mapping[str, NDArray[Any]]
    star_count: int

    def shape(self, name: str, kinds: str, length: float) -> None:
        array = self.arrays[name]
        if array.dtype.kind not in kinds:
            raise damaged(self.product, name, f"holds {array.dtype}")
        if len(array) != length:
            raise damaged(self.product, name, f"has {len(array)} entries; expected {length:g}")

    def values(self, column: SchemaColumn, rows: int) -> None:
        """Check a column with one value per row; row numbers of stars lead to a star."""
        if column.dtype.startswith("float"):
            self.reals(column.name, rows, with_unknown=column.nullable)
        else:
            self.shape(column.name, "S" if column.dtype == "string" else "iu", rows)
            if column.refers_to == "stars":
                self.below(column.name, self.star_count)

    def reals(self, name: str, length: int, *, with_unknown: bool) -> None:
        self.shape(name, "f", length)
        array = self.arrays[name]
        low, high = RANGES.get(name, (-LARGEST, LARGEST))
        if with_unknown:
            array = array[~np.isnan(array)]
        # NaN is neither above nor below anything.
        if len(array) and not (array.min() >= low and array.max() <= high):
            raise damaged(self.product, name, f"holds numbers outside {low:g} to {high:g}, or NaN")

    def below(self, name: str, limit: float) -> None:
        """Check that all entries lie in [0, limit)."""
        array = self.arrays[name]
        self.shape(name, "iu", len(array))
        if len(array) and not (array.min() >= 0 and array.max() < limit):
            raise damaged(
                self.product, name, f"refers to {array.min()} to {array.max()}; there are {limit:g}"
            )

    def offsets(self, name: str, entries: float, end: int) -> None:
        """Check that entries + 1 offsets ascend from 0 to the end of their table."""
        self.shape(name, "iu", entries + 1)
        array = self.arrays[name]
        if array[0] != 0 or array[-1] != end or np.any(array[1:] < array[:-1]):
            raise damaged(self.product, name, f"does not ascend from 0 to {end}")

    def counts(self, name: str, rows: int) -> None:
        """Check that counts of rows ascend, and that none is above the number of rows."""
        self.shape(name, "iu", rows)
        array = self.arrays[name]
        ends = rows == 0 or (array[0] >= 0 and array[-1] <= rows)
        if not ends or np.any(array[1:] < array[:-1]):
            raise damaged(self.product, name, f"does not ascend within 0 to {rows}")

    def directions(self) -> None:
        squares = sum(self.arrays[axis] ** 2 for axis in ("x", "y", "z"))
        off = np.abs(squares - 1.0)
        if len(off) and not off.max() < 1e-9:
            row = int(np.argmax(~(off < 1e-9)))
            raise damaged(self.product, "x, y, z", f"is not a unit vector in row {row}")


def damaged(product: str, what: str, problem: str) -> ProductError:
    """Return the error for a database that was changed after its build."""
    return ProductError(
        f"{product}/{what} {problem}; the database is damaged",
        product=product,
        hint="Build the database again, or fetch it again",
    )
