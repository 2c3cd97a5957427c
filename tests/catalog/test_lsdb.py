"""Stores as LSDB sees them: opened, valid in the strict sense, and matched with the same pairs."""

from __future__ import annotations

import struct
from collections import Counter
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pandas as pd
import pytest
from archive_server import Archive
from served import in_background

from starcat.catalog.store import wire
from starcat.catalog.store.ingest import ingest_to_store
from starcat.catalog.store.layout import open_store
from starcat.catalog.store.plan import StoreOptions
from starcat.catalog.store.reading import read_catalog
from starcat.catalog.store.wire import input_path
from starcat.query.session import open_session
from starcat.storage.parquet import read_parquet

# LSDB, Dask and pandas warn about their own code.
pytestmark = [pytest.mark.timeout(300), pytest.mark.filterwarnings("ignore")]

RADIUS_ARCSEC = 9.5
"""Within the margins of the stores, which LSDB cannot look beyond."""

TOLERANCE_ARCSEC = 1e-5
"""LSDB takes an arc sine of half the chord of directions, which have 15 digits."""


@pytest.fixture(scope="module")
def lsdb() -> ModuleType:
    """LSDB, which takes a second to import, and so not when tests are collected."""
    return pytest.importorskip("lsdb", reason="LSDB comes with the extra dev")


