"""Thinning by choice, and the attitude error that the stars of a field allow."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pyarrow as pa
import pytest
from drafts import chosen, spec_with
from scipy.spatial import SphericalVoronoi
from scipy.spatial.transform import Rotation

from starcat.catalog.stars.star_table import directions_of, floats_of
from starcat.catalog.stars.verdict import count_by_reason
from starcat.database.products.evenness import (
    ARCSEC,
    distribution_entropy,
    equal_area_cells,
    evenness_of,
    field_area,
    field_deviations,
    spread_of_errors,
)
from starcat.database.products.thinning import (
    POWER,
    PRIOR,
    cell_areas,
    thin_by_cells,
    thin_by_information,
)
from starcat.database.products.tiling import FieldStars, NominalField, reach_rad, tile_sphere
from starcat.database.reader import DatabaseFolder, open_database_folder
from starcat.errors import BuildError, ConfigError
from starcat.geometry.attitude import (
    attitude_deviations,
    information,
    information_of_groups,
    random_attitudes,
    solve_wahba_svd,
)
from starcat.geometry.camera import Camera
from starcat.geometry.sphere import saff_kuijlaars
from starcat.matcher.matcher import Matcher
from starcat.pipeline import guide_stars
from starcat.pipeline.build import Built, build
from starcat.pipeline.guide_stars import even_stars
from starcat.pipeline.recipes import field_size, tile_guide_stars
from starcat.pipeline.selection.ruleset import ALL_REASONS
from starcat.pipeline.simulation.selftest import answers_rightly
from starcat.pipeline.simulation.simulate import Noise, Sky, simulate_frame
from starcat.pipeline.specs.reading import preset, spec_from_dict

SIZE = NominalField(40.0, 30.0)
RULES = ["voronoi", "information"]


# The attitude error of a field --------------------------------------------------------------


def test_the_deviations_are_those_of_attitudes_fitted_to_noisy_directions():
    generator = np.random.default_rng(241)
    camera = Camera(1024, 1024, fov_x_deg=12.0)
    body = camera.directions_from_pixels(generator.random((7, 2)) * 1024.0)
    sigma = 1e-5 * np.array([1.0, 1.0, 2.0, 3.0, 1.0, 2.0, 1.0])
    trials = 6000
    off = generator.normal(size=(trials, *body.shape)) * sigma[:, None]
    fitted = solve_wahba_svd(body + off, np.broadcast_to(body, off.shape), sigma**-2)
    turns = Rotation.from_matrix(fitted).as_rotvec()
    group = np.zeros(len(body), dtype=np.int64)
    (told,) = attitude_deviations(information_of_groups(body, group, 1, sigma**-2))
    # A deviation of 6,000 attitudes is right to 0.9 %.
    assert turns.std(axis=0) == pytest.approx(told, rel=0.04)
    assert told[2] > 5.0 * told[0]  # about the boresight of a narrow field
    alone = information(body, weights=sigma**-2)
    assert information_of_groups(body, group, 1, sigma**-2)[0] == pytest.approx(alone, rel=1e-9)


def test_the_errors_of_fields_are_those_of_one_after_the_other(random_directions):
    directions = random_directions(40, 1)
    fields = tile_sphere(60, directions, np.zeros(40), SIZE)
    found = field_deviations(fields, directions)
    known = 0
    for number in range(60):
        stars = fields.star_index[fields.offsets[number] : fields.offsets[number + 1]]
        if len(stars) < 2:
            assert np.isinf(found[number]).all()
            continue
        covariance = np.linalg.inv(information(directions[stars]))
        along = fields.boresights[number]
        about = np.sqrt(along @ covariance @ along)
        across = np.sqrt(np.trace(covariance) - about**2)
        assert np.hypot(*found[number, :2]) == pytest.approx(across, rel=1e-9)
        assert found[number, 2] == pytest.approx(about, rel=1e-9)
        known += 1
    assert 10 < known < 60
    evenness = evenness_of(fields, directions, SIZE, "rectangular", 2000.0)
    assert evenness.about == pytest.approx(found[:, 2] * ARCSEC / 2000.0)
    assert np.isinf(evenness.spreads["across"].worst)


def test_the_spread_is_of_values_that_occur():
    errors = np.append(np.arange(1.0, 200.0), np.inf)
    spread = spread_of_errors(errors)
    assert (spread.median, spread.one_percent, spread.worst) == (100.0, 198.0, np.inf)


# Entropy ------------------------------------------------------------------------------------


@pytest.mark.parametrize("cells", [7, 48, 285])
def test_cells_have_the_same_area(cells, random_directions):
    cell, count = equal_area_cells(random_directions(100_000, cells), cells)
    held = np.bincount(cell, minlength=count)
    assert len(held) == count == pytest.approx(cells, rel=0.15)
    mean = 100_000 / count
    assert np.abs(held - mean).max() < 5.0 * np.sqrt(mean)


def test_entropy_tells_even_from_uneven(random_directions):
    even, _ = distribution_entropy(saff_kuijlaars(3000), 285)
    random, _ = distribution_entropy(random_directions(3000, 2), 285)
    half = random_directions(3000, 2)
    half[:, 2] = np.abs(half[:, 2])
    one, count = distribution_entropy(half, 285)
    assert even > 0.998 > random > 0.98
    assert one == pytest.approx(random - np.log(2.0) / np.log(count), abs=0.03)
    assert distribution_entropy(half[:1], 285)[0] == 0.0


def test_the_area_of_a_field():
    assert field_area(NominalField(90.0, 90.0), "rectangular") == pytest.approx(4.0 * np.pi / 6.0)
    assert field_area(NominalField(120.0, 180.0), "circular") == pytest.approx(np.pi)


# Cells --------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [6, 50, 1000])
def test_the_areas_of_cells_are_those_of_scipy(count, random_directions):
    directions = random_directions(count, 3)
    areas, _ = cell_areas(directions)
    assert areas == pytest.approx(SphericalVoronoi(directions).calculate_areas(), abs=1e-12)


def test_stars_at_one_place_share_a_cell_and_stars_of_a_circle_have_none():
    directions = np.concatenate([np.eye(3), -np.eye(3), np.eye(3)[:1]])
    areas, _ = cell_areas(directions)
    assert areas.sum() == pytest.approx(4.0 * np.pi)
    assert sorted(areas[[0, 6]]) == pytest.approx([0.0, 4.0 * np.pi / 6.0])
    angle = np.linspace(0.0, 6.0, 8)
    circle = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(8)])
    assert cell_areas(circle)[0] == pytest.approx(np.full(8, 0.5 * np.pi))
    assert thin_by_cells(circle, np.zeros(8), 5).tolist() == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("seed", [4, 5])
def test_the_smallest_cell_for_its_brightness_goes_first(seed, random_directions):
    directions, mag = random_directions(10, seed), np.random.default_rng(seed).random(10)
    left = list(range(10))
    while len(left) > 5:
        areas = SphericalVoronoi(directions[left]).calculate_areas()
        left.pop(int(np.argmin(areas * 10.0 ** (-0.4 * mag[left]))))
    assert thin_by_cells(directions, mag, 5).tolist() == left


def test_no_two_neighbours_go_at_once(random_directions):
    directions = random_directions(400, 6)
    kept = thin_by_cells(directions, np.zeros(400), 390)
    gone = np.setdiff1d(np.arange(400), kept)
    _, corners = cell_areas(directions)
    assert len(gone) == 10
    assert not [one for one in corners if len(np.intersect1d(one, gone)) > 1]


# Information --------------------------------------------------------------------------------


def whole_cost(fields: FieldStars, directions: np.ndarray, kept: list[int], reach: float) -> float:
    """Return what the thinning makes small, from the matrices themselves."""
    total = 0.0
    unit = np.diag([1.0, 1.0, 1.0 / np.sin(reach)])
    seen = fields.seen(directions)
    for number in range(len(fields.boresights)):
        own = slice(fields.offsets[number], fields.offsets[number + 1])
        is_kept = np.isin(fields.star_index[own], kept)
        matrix = unit @ information(seen[own][is_kept]) @ unit + PRIOR * np.eye(3)
        covariance = np.linalg.inv(matrix)
        total += (0.5 * (covariance[0, 0] + covariance[1, 1])) ** POWER
    return total


def thinned_by_information(count: int, directions: np.ndarray, mag: np.ndarray):
    fields = tile_sphere(20, directions, mag, SIZE)
    reach = reach_rad(SIZE, "rectangular")
    return fields, reach, thin_by_information(fields, directions, mag, reach, count).tolist()


@pytest.mark.parametrize("seed", [7, 8])
def test_the_star_goes_whose_loss_harms_least(seed, random_directions):
    directions = random_directions(30, seed)
    mag = np.sort(2.0 * np.random.default_rng(seed).random(30))
    fields, reach, kept = thinned_by_information(20, directions, mag)
    left = list(range(30))
    while len(left) > 20:
        now = whole_cost(fields, directions, left, reach)
        harm = [
            (whole_cost(fields, directions, [s for s in left if s != star], reach) - now)
            * 10.0 ** (-0.4 * mag[star])
            for star in left
        ]
        # Of several equally useless stars, such as stars in no field, the last one goes.
        left.remove(-min(zip(harm, [-star for star in left], strict=True))[1])
    assert kept == left


def test_few_stars_are_nearly_the_best_choice_of_all(random_directions):
    directions, mag = random_directions(12, 10), np.zeros(12)
    fields, reach, kept = thinned_by_information(8, directions, mag)
    costs = sorted(
        whole_cost(fields, directions, list(chosen), reach) for chosen in combinations(range(12), 8)
    )
    found = whole_cost(fields, directions, kept, reach)
    assert found <= costs[len(costs) // 100]


# The build ----------------------------------------------------------------------------------


def star_table(seed: int, order: np.ndarray, random_directions) -> pa.Table:
    directions = random_directions(len(order), seed)
    # Many have the same magnitude.
    mag = np.round(np.random.default_rng(seed).random(len(order)) * 6.0)
    x, y, z = directions[order].T
    columns = {"star_id": order + 1000, "x": x, "y": y, "z": z, "mag": mag[order]}
    return pa.table(columns)


@pytest.mark.parametrize("rule", RULES)
def test_the_order_of_the_rows_does_not_matter(rule, random_directions, small_spec):
    spec = spec_with(small_spec, selection={"max_stars": 90, "thinning": rule})
    order = np.arange(300)
    kept = [
        set(table["star_id"].to_numpy()[even_stars(table, spec)])
        for one in (order, order[::-1], np.random.default_rng(11).permutation(300))
        for table in [star_table(12, one, random_directions)]
    ]
    assert len(kept[0]) == 90
    assert kept[0] == kept[1] == kept[2]


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize(
    ("limits", "reason"),
    [
        ({"max_stars": 200}, "beyond_count"),
        ({"max_stars_per_field": 8}, "density"),
        ({"max_stars": 300, "max_stars_per_field": 8}, "density"),
    ],
    ids=["count", "density", "both"],
)
def test_every_rule_keeps_as_many(rule, limits, reason, small_database, small_spec):
    stars = open_database_folder(small_database).table("stars")
    brightest, other = (
        chosen(stars, spec_with(small_spec, selection={**limits, "thinning": name})).selected
        for name in ("brightest", rule)
    )
    assert len(other.guide_stars) == len(brightest.guide_stars) < len(stars)
    assert other.guide_stars["star_id"] != brightest.guide_stars["star_id"]
    assert count_by_reason(other.rejected, reasons=ALL_REASONS) == {
        reason: len(stars) - len(other.guide_stars)
    }
    assert np.all(np.diff(other.guide_stars["star_id"].to_numpy()) > 0)
    assert other.steps[-1].name == {"beyond_count": "count"}.get(reason, reason)


def test_a_thinning_without_a_limit_is_refused(small_spec):
    with pytest.raises(ConfigError, match="no key sets how many stars stay; give max_stars"):
        spec_with(small_spec, selection={"thinning": "voronoi"})


def test_only_another_rule_is_recorded(small_spec):
    plain, other = (
        spec_with(small_spec, selection={"max_stars": 100, "thinning": rule}).recorded()
        for rule in ("brightest", "information")
    )
    assert "thinning" not in plain["selection"]
    assert other["selection"]["thinning"] == "information"


def test_a_tiling_too_dense_to_thin_is_refused(small_database, small_spec, monkeypatch):
    spec = spec_with(small_spec, selection={"max_stars": 100, "thinning": "information"})
    monkeypatch.setattr(guide_stars.check_tiling, "__defaults__", (1000, "estimate"))
    with pytest.raises(BuildError, match="small: too dense to thin by information: the 200 fields"):
        chosen(open_database_folder(small_database).table("stars"), spec)


# Acceptance ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def thinned(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Built]:
    """gaia-12deg thinned to 3,000 stars by each rule."""
    content = preset("gaia-12deg").model_dump(mode="json")
    content["selection"]["max_stars"] = 3000
    content["self_test"] = {"frames": 500, "min_identified": 0.0}
    made = {}
    for rule in ("brightest", *RULES):
        content["selection"]["thinning"] = rule
        made[rule] = build(spec_from_dict(content, rule), tmp_path_factory.mktemp(rule))
    return made


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_information_lowers_the_error_of_the_worst_fields(thinned):
    """By 45 % for the worst of 99 of 100 fields; no field is left without an attitude."""
    errors = {rule: made.coverage.evenness.spreads for rule, made in thinned.items()}
    assert {len(made.coverage.evenness.across) for made in thinned.values()} == {10_000}
    assert {made.manifest["products"]["stars"]["rows"] for made in thinned.values()} == {3000}
    across = {rule: spread["across"] for rule, spread in errors.items()}
    assert across["information"].one_percent < 0.6 * across["brightest"].one_percent
    assert across["voronoi"].one_percent < 0.7 * across["brightest"].one_percent
    assert np.isinf(across["brightest"].worst)
    assert across["information"].worst < 25.0
    assert (
        errors["information"]["about"].one_percent < 0.6 * errors["brightest"]["about"].one_percent
    )
    entropy = {rule: made.coverage.evenness.entropy for rule, made in thinned.items()}
    assert entropy["information"] > entropy["voronoi"] > entropy["brightest"]
    for rule in RULES:
        for rate, other in zip(thinned["brightest"].rates, thinned[rule].rates, strict=True):
            assert other.identified >= rate.identified
            assert other.wrong == 0


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> DatabaseFolder:
    """All stars of gaia-12deg."""
    return open_database_folder(
        build(preset("gaia-12deg"), tmp_path_factory.mktemp("whole")).folder
    )


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_frames_of_the_whole_sky_are_identified_more_often(thinned, whole):
    """Frames with stars to G = 6, of which a database of 3,000 stars has not half: 437 of 500.

    If a sensor sees stars to G = 5, only the bright ones help: 387, 376 and 347 of 500.
    """
    rates = right_answers(thinned, whole, np.inf)
    assert rates["brightest"] < 450
    assert min(rates[rule] for rule in RULES) > 490
    rates = right_answers(thinned, whole, 5.0)
    assert rates["brightest"] > rates["information"] > rates["voronoi"] > 330


def right_answers(
    made: dict[str, Built], whole: DatabaseFolder, limit_mag: float, frames: int = 500
) -> dict[str, int]:
    """Count the frames of another database's stars that each database identifies."""
    stars, found = whole.table("stars"), {}
    for rule, built in made.items():
        matcher = Matcher.open(built.folder)
        row = {number: row for row, number in enumerate(matcher.database.star_id.tolist())}
        index = [row.get(number, -1) for number in stars["star_id"].to_pylist()]
        sky = Sky(directions_of(stars), floats_of(stars, "mag"), np.array(index, dtype=np.int32))
        generator = np.random.default_rng(13)
        noise = Noise(0.5, drop_probability=0.1, noise_mag=0.2, limit_mag=limit_mag)
        found[rule] = 0
        for matrix in random_attitudes(frames, generator):
            frame = simulate_frame(sky, matcher.database.camera, matrix, noise, generator)
            result = matcher.identify(frame.centroids_px, mag=frame.mag)
            found[rule] += result.ok and answers_rightly(result, frame, matcher)
    return found


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_light_keeps_the_stars_that_sensors_see(thinned, whole):
    """Without it the error is 8 % less, and half of the four brightest of each field are gone."""
    spec, stars = preset("gaia-12deg"), whole.table("stars")
    size, directions = field_size(spec), directions_of(stars)
    fields = tile_guide_stars(stars, spec)
    none = np.zeros(len(stars))
    dark = thin_by_information(fields, directions, none, reach_rad(size, "rectangular"), 3000)
    left = tile_sphere(10_000, directions[dark], none[dark], size)
    focal_length_px = spec.camera.camera().focal_length_px
    even = evenness_of(left, directions[dark], size, "rectangular", focal_length_px)
    with_light = thinned["information"].coverage.evenness.spreads["across"].one_percent
    assert 0.85 < even.spreads["across"].one_percent / with_light < 0.95
    _, four = fields.brightest(4)
    ids = stars["star_id"].to_numpy()
    shares = {"dark": float(np.isin(four, dark).mean())}
    for rule, built in thinned.items():
        own = open_database_folder(built.folder).table("stars")["star_id"].to_numpy()
        shares[rule] = float(np.isin(ids[four], own).mean())
    assert shares["dark"] < 0.6
    assert shares["information"] > shares["brightest"] > 0.99
