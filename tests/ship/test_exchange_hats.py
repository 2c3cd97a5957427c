"""HATS catalogs: the layout by pyarrow, the pixels by their definition, the whole by LSDB."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from folder_bytes import bytes_of
from hypothesis import given
from hypothesis import strategies as st

from starcat.catalog.store.layout import HEALPIX_COLUMN, Pixel, healpix_29
from starcat.errors import ConfigError
from starcat.ship.exchange.export import write_hats
from starcat.version import install_command

pytest.importorskip("cdshealpix")


def pixel_by_definition(ra_deg: float, dec_deg: float, order: int) -> int:
    """Nested pixel of a position, from the equations of Gorski et al. 2005, sections 4 and 5."""
    z = float(np.sin(np.radians(dec_deg)))
    turn = (ra_deg % 360.0) / 90.0  # 0 to 4
    side = 1 << order
    if abs(z) <= 2.0 / 3.0:
        up, down = side * (0.5 + turn - 0.75 * z), side * (0.5 + turn + 0.75 * z)
        row, column = int(up) // side, int(down) // side
        face = (row % 4) + 4 if row == column else (row % 4 if row < column else column % 4 + 8)
        x, y = int(down) % side, side - int(up) % side - 1
    else:
        quarter = min(int(turn), 3)
        part = turn - quarter
        # cos(dec) / sqrt(1 + |z|) is sqrt(1 - |z|) without the loss of digits at the poles.
        width = np.sqrt(3.0) * np.cos(np.radians(dec_deg)) / np.sqrt(1.0 + abs(z)) * side
        x, y = (min(int(width * share), side - 1) for share in (part, 1.0 - part))
        face = quarter if z > 0 else quarter + 8
        x, y = (side - y - 1, side - x - 1) if z > 0 else (x, y)
    inside = sum(
        ((x >> bit) & 1) << 2 * bit | ((y >> bit) & 1) << (2 * bit + 1) for bit in range(order)
    )
    return face * side * side + inside


def star_table(ra_deg: Any, dec_deg: Any) -> pa.Table:
    count = len(ra_deg)
    fields = [
        pa.field("star_id", pa.int64(), nullable=False),
        pa.field("ra_deg", pa.float64(), metadata={"unit": "deg"}),
        pa.field("dec_deg", pa.float64(), metadata={"unit": "deg"}),
        pa.field("designation", pa.string()),
    ]
    columns = [
        pa.array(np.arange(count)[::-1] + 2**62),
        pa.array(ra_deg, pa.float64(), from_pandas=True),
        pa.array(dec_deg, pa.float64(), from_pandas=True),
        pa.array([f"star {k}" for k in range(count)]),
    ]
    return pa.Table.from_arrays(columns, schema=pa.schema(fields))


@pytest.fixture(scope="module")
def sky() -> pa.Table:
    generator = np.random.default_rng(12)
    dec_deg = np.degrees(np.arcsin(generator.uniform(-1.0, 1.0, 3000)))
    return star_table(generator.uniform(0.0, 360.0, 3000), dec_deg)


def partitions(folder: Path) -> dict[Path, pa.Table]:
    dataset = folder / "dataset"
    return {
        path.relative_to(dataset): pq.ParquetFile(path).read()
        for path in sorted(dataset.rglob("Npix=*.parquet"))
    }


@given(
    ra_deg=st.floats(0.0, 360.0, exclude_max=True), z=st.floats(-1.0, 1.0), order=st.integers(0, 12)
)
def test_pixels_are_those_of_the_definition(ra_deg, z, order):
    dec_deg = float(np.degrees(np.arcsin(z)))
    ra, dec = np.array([ra_deg]), np.array([dec_deg])
    pixel = int(healpix_29(ra, dec)[0] >> 2 * (29 - order))
    # On the border of two pixels rounding decides: then one of the neighbours will do.
    near = {
        pixel_by_definition(ra_deg + d_ra, min(max(dec_deg + d_dec, -90.0), 90.0), order)
        for d_ra in (-1e-9, 0.0, 1e-9)
        for d_dec in (-1e-9, 0.0, 1e-9)
    }
    assert pixel in near


@pytest.mark.parametrize(("max_rows", "order"), [(1_000_000, 0), (200, 1), (20, 3)])
def test_the_layout(sky, tmp_path, max_rows, order):
    folder = tmp_path / "sky"
    assert write_hats(sky, folder, "sky", max_rows) == 3000
    files = partitions(folder)
    assert max(int(path.parts[0].removeprefix("Norder=")) for path in files) == order
    everything = pa.concat_tables(files.values()).drop_columns(HEALPIX_COLUMN)
    assert everything.sort_by("star_id").equals(sky.sort_by("star_id"))
    for path, table in files.items():
        pixel = Pixel(
            int(path.parts[0].removeprefix("Norder=")), int(path.stem.removeprefix("Npix="))
        )
        assert path == pixel.path
        assert 0 < len(table) <= max_rows
        assert table.sort_by([(HEALPIX_COLUMN, "ascending"), ("star_id", "ascending")]) == table
        for row in table.slice(0, 3).to_pylist():
            assert pixel_by_definition(row["ra_deg"], row["dec_deg"], pixel.order) == pixel.number
            assert pixel.first <= row[HEALPIX_COLUMN] < pixel.end
        footer = pq.read_metadata(folder / "dataset" / path)
        assert footer.num_row_groups == 1
        assert footer.row_group(0).column(0).compression == "ZSTD"


def test_what_describes_the_catalog(sky, tmp_path):
    folder = tmp_path / "sky"
    write_hats(sky, folder, "my-sky", 300)
    lines = (folder / "hats.properties").read_text().splitlines()
    known = dict(line.split("=", 1) for line in lines)
    assert known["obs_collection"] == "my-sky"
    assert known["dataproduct_type"] == "object"
    assert (known["hats_col_ra"], known["hats_col_dec"]) == ("ra_deg", "dec_deg")
    assert (known["hats_col_healpix"], known["hats_col_healpix_order"]) == (HEALPIX_COLUMN, "29")
    orders = {path.parts[0].removeprefix("Norder=") for path in partitions(folder)}
    assert (known["hats_nrows"], known["hats_order"]) == ("3000", max(orders))
    assert not any("date" in key for key in known)
    header, *pixels = (folder / "partition_info.csv").read_text().splitlines()
    assert header == "Norder,Npix"
    files = partitions(folder)
    listed = [Pixel(*map(int, line.split(","))).path for line in pixels]
    assert sorted(listed) == sorted(files)
    schema = pq.read_schema(folder / "dataset" / "_common_metadata")
    assert schema.field("ra_deg").metadata[b"unit"] == b"deg"
    footer = pq.read_metadata(folder / "dataset" / "_metadata")
    groups = [footer.row_group(k) for k in range(footer.num_row_groups)]
    assert sum(group.num_rows for group in groups) == 3000
    assert {Path(group.column(0).file_path) for group in groups} == set(files)


def test_the_same_stars_give_the_same_files(sky, tmp_path):
    shuffled = sky.take(np.random.default_rng(3).permutation(len(sky)))
    for name, table in (("a", sky), ("b", shuffled)):
        write_hats(table, tmp_path / name, "sky", 300)
    assert bytes_of(tmp_path / "a") == bytes_of(tmp_path / "b")


def test_stars_without_a_position_are_left_out_and_all_others_have_a_pixel(tmp_path):
    """Poles and both ends of the right ascensions, too."""
    table = star_table([10.0, None, float("nan"), 20.0], [5.0, 5.0, 5.0, None])
    assert write_hats(table, tmp_path / "some", "sky") == 1
    table = star_table([0.0, 359.9999999999999, 180.0, 0.0, 360.0], [90.0, 0.0, -90.0, 0.0, 0.0])
    assert write_hats(table, tmp_path / "all", "sky") == 5


def test_more_stars_in_one_place_than_a_partition_holds(tmp_path):
    table = star_table([10.0] * 3, [5.0] * 3)
    with pytest.raises(ConfigError, match=r"3 stars are in one place.*max_partition_rows"):
        write_hats(table, tmp_path / "sky", "sky", 2)
    assert not (tmp_path / "sky").exists()


def test_tables_that_are_no_star_tables(tmp_path):
    with pytest.raises(ConfigError, match="no column star_id, ra_deg, dec_deg"):
        write_hats(pa.table({"i": [1]}), tmp_path / "sky", "pairs")
    with pytest.raises(ConfigError, match="none of its 1 rows has a position"):
        write_hats(star_table([None], [None]), tmp_path / "sky", "rejected")


def test_without_cdshealpix(monkeypatch, tmp_path):
    monkeypatch.setitem(__import__("sys").modules, "cdshealpix.nested", None)
    with pytest.raises(ConfigError, match=re.escape(install_command("hats"))):
        write_hats(star_table([1.0], [1.0]), tmp_path / "sky", "sky")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_lsdb_opens_it(sky, tmp_path):
    lsdb = pytest.importorskip("lsdb", reason="LSDB comes with the extra dev")
    write_hats(sky, tmp_path / "sky", "sky", 300)
    catalog = lsdb.open_catalog(tmp_path / "sky")
    assert len(catalog) == 3000
    cone = catalog.cone_search(ra=80.0, dec=85.0, radius_arcsec=20 * 3600).compute()
    ra, dec = np.radians(sky["ra_deg"].to_numpy()), np.radians(sky["dec_deg"].to_numpy())
    axis = np.radians([80.0, 85.0])
    cosine = np.sin(dec) * np.sin(axis[1]) + np.cos(dec) * np.cos(axis[1]) * np.cos(ra - axis[0])
    inside = sky.filter(pa.array(cosine >= np.cos(np.radians(20.0))))
    assert sorted(cone["star_id"]) == sorted(inside["star_id"].to_pylist())
