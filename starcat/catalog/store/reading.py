"""Read stores as input of a build: only the partitions, row groups and columns that it uses.

A store that starcat made gives exactly the same result as its archive files: it also contains
rejected records and records whose star was read before, and it lists its inputs. A HATS catalog
from another source must have the columns `NEEDED`; other columns of the stars schema are used if
they exist. The manifest of the database then lists the catalog's own files as inputs.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from starcat.arguments import text_of_path
from starcat.catalog.ingest import Ingested, StarTables, ingest_catalog, ingest_options, ingested
from starcat.catalog.parts import NAMED_PROBLEMS, IngestOptions
from starcat.catalog.source import data_source, map_of, source_given
from starcat.catalog.source_files import FileFacts, locate, table_parts
from starcat.catalog.stars.star_table import Columns, floats_of, move_to_epoch, table_from_columns
from starcat.catalog.stars.verdict import Reason
from starcat.catalog.store.layout import (
    MANIFEST_NAME,
    REJECTED,
    REPEATED,
    Store,
    check_has_columns,
    groups_within,
    is_store,
    open_store,
    parquet_file,
    star_columns,
)
from starcat.catalog.store.metadata import MANIFEST_VERSION
from starcat.catalog.store.wire import bring, input_paths, url_of_input
from starcat.errors import ConfigError, ProductError, SchemaVersionError
from starcat.geometry.distortion import checked_number
from starcat.progress import Progress, no_progress
from starcat.resources import PathLike
from starcat.storage.atomic import file_sha256
from starcat.storage.schema import product_schema
from starcat.threads import map_in_order

NEEDED = ("star_id", "ra_deg", "dec_deg", "epoch_jyear", "mag")
"""Columns that another source's catalog must have; ``mag`` is assumed to be in the wanted band."""

_HINT = f"a build needs {', '.join(NEEDED)} of a HATS catalog, and reads others of the stars schema"
_POSITION_COLUMNS = (
    *("ra_deg", "dec_deg", "epoch_jyear", "pm_ra_cosdec_mas_yr", "pm_dec_mas_yr"),
    *("parallax_mas", "radial_velocity_km_s"),
)


def ingest(
    source: str,
    inputs: PathLike | Sequence[PathLike] | None = None,
    *,
    band: str | None = None,
    epoch_jyear: float | None = None,
    read_limit_mag: float | None = None,
    progress: Progress | None = None,
) -> Ingested:
    """Read a catalog into a star table, with a reason for every record left out.

    Parameters
    ----------
    source : str
        One that ``starcat sources`` lists, such as ``sao``, or the path of a map of your table.
    inputs : path or sequence of paths, optional
        Files or folder of the source, or the address of a HATS catalog; searched by default.
    band : str, optional
        Band of the magnitudes; the source's first by default.
    epoch_jyear : float, optional
        Julian year to move positions to; the catalog's own by default.
    read_limit_mag : float, optional
        Fainter records are left out and counted in ``beyond_read_limit`` of the result.
    progress : callable, optional
        Called with (stage, done, total).

    Returns
    -------
    Ingested
        Star table, rejected rows, and the files that were read.

    Raises
    ------
    ConfigError, SourceError
        If the source is unknown, or its files are missing or damaged.
    """
    name = source_given(text_of_path("source", source)).name
    if epoch_jyear is not None:
        epoch_jyear = checked_number("epoch_jyear", epoch_jyear)
    if read_limit_mag is not None:
        read_limit_mag = checked_number("read_limit_mag", read_limit_mag)
    return read_catalog(
        name,
        locate(name, {name: input_paths("inputs", inputs)} if inputs is not None else {}),
        band=band,
        epoch_jyear=epoch_jyear,
        read_limit_mag=read_limit_mag,
        progress=progress or no_progress,
    )


def read_catalog(source_name: str, paths: Sequence[Path], **options: Any) -> Ingested:
    """Read a star catalog from a store or archive files; options as for `ingest_catalog`."""
    here = brought(source_name, paths, **options)
    stores = [open_store(path) for path in here if path.is_dir() and is_store(path)]
    is_mapped = data_source(source_name).table is not None
    if not stores or (is_mapped and not any(store.is_ours for store in stores)):
        read = ingest_catalog(source_name, here, **options)
    else:
        _check_alone(source_name, paths)
        read = _read_store(source_name, stores[0], **options)
    address = url_of_input(paths[0]) if paths else None
    return read if address is None else _named_by_address(read, here[0], address)


