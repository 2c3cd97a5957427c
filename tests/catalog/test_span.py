"""A mission's years: where stars are at both ends, and how well that is known."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import erfa
import numpy as np
import pyarrow as pa
import pytest
from archives import record

from starcat.catalog.ingest import ingest_catalog
from starcat.catalog.source import data_source
from starcat.catalog.span import drifts, position_errors, validity, with_span
from starcat.catalog.stars.proper_motion import MAS, Motion, propagate_in_space
from starcat.catalog.stars.star_table import (
    directions_of,
    floats_of,
    move_to_epoch,
    table_from_columns,
)
from starcat.database.verify import check_database
from starcat.errors import ConfigError
from starcat.geometry.sphere import directions_from_radec, separation
from starcat.matcher.matcher import Matcher
from starcat.pipeline.build import build
from starcat.pipeline.rebuild import rebuild
from starcat.pipeline.selection.ruleset import Selection
from starcat.pipeline.selection.selecting import select_guide_stars
from starcat.pipeline.specs.reading import read_spec, spec_of_database

SPAN = (2027.0, 2042.0)
MICROARCSEC = np.radians(1e-6 / 3600.0)

# HIP, V, right ascension, declination, parallax, proper motions: hip_main at J1991.25.
FAST: dict[str, dict[str, Any]] = {
    "Barnard's star": {
        "hip": 87937, "v_mag": 9.54, "ra_deg": "269.45402305", "de_deg": "+04.66828815",
        "plx": 549.01, "pm_ra": -797.84, "pm_de": 10326.93, "e_ra": 0.93, "e_de": 1.16,
        "e_pm_ra": 1.61, "e_pm_de": 1.29,
    },
    "61 Cygni A": {
        "hip": 104214, "v_mag": 5.20, "ra_deg": "316.71181046", "de_deg": "+38.74149446",
        "plx": 287.13, "pm_ra": 4155.10, "pm_de": 3258.90,
    },
    "61 Cygni B": {
        "hip": 104217, "v_mag": 6.05, "ra_deg": "316.71747967", "de_deg": "+38.73441392",
        "plx": 285.42, "pm_ra": 4107.40, "pm_de": 3143.72,
    },
    "Arcturus": {
        "hip": 69673, "v_mag": -0.05, "ra_deg": "213.91811403", "de_deg": "+19.18726997",
        "plx": 88.85, "pm_ra": -1093.45, "pm_de": -1999.40,
    },
    "Polaris": {
        "hip": 11767, "v_mag": 1.97, "ra_deg": "037.94614689", "de_deg": "+89.26413805",
        "plx": 7.56, "pm_ra": 44.22, "pm_de": -11.74,
    },
}  # fmt: skip


def stars_of(folder: Path, *records: dict[str, Any], **options: Any) -> pa.Table:
    """Ingest records of Hipparcos."""
    layout = data_source("hipparcos").files[0]
    path = folder / "hip_main.dat"
    path.write_bytes(b"".join(record(layout, {"catalog": "H", **one}) for one in records))
    return ingest_catalog("hipparcos", [path], **options).stars


@pytest.fixture
def fast_stars(tmp_path: Path) -> pa.Table:
    return stars_of(tmp_path, *FAST.values(), epoch_jyear=sum(SPAN) / 2)


@pytest.mark.parametrize("year", SPAN)
def test_positions_at_both_ends_are_those_of_sofa(ingested, year):
    """Genuine records, also without a parallax above 0, from their own epoch."""
    own = ingested("hipparcos", "hip_main.dat.gz").stars
    start = Motion(*(floats_of(own, field.name) for field in fields(Motion)))
    parallax, velocity = floats_of(own, "parallax_mas"), floats_of(own, "radial_velocity_km_s")
    epoch = floats_of(own, "epoch_jyear")
    _, found = propagate_in_space(start, parallax, velocity, epoch, np.array(year))
    ra, dec = np.radians(start.ra_deg), np.radians(start.dec_deg)
    pm_ra, pm_dec = start.pm_ra_cosdec_mas_yr * MAS / np.cos(dec), start.pm_dec_mas_yr * MAS
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", erfa.ErfaWarning)
        moved = erfa.pmsafe(
            ra, dec, pm_ra, pm_dec, np.fmax(parallax, 0.0) / 1000.0, np.zeros(len(ra)),
            *erfa.epj2jd(1991.25), *erfa.epj2jd(year),
        )  # fmt: skip
    expected = directions_from_radec(np.degrees(moved[0]), np.degrees(moved[1]))
    assert np.nanmax(separation(found, expected)) < MICROARCSEC


def test_the_stars_that_drift_leave_with_their_reason(fast_stars):
    stars = with_span(fast_stars, SPAN)
    wanted = {"faint_limit_mag": 10.0, "max_drift_arcsec": 1.0, "doubles": {"action": "keep"}}
    selection = Selection.model_validate(wanted)
    selected = select_guide_stars(stars, selection)
    verdicts = (selected.rejected[name].to_pylist() for name in ("star_id", "reason"))
    gone = dict(zip(*verdicts, strict=True))
    assert gone == {87937: "drifts", 104214: "drifts", 104217: "drifts", 69673: "drifts"}
    assert selected.guide_stars["star_id"].to_pylist() == [11767]
    drift = dict(zip(stars["star_id"].to_pylist(), floats_of(stars, "drift_arcsec"), strict=True))
    # 7.5 years of the motion that the catalog states, and the parallax.
    assert drift[87937] == pytest.approx(7.5 * 10.3577 + 0.549, rel=1e-3)
    assert drift[104214] == pytest.approx(7.5 * 5.2807 + 0.287, rel=1e-3)


def test_validity_names_the_worst_and_what_a_release_would_gain(fast_stars):
    held = validity(with_span(fast_stars, SPAN), SPAN)
    assert held is not None
    assert [one["designation"] for one in held.worst][:2] == ["HIP 87937", "HIP 104214"]
    assert held.reissued_worst_arcsec == pytest.approx(3.75 * 10.3577 + 0.549, rel=1e-3)
    assert "HIP 87937" in str(held)
    assert validity(with_span(fast_stars, (2026.0, 2026.0)), (2026.0, 2026.0)) is None


def test_a_star_without_a_motion_has_no_drift_and_no_error(fast_stars):
    columns = {name: fast_stars[name] for name in fast_stars.column_names}
    for name in ("pm_ra_cosdec_mas_yr", "pm_dec_mas_yr", "ra_error_mas", "dec_error_mas"):
        columns[name] = np.full(len(fast_stars), np.nan)
    still = table_from_columns("stars", columns, len(fast_stars))
    assert np.isnan(drifts(still, 7.5)).all()
    assert with_span(still, SPAN)["position_error_end_arcsec"].null_count == len(still)


@pytest.mark.parametrize("year", [1991.25, *SPAN])
@pytest.mark.parametrize("correlation", [-0.7, 0.0, 0.5])
def test_errors_are_those_of_a_monte_carlo(tmp_path, year, correlation):
    """10,000 stars that have the errors of Barnard's star, moved one by one."""
    barnard = FAST["Barnard's star"]
    given = dict.fromkeys(("pm_ra_ra", "pm_de_de"), f"{correlation:5.2f}")
    predicted = position_errors(stars_of(tmp_path, barnard | given), year)[0]

    rng = np.random.default_rng(24)
    place = [float(barnard["ra_deg"]), float(barnard["de_deg"])]
    drawn = {}
    for axis in ("ra", "de"):
        own, motion = barnard[f"e_{axis}"], barnard[f"e_pm_{axis}"]
        shared = correlation * own * motion
        covariance = [[own**2, shared], [shared, motion**2]]
        drawn[axis] = rng.multivariate_normal([0.0, barnard[f"pm_{axis}"]], covariance, 10_000).T
    offset_deg = [drawn["ra"][0] / np.cos(np.radians(place[1])), drawn["de"][0]]
    ra, dec = (start + off / 3.6e6 for start, off in zip(place, offset_deg, strict=True))
    blank = np.full(10_000, barnard["plx"])
    motion = Motion(ra, dec, drawn["ra"][1], drawn["de"][1])
    epoch = np.full(10_000, 1991.25)
    moved, _ = propagate_in_space(motion, blank, np.full(10_000, np.nan), epoch, np.array(year))
    east = np.std(moved.ra_deg) * np.cos(np.radians(moved.dec_deg.mean())) * 3600.0
    north = np.std(moved.dec_deg) * 3600.0
    # The standard deviation of 10,000 draws is good to 0.7 %.
    assert predicted == pytest.approx(max(east, north), rel=0.03)


