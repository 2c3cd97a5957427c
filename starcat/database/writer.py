"""Write the files of a database: its HDF5 file, its tables, and the manifest last.

The content digest of a table is computed from the values of its columns in a fixed little-endian
layout, so it does not depend on the version of the library that wrote the file.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from starcat.catalog.stars.epochs import middle_of
from starcat.database.database import open_for_writing, write_product, write_root
from starcat.database.manifest import (
    DATABASE_NAME,
    MANIFEST_NAME,
    MANIFEST_VERSION,
    SourceFacts,
    manifest_digest,
    software_versions,
)
from starcat.database.products.index import Index
from starcat.database.products.table import PRODUCTS
from starcat.results import to_dict
from starcat.storage.atomic import file_sha256, json_bytes
from starcat.storage.parquet import write_parquet
from starcat.storage.schema import ProductSchema, product_schema


@dataclass(frozen=True)
class Product:
    """A product before it is written into a database."""

    name: str  # name of the product and of its schema
    table: pa.Table  # columns and row order follow the schema
    index: Index = field(default_factory=Index)  # indices for a matcher

    @property
    def in_database(self) -> bool:
        """Whether the matcher's HDF5 file has the product."""
        return PRODUCTS[self.name].in_database


def write_products(
    folder: Path, products: Sequence[Product], facts: Mapping[str, str | float]
) -> dict[str, dict[str, Any]]:
    """Write the products of a database; return the facts for the manifest about each.

    ``records`` of the triangles is the sum over all boresights, as counted in the papers.
    """
    written: dict[str, dict[str, Any]] = {}
    star_count = next(len(product.table) for product in products if product.name == "stars")
    with open_for_writing(folder / DATABASE_NAME) as database:
        write_root(database, facts)
        for product in products:
            schema = product_schema(product.name)
            schema.check(product.table)
            write_parquet(product.table, folder / f"{product.name}.parquet")
            if product.in_database:
                write_product(database, product.table, schema, product.index, star_count)
            written[product.name] = {
                "schema": schema.name,
                "rows": len(product.table),
                "content_sha256": content_sha256(product.table, schema),
                "parquet": f"{product.name}.parquet",
                "in_database": product.in_database,
            }
            if "records" in product.index.attributes:
                written[product.name]["records"] = int(product.index.attributes["records"])
    return written


def write_manifest(
    folder: Path,
    spec: dict[str, Any],
    sources: Sequence[SourceFacts],
    products: Mapping[str, Mapping[str, Any]],
) -> dict[str, Any]:
    """Write the manifest of a folder whose other files are complete."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    manifest: dict[str, Any] = {
        "format": "starcat-artifact",
        "manifest_version": MANIFEST_VERSION,
        "name": spec["name"],
        "version": spec["version"],
        "frame": "ICRS",
        "epoch_jyear": middle_of(spec["epoch_jyear"]),
        "spec": spec,
        "sources": [to_dict(source) for source in sources],
        "products": products,
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


def content_sha256(table: pa.Table, schema: ProductSchema) -> str:
    """Return the content digest of a product."""
    digest = hashlib.sha256(f"{schema.name} {len(table)}\n".encode())
    for column in schema.columns:
        digest.update(f"{column.name} {column.dtype} {column.unit}\n".encode())
        values = table[column.name].combine_chunks()
        is_null = values.is_null().to_numpy(zero_copy_only=False)
        digest.update(np.packbits(is_null).tobytes())
        if column.is_list:
            lengths = pc.fill_null(pc.list_value_length(values), 0)
            digest.update(lengths.to_numpy().astype("<i8").tobytes())
            values = pc.list_flatten(values)
        digest.update(_value_bytes(values, column.item_dtype))
    return digest.hexdigest()


def _value_bytes(values: pa.Array, dtype: str) -> bytes:
    if dtype == "string":
        filled = pc.fill_null(values, "")
        lengths = pc.binary_length(filled).to_numpy().astype("<i8")
        _, offsets, letters = filled.buffers()
        if not lengths.sum():
            return bytes(lengths.tobytes())
        # The texts are contiguous in a part of the buffer.
        ends = np.frombuffer(offsets, dtype=np.int32)[filled.offset :][[0, len(filled)]]
        return bytes(lengths.tobytes() + memoryview(letters)[ends[0] : ends[1]])
    if dtype == "bool":
        return bytes(np.packbits(np.array(pc.fill_null(values, False))).tobytes())
    filled = pc.fill_null(values, 0) if values.null_count else values
    return bytes(filled.to_numpy().astype(np.dtype(dtype).newbyteorder("<")).tobytes())