def brought(
    source_name: str,
    paths: Sequence[Path],
    *,
    band: str | None = None,
    read_limit_mag: float | None = None,
    progress: Progress = no_progress,
    **_: Any,
) -> list[Path]:
    """Return paths, with an address replaced by a local copy of the data that the build uses."""
    if not any(map(url_of_input, paths)):
        return list(paths)
    _check_alone(source_name, paths)
    options = ingest_options(source_name, band, None, read_limit_mag)
    return [bring(paths[0], options, progress)]


def _check_alone(source_name: str, paths: Sequence[Path]) -> None:
    if len(paths) > 1:
        raise ConfigError(
            f"{len(paths)} inputs are given, and one of them is a store; a store is "
            "a whole catalog, give it alone",
            where=source_name,
            key="input",
            value=[str(path) for path in paths],
        )


def _named_by_address(read: Ingested, copy: Path, address: str) -> Ingested:
    """Return a catalog whose files are named by their addresses."""
    store = open_store(copy)
    if store.is_ours:
        return read
    is_mapped = data_source(read.source).table is not None
    store_paths = [store.catalog.folder / file.name for file in read.files]
    names = [
        path.relative_to(copy).as_posix()
        for path in (table_parts(copy) if is_mapped else store_paths)
    ]
    files = zip(read.files, names, strict=True)
    return replace(read, files=tuple(replace(f, name=f"{address}/{name}") for f, name in files))


def _read_store(
    source_name: str,
    store: Store,
    *,
    neighbours: bool = True,
    workers: int = 2,
    progress: Progress = no_progress,
    band: str | None = None,
    **limits: float | None,
) -> Ingested:
    options = ingest_options(source_name, band, **limits)
    manifest = read_store_manifest(store)
    if manifest is not None:
        _check_made_for(store, manifest, options)
    read = partial(_bright_rows, options=options, manifest=manifest)
    paths = [path for partition in store.catalog.partitions for path in partition.paths]
    tables = StarTables()
    rows: list[int] = []
    for stars, beyond in map_in_order(read, enumerate(paths), workers):
        tables.add(stars, counted=beyond)
        rows.append(len(stars) + beyond)
        progress(f"rows {source_name}", sum(rows), None if manifest is None else manifest["kept"])
    if manifest is None:
        files = _own_files(store, paths, rows)
        problems, notes = [], ()
    else:
        # Records beyond the limit of the store itself were only counted when it was made.
        tables.counted += manifest["rejected"].get(Reason.beyond_read_limit.name, 0)
        _read_beside(store, options, manifest, tables)
        files = tuple(FileFacts(**file) for file in manifest["files"])
        problems, notes = _problems(tables.rejected, files), manifest.get("notes", ())
    return ingested(options, tables, files, problems, notes, workers if neighbours else 0)


def _problems(rejected: Sequence[pa.Table], files: Sequence[FileFacts]) -> list[str]:
    """Return the first malformed records, in reading order."""
    is_malformed = pc.field("reason") == Reason.malformed_record.name
    schema = product_schema("rejected").arrow_schema
    malformed = pa.concat_tables([schema.empty_table(), *rejected]).filter(is_malformed)
    ordered = malformed.sort_by([("source_file", "ascending"), ("source_line", "ascending")])
    first = ordered.slice(0, NAMED_PROBLEMS).to_pylist()
    return [f"{files[row['source_file']].name} {row['detail']}" for row in first]


