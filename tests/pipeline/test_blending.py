"""Close stars on the sensor: the same numbers as a build writes, and refused arguments."""

from __future__ import annotations

import json

import numpy as np
import pytest
from drafts import chosen

from starcat.catalog.stars.star_table import directions_of
from starcat.database.products.blends import blends, widths_px
from starcat.errors import ConfigError
from starcat.geometry.sphere import radec_from_directions, separation
from starcat.pipeline.blending import sensor_view_of_pair
from starcat.pipeline.estimate import read_draft
from starcat.pipeline.specs.reading import read_spec

RULE = """
[selection.neighbours]
psf_sigma_px = 1.5
action = "keep"
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory, small_spec, sao_lines):
    """A folder with an archive file, and a spec whose build keeps blended stars."""
    folder = tmp_path_factory.mktemp("blending")
    (folder / "sao.dat").write_bytes(b"".join(sao_lines))
    spec = small_spec.replace("fov_x_deg = 40.0", "fov_x_deg = 110.0")
    (folder / "spec.toml").write_text(spec + RULE)
    return folder


@pytest.fixture(scope="module")
def spec_file(folder):
    return folder / "spec.toml"


@pytest.fixture(scope="module")
def built(folder, spec_file):
    """The guide stars of that spec as its build chooses them."""
    spec = read_spec(spec_file)
    read = read_draft(spec, {"sao": [folder / "sao.dat"]})
    return chosen(read.stars, spec).selected.guide_stars


NUMBERS = ("mag", "blend_mag", "contamination", "centroid_offset_arcsec")


def test_a_star_of_the_catalog_has_the_numbers_of_the_build(spec_file, folder, built, starcat):
    rows = np.argsort(-built["contamination"].to_numpy())
    assert built["contamination"].to_numpy()[rows[4]] > 0.01
    for row in (*rows[:5].tolist(), int(rows[-1])):
        star = built.slice(row, 1).to_pylist()[0]
        position = ["blend", spec_file, star["ra_deg"], star["dec_deg"], "--json"]
        ran = starcat([*position, "--input", f"sao={folder}/sao.dat"])
        assert ran.code == 0, ran.err
        by_name = {one["star"]: one for one in json.loads(ran.out)["stars"]}
        seen = by_name[star["designation"]]
        assert [seen[name] for name in NUMBERS] == [star[name] for name in NUMBERS]


def test_two_stars_have_the_numbers_of_a_build_whose_star_has_one_neighbour(spec_file, built):
    spec, u, mag = read_spec(spec_file), directions_of(built), built["mag"].to_numpy()
    pixel_arcsec = spec.camera.camera().pixel_arcsec
    apart = np.degrees(separation(u[:, None], u)) * 3600.0 + 1e9 * np.eye(len(u))
    reach = widths_px(1.5).reach * pixel_arcsec
    lonely = [row for row in np.argsort(apart.min(axis=1)) if np.sum(apart[row] < reach) == 1]
    compared = 0
    for row in lonely[:6]:
        other = int(np.argmin(apart[row]))
        if mag[other] > 6.0:
            continue
        compared += 1
        view = sensor_view_of_pair(spec, float(apart[row, other]), [mag[row], mag[other]])
        star = built.slice(int(row), 1).to_pylist()[0]
        seen = view.stars[0]
        assert seen.blend_mag == pytest.approx(star["blend_mag"], abs=1e-6)
        assert seen.contamination == pytest.approx(star["contamination"], abs=1e-6)
        # The tangent plane is not quite the same from pair to pair.
        offset = pytest.approx(star["centroid_offset_arcsec"], rel=1e-3, abs=1e-3)
        assert seen.centroid_offset_arcsec == offset
        assert seen.is_beyond_limits == (
            star["contamination"] > 0.1 or star["centroid_offset_arcsec"] > 0.1 * pixel_arcsec
        )
    assert compared >= 3


@pytest.mark.parametrize(("separation_px", "is_resolved"), [(1.0, False), (8.0, True)])
def test_stars_are_resolved_where_detection_tells_them_apart(spec_file, separation_px, is_resolved):
    spec = read_spec(spec_file)
    pixel_arcsec = spec.camera.camera().pixel_arcsec
    with pytest.raises(ConfigError, match="two magnitudes"):
        sensor_view_of_pair(spec, 20.0, [4.0])
    view = sensor_view_of_pair(spec, separation_px * pixel_arcsec, [4.0, 5.0])
    assert [star.is_resolved for star in view.stars] == [True, is_resolved]
    light = np.array([10.0**-0.4])
    place = np.array([[separation_px, 0.0]])
    oracle = blends(1, np.array([0]), place, light, np.array([False]), widths_px(1.5))
    # A step of 8 wide pixels on the sphere is not quite one in the tangent plane.
    assert view.stars[0].centroid_offset_px == pytest.approx(oracle.offset[0, 0], rel=1e-2)
    assert view.stars[0].contamination == pytest.approx(oracle.contamination[0], rel=1e-2)


def test_the_table_fits_and_names_the_spec(spec_file, starcat):
    ran = starcat(["blend", spec_file, "--separation", "2000", "--mags", "4.0,5.5"])
    assert ran.code == 0, ran.err
    lines = ran.out.splitlines()
    assert max(map(len, lines)) <= 100
    assert lines[0].split() == ["spec", "small"]
    assert ["psf", "sigma", "1.500", "px"] in [line.split() for line in lines]
    assert [line.split()[0] for line in lines[-2:]] == ["A", "B"]


def test_what_is_missing_is_said(spec_file, small_spec, folder, built, starcat):
    without = spec_file.with_name("plain.toml")
    without.write_text(small_spec)
    star = built.slice(0, 1)
    (ra,), (dec,) = radec_from_directions(directions_of(star))
    for arguments, words in (
        (
            [without, "--separation", "20", "--mags", "4,5"],
            "selection.neighbours.psf_sigma_px = 1.0",
        ),
        ([spec_file, "--separation", "20"], "--separation ARCSEC and --mags A,B"),
        ([spec_file, "--separation", "20", "--mags", "4"], "--mags is '4'"),
        (
            [spec_file, "--separation", "-20", "--mags", "4,5"],
            "state them with --separation and --mags",
        ),
        ([spec_file, ra, dec, "--separation", "20"], "--separation ARCSEC and --mags A,B"),
        ([spec_file, 400, -2], "RA 400, Dec -2"),
        ([spec_file, 12], "RA and Dec"),
        ([spec_file, "--seperation", "20"], "no such option: --seperation"),
        ([spec_file, 0, 90, "--input", f"sao={folder}/sao.dat"], "no star with a magnitude within"),
    ):
        ran = starcat(["blend", *arguments])
        assert (ran.code, words in ran.err) != (0, True), ran.err
        assert words in ran.err
