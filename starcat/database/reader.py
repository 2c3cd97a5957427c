"""Read a database: the manifest at once, each table on first use.

Only reading a table needs more than the standard library.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starcat.database.manifest import read_manifest
from starcat.errors import ProductError
from starcat.storage.schema import ProductSchema, product_schema

if TYPE_CHECKING:
    import pyarrow as pa


class DatabaseFolder:
    """A database on disk."""

    def __init__(self, folder: Path, manifest: dict[str, Any]) -> None:
        self.folder = folder
        self.manifest = manifest

    @property
    def products(self) -> Products:
        """The tables by name, such as ``database.products["pairs"]``."""
        return Products(self)

    @cached_property
    def stars(self) -> pa.Table:
        """The guide stars as an Arrow table, sorted by star number."""
        return self.table("stars")

    def schema(self, product: str) -> ProductSchema:
        """Return the schema of a product in this database."""
        name, _, version = self.manifest["products"][product]["schema"].rpartition("-")
        return product_schema(name, version)

    def table(self, product: str) -> pa.Table:
        """Read a product from its Parquet file."""
        import pyarrow as pa

        from starcat.storage.parquet import read_parquet

        if product not in self.products:
            raise ProductError(
                f"no product {product!r}; it has {', '.join(self.products)}",
                where=self.folder,
                product=product,
            )
        path = self.folder / self.manifest["products"][product]["parquet"]
        try:
            return read_parquet(path)
        except (OSError, pa.ArrowException) as error:
            raise ProductError(
                f"cannot be read ({error})",
                where=path,
                product=product,
                hint="rebuild or fetch the database again",
            ) from error

    def __repr__(self) -> str:
        stars = self.manifest["products"]["stars"]["rows"]
        name = f"{self.manifest['name']}-{self.manifest['version']}"
        epoch, count = self.manifest["epoch_jyear"], len(self.products)
        return f"<Database {name}: {stars:,} guide stars at J{epoch:g}, {count} products>"


class Products(Mapping[str, "pa.Table"]):
    """The tables of a database by name, in the order of the manifest; each is read when used."""

    def __init__(self, database: DatabaseFolder) -> None:
        self._database_of_folder = database
        self._facts: dict[str, Any] = database.manifest["products"]

    def __getitem__(self, name: str) -> pa.Table:
        if name not in self._facts:
            raise KeyError(name)
        return self._database_of_folder.table(name)

    def __contains__(self, name: object) -> bool:
        return name in self._facts

    def __iter__(self) -> Iterator[str]:
        return iter(self._facts)

    def __len__(self) -> int:
        return len(self._facts)

    def __repr__(self) -> str:
        counts = [f"{name} ({facts['rows']:,})" for name, facts in self._facts.items()]
        return f"<Products: {', '.join(counts)}>"


def open_database_folder(folder: Path) -> DatabaseFolder:
    """Open a database."""
    return DatabaseFolder(folder, read_manifest(folder))
