"""The metadata files of a HATS collection, and the store's own account.

HATS defines properties, footers and the map of counts. ``store.json`` states which records were
read, kept and rejected, and the rows of each partition.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from starcat.catalog.parts import IngestOptions
from starcat.catalog.source import map_of
from starcat.catalog.stars.verdict import Reason
from starcat.catalog.store.cluster import versions
from starcat.catalog.store.finish import SKYMAP_ORDER, store_schema
from starcat.catalog.store.layout import (
    COLLECTION_NAME,
    DATASET,
    HEALPIX_COLUMN,
    MANIFEST_NAME,
    MAX_ORDER,
    PARTITIONS_NAME,
    SKYMAP_NAME,
    Pixel,
    write_properties,
)
from starcat.catalog.store.plan import StoreOptions
from starcat.errors import BuildError
from starcat.storage.atomic import json_bytes
from starcat.storage.parquet import votable_metadata
from starcat.version import __version__

HATS_VERSION = "v1.0"
MANIFEST_VERSION = "1.0.0"

Facts = dict[str, Any]


@dataclass(frozen=True)
class Described:
    """A HATS catalog after its partitions are written."""

    name: str  # name of the catalog
    kind: str  # ``object`` or ``margin``
    partitions: Sequence[tuple[Pixel, Facts]]  # rows and bytes of each, sorted by pixel
    max_rows: int  # most stars in a partition
    more: Mapping[str, Any]  # further properties

    def total(self, fact: str) -> int:
        """Return the sum of a fact over the partitions."""
        return sum(facts[fact] for _, facts in self.partitions)


def write_slices(
    stars: pa.Table, partitions: Sequence[Pixel], folder: Path, row_group_rows: int
) -> list[tuple[Pixel, Facts]]:
    """Write the partitions of a table in memory; return the rows and bytes of each."""
    pixels = stars[HEALPIX_COLUMN].to_numpy()
    written: list[tuple[Pixel, Facts]] = []
    for pixel in partitions:
        begin, end = np.searchsorted(pixels, [pixel.first, pixel.end])
        path = folder / DATASET / pixel.path
        path.parent.mkdir(parents=True, exist_ok=True)
        rows = stars.slice(begin, end - begin)
        pq.write_table(rows, path, compression="zstd", row_group_size=row_group_rows)
        written.append((pixel, {"rows": len(rows), "bytes": path.stat().st_size}))
    return written


def write_pixel_list(folder: Path, partitions: Sequence[Pixel]) -> None:
    """Write the list of the partitions of a HATS catalog."""
    lines = "".join(f"{pixel.order},{pixel.number}\n" for pixel in partitions)
    (folder / PARTITIONS_NAME).write_text(f"Norder,Npix\n{lines}", encoding="utf-8", newline="\n")


def describe_catalog(folder: Path, catalog: Described, schema: pa.Schema) -> None:
    """Write the metadata files of a HATS catalog."""
    dataset, pixels = folder / DATASET, [pixel for pixel, _ in catalog.partitions]
    footers = []
    for pixel in pixels:
        footer = pq.read_metadata(dataset / pixel.path)
        footer.set_file_path(pixel.path.as_posix())
        footers.append(footer)
    metadata = {**(schema.metadata or {}), **votable_metadata(schema.empty_table())}
    pq.write_metadata(schema.with_metadata(metadata), dataset / "_common_metadata")
    pq.write_metadata(schema, dataset / "_metadata", footers)
    write_pixel_list(folder, pixels)
    write_properties(folder / "hats.properties", _properties(catalog))


def _properties(catalog: Described) -> dict[str, Any]:
    return {
        "obs_collection": catalog.name,
        "dataproduct_type": catalog.kind,
        "hats_nrows": catalog.total("rows"),
        "hats_col_ra": "ra_deg",
        "hats_col_dec": "dec_deg",
        "hats_col_healpix": HEALPIX_COLUMN,
        "hats_col_healpix_order": MAX_ORDER,
        "hats_max_rows": catalog.max_rows,
        "hats_order": max((pixel.order for pixel, _ in catalog.partitions), default=0),
        "hats_npix_suffix": ".parquet",
        "hats_estsize": -(-catalog.total("bytes") // 1024),
        "hats_builder": f"starcat {__version__}",
        "hats_version": HATS_VERSION,
        **catalog.more,
    }


def write_skymap(path: Path, order: int, counts: NDArray[np.int64]) -> None:
    """Write the number of stars in each pixel, as a HEALPix map in a FITS file."""
    from astropy.io import fits

    column = fits.Column("PIXELS", "K", array=counts)
    table = fits.BinTableHDU.from_columns([column])
    table.header.update(
        {
            "PIXTYPE": "HEALPIX",
            "ORDERING": "NESTED",
            "COORDSYS": "C",
            "NSIDE": 1 << order,
            "FIRSTPIX": 0,
            "LASTPIX": len(counts) - 1,
            "INDXSCHM": "IMPLICIT",
            "OBJECT": "FULLSKY",
        }
    )
    fits.HDUList([fits.PrimaryHDU(), table]).writeto(path, overwrite=True)


@dataclass(frozen=True)
class Written:
    """The results of the tasks of a run."""

    parts: Sequence[Facts]  # results of splitting, one per file
    repeated: int  # records whose star was read before
    partitions: Sequence[tuple[Pixel, Facts]]  # results of finishing
    margins: Sequence[tuple[Pixel, Facts]]  # results of writing margins


def make_manifest(
    name: str, options: IngestOptions, written: Written, notes: Sequence[str] = ()
) -> Facts:
    """Return the account of a store, after checking that no record is missing."""
    rejected = {Reason.duplicate_record.name: written.repeated}
    for part in written.parts:
        for reason, count in part["rejected"].items():
            rejected[reason] = rejected.get(reason, 0) + count
    rows_read = sum(part["file"]["rows"] for part in written.parts)
    kept = sum(facts["rows"] for _, facts in written.partitions)
    if rows_read != kept + sum(rejected.values()):
        raise BuildError(
            f"{rows_read:,} records were read, but {kept:,} are kept and "
            f"{sum(rejected.values()):,} rejected; the store is not finished",
            where=name,
            hint="Report this, please",
        )
    if not kept:
        raise BuildError(f"none of {rows_read:,} records is kept; rejected: {rejected}", where=name)
    keys = ("rows", "repeated", "bytes", "sha256")
    table_map = map_of(options.source_name)
    return {
        "store_version": MANIFEST_VERSION,
        "source": options.source_name,
        **({"map": table_map} if table_map else {}),
        "band": options.band,
        "epoch_jyear": options.epoch_jyear,
        "read_limit_mag": options.read_limit_mag,
        "schema": store_schema().metadata[b"starcat.schema"].decode(),
        "files": [part["file"] for part in written.parts],
        "notes": list(notes),
        "rows_read": rows_read,
        "kept": kept,
        "rejected": {r.name: rejected[r.name] for r in Reason if rejected.get(r.name)},
        "partitions": [
            {"order": pixel.order, "pixel": pixel.number}
            | {key: facts[key] for key in keys if key in facts}
            for pixel, facts in written.partitions
        ],
        "versions": versions(),
    }


def describe_store(
    folder: Path, name: str, manifest: Facts, written: Written, options: StoreOptions
) -> None:
    """Write the metadata of a HATS collection, and the store's own account."""
    schema = store_schema()
    full = [(pixel, facts) for pixel, facts in written.partitions if facts["rows"]]
    more = {"hats_skymap_order": SKYMAP_ORDER, **_provenance(manifest)}
    described = Described(name, "object", full, options.max_partition_rows, more)
    describe_catalog(folder / name, described, schema)
    counts = np.zeros(12 * 4**SKYMAP_ORDER, dtype=np.int64)
    for _, facts in full:
        pixels, numbers = facts["map"]
        np.add.at(counts, pixels, numbers)
    write_skymap(folder / name / SKYMAP_NAME, SKYMAP_ORDER, counts)
    collection = {"obs_collection": name, "hats_primary_table_url": name}
    if written.margins:
        margin = f"{name}_margin"
        more = {"hats_primary_table_url": name, "hats_margin_threshold": options.margin_arcsec}
        described = replace(
            described, name=margin, kind="margin", partitions=written.margins, more=more
        )
        describe_catalog(folder / margin, described, schema)
        collection |= {"all_margins": margin, "default_margin": margin}
    write_properties(folder / COLLECTION_NAME, collection)
    (folder / MANIFEST_NAME).write_bytes(json_bytes(manifest))


def _provenance(manifest: Facts) -> Facts:
    """Return the inputs as properties of the catalog."""
    properties: Facts = {
        "starcat_source": manifest["source"],
        "starcat_band": manifest["band"],
        "starcat_rows_read": manifest["rows_read"],
    }
    for reason, count in manifest["rejected"].items():
        properties[f"starcat_rejected_{reason}"] = count
    for number, file in enumerate(manifest["files"]):
        properties[f"starcat_input_{number}"] = (
            f"{file['name']} sha256:{file['sha256']} {file['bytes']} bytes {file['rows']} rows"
        )
    return properties
