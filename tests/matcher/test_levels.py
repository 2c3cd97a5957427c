"""Frames of an unknown field of view: levels of stars and triangles, and searching all of them."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from itertools import combinations, pairwise

import numpy as np
import pytest
from skies import product_arrays

from starcat.database.products.levels import MIN_BORESIGHTS, find_levels, level_fields
from starcat.database.products.tiling import NominalField
from starcat.database.verify import check_database
from starcat.errors import ConfigError, ProductError
from starcat.frames.calibration.files import starting_camera
from starcat.frames.images.image_file import write_image
from starcat.frames.images.render import Optics, render_image
from starcat.geometry.attitude import random_attitudes
from starcat.geometry.camera import Camera
from starcat.geometry.sphere import saff_kuijlaars, tangent_axes
from starcat.matcher.blind import BEYOND, fields_served, levels, parts_of_range
from starcat.matcher.centroids import write_centroids
from starcat.matcher.database import ProductArrays
from starcat.matcher.matcher import Matcher
from starcat.pipeline.simulation.simulate import Noise, simulate_frames

CAMERA = Camera(1024, 768, fov_x_deg=10.0)
RANGE_DEG = (10.0, 40.0)


def with_levels(sky, stars_per_field=20):
    """Return a database with levels up to 40 deg."""
    fields = level_fields(sky.camera, RANGE_DEG[1], 1.5)
    made = find_levels(
        sky.directions, sky.mag, sky.camera, fields,
        boresights=2000, stars_per_field=stars_per_field, brightest=8,
    )  # fmt: skip
    return replace(sky, products={**sky.products, "levels": product_arrays(made)})


@pytest.fixture(scope="module")
def sky(sky_of, random_directions):
    return with_levels(sky_of(random_directions(7000, 3), CAMERA, boresights=2000))


@pytest.fixture(scope="module")
def matcher(sky):
    return Matcher(sky, engine="numpy")


def frame_of(sky, fov_deg, seed, faintest=60):
    """Return the brightest stars that a camera sees: centroids, magnitudes, rows and attitude."""
    camera = Camera(CAMERA.width_px, CAMERA.height_px, fov_x_deg=fov_deg)
    generator = np.random.default_rng(seed)
    matrix = random_attitudes(1, generator)[0]
    rows = np.flatnonzero(sky.directions @ matrix[2] > math.cos(camera.radius_rad))
    px = camera.pixels_from_directions(sky.directions[rows] @ matrix.T)
    inside = camera.contains(px)
    rows, px = rows[inside], px[inside]
    first = np.argsort(sky.mag[rows], kind="stable")[:faintest]
    px = px[first] + generator.normal(scale=0.3, size=(len(first), 2))
    return px, sky.mag[rows[first]] + generator.normal(scale=0.1, size=len(first)), rows[first]


def test_levels_go_up_to_the_widest_field_by_one_ratio():
    fields = [CAMERA, *level_fields(CAMERA, 40.0, 1.5)]
    half = [math.tan(math.radians(0.5 * field.fov_x_deg)) for field in fields]
    ratios = [wide / narrow for narrow, wide in pairwise(half)]
    assert len(fields) == 4
    np.testing.assert_allclose(ratios, ratios[0])
    assert 1.3 < ratios[0] <= 1.5
    assert half[-1] * ratios[0] == pytest.approx(math.tan(math.radians(20.0)))
    shape = [math.tan(math.radians(0.5 * field.fov_y_deg)) for field in fields]
    np.testing.assert_allclose(np.divide(shape, half), 0.75)


def test_levels_by_brute_force(random_directions):
    u = random_directions(700, 5)
    mag = np.random.default_rng(6).uniform(1.0, 6.0, len(u))
    narrow, fields = NominalField(20.0, 15.0), [NominalField(30.0, 22.0), NominalField(45.0, 33.0)]
    made = find_levels(u, mag, narrow, fields, boresights=10, stars_per_field=9, brightest=5)
    known = np.arange(len(u))
    for n, field in enumerate(fields):
        stars, triangles = set(), set()
        for boresight in saff_kuijlaars(MIN_BORESIGHTS):
            ra, dec = math.atan2(boresight[1], boresight[0]), math.asin(boresight[2])
            east, north = tangent_axes(np.degrees([ra]), np.degrees([dec]))
            along = u[known] @ boresight
            x, y = u[known] @ east[0] / along, u[known] @ north[0] / along
            half = [math.tan(math.radians(0.5 * a)) for a in (field.fov_x_deg, field.fov_y_deg)]
            inside = known[(along > 0) & (np.abs(x) <= half[0]) & (np.abs(y) <= half[1])]
            ordered = inside[np.argsort(mag[inside])].tolist()
            stars |= set(ordered[:9])
            triangles |= {tuple(sorted(three)) for three in combinations(ordered[:5], 3)}
        part = slice(*made.stars.offsets[n : n + 2])
        assert made.stars.values[part].tolist() == sorted(stars)
        part = slice(*made.i.offsets[n : n + 2])
        found = zip(*(getattr(made, name).values[part].tolist() for name in "ijk"), strict=True)
        assert list(found) == sorted(triangles)
        known = np.array(sorted(stars))
    assert len(known) < 0.6 * len(u)


def test_a_level_is_a_database_of_its_own_stars(sky):
    own, *wider = levels(sky)
    assert own.database is sky
    before = set(range(len(sky.mag)))
    for level in wider:
        part = level.database
        assert set(level.rows.tolist()) < before
        np.testing.assert_array_equal(part.star_id, sky.star_id[level.rows])
        np.testing.assert_array_equal(part.directions, sky.directions[level.rows])
        assert part.products["triangles"]["i"].max() < len(part.mag)
        before = set(level.rows.tolist())


def test_the_columns_of_a_level_are_those_of_the_product_triangles(sky, sky_of):
    """The triangles of the camera's own field, passed as a level, give the same answers."""
    product = sky.products["triangles"]
    whole = np.array([0, len(product["i"])])
    arrays = {
        "level": np.array([1]), "fov_x_deg": np.array([10.0]), "fov_y_deg": np.array([7.5]),
        "stars_offsets": np.array([0, len(sky.mag)]), "stars_values": np.arange(len(sky.mag)),
    }  # fmt: skip
    for name in "ijk":
        arrays |= {f"{name}_offsets": whole, f"{name}_values": product[name]}
    both = replace(sky, products={**sky.products, "levels": ProductArrays(arrays)})
    made = levels(both)[1].database.products["triangles"]
    for name in ("area_rad2", "circumradius_rad"):
        np.testing.assert_allclose(made[name], product[name], rtol=1e-5)


