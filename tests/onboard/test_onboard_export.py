"""Onboard images by the command line: export, inspect, verify."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from frames import needs_c
from PIL import Image

from starcat.cli import exchange
from starcat.database.onboard import flight_limits
from starcat.database.onboard.flight_limits import FLIGHT_CENTROIDS, FLIGHT_STARS, FLIGHT_STEPS
from starcat.database.onboard.image import Contents, make_image
from starcat.database.onboard.layout import DIRECTION_SCALE
from starcat.database.onboard.reading import read_onboard_image
from starcat.database.reader import open_database_folder
from starcat.matcher.c_engine import CEngine
from starcat.matcher.database import open_database, open_image
from starcat.pipeline.simulation import in_flight
from starcat.pipeline.simulation.simulate import simulate
from starcat.ship.exchange.onboard import contents_of, export_image


@pytest.fixture(scope="module")
def path(small_database, tmp_path_factory) -> Path:
    """The image of the small database."""
    path = tmp_path_factory.mktemp("image") / "db.img"
    export_image(small_database, "onboard", path)
    return path


@pytest.mark.parametrize("method", ["triangle", "pyramid"])
def test_an_exported_image_is_the_databases_and_is_found_sound(
    method, small_database, tmp_path, starcat
):
    path = tmp_path / "db.img"
    command = ["export", small_database, "--to", "onboard", "--method", method, "-o", path]
    ran = starcat([*command, "--json"])
    assert ran.code == 0, ran.err
    said = json.loads(ran.out)
    image = read_onboard_image(path)
    assert said["files"] == [str(path)]
    assert said["image_bytes"] == path.stat().st_size
    assert (said["stars"], said["features"]) == (len(image.star_id), len(image.features))
    assert said["stars"] == said["stars_in_database"]
    assert (said["method"], said["endian"], said["stars_per_field"]) == (method, "little", None)
    verified = starcat(["verify", path, "--against", small_database])
    assert (verified.code, verified.err) == (0, "")
    assert re.search(r"db\.img: sound \(13 checks\)", verified.out)
    assert (
        path.read_bytes()
        == make_image(contents_of(open_database_folder(small_database), method)).data
    )


def test_the_matcher_can_make_the_same_image_from_its_database(small_database, path):
    database = open_database(small_database, ("triangles",))
    rows = [database.products["triangles"][name] for name in "ijk"]
    same = ("name", "epoch_jyear", "camera", "star_id", "directions", "mag")
    contents = Contents(
        **{name: getattr(database, name) for name in same},
        method="triangle",
        features=np.stack(rows, axis=-1),
        manifest_sha256=bytes.fromhex(read_onboard_image(path).manifest_sha256),
    )
    made = make_image(contents)
    assert made.data == path.read_bytes()
    assert (database.star_id[made.star_rows] == read_onboard_image(path).star_id).all()


def test_the_same_database_gives_the_same_bytes_under_its_own_name(
    small_database, tmp_path, starcat, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    command = ["export", small_database, "--to", "onboard"]
    assert starcat(command).code == 0
    path = tmp_path / "small-1.0.0.img"
    first = path.read_bytes()
    assert starcat(command).code == 0
    assert path.read_bytes() == first
    refused = starcat([*command, "--endian", "big"])
    assert (refused.code, path.read_bytes()) == (1, first)
    assert "already exists and differs" in refused.err
    assert starcat([*command, "--endian", "big", "--replace"]).code == 0
    assert read_onboard_image(path).byte_order == "big"
    assert [path.name for path in tmp_path.iterdir()] == ["small-1.0.0.img"]
    big = starcat(["verify", path, "--against", small_database])
    assert big.code == 0, big.out


def test_an_image_that_has_to_fit_says_what_was_left_out(small_database, tmp_path, starcat):
    path = tmp_path / "db.img"
    command = ["export", small_database, "--to", "onboard", "-o", path, "--replace"]
    whole = json.loads(starcat([*command, "--json"]).out)
    ran = starcat([*command, "--max-bytes", str(whole["image_bytes"] - 1)])
    assert re.fullmatch(r"[\d,]+ triangles are left out, to fit\n", ran.err)
    fewer = starcat([*command, "--json", "--max-bytes", str(whole["image_bytes"] // 4)])
    said = json.loads(fewer.out)
    assert said["image_bytes"] <= whole["image_bytes"] // 4
    assert said["features_without_limit"] == whole["features"]
    assert said["stars"] < whole["stars"]
    assert f"not among the {said['stars_per_field']} brightest of a field" in fewer.err
    assert starcat(["verify", path, "--against", small_database]).code == 0


@needs_c
def test_an_image_of_the_small_profile_says_what_it_takes_and_identifies(
    small_database, tmp_path, starcat
):
    path = tmp_path / "db.img"
    command = ["export", small_database, "--to", "onboard", "-o", path]
    ran = starcat([*command, "--profile", "small"])
    assert "by the profile small: they are not among the 10 brightest of a field" in ran.err
    said = json.loads(starcat([*command, "--profile", "small", "--json"]).out)
    assert (said["profile"], said["method"]) == ("small", "pyramid")
    assert said["image_bytes"] == path.stat().st_size
    assert starcat(["verify", path, "--against", small_database]).code == 0
    engine = CEngine(open_image(path), path.read_bytes())
    engine.list_neighbours()
    table = engine.image.neighbours
    listed = table.first[table.n_stars]
    assert said["voting_bytes"] == 4 * (listed + table.n_stars + 1)
    assert re.search(rf"voting bytes +{said['voting_bytes']:,}", ran.out)
    ways = [(one["kind"], one["votes"]) for one in said["rates"]]
    assert ways == [("clean", False), ("hard", False), ("clean", True), ("hard", True)]
    for one in said["rates"]:
        assert (one["frames"], one["wrong"]) == (200, 0)
        assert one["identified"] >= (0.9 if one["kind"] == "hard" else 0.97) * one["frames"]
        assert 0 < one["mean_steps"] <= one["most_steps"] <= FLIGHT_STEPS
        assert f"{one['most_steps']:,}" in ran.out


@needs_c
def test_without_a_profile_nothing_is_measured_and_the_full_one_has_the_same_bytes(
    small_database, path, tmp_path, starcat, monkeypatch
):
    full = tmp_path / "full.img"
    command = ["export", small_database, "--to", "onboard", "--json", "-o"]
    said = json.loads(starcat([*command, full, "--profile", "full"]).out)
    assert full.read_bytes() == path.read_bytes()
    assert {one["identified"] for one in said["rates"] if one["kind"] == "clean"} == {200}
    assert "rates" not in json.loads(starcat([*command, tmp_path / "bare.img"]).out)
    monkeypatch.setattr(in_flight, "FLIGHT_STARS", 3)  # an image that flight refuses has none
    made = export_image(small_database, "onboard", tmp_path / "small.img", profile="small")
    assert made.rates == ()


def test_inspect_says_what_an_image_holds_within_100_columns(starcat, path):
    image, ran = read_onboard_image(path), starcat(["inspect", path])
    assert ran.code == 0
    assert max(map(len, ran.out.splitlines())) <= 100
    numbers = [f"{n:,}" for n in (len(image.features), image.sections["radii"].nbytes)]
    words = ["small-1.0.0", "1.0", "little", "2026 Julian year", "512 x 512 px, 40 x 40 deg"]
    for text in (*words, image.manifest_sha256, *numbers):
        assert text in ran.out
    said = json.loads(starcat(["inspect", path, "--json"]).out)
    assert said["name"] == "small-1.0.0"
    assert said["header"]["n_stars"] == len(image.star_id)
    rows = len(image.features)
    assert said["sections"]["radii"] == {"rows": rows, "bytes": 2 * rows}


def test_verify_names_another_database_and_damaged_blocks(
    database_version, starcat, path, tmp_path
):
    ran = starcat(["verify", path, "--against", database_version("1.0.1"), "--json"])
    assert ran.code == 5
    problems = [finding["problem"] for finding in json.loads(ran.out)["findings"]]
    assert len(problems) == 2
    assert problems[0].startswith("the sha256 of its manifest begins with ")
    assert problems[1] == "name is small-1.0.0; the database says small-1.0.1"
    assert starcat(["verify", path]).code == 0
    data = bytearray(path.read_bytes())
    data[5 * 4096 + 7] ^= 1
    data[9 * 4096] ^= 128
    (tmp_path / "db.img").write_bytes(data)
    ran = starcat(["verify", tmp_path / "db.img", "--json"])
    assert ran.code == 5
    assert [finding["problem"] for finding in json.loads(ran.out)["findings"]] == [
        "block 5: damaged (bytes 20480 to 24575)",
        "block 9: damaged (bytes 36864 to 40959)",
    ]


def test_c_source_is_written_with_its_header(small_database, tmp_path, starcat, path):
    source = tmp_path / "flight" / "db.c"
    ran = starcat(["export", small_database, "--to", "c", "-o", source, "--json"])
    assert ran.code == 0, ran.err
    header = source.with_suffix(".h")
    assert json.loads(ran.out)["files"] == [str(source), str(header)]
    assert "extern const uint64_t starcat_small_1_0_0[" in header.read_text()
    words = re.findall(r"0x([0-9A-F]{16})u", source.read_text())
    assert b"".join(bytes.fromhex(word)[::-1] for word in words) == path.read_bytes()
    header.write_text("mine")
    refused = starcat(["export", small_database, "--to", "c", "-o", source])
    assert refused.code == 1
    assert header.read_text() == "mine"


def test_the_limits_in_flight_are_those_of_the_header():
    header = (Path(__file__).parents[2] / "onboard" / "include" / "starcat.h").read_text()
    for name, limit in (("STARS", FLIGHT_STARS), ("CENTROIDS", FLIGHT_CENTROIDS)):
        assert re.findall(rf"#define STARCAT_MAX_{name} (\d+)", header) == [str(limit)]
    source = (Path(__file__).parents[2] / "onboard" / "src" / "frame.c").read_text()
    assert re.findall(r"max_steps = (\d+)u;", source) == [str(FLIGHT_STEPS)]


def test_a_field_that_the_library_has_no_room_for_is_reported(
    small_database, tmp_path, starcat, monkeypatch
):
    command = ["export", small_database, "--to", "onboard", "-o", tmp_path / "db.img"]
    assert starcat(command).err == ""
    near = read_onboard_image(tmp_path / "db.img").header["most_near"]
    monkeypatch.setattr(flight_limits, "FLIGHT_STARS", near - 1)
    assert f"-DSTARCAT_MAX_STARS={near}" in starcat(command).err
    monkeypatch.setattr(exchange, "FLIGHT_CENTROIDS", near - 1)
    ran = starcat(command)
    assert f"-DSTARCAT_MAX_CENTROIDS={near}" in ran.err
    assert f"at most {near - 1} centroids: give the brightest" in ran.out


@needs_c
def test_a_frame_that_flight_refuses_is_reported(small_database, path, tmp_path, starcat):
    """The ground identifies it; the library in flight, with other limits, returns status -10."""
    # Several frames in one file, one of them crowded, as its sky shows fainter stars as well.
    [frame] = simulate(small_database, seed=7)
    generator = np.random.default_rng(3)
    crowd = generator.uniform((0.0, 0.0), (1024.0, 1024.0), (80, 2))
    count = FLIGHT_CENTROIDS + 1
    crowded = np.concatenate([frame.centroids_px, crowd])[:count].tolist()
    advice = f"-DSTARCAT_MAX_CENTROIDS={count}"
    one, two = tmp_path / "one.json", tmp_path / "two.json"
    one.write_text(json.dumps({"frames": [{"centroids_px": crowded}]}))
    calm = {"centroids_px": crowded[:FLIGHT_CENTROIDS]}
    two.write_text(json.dumps({"frames": [calm, {"centroids_px": crowded}]}))
    ran = starcat(["identify", path, one])
    assert re.search(rf"remark.*{count} centroids", ran.out)
    [answer] = json.loads(starcat(["identify", path, one, "--json"]).out)
    assert advice in " ".join(answer["remarks"])
    # A picture is of the ground: no picture is searched in flight.
    image = np.zeros((512, 512), dtype=np.uint8)
    for x, y in generator.integers(2, 508, (2 * count, 2)):
        image[y - 1 : y + 2, x - 1 : x + 2] = [[60, 120, 60], [120, 250, 120], [60, 120, 60]]
    Image.fromarray(image).save(tmp_path / "one.png")
    [answer] = json.loads(starcat(["identify", path, tmp_path / "one.png", "--json"]).out)
    assert len(answer["stars"]) > FLIGHT_CENTROIDS
    assert "STARCAT_MAX_CENTROIDS" not in " ".join(answer["remarks"])
    ran = starcat(["identify", path, two])
    assert f"1 of 2 frames have more than {FLIGHT_CENTROIDS} centroids" in ran.err
    assert advice in ran.err
    # The folder of a database does not matter in flight.
    ran = starcat(["identify", small_database, one])
    assert "STARCAT_MAX_CENTROIDS" not in ran.out + ran.err


def test_formats_have_their_old_spelling(small_database, tmp_path, starcat):
    command = ["export", small_database, "--product", "stars"]
    for option in ("--to", "--format"):
        assert starcat([*command, option, "json", "-o", tmp_path / option[2:]]).code == 0
    stars = [(tmp_path / name / "stars.json").read_bytes() for name in ("to", "format")]
    assert stars[0] == stars[1]


def test_the_quantum_that_the_page_states_is_that_of_the_directions():
    page = (Path(__file__).parents[2] / "docs" / "onboard-format.md").read_text(encoding="utf-8")
    assert "| directions | 2^-31 | 0.00005 arcsec on each axis |" in page
    assert round(float(np.degrees(0.5 / DIRECTION_SCALE)) * 3600.0, 5) == 0.00005
