"""Photographs of 24 megapixels: they fit into one process, and the answer is always the same."""

from __future__ import annotations

import json

import numpy as np
import pytest
from database_copies import copied
from rendered import photograph_of
from served import serve

from starcat.frames.images import centroiding
from starcat.frames.images.background import subtract_background
from starcat.frames.images.image_file import write_image
from starcat.matcher.database import open_database
from starcat.pipeline.build import build
from starcat.pipeline.simulation.simulate import Noise, simulate_frames
from starcat.pipeline.specs.build_spec import CameraSpec
from starcat.pipeline.starter import starter_spec
from starcat_service.problems import Problem
from starcat_service.sandbox.sandbox import Sandbox
from starcat_service.settings import ServiceSettings

RUNS = 10
DATABASE = "0123456789abcdef"
COLOURS = {"grey": "identified", "colour": "identified", "mirrored": "no_match"}


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A database for a camera of 6000 x 4000 px."""
    camera = CameraSpec(width_px=6000, height_px=4000, fov_x_deg=20.0)
    spec = starter_spec("large", camera).spec.model_dump(mode="json", exclude_defaults=True)
    spec["self_test"] = {"frames": 20}
    given = type(starter_spec("large", camera).spec).model_validate(spec)
    return build(given, tmp_path_factory.mktemp("large")).folder


@pytest.fixture(scope="module")
def photographs(built):
    """A frame with many stars, in grey, in colour, and mirrored, so that it is not identified."""
    known = open_database(built)
    frames = simulate_frames(known.directions, known.camera, 5, Noise(0.05), 5, known.mag)
    frame = max(frames, key=lambda one: len(one.mag))
    pictures = {
        name: photograph_of(frame, known.camera, is_colour=name == "colour")
        for name in ("grey", "colour")
    }
    frame.centroids_px[:, 0] = known.camera.width_px - frame.centroids_px[:, 0]
    return {**pictures, "mirrored": photograph_of(frame, known.camera, is_colour=False)}


def essence(found):
    """Return what has to be the same every time."""
    [frame] = found["frames"]
    return frame["status"], frame.get("q_body_from_icrs"), frame["stars"]


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_server_answers_alike_every_time(built, photographs, tmp_path):
    copied(built, tmp_path / "root" / "databases" / DATABASE)
    with serve(tmp_path / "root", tmp_path / "log.txt", query_time_s=120.0) as served:
        for name, status in COLOURS.items():
            runs = RUNS if status == "identified" else 2  # a mirrored one takes long
            lines = (
                f'--b\r\nContent-Disposition: form-data; name="file"; filename="{name}.jpg"',
                "Content-Type: image/jpeg\r\n\r\n",
            )
            body = "\r\n".join(lines).encode() + photographs[name] + b"\r\n--b--\r\n"
            kind = {"Content-Type": "multipart/form-data; boundary=b"}
            found = [
                served.raw("POST", f"/api/v1/identify/{DATABASE}", kind, body, timeout_s=120.0)
                for _ in range(runs)
            ]
            assert [one.status for one in found] == [200] * runs, found[-1].text[:500]
            answers = [essence(json.loads(one.body)) for one in found]
            assert all(one == answers[0] for one in answers)
            assert answers[0][0] == status


def test_memory_that_is_missing_is_not_said_to_be_an_image_with_too_much_in_it(monkeypatch):
    image = np.random.default_rng(1).normal(100.0, 5.0, (64, 64))
    monkeypatch.setattr(centroiding, "_ROOM", 10**13)
    with pytest.raises(MemoryError):
        centroiding.detect(subtract_background(image), 1.0, 5.0)


@pytest.mark.slow
def test_a_request_that_takes_too_much_memory_says_so(small_database, tmp_path):
    sandbox = Sandbox(ServiceSettings(root=tmp_path, query_memory_gib=0.15, queries=1), tmp_path)
    write_image(tmp_path / "a.png", np.full((4000, 6000), 20, dtype=np.uint8))
    given = {"folder": str(tmp_path), "database": str(small_database), "options": {}}
    with pytest.raises(Problem, match=r"memory than it may \(0.15 GiB\).*query_memory_gib") as told:
        sandbox.call("identify", {**given, "file": "a.png"})
    assert told.value.status == 413
    sandbox.close()
