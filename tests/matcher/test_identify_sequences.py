"""``starcat identify`` where frames are expected somewhere: a prior attitude, a sequence."""

from __future__ import annotations

import json
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from slew import slew

from starcat.geometry.attitude import quaternion_from_matrix
from starcat.matcher.database import open_database
from starcat.pipeline.simulation.simulate import Noise, SimulatedFrame


@pytest.fixture(scope="module")
def frames(small_database: Path) -> list[SimulatedFrame]:
    return list(slew(open_database(small_database), 12, Noise(0.3), 3, (6,)))


@pytest.fixture
def sequence(frames: list[SimulatedFrame], tmp_path: Path) -> Path:
    path = tmp_path / "slew.json"
    content = [{"centroids_px": frame.centroids_px.tolist()} for frame in frames]
    path.write_text(json.dumps({"frames": content}))
    return path


def prior(frame: SimulatedFrame) -> str:
    return ",".join(map(str, quaternion_from_matrix(frame.matrix).tolist()))


def test_a_sequence_is_followed(starcat, small_database, sequence):
    answers = json.loads(starcat(["identify", small_database, sequence, "--track", "--json"]).out)
    assert [answer["status"] for answer in answers] == ["identified"] * 12
    found = [answer["origin"] for answer in answers]
    assert found[0] == found[6] == "lost_in_space"
    assert found[1:6] + found[7:] == ["tracking"] * 10
    alone = json.loads(starcat(["identify", small_database, sequence, "--json"]).out)
    for one, other in zip(alone, answers, strict=True):
        assert one["origin"] == "lost_in_space"
        names = [[star["star"] for star in answer["stars"]] for answer in (one, other)]
        assert names[0] == names[1]


def test_a_tracked_sequence_is_corrected_for_aberration(starcat, small_database, sequence):
    command = ["identify", small_database, sequence, "--time", "2026-11-22T10:00:00", "--json"]
    tracked = json.loads(starcat([*command, "--track"]).out)
    assert [answer["origin"] for answer in tracked].count("tracking") == 10
    for answer, alone in zip(tracked, json.loads(starcat(command).out), strict=True):
        corrections = [each["in_time"]["correction_arcsec"] for each in (answer, alone)]
        assert corrections[0] == pytest.approx(corrections[1], abs=0.01)
        assert 15.0 < corrections[0] < 21.0


def test_a_table_of_a_sequence_says_where_frames_were_found(starcat, small_database, sequence):
    lines = starcat(["identify", small_database, sequence, "--track"]).out.splitlines()
    assert sum("tracking" in line for line in lines) == 10
    assert sum("lost in space" in line for line in lines) == 2
    assert "origin" not in starcat(["identify", small_database, sequence]).out


def test_a_stream_is_followed(starcat, small_database, frames, monkeypatch):
    lines = [json.dumps({"centroids_px": frame.centroids_px.tolist()}) for frame in frames[:4]]
    monkeypatch.setattr("sys.stdin", StringIO("\n".join(lines)))
    run = starcat(["identify", small_database, "-", "--track", "--ndjson"])
    origins = [json.loads(line)["origin"] for line in run.out.splitlines()]
    assert origins == ["lost_in_space", "tracking", "tracking", "tracking"]


def test_a_prior_attitude_is_used(starcat, small_database, frames, tmp_path):
    path = tmp_path / "frame.json"
    path.write_text(json.dumps({"centroids_px": frames[1].centroids_px.tolist()}))
    asked = ["identify", small_database, path, "--json", "--prior-error-deg", "3"]
    [near] = json.loads(starcat([*asked, "--prior-q", prior(frames[0])]).out)
    assert (near["status"], near["origin"]) == ("identified", "tracking")
    truth = quaternion_from_matrix(frames[1].matrix)
    assert abs(float(np.dot(near["q_body_from_icrs"], truth))) == pytest.approx(1.0, abs=1e-6)
    [far] = json.loads(starcat([*asked, "--prior-q", prior(frames[8])]).out)
    assert (far["status"], far["origin"]) == ("no_match", "tracking")
    run = starcat([*asked, "--prior-q", "0,0,0,one"])
    assert (run.code, "expected X,Y,Z,W, four numbers" in run.err) == (2, True)
