"""Writing the files of an artifact: its database, its tables, and the manifest last."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pyarrow as pa

from starcat.artifact.content import content_sha256
from starcat.artifact.database import open_for_writing, write_product, write_root
from starcat.artifact.manifest import (
    DATABASE_NAME,
    MANIFEST_NAME,
    MANIFEST_VERSION,
    MOTIONS_VERSION,
    ProductFacts,
    SourceFacts,
    manifest_digest,
    software_versions,
)
from starcat.products.index import Index
from starcat.storage.digests import file_sha256, json_bytes
from starcat.storage.parquet import write_parquet
from starcat.storage.schema import product_schema


@dataclass(frozen=True)
class Product:
    """A product on its way into an artifact."""

    name: str  # name of the product, which is that of its schema
    table: pa.Table  # with the columns of the schema, in the schema's order of rows
    index: Index = field(default_factory=Index)  # what a matcher needs beside the columns
    in_database: bool = True  # whether the matcher's HDF5 file holds it


def write_products(
    folder: Path, products: Sequence[Product], facts: Mapping[str, str | float]
) -> dict[str, ProductFacts]:
    """Write the products of an artifact."""
    made: dict[str, ProductFacts] = {}
    star_count = next(len(product.table) for product in products if product.name == "stars")
    with open_for_writing(folder / DATABASE_NAME) as database:
        write_root(database, facts)
        for product in products:
            schema = product_schema(product.name)
            schema.check(product.table)
            write_parquet(product.table, folder / f"{product.name}.parquet")
            if product.in_database:
                write_product(database, product.table, schema, product.index, star_count)
            records = product.index.attributes.get("records")
            made[product.name] = ProductFacts(
                schema,
                len(product.table),
                content_sha256(product.table, schema),
                product.in_database,
                None if records is None else int(records),
            )
    return made


def write_manifest(
    folder: Path,
    spec: dict[str, Any],
    sources: Sequence[SourceFacts],
    products: Mapping[str, ProductFacts],
) -> dict[str, Any]:
    """Write the manifest of a folder whose other files are complete."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    has_motions = any(source.role == "motions" for source in sources)
    manifest: dict[str, Any] = {
        "format": "starcat-artifact",
        "manifest_version": MOTIONS_VERSION if has_motions else MANIFEST_VERSION,
        "name": spec["name"],
        "version": spec["version"],
        "frame": "ICRS",
        "epoch_jyear": spec["epoch_jyear"],
        "spec": spec,
        "sources": [source.as_dict() for source in sources],
        "products": {name: facts.as_dict() for name, facts in products.items()},
        "files": {
            path.relative_to(folder).as_posix(): {
                "bytes": path.stat().st_size,
                "sha256": file_sha256(path),
            }
            for path in files
        },
        "software": software_versions(),
    }
    manifest["manifest_sha256"] = manifest_digest(manifest)
    (folder / MANIFEST_NAME).write_bytes(json_bytes(manifest))
    return manifest
