"""Stores as the input of a build: only the partitions, row groups and columns that it can use.

A store that starcat made gives what reading its archive files gives, to the last bit: it keeps
rejected records, and records whose star was read before, beside the stars, and says what it was
made from. HATS catalogs of others need the columns `NEEDED`; what else of the stars schema they
have is used, and their own files are the inputs that the artifact names.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from starcat.catalog.ingest import Ingested, StarTables, ingest, ingest_options, ingested
from starcat.catalog.parts import NAMED_PROBLEMS, IngestOptions
from starcat.catalog.readers.blocks import map_in_order
from starcat.catalog.source_files import FileFacts
from starcat.catalog.stars import add_nearest_neighbours, floats_of, move_to_epoch, with_columns
from starcat.catalog.verdict import Reason
from starcat.errors import ConfigError, ProductError, SchemaError, SchemaVersionError
from starcat.progress import Progress, no_progress
from starcat.storage.digests import file_sha256
from starcat.storage.schema import product_schema
from starcat.store.layout import MANIFEST_NAME, REJECTED, REPEATED, Store, is_store, open_store
from starcat.store.metadata import MANIFEST_VERSION

NEEDED = ("star_id", "ra_deg", "dec_deg", "epoch_jyear", "mag")
"""Columns that a catalog of others must have; ``band`` is taken for the one asked for."""


def read_catalog(
    source_name: str,
    paths: Sequence[Path],
    *,
    band: str | None = None,
    epoch_jyear: float | None = None,
    read_limit_mag: float | None = None,
    neighbours: bool = True,
    workers: int = 2,
    progress: Progress = no_progress,
) -> Ingested:
    """Read a star catalog from a store or from archive files."""
    if not any(path.is_dir() and is_store(path) for path in paths):
        return ingest(
            source_name,
            paths,
            band=band,
            epoch_jyear=epoch_jyear,
            read_limit_mag=read_limit_mag,
            neighbours=neighbours,
            workers=workers,
            progress=progress,
        )
    if len(paths) > 1:
        raise ConfigError(
            f"{source_name}: {len(paths)} inputs are given, and one of them is a store; a store is "
            "a whole catalog, give it alone",
            key="input",
            value=[str(path) for path in paths],
        )
    options = ingest_options(source_name, band, epoch_jyear, read_limit_mag)
    read = _read_store(open_store(paths[0]), options, workers, progress)
    return replace(read, stars=add_nearest_neighbours(read.stars, workers)) if neighbours else read


def _read_store(store: Store, options: IngestOptions, workers: int, progress: Progress) -> Ingested:
    manifest = read_manifest(store)
    if manifest is not None:
        _check_made_for(store, manifest, options)
    stage = f"rows {options.source_name}"
    partitions = [(number, path) for number, path in enumerate(_paths(store))]
    found = StarTables()

    def read(numbered: tuple[int, Path]) -> tuple[pa.Table, int]:
        return _bright_rows(*numbered, options, is_ours=manifest is not None)

    done = 0
    rows = [0] * len(partitions)
    for (number, _), (stars, beyond) in zip(
        partitions, map_in_order(read, iter(partitions), workers), strict=True
    ):
        found.add(stars, counted=beyond)
        rows[number] = len(stars) + beyond
        done += rows[number]
        progress(stage, done, None if manifest is None else manifest["kept"])
    if manifest is not None:
        # What is beyond the limit of the store itself was only counted when it was made.
        found.counted += manifest["rejected"].get(Reason.beyond_read_limit.name, 0)
        _read_beside(store, options, found)
        files = tuple(FileFacts(**file) for file in manifest["files"])
    else:
        files = _own_files(store, [path for _, path in partitions], rows)
    stars, rejected = found.joined()
    if manifest is None or manifest["epoch_jyear"] is None:
        stars = _moved(stars, options.epoch_jyear)
    malformed = rejected.filter(pc.equal(rejected["reason"], Reason.malformed_record.name))
    malformed = malformed.sort_by([("source_file", "ascending"), ("source_line", "ascending")])
    problems = [
        f"{files[row['source_file']].name} {row['detail']}"
        for row in malformed.slice(0, NAMED_PROBLEMS).to_pylist()
    ]
    notes = (manifest or {}).get("notes", ())
    return ingested(options, stars, rejected, found.counted, files, problems, notes)


def read_manifest(store: Store) -> dict[str, Any] | None:
    """Return what a store says of itself."""
    if not store.is_ours:
        return None
    path = store.folder / MANIFEST_NAME
    try:
        manifest: dict[str, Any] = json.loads(path.read_bytes())
        found = (str(manifest["store_version"]), str(manifest["schema"]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ProductError(
            f"{path}: cannot be read ({error!r}); expected the account of a store. Make it again "
            "with 'starcat ingest SOURCE --to hats'",
            path=path,
        ) from error
    schema = product_schema("stars")
    expected = (MANIFEST_VERSION, f"stars-{schema.version}")
    if found[0].split(".")[0] != MANIFEST_VERSION.split(".")[0] or found[1] != expected[1]:
        raise SchemaVersionError(
            f"{store.folder}: a store of version {found[0]} with {found[1]}; this starcat reads "
            f"version {expected[0]} with {expected[1]}. Make it again with 'starcat ingest SOURCE "
            "--to hats', or read it with the starcat that made it",
            product="stars",
            found=found,
            expected=expected,
        )
    return manifest


def _check_made_for(store: Store, manifest: dict[str, Any], options: IngestOptions) -> None:
    """Check that a store was made of what a build asks for."""
    limit, wanted = manifest["read_limit_mag"], options.read_limit_mag
    fits = {
        "source": manifest["source"] == options.source_name,
        "band": manifest["band"] == options.band,
        "epoch_jyear": manifest["epoch_jyear"] in (None, options.epoch_jyear),
        "read_limit_mag": limit is None or (wanted is not None and wanted <= limit),
    }
    for key in (key for key, does in fits.items() if not does):
        asked = options.source_name if key == "source" else getattr(options, key)
        option = f" --band '{options.band}'" if key == "band" else ""
        raise ConfigError(
            f"{store.folder}: the store has {key} {manifest[key]}, {asked} is asked for; make one "
            f"that fits with 'starcat ingest {options.source_name} --to hats{option} -o DIR'",
            key=key,
            value=manifest[key],
        )


def _paths(store: Store) -> list[Path]:
    return [path for partition in store.catalog.partitions for path in partition.paths]


def _bright_rows(
    number: int, path: Path, options: IngestOptions, *, is_ours: bool
) -> tuple[pa.Table, int]:
    """Return a file's stars within the limit, and how many are beyond it."""
    names = product_schema("stars").arrow_schema.names
    try:
        with pq.ParquetFile(path) as file:
            has = file.schema_arrow.names
            _check_columns(path, has)
            columns = [name for name in names if name in has and not name.startswith("nearest_")]
            groups = _groups_within(file, options.read_limit_mag)
            table = file.read_row_groups(groups, columns, use_threads=False)
            table = table.replace_schema_metadata(None)
            total = file.metadata.num_rows
    except (OSError, pa.ArrowException) as error:
        raise ProductError(
            f"{path}: cannot be read as Parquet ({error}); get the catalog again", path=path
        ) from error
    if options.read_limit_mag is not None:
        table = table.filter(pc.less_equal(table["mag"], options.read_limit_mag))
    return _as_stars(table, number, options, is_ours=is_ours), total - len(table)


