"""The products of an artifact as the matcher holds them: arrays mapped from its HDF5 file.

Only what a method needs is opened. Contiguous datasets are not read but mapped, so opening
takes milliseconds whatever the size of the database.
"""

from __future__ import annotations

import json
import mmap
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import h5py
import numpy as np
from numpy.typing import NDArray

from starcat.errors import ArtifactMissing, ProductError, SchemaVersionError
from starcat.geometry.camera import Camera

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
    """

    name: str
    camera: Camera
    epoch_jyear: float
    star_id: NDArray[np.int64]
    directions: NDArray[np.float64]
    mag: NDArray[np.float64]
    designation: NDArray[np.bytes_]
    products: Mapping[str, ProductArrays] = field(default_factory=dict)
    _derived: dict[Any, Any] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __repr__(self) -> str:
        """Return name, stars and products in one line."""
        opened = ", ".join(self.products) or "no product"
        return f"<Database {self.name}: {len(self.mag):,} stars at J{self.epoch_jyear:g}, {opened}>"

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
        If there is no database, or it lacks a product.
    SchemaVersionError
        If its layout or a product's schema is of another major version.
    """
    path = _database_file(artifact)
    with _readable(path) as file, path.open("rb") as raw:
        mapped = mmap.mmap(raw.fileno(), 0, access=mmap.ACCESS_READ)
        return _read(file, mapped, path, tuple(products))


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
        return tuple(sorted(file))


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
    except (OSError, KeyError, ValueError, RuntimeError) as error:
        raise ProductError(
            f"{path}: not a readable starcat database ({error}); build it again", path=path
        ) from error


def _read(file: h5py.File, mapped: mmap.mmap, path: Path, products: tuple[str, ...]) -> Database:
    _check_version(str(file.attrs["layout_version"]), READABLE_LAYOUT, "database", path)
    stars = _product(file, mapped, "stars", path)
    camera = json.loads(file.attrs["camera"])
    return Database(
        name=f"{file.attrs['name']}-{file.attrs['version']}",
        camera=Camera(camera["width_px"], camera["height_px"], camera["focal_length_px"]),
        epoch_jyear=float(file.attrs["epoch_jyear"]),
        star_id=stars["star_id"],
        directions=np.stack([stars[axis] for axis in ("x", "y", "z")], axis=-1),
        mag=stars["mag"],
        designation=stars["designation"],
        products={name: _product(file, mapped, name, path) for name in products},
    )


def _product(file: h5py.File, mapped: mmap.mmap, name: str, path: Path) -> ProductArrays:
    if name not in file:
        raise ProductError(
            f"{path}: has no product {name!r}; set 'products.{name}.enabled = true' in its spec "
            f"and build it again, or choose a method that works with {', '.join(sorted(file))}",
            product=name,
            path=path,
        )
    group = file[name]
    _check_version(str(group.attrs["schema"]).rpartition("-")[2], READABLE_SCHEMAS, name, path)
    numbers = {
        key: float(value)
        for key, value in group.attrs.items()
        if isinstance(value, (int, float, np.number))
    }
    return ProductArrays({key: _map(group[key], mapped) for key in group}, numbers)


def _map(dataset: h5py.Dataset, mapped: mmap.mmap) -> NDArray[Any]:
    """Return a dataset as a view of the mapped file; what is not contiguous is read."""
    offset = dataset.id.get_offset()
    if offset is None or dataset.chunks is not None:
        return np.asarray(dataset[()])
    count = int(np.prod(dataset.shape))
    return np.frombuffer(mapped, dataset.dtype, count, offset).reshape(dataset.shape)


def _check_version(found: str, readable: int, product: str, path: Path) -> None:
    if found.split(".")[0] != str(readable):
        raise SchemaVersionError(
            f"{path}: {product} is of version {found}; this matcher reads {readable}.x",
            product=product,
            found=found,
            expected=f"{readable}.x",
        )
