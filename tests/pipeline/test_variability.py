"""Amplitudes from other sources: joined by number, the largest wins, no number matches nothing."""

from __future__ import annotations

import gzip
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from archives import with_field
from genuine_records import TYC2, TYC_MAIN

from starcat.catalog.ingest import ingest_catalog
from starcat.catalog.joins import Keys
from starcat.catalog.source import data_source
from starcat.catalog.stars.star_table import floats_of, table_from_columns
from starcat.catalog.variability import AmplitudeTable, join_amplitudes, read_amplitudes, read_gcvs


def stars_of(catalog: str, count: int, **columns: Any) -> pa.Table:
    given = {"star_id": np.arange(1, count + 1), "catalog": catalog}
    given |= {
        name: np.array(values) if isinstance(values, list) else values
        for name, values in columns.items()
    }
    return table_from_columns("stars", given, count)


def table_of(
    amplitude: Sequence[float],
    flag: Sequence[str | None] | None = None,
    source: str = "hipparcos",
    **numbers: Sequence[int],
) -> AmplitudeTable:
    flags = np.array(flag or [None] * len(amplitude), dtype=object)
    keys = Keys({name: np.array(values, dtype=np.int64) for name, values in numbers.items()})
    mags = np.array(amplitude, dtype=float)
    return AmplitudeTable(source, (), len(amplitude), {}, mags, flags, keys)


def joined(stars: pa.Table, *tables: AmplitudeTable) -> pa.Table:
    for table in tables:
        stars, _ = join_amplitudes(stars, table)
    return stars


# The join


@pytest.mark.parametrize("key", ["hip_number", "hd_number"])
def test_join_by_number(key):
    stars = stars_of("sao", 3, **{key: [30.0, np.nan, 10.0]})
    table = table_of([0.1, 0.2, 0.3], ["H6=1", None, "H6=2"], **{key: [10, 20, 30]})
    found, count = join_amplitudes(stars, table)
    assert count == 2
    assert found["amplitude_mag"].to_pylist() == [0.3, None, 0.1]
    assert found["amplitude_source"].to_pylist() == ["hipparcos", None, "hipparcos"]
    codes = ["hipparcos:H6=2", None, "hipparcos:H6=1"]
    assert found["variable_flag"].to_pylist() == codes
    assert found["is_flagged_variable"].to_pylist() == [True, False, True]
    assert found.schema.equals(stars.schema)


@pytest.mark.parametrize("key", ["hip_number", "hd_number", "tyc", "gaia"])
def test_no_number_matches_no_number(key):
    table = table_of([5.0, 5.0], ["x", "y"], **{key: [0, 0]})
    for catalog in ("sao", "tycho2", "gaia"):
        stars = stars_of(catalog, 4, hip_number=[0.0, np.nan, 0, 0], hd_number=[0.0, np.nan, 0, 0])
        found, count = join_amplitudes(stars, table)
        assert count == 0
        assert found.equals(stars)


def test_several_records_of_one_number_give_the_largest_amplitude():
    stars = stars_of("sao", 3, hd_number=[77.0, 78.0, 77.0])
    table = table_of([0.2, 0.9, np.nan, 0.4], ["a", None, "c", "a"], hd_number=[77, 77, 77, 77])
    found, count = join_amplitudes(stars, table)
    assert count == 2
    assert found["amplitude_mag"].to_pylist() == [0.9, None, 0.9]
    assert set(found["variable_flag"][0].as_py().split(";")) == {"hipparcos:a", "hipparcos:c"}


def test_the_first_key_that_matches_is_the_star():
    stars = stars_of("sao", 2, hip_number=[1.0, np.nan], hd_number=[500.0, 500.0])
    table = table_of([0.1, 0.8], hip_number=[1, 2], hd_number=[400, 500])
    assert joined(stars, table)["amplitude_mag"].to_pylist() == [0.1, 0.8]


@pytest.mark.parametrize(
    ("own", "other", "expected", "origin"),
    [
        (0.5, 0.2, 0.5, "tycho1"),
        (0.2, 0.5, 0.5, "hipparcos"),
        (0.2, np.nan, 0.2, "tycho1"),
        (np.nan, 0.2, 0.2, "hipparcos"),
    ],
)
def test_a_larger_amplitude_replaces_a_smaller(own, other, expected, origin):
    known = pa.array([None if np.isnan(own) else "tycho1"], pa.string())
    stars = stars_of("tycho1", 1, hip_number=[1.0], amplitude_mag=[own], amplitude_source=known)
    found = joined(stars, table_of([other], hip_number=[1]))
    assert found["amplitude_mag"].to_pylist() == [expected]
    assert found["amplitude_source"].to_pylist() == [origin]


