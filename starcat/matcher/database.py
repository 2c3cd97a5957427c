"""The products of an artifact as the matcher holds them: arrays mapped from its HDF5 file.

Only what a method needs is opened. Datasets are not read but mapped; every index is checked
against its table once, when the database is opened (`starcat.matcher.layout`). A database may
come from anywhere, so nothing that leads out of its file is followed (`starcat.storage.hdf5`).
"""

from __future__ import annotations

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

from starcat.errors import ArtifactMissing, ProductError, SchemaVersionError, StarcatError
from starcat.geometry.camera import Camera
from starcat.matcher.layout import LAYOUT, check_product
from starcat.onboard.reading import OnboardImage, read_image
from starcat.storage.hdf5 import own_dataset, own_group

Made = TypeVar("Made")

READABLE_LAYOUT = 1
"""Major version of the HDF5 layout that this matcher reads."""

READABLE_SCHEMAS = 1
"""Major version of the products' schemas that this matcher reads."""


@dataclass(frozen=True)
class ProductArrays:
    """One product: its columns and indices, and the numbers beside them.

    Attributes
    ----------
    arrays : mapping of str to ndarray
        By name of the dataset, as the product's schema says.
    numbers : mapping of str to float
        By name of the attribute.
    """

    arrays: Mapping[str, NDArray[Any]]
    numbers: Mapping[str, float] = field(default_factory=dict)

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Return an array by its name."""
        return self.arrays[name]


@dataclass(frozen=True)
class Database:
    """What a matcher needs of an artifact.

    Attributes
    ----------
    name : str
        ``<name>-<version>``.
    camera : Camera
        The camera that the database was built for.
    epoch_jyear : float
        Epoch of the directions, Julian year.
    star_id : ndarray of int64, shape (N,)
        Permanent star numbers.
    directions : ndarray of float64, shape (N, 3)
        ICRS unit vectors.
    mag : ndarray of float64, shape (N,)
        Magnitudes.
    designation : ndarray of bytes, shape (N,)
        Names.
    products : mapping of str to ProductArrays
        The products that were opened.
    image : OnboardImage or None
        The onboard image that all this was read from, which has no products.
    """

    name: str
    camera: Camera
    epoch_jyear: float
    star_id: NDArray[np.int64]
    directions: NDArray[np.float64]
    mag: NDArray[np.float64]
    designation: NDArray[np.bytes_]
    products: Mapping[str, ProductArrays] = field(default_factory=dict)
    image: OnboardImage | None = None
    _derived: dict[Any, Any] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __repr__(self) -> str:
        """Return name, stars and products in one line."""
        opened = ", ".join(self.products) or "no product"
        return f"<Database {self.name}: {len(self.mag):,} stars at J{self.epoch_jyear:g}, {opened}>"

    def __getstate__(self) -> dict[str, Any]:
        """Return what goes to another process: all but what can be made again there."""
        return {**vars(self), "_derived": {}}

    def derived(self, make: Callable[..., Made], *arguments: float) -> Made:
        """Return what a method makes of the database before it can use it, made once.

        Parameters
        ----------
        make : callable
            A function of the database and the arguments.
        *arguments : float
            For ``make``; for other ones it is called again.

        Returns
        -------
        object
            The same one every time.
        """
        key = make, arguments
        if key not in self._derived:
            self._derived[key] = make(self, *arguments)
        found: Made = self._derived[key]
        return found


def open_database(artifact: Path, products: Iterable[str] = ()) -> Database:
    """Open the database of an artifact.

    Parameters
    ----------
    artifact : Path
        The artifact's folder, or its ``database.h5``.
    products : iterable of str
        Names of the products to open beside the stars.

    Returns
    -------
    Database
        Its arrays are read-only views of the file, which has to stay in place.

    Raises
    ------
    ProductError
        If there is no database, it lacks a product, or a part of it is not what a build writes.
    SchemaVersionError
        If its layout or a product's schema is of another major version.
    """
    path = _database_file(artifact)
    with _readable(path) as file, path.open("rb") as raw:
        mapped = mmap.mmap(raw.fileno(), 0, access=mmap.ACCESS_READ)
        return _read(file, mapped, path, tuple(products))


def open_image(path: Path) -> Database:
    """Open an onboard image as a database, for the C library.

    Parameters
    ----------
    path : Path
        The image.

    Returns
    -------
    Database
        Stars in the order of the image, without names and products.

    Raises
    ------
    OnboardImageError, SchemaVersionError
        If the image cannot be read.
    """
    image = read_image(path)
    header, stars = image.header, image.star_id
    return Database(
        name=image.name,
        camera=image.camera,
        epoch_jyear=float(header["epoch_jyear"]),
        star_id=stars,
        directions=image.directions,
        mag=image.mag,
        designation=np.full(len(stars), b""),
        image=image,
    )


def products_in(artifact: Path) -> tuple[str, ...]:
    """Return the names of the products that an artifact's database holds.

    Parameters
    ----------
    artifact : Path
        The artifact's folder, or its ``database.h5``.

    Returns
    -------
    tuple of str
        In alphabetical order.

    Raises
    ------
    ProductError
        If there is no readable database.
    """
    with _readable(_database_file(artifact)) as file:
        return tuple(sorted(name for name in file if name in LAYOUT))


def _database_file(artifact: Path) -> Path:
    path = artifact / "database.h5" if artifact.is_dir() else artifact
    if not path.is_file():
        raise ArtifactMissing(
            f"{path}: no such database; give the folder of an artifact", path=path
        )
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
        raise ProductError(
            f"{path}: not a readable starcat database ({error}); build it again", path=path
        ) from error


def _read(file: h5py.File, mapped: mmap.mmap, path: Path, products: tuple[str, ...]) -> Database:
    _check_version(str(file.attrs["layout_version"]), READABLE_LAYOUT, "database", path)
    stars = _product(file, mapped, "stars", path)
    camera = json.loads(file.attrs["camera"])
    name = f"{file.attrs['name']}-{file.attrs['version']}"
    # Bytes that are no text are damage, which is told here and not where the name is used.
    name.encode()
    count = len(stars["star_id"])
    return Database(
        name=name,
        camera=Camera(
            _whole(camera["width_px"]),
            _whole(camera["height_px"]),
            _finite(camera["focal_length_px"]),
        ),
        epoch_jyear=_finite(file.attrs["epoch_jyear"]),
        star_id=stars["star_id"],
        directions=np.stack([stars[axis] for axis in ("x", "y", "z")], axis=-1),
        mag=stars["mag"],
        designation=stars["designation"],
        products={name: _product(file, mapped, name, path, count) for name in products},
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
    if name not in file or name not in LAYOUT:
        raise ProductError(
            f"{path}: has no product {name!r}; set 'products.{name}.enabled = true' in its spec "
            f"and build it again, or choose a method that works with {', '.join(sorted(file))}",
            product=name,
            path=path,
        )
    group = own_group(file, name)
    schema = group.attrs.get("schema")
    if not isinstance(schema, str):
        raise ProductError(
            f"{path}: {name} does not name its schema; build it again", product=name, path=path
        )
    _check_version(schema.rpartition("-")[2], READABLE_SCHEMAS, name, path)
    numbers = {
        key: float(value)
        for key, value in group.attrs.items()
        if isinstance(value, (int, float, np.number))
    }
    arrays: dict[str, NDArray[Any]] = {}
    for key in LAYOUT[name].datasets:
        if key not in group:
            raise ProductError(
                f"{path}: {name}/{key} is missing; build it again", product=name, path=path
            )
        arrays[key] = _map(own_dataset(group, key, len(mapped)), mapped)
    rows = len(arrays[LAYOUT[name].columns[0]])
    check_product(name, arrays, numbers, rows if star_count is None else star_count)
    return ProductArrays(arrays, numbers)


def _map(dataset: h5py.Dataset, mapped: mmap.mmap) -> NDArray[Any]:
    """Return a dataset of `own_dataset` as a view of the mapped file."""
    count = dataset.shape[0]
    offset = dataset.id.get_offset() if count else 0
    return np.frombuffer(mapped, dataset.dtype, count, offset)


def _check_version(found: str, readable: int, product: str, path: Path) -> None:
    if found.split(".")[0] != str(readable):
        raise SchemaVersionError(
            f"{path}: {product} is of version {found}; this matcher reads {readable}.x",
            product=product,
            found=found,
            expected=f"{readable}.x",
        )