@pytest.mark.parametrize("correlation", [-0.9, 0.0, 0.46])
def test_the_ellipse_is_at_most_the_root_of_two_longer_than_stated(tmp_path, correlation):
    """Each axis is exact for every correlation with the other axis, which no column has."""
    given = dict.fromkeys(("e_ra", "e_de", "e_pm_ra", "e_pm_de"), 1.0)
    given |= dict.fromkeys(("pm_ra_ra", "pm_de_de"), " 0.00")
    stars = stars_of(tmp_path, FAST["Barnard's star"] | given)
    stated_arcsec = position_errors(stars, 2027.0)[0]
    rng = np.random.default_rng(25)
    shared = [[1.0, correlation], [correlation, 1.0]]
    place, motion = (rng.multivariate_normal([0.0, 0.0], shared, 10_000) for _ in range(2))
    at_the_end = (place + (2027.0 - 1991.25) * motion) / 1000.0
    assert stated_arcsec == pytest.approx(at_the_end.std(axis=0).max(), rel=0.03)
    major = np.sqrt(np.linalg.eigvalsh(np.cov(at_the_end.T))[-1])
    assert major == pytest.approx(stated_arcsec * np.sqrt(1.0 + abs(correlation)), rel=0.03)
    assert major <= 1.01 * np.sqrt(2.0) * stated_arcsec