def _groups_within(file: pq.ParquetFile, limit: float | None) -> list[int]:
    """Return the row groups that may have stars within a limit."""
    place = file.schema_arrow.names.index("mag")
    groups = []
    for k in range(file.metadata.num_row_groups):
        group = file.metadata.row_group(k)
        known = group.column(place).statistics
        is_known = limit is not None and known is not None
        is_blank = is_known and known.has_null_count and known.null_count == group.num_rows
        is_faint = is_known and known.has_min_max and known.min > limit
        if not (is_blank or is_faint):
            groups.append(k)
    return groups


def _check_columns(path: Path, has: Sequence[str]) -> None:
    lacking = [name for name in NEEDED if name not in has]
    if lacking:
        raise SchemaError(
            f"{path}: no column {', '.join(lacking)}; a build reads {', '.join(NEEDED)} of a HATS "
            "catalog, and what else the stars schema names",
            product="stars",
            field=lacking[0],
            found=list(has),
            expected=NEEDED,
        )


def _as_stars(table: pa.Table, number: int, options: IngestOptions, *, is_ours: bool) -> pa.Table:
    """Return rows as a table of the stars schema, with what a catalog of others lacks."""
    schema = product_schema("stars").arrow_schema
    count = len(table)
    given: dict[str, Any] = {
        "catalog": pa.repeat(options.source_name, count),
        "band": pa.repeat(options.band, count),
        "source_file": pa.repeat(pa.scalar(number, pa.int32()), count),
        "source_line": pa.array(np.arange(1, count + 1)),
        "quality_flags": pa.repeat(pa.scalar(0, pa.int32()), count),
        "is_flagged_double": pa.repeat(False, count),
        "is_flagged_variable": pa.repeat(False, count),
    }
    if not is_ours:
        table = table.drop_columns(
            [
                n
                for n in ("catalog", "band", "source_file", "source_line")
                if n in table.column_names
            ]
        )
    columns = []
    for wanted in schema:
        if wanted.name in table.column_names:
            columns.append(table[wanted.name].cast(wanted.type))
        elif wanted.name == "designation":
            words = table["star_id"].cast(pa.string())
            columns.append(pc.binary_join_element_wise(options.source_name, words, " "))
        elif wanted.name in ("x", "y", "z"):
            columns.append(pa.array(np.zeros(count)))  # move_to_epoch fills them in
        else:
            columns.append(given.get(wanted.name, pa.nulls(count, wanted.type)))
    return pa.Table.from_arrays(columns, schema=schema)


