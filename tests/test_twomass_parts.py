"""Made parts of 2MASS are what starcat reads: the layout, the counts, the crowd along the plane."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent / "benchmarks"))

from twomass_parts import FAINTEST_KS_MAG, KINDS, PARTS, part_bytes, write_parts

from starcat.catalog.ingest import ingest
from starcat.catalog.stars import floats_of
from starcat.catalog.verdict import Quality
from starcat.geometry.sphere import directions_from_radec, separation

ROWS = 92 * 300


@pytest.fixture(scope="module")
def read(tmp_path_factory):
    folder = tmp_path_factory.mktemp("psc")
    write_parts(folder, ROWS)
    return ingest("2mass", [folder / f"psc_{part}.gz" for part in PARTS])


def test_every_record_is_a_star_or_rejected_for_what_it_is(read):
    assert read.rows_read == len(read.stars) + len(read.rejected) == ROWS
    assert read.problems == ()
    numbers = [*read.stars["star_id"].to_pylist(), *read.rejected["star_id"].to_pylist()]
    assert sorted(numbers) == list(range(1, ROWS + 1))
    share = {name: share for name, share, _ in KINDS}
    found = read.rejected_by_reason
    assert set(found) >= {"duplicate_record", "extended", "artifact"}
    assert found["duplicate_record"] == pytest.approx(share["repeated"] * ROWS, rel=0.15)
    assert found["extended"] == pytest.approx(share["extended"] * ROWS, rel=0.3)


def test_faint_records_have_upper_limits_for_magnitudes(read):
    mag = read.stars["mag"]
    assert 0.02 < mag.null_count / ROWS < 0.08
    flags = read.stars["quality_flags"].to_numpy()
    for bit in (Quality.SATURATED, Quality.BLENDED, Quality.POOR_PHOTOMETRY, Quality.CONTAMINATED):
        assert (flags & bit).any(), bit


def test_stars_crowd_along_the_galactic_plane(read):
    pole = directions_from_radec(192.859481, 27.128251)
    u = directions_from_radec(read.stars["ra_deg"].to_numpy(), read.stars["dec_deg"].to_numpy())
    latitude_deg = 90.0 - np.degrees(separation(u, pole))
    near = float(np.mean(np.abs(latitude_deg) < 10.0))
    assert 0.4 < near < 0.7  # 0.17 of the sphere


def test_counts_grow_tenfold_in_two_and_a_half_magnitudes(read):
    mag = floats_of(read.stars, "mag")
    assert np.nanmax(mag) <= FAINTEST_KS_MAG
    counts = [int(np.sum(mag < FAINTEST_KS_MAG - step)) for step in (0.0, 2.5)]
    assert 8.0 < counts[0] / counts[1] < 12.5


def test_a_part_is_the_same_whenever_it_is_made():
    assert part_bytes(5, 100, 7) == part_bytes(5, 100, 7)
    assert part_bytes(5, 100, 7) != part_bytes(6, 100, 7)


def test_designations_say_the_position(read):
    first = read.stars.slice(0, 1).to_pylist()[0]
    text = first["designation"].rpartition("J")[2].strip()
    hours = int(text[:2]) + int(text[2:4]) / 60 + int(text[4:8]) / 360_000
    assert hours * 15.0 == pytest.approx(first["ra_deg"], abs=1e-4)
