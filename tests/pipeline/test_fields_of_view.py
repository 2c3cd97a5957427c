"""Any field of view by default: the specs of `init`, their cost, rates and judgement."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from drafts import chosen, spec_with
from scipy.spatial import cKDTree

from starcat.catalog.ingest import ingest_catalog
from starcat.catalog.source_files import locate
from starcat.database.products.coverage import TilingGap
from starcat.database.products.kind import ProductInputs
from starcat.database.products.tiling import tile_sphere
from starcat.database.products.triangles import find_triangles
from starcat.errors import BuildError
from starcat.geometry.attitude import random_attitudes
from starcat.geometry.camera import Camera
from starcat.geometry.sphere import chord_from_separation, zones_of
from starcat.pipeline.acceptance import advice_without_magnitudes, causes, check_rates
from starcat.pipeline.build import Built, build
from starcat.pipeline.cost import Cost, product_cost
from starcat.pipeline.draft import run
from starcat.pipeline.guide_stars import STARS_A_FIELD, check_cost
from starcat.pipeline.recipes import make_product, product_inputs
from starcat.pipeline.simulation.selftest import Rates
from starcat.pipeline.specs.build_spec import BuildSpec, CameraSpec
from starcat.pipeline.specs.reading import preset
from starcat.pipeline.starter import (
    ENOUGH_STARS,
    Starter,
    advice,
    boresight_count,
    enough_limit,
    starter_spec,
)

GIB = 2**30


@cache
def embedded_stars() -> pa.Table:
    """The stars that `init` and the presets take, read once for all tests."""
    return ingest_catalog("gaia", locate("gaia", {}), neighbours=False).stars


def started(fov_deg: float) -> Starter:
    camera = CameraSpec(width_px=1280, height_px=960, fov_x_deg=fov_deg)
    return starter_spec("camera", camera, sky=embedded_stars())


def built(spec: BuildSpec, folder: Path) -> tuple[Built, Cost]:
    told: list[Cost] = []
    made = build(spec, folder, announce=told.append)
    return made, told[0]


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize("fov_deg", [1.0, 2.0, 5.0, 8.0, 12.0, 20.0, 35.0, 50.0, 90.0])
def test_every_camera_identifies_its_frames(fov_deg, tmp_path):
    """Build what `init` chooses; 1 deg is as deep as the embedded sky is, and no deeper."""
    starter = started(fov_deg)
    spec = starter.spec
    if fov_deg == 1.0:  # the embedded sky is not deep enough
        test = spec.self_test.model_copy(update={"min_identified": 0.7})
        spec = spec.model_copy(update={"self_test": test})
    made, cost = built(spec, tmp_path)
    assert cost == starter.cost or cost.rows == starter.cost.rows
    assert sum(rate.wrong for rate in made.rates) == 0
    clean, hard, bare, bare_hard = (rate.identified_share for rate in made.rates)
    if fov_deg > 1.0:
        assert min(clean, bare) >= 0.99
        assert min(hard, bare_hard) >= 0.97
    else:
        assert made.rates[0].share_of_identifiable >= 0.85
        assert any("the embedded sky has no fainter stars" in text for text in advice(starter))
        # Missed fields have few stars; they are not holes of the tiling or of the triangles.
        assert np.median(made.rates[0].missed) < 6
    assert not any("holes" in text for text in made.warnings)
    for name, count in cost.rows.items():
        if name in ("pairs", "triangles"):
            assert made.manifest["products"][name]["rows"] == pytest.approx(count, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("fov_deg", [12.0, 90.0])
def test_init_thins_to_a_number_of_stars_a_field(fov_deg):
    starter = started(fov_deg)
    assert starter.spec.selection.max_stars_per_field == STARS_A_FIELD
    assert starter.thinned.guide_stars < starter.row_of_spec.guide_stars
    assert starter.thinned.stars.one_percent >= starter.row_of_spec.stars.one_percent - 1
    assert starter.left_out == ()


def test_the_faq_states_the_limits_that_init_finds():
    text = (Path(__file__).parents[2] / "docs" / "faq.md").read_text(encoding="utf-8")
    assert ENOUGH_STARS == 10
    assert "99 of 100 fields have ten stars" in text
    told = re.search(r"G = ([\d.]+) at 12 deg, ([\d.]+) at 50 deg and\s+([\d.]+) at 2", text)
    assert told is not None
    for fov_deg, limit in zip((12.0, 50.0, 2.0), told.groups(), strict=True):
        camera = CameraSpec(width_px=1280, height_px=960, fov_x_deg=fov_deg)
        shape = {"camera.fov_x_deg": str(fov_deg), "camera.height_px": "768"}
        shape |= {"boresights.count": str(boresight_count(camera))}
        spec = preset("gaia-12deg", shape)
        assert f"{enough_limit(embedded_stars(), spec):.1f}" == limit


# --- Cost


@cache
def sky_to(limit_mag: float) -> tuple[ProductInputs, BuildSpec]:
    """What products are made of, for the stars of the embedded sky to a limit."""
    limits = {"selection.faint_limit_mag": str(limit_mag), "boresights.count": "2000"}
    spec = preset("gaia-12deg", limits)
    draft = chosen(embedded_stars(), spec)
    return product_inputs(draft.selected.guide_stars, draft.fields, spec), spec


@pytest.mark.parametrize("name", ["pairs", "triangles", "neighbours", "hausdorff_angular"])
@pytest.mark.parametrize("limit_mag", [5.0, 6.0])
def test_rows_are_estimated(name, limit_mag):
    given, _ = sky_to(limit_mag)
    made = make_product(name, given)
    assert product_cost(given, 0.0).rows[name] == pytest.approx(len(made.table), rel=0.1)


@pytest.mark.slow
def test_the_memory_of_a_build_is_estimated(starcat, tmp_path):
    """In a separate process, so that the peak of memory belongs to one build."""
    import subprocess
    import sys

    arguments = ["build", "--preset", "gaia-12deg", "-o", str(tmp_path)]
    done = subprocess.run(
        [sys.executable, "-m", "starcat", *arguments], capture_output=True, text=True, check=True
    )
    estimate = next(line for line in done.stderr.splitlines() if line.startswith("estimate: "))
    assert "6,713 guide stars in 10,000 fields" in estimate
    said_gib = float(re.findall(r"([0-9.]+) GiB", estimate)[0])
    log = json.loads((tmp_path / "gaia-12deg-1.0.0.build.json").read_bytes())
    assert 1.0 / 1.5 < said_gib * GIB / log["peak_memory_bytes"] < 1.5


def test_what_does_not_fit_is_refused_before_anything_is_made(small_spec, sao_file, tmp_path):
    stages: list[str] = []
    spec = spec_with(small_spec, products={"triangles": {"enabled": False}})
    words = r"all products together take .* the rest is the program and the catalog\. Allow more"
    with pytest.raises(BuildError, match=words) as refused:
        build(
            spec, tmp_path / "dist", inputs={"sao": [sao_file]}, max_memory_bytes=GIB // 10,
            progress=lambda stage, *_: stages.append(stage),
        )  # fmt: skip
    assert refused.value.built is None
    assert not [stage for stage in stages if stage.startswith("product")]
    assert not (tmp_path / "dist").exists()


def refusal_of(spec: BuildSpec, stars: pa.Table, most_bytes: float) -> tuple[str, dict[str, str]]:
    """Return the refusal of a build for its memory, and the lines of a spec in it."""
    draft = chosen(stars, spec)
    draft.catalog_bytes, draft.rejected_rows = 0, 0
    draft.max_memory_bytes = int(most_bytes)
    with pytest.raises(BuildError) as refused:
        run(draft, (check_cost,))
    words = str(refused.value)
    return words, dict(re.findall(r"([\w.]+) = (\w+)", words.partition(". ")[0]))


def test_a_refusal_for_memory_has_the_lines_that_help():
    """A narrow field with the default products: the largest are left out, one by one."""
    spec = preset("gaia-12deg", {"selection.faint_limit_mag": "7.5", "boresights.count": "4000"})
    stars = embedded_stars()
    words, lines = refusal_of(spec, stars, 0.9e9)
    assert set(lines.values()) == {"false"}, words
    assert f". selection.max_stars_per_field = {STARS_A_FIELD} makes all" in words
    takes_gib = float(re.findall(r"with these lines of the spec it takes ([\d.]+) GiB", words)[0])
    assert takes_gib * GIB <= 0.95e9
    helped = preset("gaia-12deg", spec_changes(spec) | lines)
    draft = chosen(stars, helped)
    draft.catalog_bytes, draft.rejected_rows, draft.max_memory_bytes = 0, 0, int(0.9e9)
    run(draft, (check_cost,))
    assert draft.cost.memory_bytes == pytest.approx(takes_gib * GIB, abs=0.06 * GIB)
    words, lines = refusal_of(spec, stars, 0.33e9)
    assert lines["selection.max_stars_per_field"] == str(STARS_A_FIELD)
    assert "Use a brighter selection.faint_limit_mag" in words


def spec_changes(spec: BuildSpec) -> dict[str, str]:
    return {
        "selection.faint_limit_mag": str(spec.selection.faint_limit_mag),
        "boresights.count": str(spec.boresights.count),
    }


# --- Judgement


def rates(identified: int, tried: int, missed: int, **more: Any) -> Rates:
    found = Rates("clean", 0.5, 0.0, 0, 0.2, tried, tried, identified, 0, 1.0)
    return replace(found, missed=(missed,) * (tried - identified), **more)


def gap(covering_deg: float) -> TilingGap:
    return TilingGap(1000, np.radians(3.0), np.radians(covering_deg), 10.0, 20.0)


def test_another_seed_does_not_decide():
    spec = preset("gaia-12deg")
    check_rates([rates(86, 100, 20)], spec, gap(2.0))
    with pytest.raises(BuildError, match=r"that is at most 86\.7%"):
        check_rates([rates(80, 100, 20)], spec, gap(2.0))
    with pytest.raises(BuildError, match="wrong answer"):
        check_rates([replace(rates(99, 100, 20), wrong=1)], spec, gap(2.0))
    nobody = replace(rates(0, 20, 0), identifiable=0, missed=())
    with pytest.raises(BuildError, match="20 pointings show fewer than 4 stars"):
        check_rates([nobody], spec, gap(2.0))


@pytest.mark.parametrize(
    ("missed", "covering_deg", "keys"),
    [
        (5, 2.0, ["selection.faint_limit_mag"]),
        (50, 2.0, ["selection.max_stars_per_field = 12"]),
        (12, 4.0, ["boresights.count = 1867"]),
        (50, 4.0, ["boresights.count = 1867", "selection.max_stars_per_field = 12"]),
        (12, 2.0, ["boresights.brightest"]),
    ],
)
def test_the_true_cause_is_named(missed, covering_deg, keys):
    told = causes(rates(50, 100, missed), preset("gaia-12deg"), gap(covering_deg))
    assert len(told) == len(keys)
    for text, key in zip(told, keys, strict=True):
        assert key in text


def test_a_database_that_needs_magnitudes_says_so():
    spec, good, poor = preset("gaia-12deg"), rates(100, 100, 9), rates(5, 50, 60)
    assert advice_without_magnitudes([good, good, good, good], spec) is None
    told = advice_without_magnitudes([good, good, poor, poor], spec)
    assert told is not None
    assert "give the magnitudes" in told
    assert "max_stars_per_field = 12" in told


@pytest.mark.slow
def test_a_failing_build_prints_its_tables_and_its_holes(starcat, tmp_path):
    options = ["--set", "camera.fov_x_deg=3", "--set", "self_test.frames=20"]
    few = ["--set", "boresights.count=1500", "--set", "products.pairs.enabled=false"]
    run = starcat(["build", "--preset", "gaia-12deg", *options, *few, "-o", tmp_path])
    assert run.code == 1
    assert "Simulated fields" in run.out
    assert "after each filter" in run.out
    assert "leaves holes" in run.err
    assert list(tmp_path.iterdir()) == []


# --- Wide fields


def test_triangles_of_90_deg_have_great_circle_sides():
    camera = Camera(1280, 960, fov_x_deg=90.0)
    generator = np.random.default_rng(91)
    u = random_attitudes(60, generator)[:, 0]
    made = find_triangles(tile_sphere(200, u, generator.random(60), camera), u, 8)
    corners = u[np.stack([made.i, made.j, made.k])]
    a, b, c = (
        np.arccos((corners[p] * corners[q]).sum(axis=-1)) for p, q in ((1, 2), (0, 2), (0, 1))
    )
    half = 0.5 * (a + b + c)
    area = np.sqrt(np.maximum(half * (half - a) * (half - b) * (half - c), 0.0))
    assert np.degrees(np.max([a, b, c])) > 80.0
    np.testing.assert_allclose(made.area_rad2, area, rtol=1e-5, atol=1e-6)


def test_the_sides_of_an_observed_triangle_are_those_of_its_stars_at_90_deg():
    from frames import observe

    camera = Camera(1280, 960, fov_x_deg=90.0)
    places = np.array([[0.5, 0.5], [1279.5, 0.5], [1279.5, 959.5], [640.0, 480.0]])
    seen = observe(places, camera, 2.0)
    body = camera.directions_from_pixels(seen.centroids_px)
    np.testing.assert_allclose(
        seen.separation_rad, np.arccos(np.clip(body @ body.T, -1, 1)), atol=1e-7
    )
    # A pixel at a corner sees less sky than one in the middle, so that no error is underestimated.
    step = camera.directions_from_pixels(np.array([[0.5, 0.5], [2.5, 0.5]]))
    assert np.arccos(step[0] @ step[1]) < seen.tolerance_rad


@pytest.mark.parametrize("radius_rad", [1e-9, 0.01, 0.4, 1.6, np.pi])
def test_zones_find_what_lies_in_a_cap(radius_rad):
    generator = np.random.default_rng(3)
    u = random_attitudes(3000, generator)[:, 0]
    u[:4] = [[0, 0, 1], [0, 0, -1], [1, 0, 0], [0, 1, 0]]
    zones, tree = zones_of(u), cKDTree(u)
    for axis in u[:40]:
        expected = tree.query_ball_point(axis, chord_from_separation(radius_rad) * (1 + 1e-12))
        assert zones.near(axis, radius_rad).tolist() == sorted(expected)