@pytest.mark.parametrize("is_reversed", [False, True])
def test_two_sources_in_any_order_give_the_same_amplitude(is_reversed):
    stars = stars_of("sao", 2, hip_number=[1.0, 2.0], variable_flag=pa.array(["Rem=4", None]))
    first = table_of([0.3, 0.7], ["H6=2", "H6=3"], hip_number=[1, 2])
    second = table_of([0.4, np.nan], ["EA", "M"], source="gcvs", hip_number=[1, 2])
    found = joined(stars, *([second, first] if is_reversed else [first, second]))
    assert found["amplitude_mag"].to_pylist() == [0.4, 0.7]
    assert found["amplitude_source"].to_pylist() == ["gcvs", "hipparcos"]
    codes = [set(text.split(";")) for text in found["variable_flag"].to_pylist()]
    assert codes == [{"Rem=4", "hipparcos:H6=2", "gcvs:EA"}, {"hipparcos:H6=3", "gcvs:M"}]


def test_joining_twice_changes_nothing():
    stars = stars_of("sao", 2, hip_number=[1.0, 2.0])
    table = table_of([0.3, np.nan], ["H6=2", "H52=P"], hip_number=[1, 2])
    once = joined(stars, table)
    assert joined(once, table).equals(once)


def test_tycho_numbers_join_only_tycho_stars():
    table = table_of([0.7], source="tycho1", tyc=[2])
    assert joined(stars_of("tycho2", 2), table)["amplitude_mag"].to_pylist() == [None, 0.7]
    assert joined(stars_of("sao", 2), table)["amplitude_mag"].null_count == 2


def test_gaia_numbers_join_to_the_last_digit_and_only_gaia_stars():
    """A star that Gaia lacks joins by its Hipparcos number."""
    lacking = stars_of("gaia", 1, star_id=[-32349], hip_number=[32349.0])
    table = table_of([0.2], source="gcvs", hip_number=[32349], gaia=[0])
    assert joined(lacking, table)["amplitude_mag"].to_pylist() == [0.2]
    number = np.array([4313918654563864191, 4313918654563864192])  # a float64 holds neither
    table = table_of([0.7], source="gcvs", gaia=[4313918654563864192])
    gaia, other = (stars_of(catalog, 2, star_id=number) for catalog in ("gaia", "2mass"))
    assert joined(gaia, table)["amplitude_mag"].to_pylist() == [None, 0.7]
    assert joined(other, table)["amplitude_mag"].null_count == 2


# The sources


@pytest.fixture
def gcvs(tmp_path: Path) -> Callable[..., AmplitudeTable]:
    """Read GCVS records: number, type, maximum, flag, minimum."""

    def run(*records: str) -> AmplitudeTable:
        lines = []
        for record in records:
            number, kind, top, flag, low = record.split()
            fields = [number, "V1 And", kind, top, flag, low, *[""] * 6]
            lines.append("\t".join("" if field == "-" else field for field in fields))
        path = tmp_path / "gcvs.tsv"
        path.write_text("# heading\n" + "\n".join(lines) + "\n", encoding="utf-8")
        return read_gcvs([path])

    return run


@pytest.mark.parametrize(
    ("record", "amplitude"),
    [
        ("10826 M 1.9 0 10.4", 8.5),  # omicron Ceti
        ("117143 EA 10.92 1 0.67", 0.67),  # WW Andromedae: the "minimum" is the amplitude
        ("90599 EA/DM 7.94 1 0.60", 0.60),  # V451 Ophiuchi
        ("4313918654563864192 NA 9.8 1 21.", 11.2),  # V1493 Aquilae: fainter than the maximum
        ("1 SR 8.0 2 9.5", 1.5),  # the minimum is fainter still: a lower bound
        ("1 SR 8.0 0 <9.5", 1.5),
        ("1 UV >18. 0 21.", 3.0),
        ("1 SR 8.0 0 7.0", None),  # a minimum brighter than the maximum is of no use
        ("1 SR 8.0 0 8.0", 0.0),
        ("1 SR 8.0 0 -", None),
        ("1 SR - 0 9.0", None),
        ("1 SR - 1 0.4", 0.4),
        ("1 SR 8.0 - 9.0", 1.0),
        # Magnitudes that are none
        *((f"118218 M 8.0 0 {mag}", None) for mag in ("nan", "inf", "1e308", "\u0665", "1_0")),
    ],
)
def test_amplitudes_of_gcvs(gcvs, record, amplitude):
    found = gcvs(record).amplitude_mag
    expected = np.nan if amplitude is None else amplitude
    np.testing.assert_allclose(found, [expected], rtol=0, atol=1e-12)


