"""The region of the sky that guide stars are in: [selection.region]."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import astropy.units as u
import numpy as np
import pyarrow as pa
import pytest
from drafts import spec_with
from mocpy import MOC

from starcat.catalog.ingest import ingest_catalog
from starcat.errors import ConfigError
from starcat.selection.selecting import Selected, select_guide_stars
from starcat.specs.reading import read_spec

CELLS = "0/1 1/20-22"


@pytest.fixture(scope="module")
def stars(sao_lines: list[bytes], tmp_path_factory: pytest.TempPathFactory) -> pa.Table:
    path: Path = tmp_path_factory.mktemp("sao") / "sao.dat"
    path.write_bytes(b"".join(sao_lines))
    return ingest_catalog("sao", [path]).stars


def selected(text: str, stars: pa.Table, faint_limit_mag: float = 20.0, **region: Any) -> Selected:
    spec = spec_with(text, selection={"faint_limit_mag": faint_limit_mag, "region": region})
    return select_guide_stars(stars, spec.selection)


def test_a_zone_keeps_its_ends_and_what_is_between(stars, small_spec):
    found = selected(small_spec, stars, zone=[-30.0, 10.0])
    dec = stars["dec_deg"].to_numpy()
    assert len(found.guide_stars) == ((dec >= -30.0) & (dec <= 10.0)).sum() > 0
    assert set(found.rejected["reason"].to_pylist()) == {"outside_region"}


def test_a_cone_keeps_what_is_within_its_radius(stars, small_spec):
    found = selected(small_spec, stars, cone=[266.4, -29.0, 40.0])
    u_stars = np.stack([stars[axis].to_numpy() for axis in "xyz"], axis=1)
    ra, dec = np.radians([266.4, -29.0])
    centre = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    assert len(found.guide_stars) == (u_stars @ centre >= np.cos(np.radians(40.0))).sum() > 0


def test_a_moc_keeps_what_is_in_its_cells_and_all_regions_hold(stars, small_spec):
    moc = MOC.from_string(CELLS, "ascii")
    found = selected(small_spec, stars, moc=CELLS, zone=[0.0, 90.0])
    ra, dec = (stars[name].to_numpy() for name in ("ra_deg", "dec_deg"))
    inside = moc.contains_lonlat(ra * u.deg, dec * u.deg) & (dec >= 0.0)
    assert len(found.guide_stars) == inside.sum() > 0


def test_a_star_beyond_the_limits_is_rejected_for_them_wherever_it_is(stars, small_spec):
    found = selected(small_spec, stars, 6.0, zone=[0.0, 90.0])
    faint = found.rejected.filter(pa.compute.greater(found.rejected["mag"], 6.0))
    assert set(faint["reason"].to_pylist()) == {"too_faint"}
    left = [len(step.directions) for step in found.steps]
    assert left == sorted(left, reverse=True)
    assert [step.name for step in found.steps][:2] == ["magnitude", "region"]


@pytest.mark.parametrize("suffix", ["fits", "json", "txt"])
def test_a_file_of_a_moc_becomes_its_cells(small_spec, tmp_path, suffix):
    moc = MOC.from_string(CELLS, "ascii")
    form = {"txt": "ascii"}.get(suffix, suffix)
    moc.save(str(tmp_path / f"survey.{suffix}"), form)
    (tmp_path / "spec.toml").write_text(
        small_spec + f'\n[selection.region]\nmoc_file = "survey.{suffix}"\n'
    )
    region = read_spec(tmp_path / "spec.toml").selection.region
    assert MOC.from_string(region.moc, "ascii") == moc
    assert region.moc_file is None


@pytest.mark.parametrize(
    ("region", "words"),
    [
        ({"zone": [10.0, -10.0]}, "the smaller first"),
        ({"cone": [0.0, 95.0, 1.0]}, "a declination from -90 to 90"),
        ({"moc": "eight"}, "is not a MOC in ASCII"),
        ({"moc": "30/1"}, "'30/1' has no order from 0 to 29"),
        ({"moc": "7"}, "'7' has no order from 0 to 29"),
        ({"moc": "3/4-1"}, "order 3 has the cells 0 to 767, the lower one first"),
        ({"moc": "3/768"}, "order 3 has the cells 0 to 767"),
        ({"moc": "3/"}, "has no cells"),
        ({"moc_file": "/etc/passwd"}, "no file is read here; state moc"),
    ],
)
def test_a_region_that_is_nowhere_is_refused(small_spec, stars, region, words):
    with pytest.raises(ConfigError, match=words):
        selected(small_spec, stars, **region)


def test_a_file_that_is_not_a_moc_is_reported(small_spec, tmp_path):
    (tmp_path / "survey.fits").write_bytes(b"no FITS")
    (tmp_path / "spec.toml").write_text(
        small_spec + '\n[selection.region]\nmoc_file = "survey.fits"\n'
    )
    with pytest.raises(ConfigError, match=r"survey\.fits: is not a MOC in fits"):
        read_spec(tmp_path / "spec.toml")
