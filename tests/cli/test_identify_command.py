"""``starcat identify`` in a pipeline: streams, exit codes, and copies with world coordinates."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits as fits_file
from astropy.wcs import WCS

from starcat.matcher.matcher import Matcher

Run = Callable[[list[Any]], Any]


@pytest.fixture
def frame(starcat: Run, small_database: Path, tmp_path: Path) -> Path:
    path = tmp_path / "frame.csv"
    assert starcat(["simulate", small_database, "-o", path, "--seed", "7"]).code == 0
    return path


def test_answers_come_line_by_line_from_a_stream(
    starcat, frame, small_database, monkeypatch, capsys
):
    rows = [line.split(",") for line in frame.read_text().splitlines()[1:]]
    pixels = [[float(x), float(y)] for x, y, _ in rows]
    asked = [{"name": "a", "centroids_px": pixels}, {"centroids_px": pixels[:2]}]
    before: list[str] = []

    def lines() -> Iterator[str]:
        for content in asked:
            before.append(capsys.readouterr().out)
            yield json.dumps(content) + "\n"

    monkeypatch.setattr("sys.stdin", lines())
    run = starcat(["identify", small_database, "-", "--ndjson"])
    # The first answer was there before the second frame was asked for.
    assert [text.count("\n") for text in before] == [0, 1]
    first, second = json.loads(before[1]), json.loads(run.out)
    assert (first["frame"], first["status"]) == ("a", "identified")
    assert (second["frame"], second["status"]) == ("stdin 2", "too_few_stars")
    assert second["refusal"]["reason"] == "too_few_stars"


def test_a_broken_line_of_a_stream_ends_it_after_the_answers_before_it(
    starcat, small_database, monkeypatch
):
    text = '{"centroids_px": [[1, 2]]}\n\n{"centroids_px": [[1'
    monkeypatch.setattr("sys.stdin", StringIO(text))
    run = starcat(["identify", small_database, "-", "--ndjson"])
    assert run.code == 2
    assert json.loads(run.out)["frame"] == "stdin 1"
    assert json.loads(run.err)["error"]["message"].startswith("stdin 3: not JSON")


@pytest.mark.parametrize("form", ["csv", "json", "one line of json"])
def test_centroids_come_from_stdin(starcat, frame, small_database, monkeypatch, form):
    text = frame.read_text()
    if form != "csv":
        rows = [[float(value) for value in line.split(",")] for line in text.splitlines()[1:]]
        content = {"centroids_px": [[x, y] for x, y, _ in rows], "mag": [mag for *_, mag in rows]}
        text = json.dumps({"frames": [content]}, indent=None if "line" in form else 1)
    monkeypatch.setattr("sys.stdin", StringIO(text))
    [found] = json.loads(starcat(["identify", small_database, "-", "--json"]).out)
    [expected] = json.loads(starcat(["identify", small_database, frame, "--json"]).out)
    assert found["stars"] == expected["stars"]
    assert found["frame"].startswith("stdin")


def test_a_script_sees_that_a_frame_was_not_identified(starcat, frame, small_database, tmp_path):
    few = tmp_path / "few.csv"
    few.write_text("x_px,y_px\n1,2\n")
    run = starcat(["identify", small_database, few])
    assert run.code == 0
    assert re.search(r"message +fewer than 4 centroids", run.out)
    assert re.search(r"hint +find more stars", run.out)
    assert all(len(line) <= 100 for line in run.out.splitlines())
    assert starcat(["identify", small_database, frame, "--fail-on-no-match"]).code == 0
    for form in ("--json", "--ndjson"):
        run = starcat(["identify", small_database, few, "--fail-on-no-match", form])
        assert run.code == 6
        assert "too_few_stars" in run.out
        error = json.loads(run.err)["error"]
        assert error["message"].startswith("1 of 1 frames not identified (few: too_few_stars)")
    few.write_text("x_px,y_px,colour\n1,2,3\n")
    run = starcat(["identify", small_database, few])
    assert "not used: colour; used are x_px, y_px" in " ".join(run.out.split())
    [found] = json.loads(starcat(["identify", small_database, few, "--json"]).out)
    assert found["remarks"][0].startswith("not used: colour;")
    run = starcat(["identify", small_database, few, frame, few.with_name("few.csv")])
    assert "not used: colour; used are x_px, y_px" in run.err
    assert "(1 of 2 frames)" in run.err


def changed(frame: Path, places: Callable[[Any], Any]) -> Path:
    """Return a copy of a frame with other places of its centroids."""
    rows = np.loadtxt(frame, delimiter=",", skiprows=1)
    rows[:, :2] = places(rows[:, :2])
    path = frame.with_name("changed.csv")
    np.savetxt(path, rows, delimiter=",", header="x_px,y_px,mag", comments="")
    return path


def test_a_lens_a_little_off_its_data_sheet_is_identified_from_centroids_and_pictures(
    starcat, frame, small_database
):
    longer = changed(frame, lambda px: 256.0 + 1.02 * (px - 256.0))
    [found] = json.loads(starcat(["identify", small_database, longer, "--json"]).out)
    [plain] = json.loads(starcat(["identify", small_database, frame, "--json"]).out)
    assert found["status"] == "identified"
    assert found["focal_length_px"] == pytest.approx(1.02 * plain["focal_length_px"], rel=1e-3)
    # A scale is part of the shape of every frame.
    [strict] = json.loads(
        starcat(["identify", small_database, longer, "--fov-error", "0", "--json"]).out
    )
    assert strict["focal_length_px"] == pytest.approx(found["focal_length_px"], rel=1e-3)


def test_a_lens_far_off_its_data_sheet_gets_the_advice_to_state_its_field(
    starcat, frame, small_database
):
    longer = changed(frame, lambda px: 256.0 + 1.15 * (px - 256.0))
    strict = starcat(["identify", small_database, longer, "--fov-error", "0"])
    printed = " ".join(strict.out.split())
    assert "fits a field of 35.1" in printed
    assert "(--fov 35.12)" in printed


@pytest.mark.parametrize(
    "places",
    [lambda px: px * [1, -1] + [0, 512], lambda px: px * [-1, 1] + [512, 0]],
    ids=["y upwards", "x to the left"],
)
def test_a_mirrored_frame_gets_no_answer_but_the_advice_to_flip_it(
    starcat, frame, small_database, places
):
    other = changed(frame, places)
    [found] = json.loads(starcat(["identify", small_database, other, "--json"]).out)
    assert (found["status"], found["refusal"]["reason"]) == ("no_match", "mirrored")
    assert "matches only mirrored" in found["refusal"]["message"]
    assert all(star["star"] is None for star in found["stars"])
    assert "q_body_from_icrs" not in found
    printed = " ".join(starcat(["identify", small_database, other]).out.split())
    assert "matches only mirrored" in printed
    assert "(--flip)" in printed
    [found] = json.loads(starcat(["identify", small_database, other, "--flip", "--json"]).out)
    assert found["status"] == "identified"


def test_a_frame_flipped_by_mistake_gets_the_advice_to_leave_flip_out(
    starcat, frame, small_database
):
    printed = " ".join(starcat(["identify", small_database, frame, "--flip"]).out.split())
    assert "no_match" in printed
    assert "it was turned over, and was upright before" in printed
    assert "leave this option out (--flip)" in printed


def test_pixels_counted_from_the_centre_are_reported(starcat, frame, small_database):
    centred = changed(frame, lambda px: px - 256.0)
    [found] = json.loads(starcat(["identify", small_database, centred, "--json"]).out)
    outside = sum(star.get("dropped") == "out_of_frame" for star in found["stars"])
    assert outside > len(found["stars"]) / 3
    assert found["remarks"][0].startswith(f"{outside} of {len(found['stars'])} centroids lie out")
    assert "count from the centre of the frame; add 256 to x and 256 to y" in found["remarks"][0]
    matcher = Matcher.open(small_database)
    rows = np.loadtxt(centred, delimiter=",", skiprows=1)
    answer = matcher.identify(rows[:, :2])
    assert f"centroids ({outside} dropped)" in repr(answer)
    assert answer.remarks[0] == found["remarks"][0]
    run = starcat(["identify", small_database, centred, frame, few := centred.with_name("c.csv")])
    assert f"{few.name}: no such file" in run.err
    assert f"{centred.stem}: {outside} of" in run.err


def worst_arcsec(
    header: fits_file.Header, answer: dict[str, Any], *, bottom_up: bool = False
) -> float:
    """Distances between spots and their stars by the WCS, against the residuals of the answer."""
    stars = [star for star in answer["stars"] if star["star"]]
    assert len(stars) > 10
    x, y, ra, dec, said = (
        np.array([star[name] for star in stars])
        for name in ("x_px", "y_px", "ra_deg", "dec_deg", "separation_arcsec")
    )
    y = header["NAXIS2"] - y if bottom_up else y
    place = WCS(header).pixel_to_world(x - 0.5, y - 0.5)
    return float(np.abs(place.separation(SkyCoord(ra, dec, unit="deg")).arcsec - said).max())


@pytest.mark.parametrize("said_by", [None, "the file", "--flip"], ids=str)
def test_the_wcs_goes_into_a_copy_of_a_fits_file(starcat, small_database, tmp_path, said_by):
    image, copy = tmp_path / "frame.fits", tmp_path / "copy.fits"
    assert starcat(["simulate", small_database, "-o", image, "--seed", "7"]).code == 0
    with fits_file.open(image, mode="update") as parts:
        parts[0].header["OBJECT"] = "a field"
        parts[0].header["CRVAL1"] = 12.0
        parts[0].header["CROTA2"] = 77.0
        if said_by:
            parts[0].data = parts[0].data[::-1]
            del parts[0].header["ROWORDER"]
        if said_by == "the file":
            parts[0].header["ROWORDER"] = "BOTTOM-UP"
    more = ["--flip"] if said_by == "--flip" else []
    run = starcat(["identify", small_database, image, "--json", "--wcs", copy, *more])
    assert run.code == 0
    [answer] = json.loads(run.out)
    with fits_file.open(copy) as parts, fits_file.open(image) as before:
        header = parts[0].header
        assert np.array_equal(parts[0].data, before[0].data)
        assert header["BITPIX"] == before[0].header["BITPIX"]
        assert header["OBJECT"] == "a field"
        assert "CROTA2" not in header
        assert "MJDREF" not in header
        assert worst_arcsec(header, answer, bottom_up=bool(said_by)) < 1e-3


def test_all_parts_of_a_compressed_fits_file_are_in_the_copy(starcat, small_database, tmp_path):
    image, packed, copy = (tmp_path / name for name in ("frame.fits", "frame.fits.fz", "copy.fits"))
    assert starcat(["simulate", small_database, "-o", image, "--seed", "7"]).code == 0
    values = fits_file.getdata(image)
    table = fits_file.BinTableHDU.from_columns([fits_file.Column("A", "J", array=[1, 2])])
    parts = [fits_file.PrimaryHDU(), fits_file.CompImageHDU(values), table]
    fits_file.HDUList(parts).writeto(packed)
    run = starcat(["identify", small_database, packed, "--json", "--wcs", copy])
    [answer] = json.loads(run.out)
    with fits_file.open(copy) as copied:
        assert [type(part) for part in copied] == [type(part) for part in parts]
        assert np.array_equal(copied[1].data, values)
        assert worst_arcsec(copied[1].header, answer) < 1e-3


def test_the_wcs_of_a_png_goes_into_a_new_fits_file(starcat, small_database, tmp_path):
    image, copy = tmp_path / "frame.png", tmp_path / "copy.fits"
    camera = tmp_path / "camera.toml"
    camera.write_text(
        "width_px = 512\nheight_px = 512\nfov_x_deg = 40.0\n[distortion]\nk1 = 0.01\n"
    )
    assert starcat(["simulate", small_database, "-o", image, "--seed", "7"]).code == 0
    call = ["identify", small_database, image, "--json", "--wcs", copy, "--camera", camera]
    [answer] = json.loads(starcat(call).out)
    with fits_file.open(copy) as parts:
        assert parts[0].header["ROWORDER"] == "TOP-DOWN"
        assert parts[0].header["CTYPE1"] == "RA---TAN-SIP"
        # A hundredth of a pixel.
        assert worst_arcsec(parts[0].header, answer) < 2.8
    first = copy.read_bytes()
    assert starcat(call).code == 0
    assert copy.read_bytes() == first