def read_store_manifest(store: Store) -> dict[str, Any] | None:
    """Return the account of a store; None if starcat did not make it."""
    if not store.is_ours:
        return None
    path = store.folder / MANIFEST_NAME
    try:
        manifest: dict[str, Any] = json.loads(path.read_bytes())
        versions = (str(manifest["store_version"]), str(manifest["schema"]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ProductError(
            f"cannot be read ({error!r}); expected the account of a store",
            where=path,
            hint="Make it again with 'starcat ingest SOURCE --to hats'",
        ) from error
    schema = product_schema("stars")
    expected = (MANIFEST_VERSION, f"stars-{schema.version}")
    if versions[0].split(".")[0] != MANIFEST_VERSION.split(".")[0] or versions[1] != expected[1]:
        raise SchemaVersionError(
            f"a store of version {versions[0]} with {versions[1]}; this starcat reads "
            f"version {expected[0]} with {expected[1]}",
            where=store.folder,
            product="stars",
            found=versions,
            expected=expected,
            hint="Make it again with 'starcat ingest SOURCE --to hats', or read it with the "
            "starcat that made it",
        )
    return manifest


def _check_made_for(store: Store, manifest: dict[str, Any], options: IngestOptions) -> None:
    """Check that a store was made with the options that a build requires."""
    limit, required = manifest["read_limit_mag"], options.read_limit_mag
    fits = {
        "source": manifest["source"] == options.source_name,
        "map": manifest.get("map") == map_of(options.source_name),
        "band": manifest["band"] == options.band,
        "epoch_jyear": manifest["epoch_jyear"] in (None, options.epoch_jyear),
        "read_limit_mag": limit is None or (required is not None and required <= limit),
    }
    for key in (key for key, does in fits.items() if not does):
        asked = {"source": options.source_name, "map": "another"}.get(key) or getattr(options, key)
        option = f" --band '{options.band}'" if key == "band" else ""
        raise ConfigError(
            f"the store has {key} {manifest.get(key)}, not {asked}",
            where=store.folder,
            key=key,
            value=manifest.get(key),
            hint=f"make one that fits with 'starcat ingest {options.source_name} --to "
            f"hats{option} -o DIR'",
        )


def _bright_rows(
    numbered: tuple[int, Path], options: IngestOptions, manifest: dict[str, Any] | None
) -> tuple[pa.Table, int]:
    """Return the stars of a file within the limit, and the number of stars beyond it."""
    number, path = numbered
    with parquet_file(path, ProductError, "get the catalog again") as file:
        has = file.schema_arrow.names
        check_has_columns(path, has, NEEDED, _HINT)
        groups = groups_within(file.metadata, "mag", options.read_limit_mag)
        table = file.read_row_groups(groups, star_columns(has), use_threads=False)
        total = file.metadata.num_rows
    if options.read_limit_mag is not None:
        table = table.filter(pc.less_equal(table["mag"], options.read_limit_mag))
    return _as_stars(table, number, options, manifest), total - len(table)


def _as_stars(
    table: pa.Table, number: int, options: IngestOptions, manifest: dict[str, Any] | None
) -> pa.Table:
    """Return rows as a table of the stars schema; columns that the catalog lacks are added."""
    count = len(table)
    columns: Columns = dict(zip(table.column_names, table.columns, strict=True))
    if manifest is None:
        words = table["star_id"].cast(pa.string())
        named = pc.binary_join_element_wise(options.source_name, words, " ")
        columns = {"designation": named, "quality_flags": 0, **columns}
        columns |= {"catalog": options.source_name, "band": options.band}
        columns |= {"source_file": number, "source_line": np.arange(1, count + 1)}
    if manifest is None or manifest["epoch_jyear"] is None:
        positions = {
            name: floats_of(table, name) for name in _POSITION_COLUMNS if name in table.column_names
        }
        positions["quality_flags"] = np.asarray(columns["quality_flags"])
        columns |= move_to_epoch(positions, options.epoch_jyear)
    return table_from_columns("stars", columns, count)


def _read_beside(
    store: Store, options: IngestOptions, manifest: dict[str, Any], tables: StarTables
) -> None:
    """Read rejected records, and records whose star was read before."""
    within = None
    if options.read_limit_mag is not None:
        within = pc.field("mag") <= options.read_limit_mag
    for path in sorted((store.folder / REPEATED).glob("*.parquet")):
        again = pq.read_table(path)
        bright = again if within is None else again.filter(within)
        tables.add(_as_stars(bright, 0, options, manifest), counted=len(again) - len(bright))
    for path in sorted((store.folder / REJECTED).glob("*.parquet")):
        rejected = pq.read_table(path, schema=product_schema("rejected").arrow_schema)
        listed = rejected
        if within is not None:
            is_malformed = pc.field("reason") == Reason.malformed_record.name
            listed = rejected.filter(within | is_malformed)
        tables.rejected.append(listed)
        tables.counted += len(rejected) - len(listed)


def _own_files(store: Store, paths: Sequence[Path], rows: Sequence[int]) -> tuple[FileFacts, ...]:
    """Return the files of a catalog from another source as inputs."""
    folder = store.catalog.folder
    return tuple(
        FileFacts(path.relative_to(folder).as_posix(), file_sha256(path), path.stat().st_size, n)
        for path, n in zip(paths, rows, strict=True)
    )
