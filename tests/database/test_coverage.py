"""Coverage: stars of the fields, distances between fields, and the keys of the spec for them."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from math import comb
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drafts import chosen, spec_with
from scipy.spatial import cKDTree

from starcat.catalog.stars.verdict import count_by_reason
from starcat.database.products.coverage import (
    coverage_from_counts,
    covering_radius,
    field_coverage,
    summarise_coverage,
    tiling_gap,
)
from starcat.database.products.tiling import FieldStars, NominalField, tile_sphere
from starcat.database.reader import open_database_folder
from starcat.errors import BuildError
from starcat.geometry.sphere import directions_from_radec, saff_kuijlaars, separation
from starcat.pipeline.build import Built, build
from starcat.pipeline.guide_stars import check_fields
from starcat.pipeline.recipes import tile_guide_stars
from starcat.pipeline.selection.ruleset import ALL_REASONS
from starcat.pipeline.selection.selecting import reject_dense, select_guide_stars
from starcat.pipeline.specs.reading import preset

# Stars of a field ---------------------------------------------------------------------------


@pytest.mark.parametrize("brightest", [1, 3, 6, 100])
def test_counts_are_those_of_counting(brightest, random_directions):
    stars = random_directions(400, 1)
    mag = np.arange(400.0)
    fields = tile_sphere(40, stars, mag, NominalField(30.0, 30.0), "circular")
    made = field_coverage(fields, brightest)
    for tile, boresight in enumerate(fields.boresights):
        inside = int(np.sum(separation(stars, boresight) <= np.radians(15.0)))
        assert made.stars[tile] == inside
        assert made.pairs[tile] == comb(inside, 2)
        assert made.triangles[tile] == comb(min(inside, brightest), 3)


def test_an_empty_sky_has_a_coverage():
    fields = tile_sphere(5, np.empty((0, 3)), np.empty(0), NominalField(10.0, 10.0))
    made = field_coverage(fields, 6)
    summary = summarise_coverage(made)
    assert not np.any([made.stars, made.pairs, made.triangles])
    assert (summary.fields, summary.stars.maximum, summary.histogram.tolist()) == (5, 0, [5])


def test_a_summary_by_hand():
    boresights = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    summary = summarise_coverage(coverage_from_counts(boresights, np.array([7, 2, 2, 5]), 6))
    assert (summary.stars.minimum, summary.stars.median, summary.stars.maximum) == (2, 2, 7)
    assert summary.stars.mean == 4.0
    # The first of the two worst fields along the spiral.
    assert (summary.worst_boresight, summary.worst_ra_deg, summary.worst_dec_deg) == (1, 90.0, 0.0)
    assert summary.histogram.tolist() == [0, 0, 2, 0, 0, 1, 0, 1]
    assert (summary.pairs.maximum, summary.triangles.maximum) == (21, 20)


def test_one_per_cent_is_the_count_that_one_field_in_a_hundred_does_not_exceed():
    counts = np.arange(1000)[::-1]
    summary = summarise_coverage(coverage_from_counts(saff_kuijlaars(1000), counts, 6))
    assert summary.stars.one_percent == 9
    assert np.mean(counts <= summary.stars.one_percent) == 0.01


# Distances between fields -------------------------------------------------------------------


@pytest.mark.parametrize("count", [10, 100, 10_000])
def test_no_direction_is_farther_than_the_covering_radius(count, random_directions):
    boresights = saff_kuijlaars(count)
    radius, direction = covering_radius(boresights)
    sample = random_directions(200_000, count)
    chord, _ = cKDTree(boresights).query(sample, workers=2)
    farthest = float(2.0 * np.arcsin(0.5 * chord.max()))
    assert 0.93 * radius < farthest <= radius
    nearest = separation(boresights, direction).min()
    assert nearest == pytest.approx(radius, rel=1e-12)
    assert np.linalg.norm(direction) == pytest.approx(1.0, rel=1e-14)


def circle(ra_deg: list[float], dec_deg: float) -> np.ndarray:
    return directions_from_radec(ra_deg, np.full(len(ra_deg), dec_deg))


FEW = {
    "one": circle([10.0], 20.0),
    "both poles": np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]),
    "antipodes": np.array([[0.6, 0.8, 0.0], [-0.6, -0.8, 0.0]]),
    "two near": circle([10.0, 12.0], 5.0),
    "spiral of 3": saff_kuijlaars(3),
    "spiral of 5": saff_kuijlaars(5),
    "three of an octant": np.eye(3),
    "equator": circle([0.0, 45.0, 90.0, 135.0, 180.0, 225.0, 270.0, 315.0], 0.0),
    "half of the equator": circle([0.0, 45.0, 90.0, 135.0], 0.0),
    "arc of a parallel": circle([0.0, 10.0, 30.0, 100.0], 50.0),
    # The farthest direction is opposite to the middle of the two outer ones.
    "four of one side": np.concatenate([circle([-30.0, 30.0], 0.0), circle([0.0, 1.0], 3.0)]),
    "an octahedron": np.concatenate([np.eye(3), -np.eye(3)]),
    # Each facet of a cube has four corners on one circle.
    "a cube": np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / np.sqrt(3),
}
KNOWN_DEG = {
    "one": 180.0, "both poles": 90.0, "spiral of 3": 90.0, "equator": 90.0,
    "an octahedron": np.degrees(np.arccos(1.0 / np.sqrt(3.0))),
    "a cube": np.degrees(np.arccos(1.0 / np.sqrt(3.0))),
}  # fmt: skip


@pytest.mark.parametrize("name", FEW)
@pytest.mark.parametrize("rotation", range(3))
def test_few_directions(name, rotation, random_directions):
    """The radius equals a brute-force search over the sphere, refined at the farthest point."""
    turn, _ = np.linalg.qr(random_directions(3, rotation))
    directions = FEW[name] @ (turn if rotation else np.eye(3))
    radius, direction = covering_radius(directions)
    assert separation(directions, direction).min() == pytest.approx(radius, abs=1e-9)
    assert np.degrees(radius) == pytest.approx(KNOWN_DEG.get(name, np.degrees(radius)), rel=1e-9)
    sample = random_directions(20_000, rotation)
    best = 0.0
    for width in (0.1, 0.03, 0.01, 0.003, 0.001, 0.0003, 0.0001):
        reach = np.array([separation(sample, each) for each in directions]).min(axis=0)
        best = max(best, float(reach.max()))
        near = sample[np.argmax(reach)] + width * random_directions(5_000, rotation + 9)
        sample = near / np.linalg.norm(near, axis=1)[:, None]
    assert best <= radius + 1e-9
    assert best == pytest.approx(radius, abs=2e-4)


def test_default_tiling_leaves_no_hole():
    gap = tiling_gap(saff_kuijlaars(10_000), np.radians(6.0))
    assert not gap.has_holes
    assert np.degrees(gap.covering_radius_rad) == pytest.approx(1.50026, abs=1e-5)


@pytest.mark.parametrize("count", [1, 10, 100, 500])
def test_holes_are_said_and_so_is_what_closes_them(count):
    tile = np.radians(6.0)
    gap = tiling_gap(saff_kuijlaars(count), tile)
    assert gap.has_holes
    assert gap.boresights_needed > count
    assert not tiling_gap(saff_kuijlaars(gap.boresights_needed), tile).has_holes


# What a spec can ask ------------------------------------------------------------------------


@pytest.fixture
def make(tmp_path: Path, sao_file: Path, small_spec: str) -> Callable[..., Built]:
    """Build the small spec with some keys of its selection and boresights set."""

    def run(**changes: dict[str, Any]) -> Built:
        spec = spec_with(small_spec, **changes)
        return build(spec, tmp_path / "dist", inputs={"sao": [sao_file]})

    return run


def test_too_few_stars_in_a_field_fail_the_build(make, small_database, small_spec, tmp_path):
    table = open_database_folder(small_database).table("boresights").to_pylist()
    counts = np.array([row["star_count"] for row in table])
    wanted = int(counts.min()) + 2
    short = np.flatnonzero(counts < wanted)
    with pytest.raises(BuildError) as caught:
        make(boresights={"min_stars_per_field": wanted})
    message = str(caught.value)
    assert message.startswith(f"small: {len(short)} of 200 fields have fewer than {wanted} ")
    worst = table[int(counts.argmin())]
    assert (
        f"boresight {worst['boresight']} (RA {worst['ra_deg']:.2f}, Dec {worst['dec_deg']:+.2f} "
        f"deg): {worst['star_count']}"
    ) in message
    assert message.count("boresight ") == min(len(short), 5)
    assert not (tmp_path / "dist").exists()
    just = spec_with(small_spec, boresights={"min_stars_per_field": int(counts.min())})
    chosen(open_database_folder(small_database).table("stars"), just)
    report = json.loads((small_database / "report" / "report.json").read_bytes())
    assert (report["warnings"], report["coverage"]["tiling"]["holes"]) == ([], False)


def test_only_some_of_many_short_fields_are_named():
    spec = preset("sao-12deg").model_copy(
        update={"boresights": preset("sao-12deg").boresights.model_copy(
            update={"min_stars_per_field": 3})}
    )  # fmt: skip
    none = FieldStars(saff_kuijlaars(50), np.zeros(51, dtype=np.int64), np.empty(0, dtype=np.int32))
    with pytest.raises(BuildError, match=r"50 of 50 fields .*boresight 4 .*, \.\.\.\. A fainter"):
        check_fields(none, spec)


@pytest.mark.parametrize("most", [3, 6, 12])
def test_thinning_keeps_the_brightest_of_every_field(most, small_database, small_spec):
    spec = spec_with(small_spec, selection={"max_stars_per_field": most})
    stars = open_database_folder(small_database).table("stars")
    before = tile_guide_stars(stars, spec)
    selected = select_guide_stars(stars, spec.selection)
    thinned = reject_dense(selected, before.brightest(most)[1])
    after = tile_guide_stars(thinned.guide_stars, spec)
    names = stars["star_id"].to_numpy(), thinned.guide_stars["star_id"].to_numpy()
    was, now = (
        np.split(own[fields.star_index], fields.offsets[1:-1])
        for own, fields in zip(names, (before, after), strict=True)
    )
    for one, other in zip(was, now, strict=True):
        assert np.array_equal(other[:most], one[:most])
        assert set(other) <= set(one)
    assert after.count.max() < before.count.max()
    assert np.std(after.count) < np.std(before.count)
    # Nothing is lost.
    gone = count_by_reason(thinned.rejected, reasons=ALL_REASONS).get("density", 0)
    assert len(thinned.guide_stars) + gone == len(selected.guide_stars)
    assert len(thinned.rejected) == len(selected.rejected) + gone

    assert np.all(np.diff(thinned.rejected["star_id"].to_numpy()) > 0)
    step = thinned.steps[-1]
    assert (step.name, len(step.directions)) == ("density", len(thinned.guide_stars))


def test_a_build_says_that_its_tiling_has_holes(starcat, small_spec, sao_file, tmp_path, caplog):
    (tmp_path / "spec.toml").write_text(small_spec)
    # Holes of the tiling have no triangles either.
    few = ["--set", "boresights.count=20", "--set", "self_test.min_identified=0"]
    arguments = ["build", tmp_path / "spec.toml", "--input", f"sao={sao_file}", *few]
    with caplog.at_level(logging.WARNING, logger="starcat"):
        run = starcat([*arguments, "-o", tmp_path, "--json"])
    assert run.code == 0
    (warning,) = json.loads(run.out)["warnings"]
    assert warning.startswith("boresights.count = 20 leaves holes: RA ")
    assert "a field reaches 20.000 deg at any roll" in warning
    assert warning in caplog.text
    estimate, _, rest = run.err.partition("\n")
    assert (estimate.partition(": ")[0], rest) == ("estimate", f"warning: {warning}\n")
    folder = tmp_path / "small-1.0.0"
    report = json.loads((folder / "report" / "report.json").read_bytes())
    assert report["warnings"] == [warning]
    assert warning.split(":")[0] in (folder / "report" / "index.html").read_text()
    run = starcat(["coverage", folder, "--json"])
    assert report["coverage"] == json.loads(run.out)
    assert report["coverage"]["tiling"]["holes"] is True
    assert "leaves holes" in run.err


@pytest.mark.slow
def test_a_database_blind_to_part_of_the_sky_is_no_proven_one(make):
    narrow = {"camera": {"width_px": 512, "height_px": 512, "fov_x_deg": 20.0}}
    with pytest.raises(
        BuildError, match=r"of 200 simulated pointings, .* at least 4 stars"
    ) as told:
        make(
            **narrow,
            boresights={"count": 2000},
            self_test={"frames": 200, "noise_px": 0.1, "min_identified": 0.9},
        )
    clean = told.value.built.rates[0]
    assert clean.share_of_identifiable > 0.9 > clean.identified_share
    assert "pointings show fewer than 4 stars: a fainter selection.faint" in str(told.value)
    made = make(**narrow, boresights={"count": 2000}, self_test={"min_identified": 0.0})
    (warning,) = made.warnings
    blind = made.coverage.summary.histogram[:4].sum()
    assert warning.startswith(f"{blind} of 2,000 fields ({blind / 2000:.2%}) hold fewer than 4 gu")
    report = json.loads((made.folder / "report" / "report.json").read_bytes())
    assert report["warnings"] == [warning]
