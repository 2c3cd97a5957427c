"""Catalog stores: the same stars as in memory, the same bytes for any number of workers."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from starcat.catalog.ingest import ingest
from starcat.store.ingest import ingest_to_store
from starcat.store.layout import open_store
from starcat.store.options import StoreOptions
from starcat.store.pixels import HEALPIX_COLUMN, healpix_29
from starcat.store.reading import read_catalog


def stars_of(folder: Path) -> pa.Table:
    """Return all stars of a store by star_id, as ingest returns them."""
    paths = [path for part in open_store(folder).catalog.partitions for path in part.paths]
    table = pa.concat_tables([pq.ParquetFile(path).read() for path in paths])
    return table.sort_by("star_id").combine_chunks()


CASES = [
    ("sao", "sao.dat.gz", 2000),
    ("tycho2", "tyc2.dat.gz", 4000),
    ("2mass", "psc_measured.gz", 300),
]


@pytest.mark.parametrize(("source", "name", "max_rows"), CASES)
def test_a_store_holds_what_ingest_returns(source, name, max_rows, catalogs, tmp_path):
    paths = [catalogs / name]
    read = ingest(source, paths)
    options = StoreOptions(max_partition_rows=max_rows)
    made = ingest_to_store(source, paths, tmp_path / "store", options=options)
    stars = stars_of(tmp_path / "store")
    assert stars.drop_columns(HEALPIX_COLUMN).equals(read.stars)
    assert stars[HEALPIX_COLUMN].to_numpy().tolist() == (
        healpix_29(stars["ra_deg"].to_numpy(), stars["dec_deg"].to_numpy()).tolist()
    )
    assert made.manifest["rejected"] == read.rejected_by_reason
    assert made.manifest["rows_read"] == read.rows_read
    assert len(made.manifest["partitions"]) > 3


@pytest.mark.parametrize("limit", [None, 9.0])
@pytest.mark.parametrize(("source", "name", "max_rows"), CASES)
def test_a_build_reads_from_a_store_what_it_reads_from_files(
    source, name, max_rows, limit, catalogs, tmp_path
):
    paths = [catalogs / name]
    options = StoreOptions(max_partition_rows=max_rows)
    ingest_to_store(source, paths, tmp_path / "store", options=options)
    how = {"epoch_jyear": 2026.5, "read_limit_mag": limit}
    files, store = ingest(source, paths, **how), read_catalog(source, [tmp_path / "store"], **how)
    assert store.stars.equals(files.stars)
    assert store.rejected.equals(files.rejected)
    assert store.rejected_by_reason == files.rejected_by_reason
    assert (store.files, store.problems) == (files.files, files.problems)
    assert store.notes == files.notes
