"""What can be exported: the products of an artifact, or a Parquet file, by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pyarrow as pa

from starcat.artifact.reader import open_artifact
from starcat.errors import ConfigError, SourceError, SourceMissing, suggest
from starcat.exchange.label import Label
from starcat.storage.parquet import read_parquet


@dataclass(frozen=True)
class NamedTables:
    """Tables that are read when asked for.

    Attributes
    ----------
    name : str
        Name of all of them together, such as the artifact's name and version.
    readers : mapping of str to callable
        What returns each table, by product.
    artifact, version : str
        The artifact that they are products of; empty where they are of none.
    """

    name: str
    readers: Mapping[str, Callable[[], pa.Table]]
    artifact: str = ""
    version: str = ""

    def label(self, product: str) -> Label:
        """Return what an exported file says of its table."""
        return Label(product, self.artifact, self.version)

    def chosen(self, products: Sequence[str] | None) -> list[str]:
        """Return the names asked for, in the order of the tables."""
        for product in products or ():
            if product not in self.readers:
                hint = suggest(product, self.readers)
                raise ConfigError(
                    f"{self.name} has no product {product!r}; {hint}it has "
                    f"{', '.join(self.readers)}",
                    key="product",
                    value=product,
                )
        return [name for name in self.readers if not products or name in products]


def tables_of(path: Path) -> NamedTables:
    """Return the tables of an artifact, or the one of a Parquet file."""
    if path.is_dir():
        artifact = open_artifact(path)
        readers = {name: partial(artifact.table, name) for name in artifact.products}
        name, version = artifact.manifest["name"], artifact.manifest["version"]
        return NamedTables(f"{name}-{version}", readers, name, version)
    if not path.exists():
        raise SourceMissing(
            f"{path}: does not exist; give the folder of an artifact or a Parquet file", path=path
        )
    return NamedTables(path.stem, {path.stem: partial(_read_file, path)})


def in_memory(name: str, tables: Mapping[str, pa.Table]) -> NamedTables:
    """Return tables that have been read."""
    return NamedTables(name, {product: partial(tables.__getitem__, product) for product in tables})


def _read_file(path: Path) -> pa.Table:
    try:
        return read_parquet(path)
    except (OSError, pa.ArrowException) as error:
        raise SourceError(
            f"{path}: not a readable Parquet file ({error}); give the folder of an artifact or a "
            "Parquet file, or say with --from-peer whose file it is",
            path=path,
        ) from error
