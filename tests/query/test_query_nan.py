"""NaN in Parquet files that starcat did not write: null, and greater than all numbers in structs.

pyarrow leaves NaN out of the least and the greatest value that a Parquet file states.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from starcat.query.session import open_session

COUNT = 12_000
GROUP_ROWS = 2_048  # the least number of rows of a group whose statistics DuckDB uses
NAN = float("nan")


def answers(target: Path, *texts: str) -> list[list[tuple[Any, ...]]]:
    """Return the rows of queries about a target."""
    found = []
    with open_session([str(target)]) as session:
        for text in texts:
            with session.ask(text) as answer:
                found.append(answer.rows(COUNT))
    return found


@pytest.fixture(scope="module")
def ruwe() -> np.ndarray:
    """Values of one column: row groups without NaN, with some, with few other values, NaN only."""
    generator = np.random.default_rng(25521)
    values = np.round(generator.normal(1.0, 0.2, COUNT), 1)
    group = np.arange(COUNT) // GROUP_ROWS
    values[(group == 1) & (generator.random(COUNT) < 0.1)] = NAN
    values[group == 2] = 1.0
    values[(group == 2) & (generator.random(COUNT) < 0.5)] = NAN
    values[group == 3] = NAN
    return values


@pytest.fixture(scope="module", params=["file", "store"])
def target(request: pytest.FixtureRequest, ruwe: np.ndarray, tmp_path_factory) -> Path:
    """A Parquet file, and a HATS catalog, with the column as double, as float and in a struct."""
    folder = tmp_path_factory.mktemp("nan")
    small = pa.array(ruwe.astype(np.float32), from_pandas=False)
    table = pa.table(
        {"row": np.arange(COUNT), "ruwe": pa.array(ruwe, from_pandas=False), "small": small,
         "inside": pa.StructArray.from_arrays([pa.array(ruwe, from_pandas=False)], ["ruwe"]),
         "ra": np.full(COUNT, 45.0), "dec": np.full(COUNT, 10.0),
         "outside": pa.StructArray.from_arrays([pa.array(np.full(COUNT, 10.0))], ["dec"])}
    )  # fmt: skip
    if request.param == "file":
        pq.write_table(table, folder / "stars.parquet", row_group_size=GROUP_ROWS)
        return folder / "stars.parquet"
    said = "obs_collection=nan\nhats_col_ra=ra\nhats_col_dec=dec\n"
    (folder / "hats.properties").write_text(said)
    for pixel in range(2):
        path = folder / "dataset" / "Norder=0" / "Dir=0" / f"Npix={pixel}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        half = table.slice(pixel * COUNT // 2, COUNT // 2)
        pq.write_table(half, path, row_group_size=GROUP_ROWS)
    return folder


CONDITIONS = {
    "{} = 1.0": lambda x: x == 1.0,
    "{} != 1.0": lambda x: x != 1.0,
    "{} > 1.0": lambda x: x > 1.0,
    "{} >= 1.0": lambda x: x >= 1.0,
    "{} < 1.0": lambda x: x < 1.0,
    "{} <= 1.0": lambda x: x <= 1.0,
    "{} > 9.0": lambda x: x > 9.0,
    "{} <= 9.0": lambda x: x <= 9.0,
    "{} BETWEEN 1.0 AND 1.2": lambda x: (x >= 1.0) & (x <= 1.2),
    "NOT {} <= 1.0": lambda x: ~(x <= 1.0),
    "{} IN (1.0, 0.9)": lambda x: (x == 1.0) | (x == 0.9),
    "{} NOT IN (1.0, 0.9)": lambda x: (x != 1.0) & (x != 0.9),
}


def test_nan_is_null(target: Path, ruwe: np.ndarray):
    nan = np.isnan(ruwe)
    expected = {text: condition(ruwe) & ~nan for text, condition in CONDITIONS.items()}
    expected |= {"{} IS NULL": nan, "{} IS NOT NULL": ~nan, "isnan({})": np.zeros(COUNT, bool)}
    check_rows(target, "ruwe", expected)


def test_nan_in_a_struct_is_the_greatest_number(target: Path, ruwe: np.ndarray):
    nan = np.isnan(ruwe)
    large = np.where(nan, np.inf, ruwe)
    expected = {text: condition(large) for text, condition in CONDITIONS.items()}
    check_rows(target, "inside.ruwe", {**expected, "isnan({})": nan, "NOT isnan({})": ~nan})


def check_rows(target: Path, column: str, expected: dict[str, np.ndarray]) -> None:
    texts = [f"SELECT row FROM stars WHERE {one.format(column)} ORDER BY row" for one in expected]
    for text, found, rows in zip(texts, answers(target, *texts), expected.values(), strict=True):
        assert [row for (row,) in found] == np.flatnonzero(rows).tolist(), text


def test_aggregates_leave_out_nan(target: Path, ruwe: np.ndarray):
    known = ruwe[~np.isnan(ruwe)]
    [[extremes], [counts], [other]] = answers(
        target,
        "SELECT min(ruwe), max(ruwe), max(small), avg(ruwe) FROM stars",
        "SELECT count(ruwe), count(small), count(*) FROM stars",
        # Columns without NaN, of which DuckDB knows the least and the greatest value.
        "SELECT min(dec), max(dec), max(outside.dec), min(outside.dec) FROM stars",
    )
    assert extremes == pytest.approx((known.min(), known.max(), known.max(), known.mean()))
    assert counts == (len(known), len(known), COUNT)
    assert other == (10.0, 10.0, 10.0, 10.0)


def test_footers_still_tell_where_a_region_can_be(tmp_path: Path):
    dec = np.linspace(-90.0, 90.0, COUNT)
    table = pa.table({"ra_deg": np.full(COUNT, 5.0), "dec_deg": dec, "mag": np.full(COUNT, NAN)})
    pq.write_table(table, tmp_path / "stars.parquet", row_group_size=GROUP_ROWS)
    region = "FROM box(0, 10, 80, 90)"
    [rows, [(_, plan)]] = answers(
        tmp_path / "stars.parquet", f"SELECT count(*) {region}", f"EXPLAIN SELECT mag {region}"
    )
    assert rows == [(int(np.count_nonzero(dec >= 80.0)),)]
    assert re.search(r"dec_deg *>= *80", plan)


def test_rows_without_a_position_are_in_no_region(tmp_path: Path):
    ra = [0.5, NAN, 359.5, 10.0, 0.4, 0.6]
    table = pa.table(
        {"row": range(6), "ra_deg": ra, "dec_deg": [0.0, 0.0, 0.1, NAN, 0.2, 0.3],
         "epoch_jyear": [2000.0] * 4 + [NAN, 2000.0], "pm_dec_mas_yr": [1.0] * 6,
         "pm_ra_cosdec_mas_yr": [1.0] * 5 + [NAN]}
    )  # fmt: skip
    pq.write_table(table, tmp_path / "stars.parquet")
    regions = ["cone(0, 0, 5)", "box(350, 10, -20, 20)", "box(0, 360, -90, 90)",
               "field(0, 0, 0, 12, 12)",
               "stars WHERE in_moc(ra_deg, dec_deg, '0/0-11')"]  # fmt: skip
    for found in answers(
        tmp_path / "stars.parquet", *(f"SELECT row FROM {one}" for one in regions)
    ):
        assert sorted(found) == [(0,), (2,), (4,), (5,)]
    pairs, cells = answers(
        tmp_path / "stars.parquet",
        # A row without an epoch or a motion is not moved, and is not lost.
        "SELECT a_row FROM crossmatch('stars', 'stars', 1, epoch := 2100.0)",
        "SELECT row FROM stars WHERE healpix(3, ra_deg, dec_deg) IS NULL",
    )
    assert sorted(pairs) == [(0,), (2,), (4,), (5,)]
    assert sorted(cells) == [(1,), (3,)]