def test_numbers_of_gcvs(gcvs):
    found = gcvs("118218 M 1 0 2", "4313918654563864193 - 1 0 2")
    assert found.keys.numbers["hip_number"].tolist() == [118218, 0]
    assert found.keys.numbers["gaia"].tolist() == [0, 4313918654563864193]
    assert found.flag.tolist() == ["M", None]
    assert found.files[0].rows == 2
    assert found.rejected == {}


@pytest.mark.parametrize("ref", ["none", "0", "\u00b2\u00b3", "9" * 19, "\u0661", "-5", "1_0"])
def test_a_record_of_gcvs_without_a_number_is_rejected(gcvs, ref):
    found = gcvs("118218 M 1 0 2", f"{ref} SR 1 0 2")
    assert found.keys.numbers["hip_number"].tolist() == [118218]
    assert found.rejected == {"no_identity": 1}
    assert found.files[0].rows == 2


def test_a_star_without_position_can_still_be_known_to_vary(tmp_path, catalogs):
    layout = data_source("hipparcos").files[0]
    with gzip.open(catalogs / "hip_main.dat.gz") as file:
        good, other = file.readline(), file.readline()
    for name, text in (("ra_deg", b""), ("var_flag", b"3"), ("hip", b"4711")):
        other = with_field(layout, other, layout.column(name), text)
    (tmp_path / "hip_main.dat").write_bytes(good + other)
    table = read_amplitudes("hipparcos", [tmp_path])
    assert table.rejected == {"no_position": 1}
    row = table.keys.numbers["hip_number"].tolist().index(4711)
    assert table.amplitude_mag[row] > 0.6


def test_tycho1_into_tycho2(tmp_path):
    layout = data_source("tycho1").files[0]
    # TYC 1-13-1: VT 8.57 to 8.79.
    line = with_field(layout, TYC_MAIN[0], layout.column("var_flag"), b"V")
    (tmp_path / "tyc_main.dat").write_bytes(b"\n".join([line, TYC_MAIN[1]]) + b"\n")
    (tmp_path / "tyc2.dat").write_bytes(b"\n".join(TYC2) + b"\n")
    stars = ingest_catalog("tycho2", [tmp_path]).stars
    found, count = join_amplitudes(stars, read_amplitudes("tycho1", [tmp_path]))
    assert count == 1
    assert found["designation"].to_pylist()[1] == "TYC 1-13-1"
    assert found["amplitude_mag"].to_pylist() == [None, pytest.approx(0.22), None]
    assert found["amplitude_source"].to_pylist() == [None, "tycho1", None]
    assert found["variable_flag"].to_pylist() == [None, "tycho1:T48=V", None]


def test_strongly_variable_naked_eye_stars_of_sao(catalogs, ingested, expected):
    stars = ingested("sao", "sao.dat.gz").stars
    table = read_amplitudes("hipparcos", [catalogs / "hip_main.dat.gz"])
    assert table.kept == expected(genuine=9_928, generated=8_642)
    assert table.rejected == {"no_position": 5}
    found, count = join_amplitudes(stars, table)
    assert count == expected(genuine=9_916, generated=8_647)
    is_strong = (floats_of(found, "mag") <= 6.0) & (floats_of(found, "amplitude_mag") > 0.6)
    assert is_strong.sum() == expected(genuine=34, generated=30)
    assert len(found) == len(stars)


def test_the_whole_gcvs(catalogs, expected):
    table = read_amplitudes("gcvs", [catalogs / "gcvs.tsv.gz"])
    of_hipparcos, of_gaia = expected(genuine=(6_892, 43_100), generated=(209, 209))
    assert (table.kept, table.rejected) == (of_hipparcos + of_gaia, {})
    assert (table.keys.numbers["hip_number"] > 0).sum() == of_hipparcos
    assert (table.keys.numbers["gaia"] > 0).sum() == of_gaia
    assert np.nanmin(table.amplitude_mag) >= 0.0
    if of_gaia > 209:
        mira = table.keys.numbers["hip_number"].tolist().index(10826)
        assert (table.amplitude_mag[mira], table.flag[mira]) == (pytest.approx(8.5), "M")