@pytest.mark.parametrize("fov_deg", [10.1, 12.0, 15.5, 19.0, 24.0, 30.0, 39.9])
def test_frames_of_all_fields_of_a_range_are_identified(sky, matcher, fov_deg):
    true_px = Camera(1024, 768, fov_x_deg=fov_deg).focal_length_px
    for seed in range(3):
        px, mag, rows = frame_of(sky, fov_deg, seed)
        result = matcher.identify(px, mag=mag, fov_deg=RANGE_DEG)
        assert result.ok, (fov_deg, seed, result.refusal)
        has_star = result.star_index >= 0
        assert has_star.sum() >= 8
        np.testing.assert_array_equal(result.star_index[has_star], rows[has_star])
        np.testing.assert_array_equal(result.star_ids[has_star], sky.star_id[rows[has_star]])
        error_px = abs(result.camera.focal_length_px - true_px)
        assert error_px < min(5.0 * result.focal_length_error_px, 0.005 * true_px)
        assert len(result.stars.spot) == has_star.sum()


def test_nothing_is_taken_for_a_frame_of_the_range(sky, matcher):
    generator = np.random.default_rng(11)
    frames = [frame_of(sky, fov_deg, seed)[:2] for fov_deg in (8.5, 70.0) for seed in range(2)]
    for count in (6, 30, 90):
        frames.append((generator.uniform(0, 768, (count, 2)), generator.uniform(1, 6, count)))
    mirrored = frame_of(sky, 20.0, 1)
    frames.append((np.array([1024.0, 0.0]) + mirrored[0] * [-1.0, 1.0], mirrored[1]))
    for px, mag in frames:
        result = matcher.identify(px, mag=mag, fov_deg=RANGE_DEG)
        assert result.status == "no_match"
        assert result.refusal.reason in ("chance", "share_of_frame", "scale", "no_candidate")
    few = matcher.identify(px[:3], mag=mag[:3], fov_deg=RANGE_DEG)
    assert few.status == "too_few_stars"
    # A frame outside of a narrower range gets no answer.
    px, mag, _ = frame_of(sky, 20.0, 2)
    for fov_deg, is_found in (((15.0, 25.0), True), ((11.0, 18.0), False), ((22.5, 38.0), False)):
        assert matcher.identify(px, mag=mag, fov_deg=fov_deg).ok == is_found
    # The same steps give the same end.
    px, mag = generator.uniform(0, 768, (40, 2)), np.linspace(1.0, 5.0, 40)
    few_steps = matcher.with_settings(max_steps=2000)
    first, second = (few_steps.identify(px, mag=mag, fov_deg=RANGE_DEG) for _ in range(2))
    assert first.refusal == second.refusal
    assert first.refusal.reason == "steps"


