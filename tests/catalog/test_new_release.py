"""A new release of a catalog: other numbers, another epoch, and the same stars."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from drafts import spec_with

from starcat.database.diff import NOT_READ, Difference, diff
from starcat.database.reader import DatabaseFolder, open_database_folder
from starcat.pipeline.build import build

COUNT = 700
GONE, FADED, VARIABLE, NEW = 10, 20, 30, COUNT


def gaia_source() -> dict[str, np.ndarray]:
    """Return rows with the columns that gaia_source has in DR3: stars with large motions."""
    rng, count = np.random.default_rng(4), COUNT + 1
    u = rng.normal(size=(count, 3))
    u /= np.linalg.norm(u, axis=1)[:, None]
    bands, measured = ("g", "bp", "rp"), ("ra", "dec", "pmra", "pmdec", "parallax")
    mags = {f"phot_{band}_mean_mag": rng.uniform(2.0, 5.8, count) for band in bands}
    return {
        "source_id": np.arange(count) * 4096 + 1,
        "ra": np.degrees(np.arctan2(u[:, 1], u[:, 0])) % 360.0,
        "dec": np.degrees(np.arcsin(u[:, 2])),
        "pmra": rng.normal(0.0, 800.0, count),
        "pmdec": rng.normal(0.0, 800.0, count),
        "parallax": np.full(count, 20.0),
        "radial_velocity": np.zeros(count),
        "ruwe": np.ones(count),
        "non_single_star": np.zeros(count, dtype=np.int64),
        "phot_variable_flag": np.full(count, "NOT_AVAILABLE", dtype=object),
        **{f"phot_{band}_mean_flux_over_error": np.full(count, 500.0) for band in bands},
        **mags,
        **{f"{name}_error": np.full(count, 0.02) for name in measured},
    }


def later_release(old: dict[str, np.ndarray], years: float = 1.0) -> dict[str, np.ndarray]:
    """Return the same stars with other numbers, in another order, at a later epoch."""
    moved = {
        "ra": (old["ra"] + years * old["pmra"] / 3.6e6 / np.cos(np.radians(old["dec"]))) % 360.0,
        "dec": old["dec"] + years * old["pmdec"] / 3.6e6,
        "source_id": (old["source_id"] // 4096) * 8192 + 77,
        "ref_epoch": np.full(COUNT + 1, 2016.0 + years),
        "phot_g_mean_mag": old["phot_g_mean_mag"] + 0.003,
    }
    new = {**old, **moved}
    new["phot_g_mean_mag"][FADED] = 9.0
    new["phot_variable_flag"] = old["phot_variable_flag"].copy()
    new["phot_variable_flag"][VARIABLE] = "VARIABLE"
    del new["non_single_star"]
    return new


def built(folder: Path, small_spec: str, source: str, rows: dict[str, Any]) -> DatabaseFolder:
    path = folder / f"{source}.parquet"
    pq.write_table(pa.table({name: pa.array(list(values)) for name, values in rows.items()}), path)
    spec = spec_with(
        small_spec, epoch_jyear=2017.0, name=source[:8].replace("_", "-"),
        catalog={"source": source, "band": "G"}, selection={"variables": {"flags": "strict"}},
    )  # fmt: skip
    return open_database_folder(build(spec, folder / "dist", inputs={source: [path]}).folder)


@pytest.fixture(scope="module")
def releases(tmp_path_factory, small_spec) -> tuple[DatabaseFolder, DatabaseFolder]:
    folder, old = tmp_path_factory.mktemp("releases"), gaia_source()
    keep_old, keep_new = np.arange(COUNT + 1) != NEW, np.arange(COUNT + 1) != GONE
    new = later_release(old)
    order = np.random.default_rng(1).permutation(np.flatnonzero(keep_new))
    return (
        built(folder, small_spec, "gaia_dr3_hats", {k: v[keep_old] for k, v in old.items()}),
        built(folder, small_spec, "gaia_dr4_hats", {k: v[order] for k, v in new.items()}),
    )


def by_id(stars: Any) -> dict[int, str]:
    return {one.star_id: one.reason for one in stars}


@pytest.mark.slow
def test_renumbered_stars_that_have_moved_are_paired(releases):
    found: Difference = diff(*releases)
    n_old, n_new = (len(side.table("stars")) for side in releases)
    assert found.paired_by_number == 0
    assert found.paired_by_position == n_old - 3 == n_new - 1 > 500
    assert by_id(found.went) == {
        GONE * 4096 + 1: NOT_READ,
        FADED * 4096 + 1: "too_faint",
        VARIABLE * 4096 + 1: "flagged_variable",
    }
    assert by_id(found.came) == {NEW * 8192 + 77: NOT_READ}
    # Both databases are for 2017.0: motions have moved the stars of DR3 to the places of DR4.
    assert max(one.moved_arcsec for one in found.moved) < 0.01
    assert {round(one.mag_b - one.mag_a, 4) for one in found.moved} == {0.003}