def _moved(stars: pa.Table, epoch_jyear: float | None) -> pa.Table:
    names = ("ra_deg", "dec_deg", "epoch_jyear", "pm_ra_cosdec_mas_yr", "pm_dec_mas_yr")
    columns: dict[str, Any] = {name: floats_of(stars, name) for name in names}
    columns["quality_flags"] = stars["quality_flags"].to_numpy()
    return with_columns(stars, move_to_epoch(columns, epoch_jyear))


def _read_beside(store: Store, options: IngestOptions, found: StarTables) -> None:
    """Read rejected records, and those whose star was read before."""
    limit = options.read_limit_mag
    for path in sorted((store.folder / REPEATED).glob("*.parquet")):
        again = pq.read_table(path)
        total = len(again)
        if limit is not None:
            again = again.filter(pc.less_equal(again["mag"], limit))
        found.add(_as_stars(again, 0, options, is_ours=True), counted=total - len(again))
    for path in sorted((store.folder / REJECTED).glob("*.parquet")):
        rejected = pq.read_table(path, schema=product_schema("rejected").arrow_schema)
        total = len(rejected)
        if limit is not None:
            listed = pc.or_(
                pc.fill_null(pc.less_equal(rejected["mag"], limit), False),
                pc.equal(rejected["reason"], Reason.malformed_record.name),
            )
            rejected = rejected.filter(listed)
        found.rejected.append(rejected)
        found.counted += total - len(rejected)


def _own_files(store: Store, paths: Sequence[Path], rows: Sequence[int]) -> tuple[FileFacts, ...]:
    """Return the files of a catalog of others as the inputs that they are."""
    folder = store.catalog.folder
    return tuple(
        FileFacts(path.relative_to(folder).as_posix(), file_sha256(path), path.stat().st_size, n)
        for path, n in zip(paths, rows, strict=True)
    )