def test_an_answer_counts_the_chance_of_all_levels(sky, matcher):
    px, mag, _ = frame_of(sky, 20.0, 2, faintest=9)
    found = matcher.identify(px, mag=mag, fov_deg=RANGE_DEG)
    chance = found.false_match_probability
    assert found.ok
    focal_px = found.camera.focal_length_px
    parts = parts_of_range(levels(sky), CAMERA, RANGE_DEG)
    [part] = [part for part in parts if part.low_px < focal_px < part.high_px]
    ends = 2.0 * np.degrees(np.arctan(512.0 / np.array([part.high_px, part.low_px])))
    alone = matcher.identify(px, mag=mag, fov_deg=tuple(ends.tolist()))
    assert chance == pytest.approx(4.0 * alone.false_match_probability, rel=1e-6)
    # Just below this bound the frame is answered with a shape, whose own bound is lower.
    strict = matcher.with_settings(max_false_match_probability=0.9 * chance)
    other = strict.identify(px, mag=mag, fov_deg=RANGE_DEG)
    assert other.ok
    assert other.false_match_probability <= 0.9 * chance
    strict = matcher.with_settings(max_false_match_probability=1e-6 * chance)
    assert strict.identify(px, mag=mag, fov_deg=RANGE_DEG).refusal.reason == "chance"


def test_parts_cover_the_range_once(sky):
    parts = parts_of_range(levels(sky), CAMERA, (9.0, 41.0))
    ends = [(part.low_px, part.high_px) for part in parts]
    focal = [Camera(1024, 768, fov_x_deg=fov).focal_length_px for fov in (41.0, 9.0)]
    assert ends[0][0] == pytest.approx(focal[0])
    assert ends[-1][1] == pytest.approx(focal[1])
    assert [high for _, high in ends[:-1]] == [low for low, _ in ends[1:]]
    for part in parts:
        middle = part.focal_length_px
        assert middle * (1.0 - part.fov_error) == pytest.approx(part.low_px)
        assert middle / (1.0 - part.fov_error) == pytest.approx(part.high_px)
    # A portrait of the same detector has the same levels.
    upright = parts_of_range(levels(sky), Camera(768, 1024, fov_x_deg=10.0), (8.0, 30.0))
    assert {part.level.half_width for part in upright} == {p.level.half_width for p in parts}


def test_the_part_of_a_range_that_is_served_depends_on_the_shape_of_a_frame(sky):
    square, wide = Camera(600, 600, fov_x_deg=20.0), Camera(1024, 576, fov_x_deg=20.0)
    assert fields_served(sky, square, (5.0, 30.0)) == (pytest.approx(6.94, abs=0.01), 30.0)
    narrowest_deg, _ = fields_served(sky, wide, (5.0, 30.0))
    assert narrowest_deg == pytest.approx(6.94 / 0.75, abs=0.05)  # the root of 9:16 is 0.75
    for camera in (square, wide, Camera(576, 1024, fov_x_deg=20.0)):
        assert parts_of_range(levels(sky), camera, fields_served(sky, camera, (2.0, 89.0)))
    with pytest.raises(ConfigError, match="fov_deg is 2 to 5; sky-"):
        fields_served(sky, wide, (2.0, 5.0))


def test_ranges_that_cannot_be_searched_are_refused(sky, sky_of):
    frame = np.ones((5, 2))
    for fov_deg, words in (
        ((20.0, 10.0), "the narrower one first"),
        ((12.0, 12.0), "the narrower one first"),
        ((0.0, 12.0), "between 0 and 180"),
        ((math.nan, 12.0), "between 0 and 180"),
        (
            (10.0 / (1.05 * BEYOND), 12.0),
            "sky-1.0.0 is for fields of 10 to 40 deg across the width if a frame has",
        ),
        ((12.0, 60.0), "sky-1.0.0 is for fields of 10 to 40 deg across the width if a frame has"),
        ("5", "fov_deg is '5'; expected a finite number"),  # the field itself
    ):
        with pytest.raises(ConfigError, match=words):
            Matcher(sky).identify(frame, fov_deg=fov_deg)
    for fov_deg in ((20.0,), (5, 20, 40), (5, "20")):
        with pytest.raises(ConfigError, match=r"fov_deg is .*; expected a pair of numbers"):
            Matcher(sky).identify(frame, fov_deg=fov_deg)
    for fov_deg in (20.0, "5", (20.0,), (5, 20, 40), (5, "20")):
        with pytest.raises(ConfigError, match=r"fov_deg is .*; expected a pair of numbers"):
            starting_camera(CAMERA, fov_deg=fov_deg)
    with pytest.raises(ConfigError, match="only 'triangle' can find it"):
        Matcher(sky, method="pyramid").identify(frame, fov_deg=RANGE_DEG)
    plain = sky_of(sky.directions, CAMERA, boresights=10)
    with pytest.raises(ProductError, match=r"set 'products.levels.enabled = true'"):
        Matcher(plain).identify(frame, fov_deg=RANGE_DEG)


