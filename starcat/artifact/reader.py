"""Reading an artifact."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from starcat.artifact.manifest import read_manifest
from starcat.errors import ProductError
from starcat.storage.parquet import read_parquet
from starcat.storage.schema import ProductSchema, product_schema


@dataclass(frozen=True)
class Artifact:
    """An artifact on disk."""

    folder: Path  # the folder ``<name>-<version>``
    manifest: dict[str, Any]

    @property
    def products(self) -> list[str]:
        """Names of the products, in the order of the manifest."""
        return list(self.manifest["products"])

    def schema(self, product: str) -> ProductSchema:
        """Return the schema that a product was written with."""
        name, _, version = self.manifest["products"][product]["schema"].rpartition("-")
        return product_schema(name, version)

    def table(self, product: str) -> pa.Table:
        """Read a product from its Parquet file."""
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
    """Open an artifact."""
    return Artifact(folder, read_manifest(folder))
