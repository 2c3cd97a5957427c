"""Reading an artifact, and checking that it is whole and says the same everywhere."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa

from starcat.artifact.content import content_sha256, file_sha256
from starcat.artifact.database import MATCHER_STAR_COLUMNS
from starcat.artifact.manifest import DATABASE_NAME, read_manifest
from starcat.errors import ProductError
from starcat.parquet import read_parquet
from starcat.schema import ProductSchema, product_schema

_AGAIN = "Build the artifact again, or fetch it again"


@dataclass(frozen=True)
class Artifact:
    """An artifact on disk.

    Attributes
    ----------
    folder : Path
        The folder ``<name>-<version>``.
    manifest : dict
        Its manifest.
    """

    folder: Path
    manifest: dict[str, Any]

    @property
    def products(self) -> list[str]:
        """Names of the products, in the order of the manifest."""
        return list(self.manifest["products"])

    def schema(self, product: str) -> ProductSchema:
        """Return the schema that a product was written with.

        Parameters
        ----------
        product : str
            Name of the product.

        Returns
        -------
        ProductSchema
            The contract.
        """
        name, _, version = self.manifest["products"][product]["schema"].rpartition("-")
        return product_schema(name, version)

    def table(self, product: str) -> pa.Table:
        """Read a product from its Parquet file.

        Parameters
        ----------
        product : str
            Name of the product.

        Returns
        -------
        pyarrow.Table
            The whole product.

        Raises
        ------
        ProductError
            If the artifact has no such product, or its file cannot be read.
        """
        if product not in self.manifest["products"]:
            raise ProductError(
                f"{self.folder}: no product {product!r}; it has {', '.join(self.products)}",
                product=product,
                path=self.folder,
            )
        path = self.folder / self.manifest["products"][product]["parquet"]
        try:
            return read_parquet(path)
        except (OSError, pa.ArrowException) as error:
            raise ProductError(
                f"{path}: cannot be read ({error}); rebuild or fetch the artifact again",
                product=product,
                path=path,
            ) from error


def open_artifact(folder: Path) -> Artifact:
    """Open an artifact.

    Parameters
    ----------
    folder : Path
        The folder ``<name>-<version>``.

    Returns
    -------
    Artifact
        With its manifest read; products are read when asked for.

    Raises
    ------
    ProductError
        If the folder is not an artifact.
    """
    return Artifact(folder, read_manifest(folder))


def check_artifact(folder: Path) -> Artifact:
    """Read an artifact back and check every file against the manifest.

    Parameters
    ----------
    folder : Path
        The artifact.

    Returns
    -------
    Artifact
        The artifact, found whole.

    Raises
    ------
    ProductError
        Naming the first file or product that is missing or differs.
    SchemaError
        If a product does not follow its schema.
    """
    artifact = open_artifact(folder)
    for name, facts in artifact.manifest["files"].items():
        path = folder / name
        if not path.is_file():
            raise ProductError(f"{path}: missing; the manifest lists it. {_AGAIN}", path=path)
        size = path.stat().st_size
        if size != facts["bytes"]:
            raise ProductError(
                f"{path}: {size} bytes; the manifest says {facts['bytes']}. {_AGAIN}", path=path
            )
        if file_sha256(path) != facts["sha256"]:
            raise ProductError(
                f"{path}: changed since it was built, its digest is not that of the manifest. "
                f"{_AGAIN}",
                path=path,
            )
    for product, facts in artifact.manifest["products"].items():
        table, schema = artifact.table(product), artifact.schema(product)
        schema.check(table)
        if len(table) != facts["rows"] or content_sha256(table, schema) != facts["content_sha256"]:
            raise ProductError(
                f"{folder}: product {product} does not hold what the manifest says",
                product=product,
                path=folder,
            )
        if facts["in_database"]:
            _check_database(folder / DATABASE_NAME, table, schema)
    return artifact


def _check_database(path: Path, table: pa.Table, schema: ProductSchema) -> None:
    """Check that the HDF5 file holds the same values as the table."""
    with h5py.File(path, "r") as file:
        group = file[schema.product]
        for column in schema.columns:
            if schema.product == "stars" and column.name not in MATCHER_STAR_COLUMNS:
                continue
            values = table[column.name].combine_chunks()
            if column.is_list:
                stored, expected = group[f"{column.name}_values"][:], values.flatten().to_numpy()
            elif column.dtype == "string":
                stored = np.char.decode(group[column.name][:])
                expected = np.array(values.to_pylist(), dtype=np.str_)
            else:
                stored = group[column.name][:]
                expected = values.to_numpy(zero_copy_only=False)
            equal_nan = stored.dtype.kind == "f"
            if not np.array_equal(stored, expected, equal_nan=equal_nan):
                raise ProductError(
                    f"{path}: {schema.product}/{column.name} differs from the Parquet file",
                    product=schema.product,
                    path=path,
                )
