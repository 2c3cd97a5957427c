"""``starcat identify`` with many files: folders, patterns, one table, a line each, one picture."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from starcat.errors import ConfigError
from starcat.frames.calibration.files import calibrate
from starcat.frames.images.batch import (
    BatchItem,
    files_of,
    identify_files,
    is_batch,
    read_frames,
    small_picture,
)
from starcat.frames.images.contact_sheet import write_contact_sheet
from starcat.frames.images.image_file import write_image
from starcat.frames.images.measure import LocalInputs
from starcat.frames.images.render import Optics, render_image, write_simulated
from starcat.geometry.attitude import after_turn, matrix_from_quaternion
from starcat.matcher.database import open_database
from starcat.matcher.matcher import Matcher
from starcat.matcher.tracking import Tracker
from starcat.pipeline.simulation.simulate import Noise, Sky, simulate_frame, simulate_frames


@pytest.fixture(scope="module")
def night(small_database, tmp_path_factory) -> Path:
    """Six pictures, one damaged and one without stars, and a file that is not a picture."""
    folder, database = tmp_path_factory.mktemp("night"), open_database(small_database)
    eye, noise = database.camera, Noise(0.5)
    frames = simulate_frames(database.directions, eye, 4, noise, 1, mag=database.mag)
    for number, frame in enumerate(frames, start=1):
        write_simulated(folder / f"img_{number}.png", frame, eye, number)
    (folder / "img_5.png").write_bytes((folder / "img_1.png").read_bytes()[:200])
    Image.fromarray(np.full((512, 512), 100, np.uint16)).save(folder / "img_10.png")
    (folder / "notes.txt").write_text("cloudy at first\n")
    return folder


def test_files_are_those_of_folders_patterns_and_names(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("b/img_10.JPG", "b/img_2.jpg", "b/frame.csv", "b/.hidden.png", "c/1.csv", "a.png"):
        Path(name).parent.mkdir(exist_ok=True)
        Path(name).touch()
    assert [str(path) for path in files_of(["b"])] == ["b/img_2.jpg", "b/img_10.JPG"]
    assert [str(path) for path in files_of(["c"])] == ["c/1.csv"]
    assert list(map(str, files_of(["a.png", "*.png", "b/*_2*"]))) == ["a.png", "b/img_2.jpg"]
    assert [is_batch(given) for given in (["b"], ["*.png"], ["a.png", "b.png"])] == [True] * 3
    assert not is_batch(["a.png"])
    assert not is_batch(["-"])


@pytest.mark.parametrize(
    ("given", "words"),
    [("*.fits", "no file has such a name"), ("-", "goes alone"), ("empty", "neither pictures")],
)
def test_inputs_that_are_no_files_are_refused(given, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigError, match=words):
        files_of([given])


def test_many_pictures_are_one_table_and_a_file_that_is_not_a_picture_spoils_no_other(
    starcat, night, small_database, tmp_path
):
    sheet = tmp_path / "sheet.png"
    run = starcat(["identify", small_database, night, "--contact-sheet", sheet])
    assert run.code == 2
    assert "1 of 6 files cannot be used" in run.err
    assert "img_5.png" in run.err
    rows = [line.split() for line in run.out.splitlines() if line.startswith("img_")]
    assert [row[0] for row in rows] == [f"img_{n}" for n in (1, 2, 3, 4, 10)]
    assert [row[1] for row in rows] == ["identified"] * 4 + ["too_few_stars"]
    again = tmp_path / "again.png"
    items = identify_files(files_of([str(night)]), Matcher.open(small_database))
    write_contact_sheet(again, list(items))
    assert sheet.read_bytes() == again.read_bytes()


def test_each_answer_of_many_is_a_line_of_json(starcat, night, small_database):
    run = starcat(["identify", small_database, f"{night}/img_[!234]*.png", "--json"])
    assert run.code == 2
    found = [json.loads(line) for line in run.out.splitlines()]
    assert [Path(one["file"]).name for one in found] == [f"img_{n}.png" for n in (1, 5, 10)]
    states = [one["status"] for one in found]
    assert states == ["identified", "unusable", "too_few_stars"]
    [alone] = json.loads(starcat(["identify", small_database, night / "img_1.png", "--json"]).out)
    assert found[0]["stars"] == alone["stars"]
    # Many frames give the same exit code as one frame.
    asked = [night / "img_1.png", night / "img_10.png"]
    assert starcat(["identify", small_database, *asked]).code == 0
    run = starcat(["identify", small_database, *asked, "--fail-on-no-match"])
    assert run.code == 6
    assert "1 of 2 frames not identified (img_10: too_few_stars)" in run.err
    run = starcat(["identify", small_database, *asked, "--wcs", "one.fits"])
    assert (run.code, "--wcs is for one file" in run.err) == (2, True)


def told(items: list[BatchItem]) -> list[object]:
    return [
        (item.path, [answer.content() | {"time_s": 0} for answer in item.answers], str(item.error))
        for item in items
    ]


@pytest.mark.slow
def test_processes_change_no_answer(night, small_database):
    matcher, paths = Matcher.open(small_database), files_of([str(night)])[2:]
    alone, several = (list(identify_files(paths, matcher, workers=n)) for n in (0, 2))
    assert told(alone) == told(several)
    for one, other in zip(alone, several, strict=True):
        assert np.array_equal(one.small, other.small)


def test_centroid_files_are_a_batch_too(starcat, small_database, tmp_path):
    for seed in (1, 2):
        starcat(["simulate", small_database, "-o", tmp_path / f"{seed}.csv", "--seed", seed])
    shutil.copy(tmp_path / "1.csv", tmp_path / "3.csv")
    run = starcat(["identify", small_database, tmp_path, "--json", "--track"])
    found = [json.loads(line) for line in run.out.splitlines()]
    assert [one["status"] for one in found] == ["identified"] * 3
    sheet = tmp_path / "sheet.png"
    assert starcat(["identify", small_database, tmp_path, "--contact-sheet", sheet]).code == 0
    with Image.open(sheet) as drawn:
        assert drawn.size[0] > 512


@pytest.mark.parametrize("shape", [(20, 30), (1000, 37), (3, 5000)])
def test_a_small_picture_keeps_every_star(shape):
    image = np.full(shape, 10.0)
    image[shape[0] // 2, shape[1] // 2] = 1000.0
    small = small_picture(image)
    assert max(small.shape) <= 256
    assert small.max() == 255


def pictures_of_a_turn(database, folder, count):
    """Write pictures of a camera that turns by 1.5 deg from each to the next."""
    generator = np.random.default_rng(3)
    sky = Sky(database.directions, database.mag, np.arange(len(database.mag), dtype=np.int32))
    q, paths = (0.0, 0.0, 0.0, 1.0), []
    for number in range(count):
        q = after_turn(q, (np.radians(1.5), 0.0, 0.0))
        matrix = matrix_from_quaternion(np.array(q))
        frame = simulate_frame(sky, database.camera, matrix, Noise(0.2), generator)
        paths.append(folder / f"{number}.png")
        write_simulated(paths[-1], frame, database.camera, number)
    return paths


def test_a_picture_without_stars_is_one_frame_of_a_sequence(small_database, tmp_path, monkeypatch):
    """A frame that is searched for again, in other ways, moves the time of the tracker once."""
    predictions = []
    paths = pictures_of_a_turn(open_database(small_database), tmp_path, 6)
    generator = np.random.default_rng(4)
    dark = generator.normal(100.0, 5.0, (512, 512))
    Image.fromarray(np.rint(dark).astype(np.uint16)).save(paths[3])
    predicted = Tracker._predicted

    def noted(self, now, camera):
        found = predicted(self, now, camera)
        predictions.append((now, found[1]))
        return found

    monkeypatch.setattr(Tracker, "_predicted", noted)
    matcher = Matcher.open(small_database)
    items = list(identify_files(paths, matcher, local=LocalInputs(track=True), workers=0))
    origins = [item.answers[0].result.origin for item in items if item.answers[0].result.ok]
    assert origins == ["lost_in_space", *["tracking"] * 4]
    assert {now for now, _ in predictions} == set(map(float, range(6)))
    assert dict(predictions)[5.0] < 1.0  # degrees


def test_a_picture_that_cannot_be_used_is_one_frame_of_a_sequence(small_database, tmp_path):
    paths = pictures_of_a_turn(open_database(small_database), tmp_path, 11)
    Image.fromarray(np.zeros((300, 512), dtype=np.uint16)).save(paths[8])
    paths[9].write_bytes(b"no picture")
    matcher = Matcher.open(small_database)
    items = list(identify_files(paths, matcher, local=LocalInputs(track=True), workers=0))
    assert [item.error is not None for item in items] == [False] * 8 + [True] * 2 + [False]
    assert items[10].answers[0].result.origin == "tracking"


def test_the_spots_of_pictures_are_put_together(small_database, tmp_path, monkeypatch):
    """Those of the first measurement, whatever further attempts find."""
    generator, seen = np.random.default_rng(6), []
    place_px = generator.uniform(30.0, 480.0, (12, 2))
    mag = generator.uniform(3.0, 5.0, 12)
    for number in range(3):
        light = render_image(place_px, mag, (512, 512), Optics(), number)
        write_image(tmp_path / f"{number}.fits", light)
    record = Tracker.record

    def noted(self, *found, **beside):
        record(self, *found, **beside)
        seen.append(self._composite.seen.tolist())

    monkeypatch.setattr(Tracker, "record", noted)
    paths = sorted(tmp_path.glob("*.fits"))
    matcher = Matcher.open(small_database)
    items = list(identify_files(paths, matcher, local=LocalInputs(track=True), workers=0))
    assert [item.answers[0].result.status for item in items] == ["no_match"] * 3
    assert seen == [[1] * 12, [2] * 12, [3] * 12]


def test_a_folder_is_read_by_calibrate_and_read_frames(small_database, tmp_path, monkeypatch):
    database = open_database(small_database)
    (tmp_path / "night").mkdir()
    u, camera, noise = database.directions, database.camera, Noise(0.2)
    for number, frame in enumerate(simulate_frames(u, camera, 4, noise, 1, mag=database.mag)):
        write_simulated(tmp_path / "night" / f"{number}.csv", frame, database.camera, number)
    assert [frame.name for frame in read_frames(tmp_path / "night")] == ["0", "1", "2", "3"]
    monkeypatch.chdir(tmp_path)
    assert calibrate(small_database, "night").n_identified == 4
