"""Databases of a region: tiling, self-test and report stay inside the region."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from drafts import spec_with

from starcat.catalog.stars.region import Region
from starcat.catalog.stars.star_table import directions_of
from starcat.database.products.coverage import tiling_gap
from starcat.database.reader import open_database_folder
from starcat.database.verify import _count_problems, check_database
from starcat.errors import BuildError
from starcat.geometry.sphere import directions_from_radec, saff_kuijlaars, separation
from starcat.pipeline.acceptance import causes
from starcat.pipeline.build import build
from starcat.pipeline.estimate import estimate_spec
from starcat.pipeline.recipes import boresights_of
from starcat.pipeline.report_data import database_coverage
from starcat.pipeline.simulation.selftest import Rates
from starcat.pipeline.simulation.simulate import simulate
from starcat.pipeline.specs.build_spec import BuildSpec
from starcat.pipeline.specs.reading import preset

CONE, ZONE = [83.0, -5.0, 50.0], [-40.0, 40.0]
REGIONS = {
    "cone": {"cone": CONE},
    "zone": {"zone": ZONE},
    "moc": {"moc": "0/4-7"},
    "cone and zone": {"cone": CONE, "zone": ZONE},
}


def spec_of(text: str, region: dict[str, Any], **sections: Any) -> BuildSpec:
    sections.setdefault("self_test", {"frames": 40, "min_identified": 0.9})
    return spec_with(text, selection={"region": region}, **sections)


def is_inside(region: dict[str, Any], directions: np.ndarray) -> np.ndarray:
    """Whether directions are in a region, by other code for all but the MOC."""
    inside = np.ones(len(directions), dtype=bool)
    if "cone" in region:
        ra_deg, dec_deg, radius_deg = region["cone"]
        centre = directions_from_radec(ra_deg, dec_deg)
        inside &= directions @ centre >= np.cos(np.radians(radius_deg))
    if "zone" in region:
        low, high = np.sin(np.radians(region["zone"]))
        inside &= (directions[:, 2] >= low) & (directions[:, 2] <= high)
    if "moc" in region:
        # The base cells 4 to 7 are around the equator, those of even number of ra 0, 90, ...
        inside &= np.abs(directions[:, 2]) < 2.0 / 3.0 + 1e-9
    return inside


@pytest.mark.parametrize("name", REGIONS)
def test_a_database_of_a_region_proves_itself(name, small_spec, sao_file, tmp_path):
    region = REGIONS[name]
    spec = spec_of(small_spec, region)
    built = build(spec, tmp_path, inputs={"sao": [sao_file]})
    assert built.rates[0].identified_share >= 0.9
    check_database(built.folder)
    database = open_database_folder(built.folder)
    table = database.table("boresights")
    boresights = np.stack([table[axis].to_numpy() for axis in "xyz"], axis=-1)
    spiral = saff_kuijlaars(200)
    if "moc" not in region:
        assert (boresights == spiral[is_inside(region, spiral)]).all()
    assert 0 < len(boresights) < 200
    assert is_inside(region, boresights).all()
    assert is_inside(region, directions_of(database.stars)).all()
    coverage = database_coverage(database)
    assert coverage.as_dict() == built.coverage.as_dict()
    assert coverage.summary.fields == len(boresights)
    frames = simulate(built.folder, 20)
    assert is_inside(region, np.array([frame.matrix[2] for frame in frames])).all()
    found = estimate_spec(spec, {"sao": [sao_file]})
    assert found.cost.fields == len(boresights)
    assert not any("leaves holes" in words for words in (*found.warnings, *built.warnings))


@pytest.mark.slow
@pytest.mark.parametrize("region", [{"cone": [83.0, -5.0, 15.0]}, {"zone": [-30.0, 30.0]}], ids=str)
def test_regions_of_the_embedded_sky_prove_themselves(region, tmp_path):
    content = preset("gaia-12deg").recorded()
    content["selection"]["region"] = region
    spec = BuildSpec.model_validate(content)
    assert spec.self_test.min_identified == 0.9
    built = build(spec, tmp_path)
    assert built.rates[0].interval[1] >= 0.9
    assert sum(rates.wrong for rates in built.rates) == 0


@pytest.mark.parametrize("moved", [-1, 1])
def test_a_wrong_number_of_fields_of_a_region_is_found(moved, small_spec, sao_file, tmp_path):
    built = build(spec_of(small_spec, {"cone": CONE}), tmp_path, inputs={"sao": [sao_file]})
    manifest = built.manifest
    assert not list(_count_problems(manifest, {}))
    manifest["products"]["boresights"]["rows"] += moved
    assert "boresights; the spec says" in " ".join(_count_problems(manifest, {}))
    manifest["spec"]["selection"]["region"] = {"cone": "north"}
    assert "selection.region of the recorded spec is not" in " ".join(_count_problems(manifest, {}))
    # Earlier versions tiled the whole sphere.
    manifest["products"]["boresights"]["rows"] = 200
    assert not list(_count_problems(manifest, {}))


def test_a_region_without_a_boresight_is_refused(small_spec, sao_file, tmp_path):
    spec = spec_of(small_spec, {"cone": [83.0, -5.0, 15.0]}, boresights={"count": 2})
    words = r"none of the fields of boresights.count = 2 has its boresight in \[selection.region\]"
    with pytest.raises(BuildError, match=words):
        build(spec, tmp_path, inputs={"sao": [sao_file]})


@pytest.mark.parametrize("region", [None, {"cone": [83.0, -5.0, 12.0]}])
def test_a_failed_test_of_a_region_says_what_its_edge_costs(region, small_spec):
    spec = spec_of(small_spec, region or {})
    few = Rates("clean", 0.5, 0.0, 0, 0.2, 100, 60, 50, 0, 1.0, missed=(4,) * 10)
    words = " ".join(causes(few, spec, tiling_gap(saff_kuijlaars(200), 1.0)))
    assert ("Frames near the edge of [selection.region] show" in words) == (region is not None)


@pytest.mark.parametrize("region", [{"cone": [83.0, -5.0, 30.0]}, {"zone": [10.0, 60.0]}], ids=str)
def test_gaps_of_a_region_are_those_inside(region, random_directions):
    part = Region.model_validate(region).footprint
    inside = saff_kuijlaars(400)
    inside = inside[part.contains(inside)]
    gap = tiling_gap(inside, 0.1, 400, part)
    probes = random_directions(30_000, 5)
    probes = probes[is_inside(region, probes)]
    nearest = np.min([separation(probes, one) for one in inside], axis=0).max()
    assert nearest - 0.01 < gap.covering_radius_rad < nearest + 0.03
    assert gap.boresights == 400
    assert part.contains(directions_from_radec([gap.ra_deg], [gap.dec_deg])).all()


def test_the_map_of_a_region_is_empty_outside(small_spec):
    from starcat.pipeline.report.coverage_map import nearest_raster

    spec = spec_of(small_spec, {"zone": [-20.0, 20.0]})
    part = spec.selection.region.footprint
    whole, some = (nearest_raster(boresights_of(spec), 80, one) for one in (None, part))
    assert (some[20] >= 0).sum() == (whole[20] >= 0).sum() > 0
    assert (some[4] == -1).all()
    assert (whole[4] >= 0).any()
