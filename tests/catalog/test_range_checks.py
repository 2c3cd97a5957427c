"""Impossible values are left out with a reason; they are not an error."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from archives import archive_records, file_header, record
from catalog_folder import bright_sky

from starcat.catalog.ingest import Ingested, ingest_catalog
from starcat.catalog.parts import RANGES, check_ranges
from starcat.catalog.source import SourceColumn, data_source
from starcat.stars.verdict import Verdicts

SKY = bright_sky().where(np.arange(40))
BRIGHT_SKY = replace(SKY, v_mag=SKY.v_mag - 6.0)

Read = Callable[..., Ingested]


@pytest.fixture
def read(tmp_path: Path) -> Read:
    """Ingest 40 good records and one more, of the given fields."""

    def run(source: str, layout_name: str, **fields: str | float) -> Ingested:
        layout = next(file for file in data_source(source).files if file.name == layout_name)
        sky = BRIGHT_SKY if layout_name == "suppl_1" else SKY
        records = archive_records(source, sky)[layout_name]
        path = tmp_path / layout.file_names[0].replace("{part}", "aaa")
        path.write_bytes(file_header(layout, 41) + b"".join([*records, record(layout, fields)]))
        return ingest_catalog(source, [path])

    return run


PSC = {
    "ra": "10.000000", "dec": "20.000000", "designation": "00400000+2000000 ", "k_m": "5.000",
    "pts_key": "77", "jdate": "2451545.0",
}  # fmt: skip


def test_a_record_of_tycho2_without_a_mean_position_or_an_epoch_is_rejected(read):
    fields = {"tyc1": 9000, "tyc2": 1, "tyc3": 1, "ra_deg": 10.0, "de_deg": 20.0, "vt_mag": 5.0}
    epochs = {"ep_ra_1990": 1.5, "ep_de_1990": 1.5}
    assert len(read("tycho2", "tyc2", **fields, **epochs).stars) == 41
    assert read("tycho2", "tyc2", **fields).rejected_by_reason == {"no_position": 1}


HIP = {"hip": 118000, "ra_deg": "010.00000000", "de_deg": "+20.00000000", "v_mag": 5.0}
TYC1 = {"tyc1": 9000, "tyc2": 1, "tyc3": 1, **{k: v for k, v in HIP.items() if k != "hip"}}
TYC2 = {"tyc1": 9000, "tyc2": 1, "tyc3": 1, "ra_mean_deg": 10.0, "de_mean_deg": 20.0}
SUPPL = {"tyc1": 9000, "tyc2": 1, "tyc3": 1, "ra_deg": 10.0, "de_deg": 20.0, "vt_mag": 1.0}
SAO = {"sao": 258997, "v_mag": 5.0, "ra2000_rad": 1.0, "de2000_rad": "0.5"}
GAIA = {"source_id": 5, "ra_deg": 10.0, "dec_deg": 20.0, "mag_g": 5.0}


@pytest.mark.parametrize(
    ("source", "layout", "good", "field", "value"),
    [
        ("2mass", "psc", PSC, "ra", "1e308"),
        ("2mass", "psc", PSC, "ra", "-0.1"),
        ("2mass", "psc", PSC, "dec", "100000"),
        ("2mass", "psc", PSC, "k_m", "1e300"),
        ("2mass", "psc", PSC, "pts_key", "99999999999999999999"),
        ("2mass", "psc", PSC, "pts_key", "1.5"),
        ("2mass", "psc", PSC, "jdate", "1e99"),
        ("hipparcos", "hip_main", HIP, "ra_deg", "1E308"),
        ("hipparcos", "hip_main", HIP, "de_deg", "100000"),
        ("hipparcos", "hip_main", HIP, "hip", "1E99"),
        ("hipparcos", "hip_main", HIP, "hd", "9E99"),
        ("hipparcos", "hip_main", HIP, "pm_ra", "1E200"),
        ("tycho1", "tyc_main", TYC1, "tyc1", "-1"),
        ("tycho1", "tyc_main", TYC1, "tyc1", "9E9"),
        ("tycho1", "tyc_main", TYC1, "tyc2", "9E99"),
        ("tycho1", "tyc_main", TYC1, "ra_deg", "361"),
        ("tycho1", "tyc_main", TYC1, "hip", "9E9"),
        ("tycho2", "tyc2", TYC2, "tyc2", "-1"),
        ("tycho2", "tyc2", TYC2, "ra_mean_deg", "1E308"),
        ("tycho2", "tyc2", TYC2, "de_mean_deg", "-90.1"),
        ("tycho2", "suppl_1", SUPPL, "de_deg", "100000"),
        ("tycho2", "suppl_1", SUPPL, "vt_mag", "-1E99"),
        ("sao", "sao", SAO, "ra2000_rad", "1D308"),
        ("sao", "sao", SAO, "de2000_rad", "1.6"),
        ("sao", "sao", SAO, "sao", "9E99"),
        ("sao", "sao", SAO, "pm_de2000", "1E30"),
        ("gaia", "gaia_merged", GAIA, "ra_deg", np.inf),
        ("gaia", "gaia_merged", GAIA, "dec_deg", 1e5),
        ("gaia", "gaia_merged", GAIA, "source_id", -(2**63)),
        ("gaia", "gaia_merged", GAIA, "mag_g", np.inf),
    ],
)
def test_a_number_that_the_column_cannot_hold_is_malformed(
    read, source, layout, good, field, value
):
    assert len(read(source, layout, **good).stars) == 41
    found = read(source, layout, **{**good, field: value})
    assert len(found.stars) == 40
    assert found.rejected_by_reason == {"malformed_record": 1}
    (problem,) = found.problems
    assert f"{field}: found " in problem
    assert " to " in problem


def test_ninety_degrees_and_a_minute_is_no_declination(read):
    fields = {"sao": 258997, "v_mag": 5.0, "ra2000_h": 1, "ra2000_m": 2, "ra2000_s": 3.0}
    north = {"de2000_sign": "+", "de2000_d": 90, "de2000_m": 0, "de2000_s": 0.0}
    assert len(read("sao", "sao", **fields, **north).stars) == 41
    found = read("sao", "sao", **fields, **{**north, "de2000_m": 1})
    assert found.rejected_by_reason == {"no_position": 1}


def test_a_right_ascension_of_360_degrees_is_0(read):
    found = read("2mass", "psc", **{**PSC, "ra": "360.000000"})
    assert 0.0 in found.stars["ra_deg"].to_pylist()
    assert len(found.stars) == 41


def test_a_proper_motion_that_only_the_pole_makes_possible(read):
    # 100 s of time a year is 1.5 million mas/yr at the equator, and 2,600 near the pole.
    near = {**SAO, "pm_ra2000": "99.9999", "pm_de2000": "0.0", "de2000_rad": "1.57"}
    assert len(read("sao", "sao", **near).stars) == 41
    found = read("sao", "sao", **{**near, "de2000_rad": "0.0"})
    assert found.rejected_by_reason == {"impossible_value": 1}


@pytest.mark.parametrize("name", sorted(RANGES))
def test_the_ends_of_ranges(name):
    least, greatest = RANGES[name]
    values = np.array([least, greatest, np.nextafter(least, -np.inf), np.nextafter(greatest, 1e99)])
    columns = {"ra_deg": np.ones(4), "dec_deg": np.ones(4), "epoch_jyear": 2000.0, name: values}
    verdicts = Verdicts(4)
    check_ranges(columns, verdicts)
    assert verdicts.is_kept.tolist() == [True, True, False, False]
    assert verdicts.reasons.to_pylist() == ["impossible_value"] * 2


def test_ranges_follow_limits_then_digits_then_units():
    assert SourceColumn(name="a", format="I3", unit="h").range == (-999.0, 999.0)
    assert SourceColumn(name="a", format="I3", limits=(1, 7)).range == (1.0, 7.0)
    assert SourceColumn(name="a", format="F5.2", unit="h").range == (0.0, 24.0)
    assert SourceColumn(name="a", format="F5.2", unit="deg").range is None


def test_limits_swapped_are_refused():
    with pytest.raises(ValueError, match=r"limits \(7.0, 1.0\) are not least <= greatest"):
        SourceColumn(name="a", format="I3", limits=(7, 1))


def test_progress_counts_bytes_within_a_file(tmp_path):
    line = archive_records("sao", SKY)["sao"][0]
    lines = [b"%6d" % number + line[6:] for number in range(1, 60_001)]
    path = tmp_path / "sao.dat"
    path.write_bytes(b"".join(lines))
    events: list[tuple[str, int, int | None]] = []
    ingest_catalog("sao", [path], neighbours=False, progress=lambda *event: events.append(event))
    done = [event[1] for event in events]
    size = path.stat().st_size
    assert {(stage, total) for stage, _, total in events} == {("read sao", size)}
    assert done == sorted(done)
    assert done[-1] == size
    assert any(0 < each < size for each in done), "nothing was reported within the file"