def test_levels_that_contradict_themselves_are_damaged(sky):
    arrays = sky.products["levels"].arrays
    stranger = np.setdiff1d(np.arange(len(sky.mag)), levels(sky)[1].rows)[0]
    # Row 1 is that of a star which is not of the level, or the end of the first list.
    damages = {"stars_values": stranger, "j_values": stranger}
    damages["k_offsets"] = arrays["k_offsets"][1] + 1
    changes = []
    for name, value in damages.items():
        changes.append({name: arrays[name].copy()})
        changes[-1][name][1] = value
    # No level at all.
    changes.append({name: row[: name.endswith("_offsets")] for name, row in arrays.items()})
    for change in changes:
        damaged = {**sky.products, "levels": ProductArrays({**arrays, **change})}
        with pytest.raises(ProductError, match="the database is damaged"):
            levels(replace(sky, products=damaged))


RANGE_SPEC = """\
name = "range"
version = "1.0.0"
epoch_jyear = 2026.0
catalog.source = "sao"
selection.faint_limit_mag = 6.4
camera = { width_px = 512, height_px = 512, fov_x_deg = 30.0 }
boresights.count = 600
self_test = { frames = 5, min_identified = 0.5 }
products.levels = { enabled = true, widest_fov_x_deg = 70.0 }
"""


@pytest.mark.slow
def test_an_database_of_a_range_is_asked_from_the_command_line(
    starcat, sao_file, small_database, tmp_path
):
    (tmp_path / "range.toml").write_text(RANGE_SPEC)
    run = starcat(["build", tmp_path / "range.toml", "--input", f"sao={sao_file}", "-o", tmp_path])
    assert run.code == 0, run.err
    built = tmp_path / "range-1.0.0"
    check_database(built)
    manifest = json.loads((built / "manifest.json").read_bytes())
    assert manifest["products"]["levels"]["rows"] == 2
    database = Matcher.open(built).database
    camera = Camera(640, 480, fov_x_deg=55.0)
    frame = next(simulate_frames(database.directions, camera, 1, Noise(0.2), 3, mag=database.mag))
    write_centroids(frame.centroids_px, tmp_path / "frame.csv", frame.mag)
    ask = ["identify", built, tmp_path / "frame.csv", "--json", "--fov", "32:70"]
    run = starcat([*ask, "--size", "640x480"])
    [answer] = json.loads(run.out)
    assert answer["status"] == "identified"
    assert answer["focal_length_px"] == pytest.approx(camera.focal_length_px, rel=2e-3)
    optics = Optics(zero_point_e=3e6)
    drawn = render_image(frame.centroids_px, frame.mag, (640, 480), optics, 1)
    write_image(tmp_path / "frame.png", drawn)
    ask_picture = ["identify", built, tmp_path / "frame.png", "--fov", "32:70"]
    [answer] = json.loads(starcat([*ask_picture, "--json"]).out)
    assert answer["status"] == "identified"
    run = starcat([*ask, "--size", "640"])
    assert (run.code, "expected WIDTHxHEIGHT" in run.err) == (2, True)
    run = starcat([*ask_picture, "--size", "8x8"])
    assert (run.code, "the image has 640 x 480 px" in run.err) == (2, True)
    # A database without levels does not mention them, as before there was such a product.
    plain = json.loads((small_database / "manifest.json").read_bytes())
    assert "levels" not in plain["spec"]["products"]
    assert "levels" in manifest["spec"]["products"]


@pytest.mark.slow
def test_init_writes_a_spec_for_a_range(starcat, tmp_path):
    file = tmp_path / "range.toml"
    run = starcat(["init", file, "--size", "1024x768", "--fov-range", "15:30", "--json"])
    assert run.code == 0, run.err
    spec = json.loads(run.out)["checked"]["spec"]
    assert spec["camera"]["fov_x_deg"] == 15.0
    assert spec["products"]["levels"]["enabled"]
    assert spec["products"]["levels"]["widest_fov_x_deg"] == 30.0
    enabled = {name for name, product in spec["products"].items() if product["enabled"]}
    assert enabled == {"triangles", "levels"}
    both = ["--fov-range", "15:30", "--fov-x-deg", "15"]
    run = starcat(["init", tmp_path / "b.toml", "--size", "1024x768", *both])
    assert run.code == 2
    assert "--fov-range and --fov-x-deg are both given; leave out one of them" in run.err
