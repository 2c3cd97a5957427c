"""The account of a store: what was read, kept and rejected, and what lies in which partition."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from starcat.catalog.parts import IngestOptions
from starcat.catalog.verdict import Reason
from starcat.errors import BuildError
from starcat.storage.digests import json_bytes
from starcat.store.cluster import versions
from starcat.store.finish import SKYMAP_ORDER, store_schema
from starcat.store.layout import COLLECTION_NAME, MANIFEST_NAME, SKYMAP_NAME, write_properties
from starcat.store.metadata import Described, describe_catalog, sum_maps, write_skymap
from starcat.store.options import StoreOptions
from starcat.store.pixels import Pixel

MANIFEST_VERSION = "1.0.0"

Facts = dict[str, Any]


@dataclass(frozen=True)
class Written:
    """What the tasks of a run wrote.

    Attributes
    ----------
    parts : sequence of dict
        Results of splitting, one a file.
    repeated : int
        Records of stars that were read before.
    partitions, margins : sequence of (Pixel, dict)
        Results of finishing, and of writing margins.
    """

    parts: Sequence[Facts]
    repeated: int
    partitions: Sequence[tuple[Pixel, Facts]]
    margins: Sequence[tuple[Pixel, Facts]]


def make_manifest(
    name: str, how: IngestOptions, written: Written, notes: Sequence[str] = ()
) -> Facts:
    """Return what a store says of itself, after checking that no record is missing."""
    rejected = {Reason.duplicate_record.name: written.repeated}
    for part in written.parts:
        for reason, count in part["rejected"].items():
            rejected[reason] = rejected.get(reason, 0) + count
    rows_read = sum(part["file"]["rows"] for part in written.parts)
    kept = sum(facts["rows"] for _, facts in written.partitions)
    if rows_read != kept + sum(rejected.values()):
        raise BuildError(
            f"{name}: {rows_read:,} records were read, but {kept:,} are kept and "
            f"{sum(rejected.values()):,} rejected; the store is not finished. Report this, please"
        )
    if not kept:
        raise BuildError(f"{name}: none of {rows_read:,} records is kept; rejected: {rejected}")
    told = ("rows", "repeated", "bytes", "sha256")
    return {
        "store_version": MANIFEST_VERSION,
        "source": how.source_name,
        "band": how.band,
        "epoch_jyear": how.epoch_jyear,
        "read_limit_mag": how.read_limit_mag,
        "schema": store_schema().metadata[b"starcat.schema"].decode(),
        "files": [part["file"] for part in written.parts],
        "notes": list(notes),
        "rows_read": rows_read,
        "kept": kept,
        "rejected": {r.name: rejected[r.name] for r in Reason if rejected.get(r.name)},
        "partitions": [
            {"order": pixel.order, "pixel": pixel.number}
            | {key: facts[key] for key in told if key in facts}
            for pixel, facts in written.partitions
        ],
        "versions": versions(),
    }


def describe_store(
    folder: Path, name: str, manifest: Facts, written: Written, options: StoreOptions
) -> None:
    """Write what makes a folder a HATS collection, and the store's own account."""
    schema = store_schema()
    full = [(pixel, facts) for pixel, facts in written.partitions if facts["rows"]]
    more = {"hats_skymap_order": SKYMAP_ORDER, **_provenance(manifest)}
    described = _described(name, "object", full, options, more)
    describe_catalog(folder / name, described, schema)
    counts = sum_maps(SKYMAP_ORDER, [facts["map"] for _, facts in full])
    write_skymap(folder / name / SKYMAP_NAME, SKYMAP_ORDER, counts)
    collection = {"obs_collection": name, "hats_primary_table_url": name}
    if written.margins:
        margin = f"{name}_margin"
        more = {
            "hats_primary_table_url": name,
            "hats_margin_threshold": options.margin_arcsec,
        }
        described = _described(margin, "margin", written.margins, options, more)
        describe_catalog(folder / margin, described, schema)
        collection |= {"all_margins": margin, "default_margin": margin}
    write_properties(folder / COLLECTION_NAME, collection)
    (folder / MANIFEST_NAME).write_bytes(json_bytes(manifest))


def _described(
    name: str,
    kind: str,
    written: Sequence[tuple[Pixel, Facts]],
    options: StoreOptions,
    more: Facts,
) -> Described:
    rows = sum(facts["rows"] for _, facts in written)
    size = sum(facts["bytes"] for _, facts in written)
    pixels = tuple(pixel for pixel, _ in written)
    return Described(name, kind, rows, size, options.max_partition_rows, pixels, more)


def _provenance(manifest: Facts) -> Facts:
    """Return the inputs as properties of the catalog."""
    known: Facts = {
        "starcat_source": manifest["source"],
        "starcat_band": manifest["band"],
        "starcat_rows_read": manifest["rows_read"],
    }
    for reason, count in manifest["rejected"].items():
        known[f"starcat_rejected_{reason}"] = count
    for number, file in enumerate(manifest["files"]):
        known[f"starcat_input_{number}"] = (
            f"{file['name']} sha256:{file['sha256']} {file['bytes']} bytes {file['rows']} rows"
        )
    return known
