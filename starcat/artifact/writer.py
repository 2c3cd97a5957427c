"""Writing an artifact: into a hidden folder, read back, and only then given its name."""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import pyarrow as pa

from starcat.artifact.content import content_sha256
from starcat.artifact.database import open_for_writing, write_product, write_root
from starcat.artifact.manifest import (
    DATABASE_NAME,
    MANIFEST_NAME,
    MANIFEST_VERSION,
    ProductFacts,
    SourceFacts,
    manifest_digest,
    software_versions,
)
from starcat.errors import OutputError, reason
from starcat.products.index import Index
from starcat.storage.digests import file_sha256, json_bytes
from starcat.tables.parquet import write_parquet
from starcat.tables.schema import product_schema

Outcome = Literal["written", "unchanged", "replaced"]


@dataclass(frozen=True)
class Product:
    """A product on its way into an artifact.

    Attributes
    ----------
    name : str
        Of its schema.
    table : pyarrow.Table
        With the columns of the schema, in the schema's order of rows.
    index : Index
        What a matcher needs beside the columns.
    in_database : bool
        Whether the matcher's HDF5 file holds it.
    """

    name: str
    table: pa.Table
    index: Index = field(default_factory=Index)
    in_database: bool = True


@contextmanager
def partial_folder(final: Path) -> Iterator[Path]:
    """Give a folder to write into, beside the final one, and remove it afterwards.

    Parameters
    ----------
    final : Path
        Where the artifact will be.

    Yields
    ------
    Path
        An empty folder ``.<name>.*.partial`` on the same file system.

    Raises
    ------
    OutputError
        If it cannot be made, or the disk is full.
    """
    try:
        final.parent.mkdir(parents=True, exist_ok=True)
        made = Path(tempfile.mkdtemp(prefix=f".{final.name}.", suffix=".partial", dir=final.parent))
    except OSError as error:
        raise OutputError(
            f"{final.parent}: cannot write there ({reason(error)}); choose another folder "
            "with --output",
            path=final.parent,
        ) from error
    try:
        made.chmod(0o755)
        yield made
    except OSError as error:
        if error.errno in {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES}:
            raise OutputError(
                f"{final.parent}: writing failed ({reason(error)}); nothing was left there",
                path=final.parent,
            ) from error
        raise
    finally:
        shutil.rmtree(made, ignore_errors=True)


def write_products(
    folder: Path, products: Sequence[Product], facts: Mapping[str, str | float]
) -> dict[str, ProductFacts]:
    """Write the products of an artifact.

    Parameters
    ----------
    folder : Path
        Where to write ``database.h5`` and one Parquet file a product.
    products : sequence of Product
        In the order of the database.
    facts : mapping of str to str or float
        Attributes of the database as a whole.

    Returns
    -------
    dict of str to ProductFacts
        For the manifest, by product.

    Raises
    ------
    SchemaError
        If a table does not follow its schema.
    """
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
    """Write the manifest of a folder whose other files are complete.

    Parameters
    ----------
    folder : Path
        With all files of the artifact but the manifest.
    spec : dict
        The whole build spec.
    sources : sequence of SourceFacts
        What went in.
    products : mapping of str to ProductFacts
        What came out.

    Returns
    -------
    dict
        The manifest.
    """
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    manifest: dict[str, Any] = {
        "format": "starcat-artifact",
        "manifest_version": MANIFEST_VERSION,
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


def move_into_place(partial: Path, final: Path, *, replace: bool) -> Outcome:
    """Give a complete folder its final name.

    Parameters
    ----------
    partial : Path
        Complete and checked.
    final : Path
        The name to give it.
    replace : bool
        Whether a different artifact of that name may be replaced.

    Returns
    -------
    {"written", "unchanged", "replaced"}
        ``unchanged`` where the final folder already held the same manifest.

    Raises
    ------
    OutputError
        If something else is there and ``replace`` is false.
    """
    for path in sorted(partial.rglob("*")):
        if path.is_file():
            with path.open("rb") as file:
                os.fsync(file.fileno())
    if not final.exists() and _rename(partial, final):
        return "written"
    new = (partial / MANIFEST_NAME).read_bytes()
    old = final / MANIFEST_NAME
    if old.is_file() and old.read_bytes() == new and _is_whole(final, partial):
        return "unchanged"
    if not replace:
        raise OutputError(
            f"{final} already exists and differs; raise the version in the spec, choose another "
            "--output, or pass --replace",
            path=final,
        )
    aside = partial.with_name(f"{partial.name}.old.partial")
    try:
        final.rename(aside)
        partial.rename(final)
    except BaseException:  # a signal between the two must not leave the name empty
        if aside.exists() and not final.exists():
            aside.rename(final)
        raise
    shutil.rmtree(aside, ignore_errors=True)
    return "replaced"


def _rename(partial: Path, final: Path) -> bool:
    """Rename, and return False where another build has just taken the name."""
    try:
        partial.rename(final)
    except OSError:
        if final.exists():
            return False
        raise
    return True


def _is_whole(final: Path, partial: Path) -> bool:
    """Return whether every file of the new artifact is in the old one with the same bytes."""
    names = [path.relative_to(partial) for path in partial.rglob("*") if path.is_file()]
    return all(
        (final / name).is_file() and file_sha256(final / name) == file_sha256(partial / name)
        for name in names
    )