@pytest.fixture
def folder_of(tmp_path: Path, sao_file: Path, small_spec: str) -> Callable[..., Path]:
    """Build the small spec with some of its keys changed."""
    (tmp_path / "small.toml").write_text(small_spec)

    def run(**changes: str) -> Path:
        spec = read_spec(tmp_path / "small.toml", changes)
        return build(spec, tmp_path, inputs={"sao": [sao_file]}).folder

    return run


def test_a_database_of_a_span(folder_of):
    folder = folder_of(epoch_jyear="[2027.0, 2042.0]")
    database = check_database(folder)
    assert (database.manifest["epoch_jyear"], spec_of_database(database).span_jyear) == (
        2034.5,
        SPAN,
    )
    stars = database.table("stars")
    known = ~np.isnan(floats_of(stars, "drift_arcsec"))
    speed = np.hypot(floats_of(stars, "pm_ra_cosdec_mas_yr"), floats_of(stars, "pm_dec_mas_yr"))
    np.testing.assert_allclose(
        floats_of(stars, "drift_arcsec")[known], 7.5e-3 * speed[known], rtol=1e-4, atol=1e-9
    )
    report = json.loads((folder / "report" / "report.json").read_text())
    assert report["validity"]["end_jyear"] == 2042.0
    assert Matcher.open(folder).database.epoch_jyear == 2034.5


@pytest.mark.slow
def test_a_span_has_the_positions_of_its_middle(folder_of, tmp_path):
    folder = folder_of(epoch_jyear="[2027.0, 2042.0]")
    same = folder_of(epoch_jyear="2034.5", version='"1.0.1"')
    stars, others = (check_database(one).table("stars") for one in (folder, same))
    np.testing.assert_array_equal(directions_of(stars), directions_of(others))
    assert rebuild(folder, {"sao": [tmp_path / "sao.dat"]}).is_identical


@pytest.mark.parametrize(
    ("epoch", "words"),
    [
        ("[2042.0, 2027.0]", "ends in 2027 and begins in 2042"),
        ("[2027.0, 2027.0]", "ends in 2027 and begins in 2027"),
        ("[2027.0]", "a list of 1"),
        ("[2027.0, 2030.0, 2042.0]", "a list of 3"),
        ("[2027.0, 27.0]", "found 27.0; give a Julian year from 1800 to 2200"),
        ('"2027"', "found '2027'; give a Julian year from 1800 to 2200"),
        ("true", "give a Julian year"),
        ("[nan, 2042.0]", "found nan"),
    ],
)
def test_an_invalid_span_is_reported(tmp_path, small_spec, epoch, words):
    path = tmp_path / "small.toml"
    path.write_text(small_spec)
    with pytest.raises(ConfigError, match="epoch_jyear") as raised:
        read_spec(path, {"epoch_jyear": epoch})
    assert words in str(raised.value)
    with pytest.raises(ConfigError, match="give a span"):
        read_spec(path, {"selection.max_drift_arcsec": "1.0"})


@pytest.mark.parametrize(
    ("from_jyear", "off_arcsec"), [(1991.25, (0.82, 1.20, 1.66)), (2016.0, (0.08, 0.22, 0.43))]
)
def test_a_radial_velocity_is_used_where_one_is_known(from_jyear, off_arcsec):
    """Barnard's star comes closer by 110.5 km/s; docs/algorithms.md has the figures."""
    star = FAST["Barnard's star"]
    stated = {
        "ra_deg": star["ra_deg"], "dec_deg": star["de_deg"], "epoch_jyear": from_jyear,
        "pm_ra_cosdec_mas_yr": star["pm_ra"], "pm_dec_mas_yr": star["pm_de"],
        "parallax_mas": star["plx"],
    }  # fmt: skip
    columns = {name: np.full(2, float(value)) for name, value in stated.items()}
    columns["radial_velocity_km_s"] = np.array([np.nan, -110.5])
    ra, dec = np.radians(columns["ra_deg"][0]), np.radians(columns["dec_deg"][0])
    pm = star["pm_ra"] * MAS / np.cos(dec), star["pm_de"] * MAS
    years = (SPAN[0], sum(SPAN) / 2, SPAN[1])
    for year, off in zip(years, off_arcsec, strict=True):
        moved = move_to_epoch(columns, year)
        without, known = (
            np.array([moved[axis][row] for axis in "xyz"])  # type: ignore[index]
            for row in (0, 1)
        )
        times = (*erfa.epj2jd(from_jyear), *erfa.epj2jd(year))
        sofa = erfa.pmsafe(ra, dec, *pm, star["plx"] / 1000.0, -110.5, *times)
        expected = directions_from_radec(np.degrees(sofa[0]), np.degrees(sofa[1]))
        assert separation(known, expected) < MICROARCSEC
        assert np.degrees(separation(known, without)) * 3600.0 == pytest.approx(off, abs=0.006)
    middle = table_from_columns("stars", move_to_epoch(columns, years[1]), 2)
    gained = np.diff(drifts(middle, 7.5))[0]
    assert gained == pytest.approx(0.5 * (off_arcsec[2] - off_arcsec[0]) + 0.036, abs=0.02)