@pytest.fixture(scope="module")
def stores(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two catalogs of the same stars in Gaia's layout, many of them on a border of base pixels."""
    folder = tmp_path_factory.mktemp("lsdb")
    generator = np.random.default_rng(29)
    count = 1500
    ra_deg = np.append(generator.uniform(0.0, 360.0, 900), np.full(600, 90.0))
    dec_deg = np.append(generator.uniform(-88.0, 88.0, 900), generator.uniform(45.0, 85.0, 600))
    made = []
    for number, name in enumerate(("first", "second")):
        east, north = generator.normal(scale=4.0 / 3600.0, size=(2, count))
        ra = (ra_deg + east / np.cos(np.radians(dec_deg))) % 360.0
        mag = generator.uniform(3.0, 9.0, count)
        values = (ra, dec_deg + north, mag, mag + 0.1, mag - 0.5)
        ids = 1 + 10_000 * number + generator.permutation(count)
        records = [struct.pack("<qddfff", *row) for row in zip(ids, *values, strict=True)]
        path = folder / name / "gaia_merged.bin"
        path.parent.mkdir()
        path.write_bytes(b"GDR3" + struct.pack("<IQ", 1, count) + b"".join(records))
        options = StoreOptions(max_partition_rows=250)
        ingest_to_store("gaia", [path], folder / f"{name}.hats", options=options)
        made.append(folder / f"{name}.hats")
    return made[0], made[1]


def pairs_of(frame: Any) -> dict[tuple[int, int], float]:
    """Return the separations of LSDB's pairs, arcseconds."""
    ids = zip(frame["star_id_a"], frame["star_id_b"], strict=True)
    return {
        (int(a), int(b)): float(angle)
        for (a, b), angle in zip(ids, frame["_dist_arcsec"], strict=True)
    }


@pytest.mark.slow
def test_lsdb_opens_a_store_and_hats_finds_it_valid(lsdb, stores):
    from hats.io.validation import is_valid_collection

    for store in stores:
        catalog = lsdb.open_catalog(store)
        opened = open_store(store)
        rows = int(opened.catalog.properties["hats_nrows"])
        assert len(catalog) == rows > 1000
        assert len(catalog.get_healpix_pixels()) == len(opened.catalog.partitions) > 12
        assert catalog.margin is not None
        assert catalog.margin.hc_structure.catalog_info.margin_threshold == opened.margin_arcsec
        assert is_valid_collection(store, strict=True, verbose=False)


@pytest.mark.slow
def test_lsdb_finds_the_same_pairs(lsdb, stores):
    query = (
        "SELECT a_star_id, b_star_id, separation_arcsec "
        f"FROM crossmatch('first_hats', 'second_hats', {RADIUS_ARCSEC}, epoch := NULL)"
    )
    with open_session([str(store) for store in stores]) as session, session.ask(query) as answer:
        rows = answer.rows(100_000)
    angles = {(a_id, b_id): angle for a_id, b_id, angle in rows}
    most = max(Counter(a_id for a_id, _ in angles).values())
    a, b = (lsdb.open_catalog(store) for store in stores)
    how = {"suffixes": ("_a", "_b"), "suffix_method": "all_columns", "require_right_margin": True}
    found = a.crossmatch(b, n_neighbors=most + 1, radius_arcsec=RADIUS_ARCSEC, **how).compute()
    theirs = pairs_of(found)
    assert theirs.keys() == angles.keys()
    assert len(theirs) == len(found) > 800
    off = [abs(theirs[pair] - angles[pair]) for pair in theirs]
    assert max(off) < TOLERANCE_ARCSEC
    # Pairs across the borders of partitions are among them.
    bounds = [part.pixel.first for part in open_store(stores[1]).catalog.partitions]
    known = [_places(store) for store in stores]
    parts = [
        np.searchsorted(bounds, [known[k][pair[k]] for pair in angles], side="right")
        for k in (0, 1)
    ]
    assert (parts[0] != parts[1]).sum() > 50


def _places(store: Path) -> dict[int, int]:
    found: dict[int, int] = {}
    for partition in open_store(store).catalog.partitions:
        for path in partition.paths:
            table = read_parquet(path)
            ids, places = table["star_id"].to_pylist(), table["_healpix_29"].to_pylist()
            found.update(zip(ids, places, strict=True))
    return found


def gaia_columns(count: int) -> pd.DataFrame:
    """Columns of gaia_source that the map ``gaia_dr3_hats`` names, and one that it does not."""
    generator = np.random.default_rng(31)
    numbers = "ra_error dec_error pmra pmdec pmra_error pmdec_error parallax parallax_error"
    fluxes = (f"phot_{band}_mean_flux_over_error" for band in ("g", "bp", "rp"))
    names = [*numbers.split(), "radial_velocity", "ruwe", *fluxes, "not_in_the_map"]
    mag = generator.uniform(3.0, 15.0, count)
    columns = {
        "source_id": np.arange(1, count + 1),
        "ra": generator.uniform(0.0, 360.0, count),
        "dec": np.degrees(np.arcsin(generator.uniform(-1.0, 1.0, count))),
        **{f"phot_{band}_mean_mag": mag for band in ("g", "bp", "rp")},
        **{name: generator.uniform(0.1, 1.0, count) for name in names},
        "non_single_star": np.zeros(count, dtype=np.int16),
        "phot_variable_flag": ["NOT_AVAILABLE"] * count,
    }
    return pd.DataFrame(columns)


@pytest.mark.slow
def test_a_catalog_that_lsdb_wrote_is_read_at_an_address(lsdb, tmp_path, monkeypatch):
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.setenv("STARCAT_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(wire, "GAP_BYTES", 0)
    monkeypatch.setattr(wire, "FOOTER_BYTES", 1024)
    made = lsdb.from_dataframe(gaia_columns(20_000), catalog_name="gaia", margin_threshold=10.0)
    made.write_catalog(tmp_path / "gaia_dr3", catalog_name="gaia")
    with Archive() as server, in_background(server):
        address = server.serve_folder("/gaia_dr3", tmp_path / "gaia_dr3")
        limit = {"read_limit_mag": 9.0}
        far = read_catalog("gaia_dr3_hats", [input_path(address)], **limit)
        sent = sum(one.sent for one in server.requests if "Npix" in one.path)
    near = read_catalog("gaia_dr3_hats", [tmp_path / "gaia_dr3"], **limit)
    assert len(far.stars) > 5000
    assert far.stars.equals(near.stars)
    assert far.rejected_by_reason == near.rejected_by_reason
    files = list((tmp_path / "gaia_dr3" / "gaia").rglob("Npix*.parquet"))
    assert sent < sum(path.stat().st_size for path in files)
