"""Trials: the noise that is stated to the matcher, and the stars that noise hides."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq

from starcat.catalog.stars.region import Region
from starcat.database import open_database_folder
from starcat.geometry.camera import Camera
from starcat.matcher.c_engine import library_version
from starcat.pipeline.build import build
from starcat.pipeline.simulation.simulate import Noise, SimulatedFrame, Sky, simulate_frame
from starcat.pipeline.specs.reading import spec_from_dict
from starcat_lab.experiment import (
    Attitudes,
    Experiment,
    attitude_of,
    catalog_of_database,
    description,
    run_experiment,
)
from starcat_lab.papers import s2, s4

CAMERA = Camera(1024, 1024, fov_x_deg=12.0)

LIMITED = Noise(noise_mag=1.0, limit_mag=6.0)


def seen(u: np.ndarray, noise: Noise) -> SimulatedFrame:
    sky = Sky(u, np.linspace(3.0, 9.0, len(u)), np.arange(len(u)))
    return simulate_frame(sky, CAMERA, np.eye(3), noise, np.random.default_rng(3))


def test_the_true_magnitude_decides_what_is_seen_where_it_is_asked_to(random_directions):
    u = random_directions(60_000, 4)
    true = set(seen(u, replace(LIMITED, noise_mag=0.0)).star_index.tolist())
    unhidden = seen(u, replace(LIMITED, is_limit_true=True))
    assert len(true) > 20
    assert set(unhidden.star_index.tolist()) == true
    assert unhidden.mag.max() > 6.0  # the measured magnitude still has noise
    hidden = seen(u, LIMITED)
    assert hidden.mag.max() <= 6.0
    assert len(true - set(hidden.star_index.tolist())) > 3
    assert len(set(hidden.star_index.tolist()) - true) > 3


def test_the_installed_engine_answers_as_numpy_does(small_database, tmp_path):
    numpy = Experiment("numpy", "triangle", Attitudes("random", 30), Noise(0.3, limit_mag=6.0))
    installed = replace(numpy, name="installed", engine="auto")
    paths = (run_experiment(one, small_database, tmp_path) for one in (numpy, installed))
    found = [pq.read_table(path) for path in paths]
    for column in ("status", "n_named", "n_right", "n_wrong"):
        assert found[0][column].to_pylist() == found[1][column].to_pylist()
    facts = json.loads(description(installed, small_database))
    assert facts["c_library"] == library_version()
    assert "c_library" not in json.loads(description(numpy, small_database))


def test_the_sky_of_a_database_has_each_star_once(small_spec, sao_lines, tmp_path):
    """Also a star with two records, of which one is rejected."""
    lines = b"".join([*sao_lines, *sao_lines[:5]])
    (tmp_path / "sao.dat").write_bytes(lines)
    spec = spec_from_dict(tomllib.loads(small_spec), "small.toml")
    folder = build(spec, tmp_path / "dist", inputs={"sao": [tmp_path / "sao.dat"]}).folder
    rejected = open_database_folder(folder).table("rejected")
    assert rejected["reason"].to_pylist().count("duplicate_record") == 5
    sky = catalog_of_database(folder)
    assert len(np.unique(sky.directions, axis=0)) == len(sky)
    assert len(sky) == open_database_folder(folder).table("stars").num_rows + sum(
        reason != "duplicate_record" for reason in rejected["reason"].to_pylist()
    )


def test_random_boresights_are_in_the_region_of_a_database():
    experiment, stars = Experiment("any", "triangle", Attitudes("random", 9)), np.eye(3)
    part = Region(zone=(10.0, 20.0)).footprint
    made = [
        attitude_of(experiment, n, stars, np.random.default_rng([1, n]), part) for n in range(9)
    ]
    dec_deg = np.degrees([np.arcsin(matrix[2, 2]) for matrix in made])
    assert ((dec_deg >= 10.0) & (dec_deg <= 20.0)).all()
    assert len(set(dec_deg)) == 9


def test_noise_of_a_magnitude_is_read_in_every_way():
    rows = {row.experiment.name: row for paper in (s2, s4) for row in paper.rows(quick=True)}
    one = rows["s2-magnitude-noise-1-dynamic_angle"]
    for name in ("guides", "seen"):
        other = rows[f"s2-{name}-magnitude-1-dynamic_angle"]
        assert other.published_percent == one.published_percent == 98.84
        assert other.experiment != one.experiment
    assert rows["s4-seen-magnitude-1-triangle"].experiment.noise.is_limit_true
    assert rows["s4-mixed-installed-triangle"].experiment.engine == "auto"
