"""Catalog stores: the same stars as in memory, the same bytes for any number of workers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from genuine_records import SAO

from starcat.catalog.ingest import ingest_catalog
from starcat.catalog.store.ingest import ingest_to_store
from starcat.catalog.store.layout import HEALPIX_COLUMN, healpix_29, open_store
from starcat.catalog.store.plan import StoreOptions
from starcat.catalog.store.reading import read_catalog
from starcat.ship.exchange.export import write_hats
from starcat.storage.atomic import file_sha256


def stars_of(folder: Path) -> pa.Table:
    """Return all stars of a store by star_id, as ingest returns them."""
    paths = [path for part in open_store(folder).catalog.partitions for path in part.paths]
    table = pa.concat_tables([pq.ParquetFile(path).read() for path in paths])
    return table.sort_by("star_id").combine_chunks()


CASES = [("tycho2", "tyc2.dat.gz", 3000), ("2mass", "psc_measured.gz", 1000)]


@dataclass(frozen=True)
class Made:
    """A file of an archive, and the store that was made of it."""

    source: str
    path: Path
    folder: Path
    manifest: dict[str, Any]


@pytest.fixture(scope="module", params=CASES, ids=lambda case: case[0])
def made(request, catalogs, tmp_path_factory):
    source, name, max_rows = request.param
    folder, path = tmp_path_factory.mktemp(source) / "store", catalogs / name
    options = StoreOptions(max_partition_rows=max_rows)
    manifest = ingest_to_store(source, [path], folder, options=options).manifest
    return Made(source, path, folder, manifest)


def test_a_store_holds_what_ingest_returns(made, ingested):
    read = ingested(made.source, made.path.name)
    stars = stars_of(made.folder)
    assert stars.drop_columns(HEALPIX_COLUMN).equals(read.stars)
    assert stars[HEALPIX_COLUMN].to_numpy().tolist() == (
        healpix_29(stars["ra_deg"].to_numpy(), stars["dec_deg"].to_numpy()).tolist()
    )
    assert made.manifest["rejected"] == read.rejected_by_reason
    assert made.manifest["rows_read"] == read.rows_read
    assert len(made.manifest["partitions"]) > 3


@pytest.mark.parametrize("limit", [None, pytest.param(9.0, marks=pytest.mark.slow)])
def test_a_build_reads_from_a_store_what_it_reads_from_files(made, limit):
    how = {"epoch_jyear": 2026.5, "read_limit_mag": limit}
    files = ingest_catalog(made.source, [made.path], **how)
    store = read_catalog(made.source, [made.folder], **how)
    assert store.stars.equals(files.stars)
    assert store.rejected.equals(files.rejected)
    assert store.rejected_by_reason == files.rejected_by_reason
    assert (store.files, store.problems) == (files.files, files.problems)
    assert store.notes == files.notes


def test_a_store_with_a_limit_counts_what_it_left_out(sao_file, tmp_path):
    ingest_to_store("sao", [sao_file], tmp_path / "store", read_limit_mag=6.0)
    files = ingest_catalog("sao", [sao_file], read_limit_mag=5.5)
    store = read_catalog("sao", [tmp_path / "store"], read_limit_mag=5.5)
    assert store.rejected_by_reason == files.rejected_by_reason
    assert store.rows_read == files.rows_read > len(store.stars) > 0
    assert store.stars.equals(files.stars)


def test_a_hats_catalog_of_others_is_read_with_what_it_has(catalogs, ingested, tmp_path):
    read = ingested("hipparcos", "hip_main.dat.gz")
    some = ["star_id", "ra_deg", "dec_deg", "epoch_jyear", "mag", "pm_ra_cosdec_mas_yr"]
    some.append("parallax_mas")
    write_hats(read.stars.select([*some, "pm_dec_mas_yr"]), tmp_path / "theirs", "theirs", 500)
    how = {"epoch_jyear": 2026.0, "read_limit_mag": 8.0}
    found = read_catalog("hipparcos", [tmp_path / "theirs"], **how)
    wanted = ingest_catalog("hipparcos", [catalogs / "hip_main.dat.gz"], **how)
    kept = [*some, "pm_dec_mas_yr", "x", "y", "z", "nearest_separation_arcsec"]
    assert found.stars.select(kept).equals(wanted.stars.select(kept))
    assert found.rows_read == len(read.stars)
    assert found.beyond_read_limit == len(read.stars) - len(found.stars)
    first = found.files[0]
    assert first.sha256 == file_sha256(tmp_path / "theirs" / first.name)


def sao_record(number: int, mag: float) -> bytes:
    """The record of SAO 106 with another number and magnitude."""
    return f"{number:6}".encode() + SAO[6:80] + f"{mag:4.1f}".encode() + SAO[84:]


def test_repeated_records_are_judged_within_the_limit_of_the_build(tmp_path):
    """A record is repeated, or not, by what a build reads: as if it read the archive's file."""
    lines = [sao_record(1, 9.0), sao_record(1, 5.0), sao_record(2, 5.0), sao_record(2, 6.0)]
    archive = tmp_path / "sao.dat"
    archive.write_bytes(b"\n".join(lines) + b"\n")
    made = ingest_to_store("sao", [archive], tmp_path / "store")
    assert made.manifest["rejected"] == {"duplicate_record": 2}
    for limit in (None, 8.0, 5.5, 4.0):
        files = ingest_catalog("sao", [archive], read_limit_mag=limit)
        store = read_catalog("sao", [tmp_path / "store"], read_limit_mag=limit)
        assert store.stars.equals(files.stars)
        assert store.rejected.equals(files.rejected)
        assert store.rejected_by_reason == files.rejected_by_reason
