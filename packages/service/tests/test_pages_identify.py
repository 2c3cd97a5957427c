"""The pages *Identify* and *Plan*: their inputs, their answers, and their refusals."""

from __future__ import annotations

import base64
import csv
import html
import io
import json
import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.wcs import WCS
from fastapi.testclient import TestClient
from hypothesis import given
from hypothesis import strategies as st
from services import DATABASE

import starcat
from starcat.errors import ConfigError
from starcat.geometry.attitude import quaternion_from_matrix
from starcat.matcher.centroids import read_centroid_files
from starcat.matcher.database import open_database
from starcat.matcher.options import OPTIONS
from starcat.pipeline.simulation.simulate import Noise, simulate_frames
from starcat_service.pages.answers import link_of, shown_frames
from starcat_service.pages.identify import NOISE_PX, centroid_file
from starcat_service.pages.wording import OPTION_FIELDS

SEED = 7


@pytest.fixture(scope="module")
def simulated(small_database: Path):
    """The frame that the page simulates, with its truth."""
    stars = open_database(small_database)
    noise = Noise(NOISE_PX)
    return next(simulate_frames(stars.directions, stars.camera, 1, noise, SEED, mag=stars.mag))


def quaternion_in(page: str) -> np.ndarray:
    [text] = re.findall(r"<code>\[([-0-9., e]+)\]</code>", page)
    return np.array([float(component) for component in text.split(",")])


def asked(client: TestClient, files: dict | None = None, **fields: str | int):
    return client.post("/identify", data={"database": DATABASE, **fields}, files=files)


def error_rad(page: str, matrix: np.ndarray) -> float:
    """The angle between the attitude of a page and the true one."""
    true = quaternion_from_matrix(matrix)
    return float(2.0 * np.arccos(np.clip(abs(true @ quaternion_in(page)), 0.0, 1.0)))


@pytest.mark.slow
def test_a_simulated_frame_is_drawn_measured_and_identified(client, simulated):
    answer = asked(client, seed=SEED)
    assert answer.status_code == 200
    assert ">identified<" in answer.text
    assert error_rad(answer.text, simulated.matrix) < 2e-3
    [picture] = re.findall(r'<img src="data:image/svg[+]xml;base64,([^"]+)"', answer.text)
    assert answer.text.count(picture) == 1  # it is most of the page
    drawn = ElementTree.fromstring(base64.b64decode(picture))
    x, top, *size = map(float, drawn.get("viewBox").split())
    assert min(x, top) > 40  # without the margins
    assert size == pytest.approx([float(drawn.get(name)[:-2]) for name in ("width", "height")])
    assert max(size) == pytest.approx(9 * 72)
    assert "SAO" in answer.text
    assert answer.text.count('<th scope="row"') >= 4
    assert f'name="seed" value="{SEED + 1}"' in answer.text


def test_centroids_are_pasted(client, simulated):
    lines = [
        f"{x:.3f};\t{y:.3f};\t{10 ** (-0.4 * mag):.6g}"
        for (x, y), mag in zip(simulated.centroids_px.tolist(), simulated.mag, strict=True)
    ]
    answer = asked(client, centroids="\r\n".join(lines), brightness="light")
    assert answer.status_code == 200
    assert error_rad(answer.text, simulated.matrix) < 2e-3


def pasted(frame, *, is_up: bool = False, scale: float = 1.0, height: float = 512.0) -> str:
    """The centroids of a frame, with magnitudes, as a user pastes them."""
    x, y = (frame.centroids_px * scale).T
    rows = zip(x, height * scale - y if is_up else y, frame.mag, strict=True)
    return "\n".join(f"{x_px:.4f} {y_px:.4f} {mag:.3f}" for x_px, y_px, mag in rows)


def test_a_frame_of_another_camera_is_identified(client, simulated):
    twice = {"centroids": pasted(simulated, scale=2.0), "brightness": "mag"}
    assert "not identified" in asked(client, **twice).text
    by_field = {"camera.width_px": 1024, "camera.height_px": 1024, "camera.fov_x_deg": 40}
    by_lens = {"lens": "focal", "camera.focal_length_mm": 14.0671, "camera.pixel_um": 10.0}
    size = dict.fromkeys(("camera.width_px", "camera.height_px"), 1024)
    text = {"camera_file": "width_px = 1024\nheight_px = 1024\nfov_x_deg = 40.0"}
    for camera in (by_field, {**size, **by_lens}, text):
        answer = asked(client, **twice, **camera)
        assert error_rad(answer.text, simulated.matrix) < 2e-3, camera
    assert 'id="other-camera"' in answer.text
    wrong = asked(client, **twice, **{"camera.width_px": "-4"})
    assert wrong.status_code == 422
    assert re.search(r'id="camera.width_px"[^>]*aria-invalid="true"', wrong.text)


def test_a_mirrored_frame_is_identified_where_that_is_said(client, simulated):
    up = {"centroids": pasted(simulated, is_up=True), "brightness": "mag"}
    refused = asked(client, **up).text
    assert ">identified<" not in refused
    [remedy] = re.findall(r'href="([^"]+)">Identify it so', refused)
    answer = client.get(html.unescape(remedy))
    assert error_rad(answer.text, simulated.matrix) < 2e-3
    answer = asked(client, **up, **{"camera.flip": "on"})
    assert error_rad(answer.text, simulated.matrix) < 2e-3


def test_a_scale_that_is_off_is_found_within_what_is_stated(client, simulated):
    wide = {"centroids": pasted(simulated), "brightness": "mag", "camera.fov_x_deg": "41.5"}
    answer = asked(client, **wide, field_error="6")
    assert error_rad(answer.text, simulated.matrix) < 2e-3
    by_range = asked(client, **wide, fov_from="30", fov_to="50")
    assert by_range.status_code == 422  # of a database that serves one field
    assert "no product &#39;levels&#39;" in by_range.text
    off = {**wide, "camera.fov_x_deg": "44"}  # by more than is allowed where nothing is said
    refused = asked(client, **off).text
    [remedy] = re.findall(r'href="([^"]+)">Identify it so', refused)
    assert error_rad(client.get(html.unescape(remedy)).text, simulated.matrix) < 2e-3
    half = asked(client, **wide, fov_from="30")
    assert half.status_code == 422
    assert "both ends" in half.text


def test_a_time_gives_the_attitude_without_aberration(client, simulated):
    frame = {"centroids": pasted(simulated), "brightness": "mag"}
    answer = asked(client, **frame, time="2026-11-22T10:00:00")
    assert "Without aberration" in answer.text
    [off] = re.findall(r"attitude, ([0-9.]+) arcsec", answer.text)
    assert 0.0 < float(off) < 26.0
    wrong = asked(client, **frame, time="yesterday")
    assert wrong.status_code == 422
    assert "expected date and time in UTC" in wrong.text


def files_of(page: str) -> dict[str, bytes]:
    """The files that an answer offers, by the end of their names."""
    links = re.findall(r'href="data:([^"]*);base64,([^"]*)" download="[^"]*-?answer\.?(\w*)"', page)
    files = {kind: base64.b64decode(content) for _, content, kind in links}
    [wcs] = re.findall(r'href="data:application/fits;base64,([^"]*)"', page)
    return {**files, "fits": base64.b64decode(wcs)}


def test_an_answer_is_saved_as_json_csv_and_wcs(client, simulated):
    page = asked(client, seed=SEED).text
    files = files_of(page)
    [frame] = json.loads(files["json"])
    assert frame["q_body_from_icrs"] == pytest.approx(quaternion_in(page), abs=1e-8)
    rows = list(csv.DictReader(files["csv"].decode().splitlines()))
    assert len(rows) == len(frame["stars"])
    assert {row["star"] for row in rows if row["star"]} == {
        star["star"] for star in frame["stars"] if star["star"]
    }
    with fits.open(io.BytesIO(files["fits"])) as parts:
        header, data = parts[0].header, parts[0].data
    assert data.size == 0
    matched = [star for star in frame["stars"] if star["star"]]
    pixels = np.array([[star["x_px"], star["y_px"]] for star in matched]) - 0.5
    sky = WCS(header).pixel_to_world(*pixels.T)
    off = sky.separation(SkyCoord([star["ra_deg"] for star in matched],
                                  [star["dec_deg"] for star in matched], unit="deg"))  # fmt: skip
    assert off.arcsec.max() < 1.5 * 512  # a centroid is off by a pixel or so, of 281 arcsec
    assert (header["IMAGEW"], header["IMAGEH"]) == (512, 512)


@pytest.mark.slow
def test_a_link_keeps_an_answer(client, simulated):
    frame = client.get(f"/identify/frame/{DATABASE}?seed={SEED}").content
    page = asked(client, {"file": ("frame.png", frame)}, tolerance_px="3").text
    [link] = re.findall(r'href="(/identify[?][^"]+)">Link to this answer', page)
    again = client.get(html.unescape(link))
    assert again.status_code == 200
    assert error_rad(again.text, simulated.matrix) < 2e-3
    assert np.allclose(quaternion_in(again.text), quaternion_in(page), atol=1e-5)
    assert 'name="tolerance_px" type="text" value="3"' in again.text
    [seeded] = re.findall(r'href="(/identify[?][^"]+)">Link', asked(client, seed=SEED).text)
    assert f"seed={SEED}" in seeded
    many = {"centroids_px": [[123.456, 234.567]] * 900}
    assert link_of(many, {"database": DATABASE}) == ""  # an address has its limits
    assert "centroids" not in seeded


def test_many_pictures_are_identified_at_once(client):
    frames = [
        ("file", (f"f{k}.png", client.get(f"/identify/frame/{DATABASE}?seed={k}").content))
        for k in (SEED, SEED + 1)
    ]
    page = client.post(
        "/identify",
        data={"database": DATABASE},
        files=[("file", ("broken.png", b"no picture")), *frames],
    ).text
    assert "2 of 3 frames identified" in page
    assert re.search(r">broken.png</th><td>[^<]{20}", page)
    assert len(json.loads(files_of(page)["json"])) == 2
    assert len(re.findall(r'<th scope="row"><a href="/identify[?]', page)) == 2


def test_the_table_has_the_names_of_the_picture():
    content = {
        "frame": "f",
        "status": "identified",
        "stars": [
            {"x_px": 1.0, "y_px": 2.0, "star": star, "mag": mag, "ra_deg": ra, "dec_deg": dec}
            for star, mag, ra, dec in (
                ("Gaia DR3 3043755000000000000", 0.3, 114.8219, 5.2185),
                ("Gaia DR3 1234567890123456789", 9.9, 20.0, 20.0),
            )
        ]
        + [{"x_px": 3.0, "y_px": 4.0, "star": None, "mag": None}],
    }
    answer = {"frames": [content], "more": [{"mag": None, "wcs": None}],
             "notes": [], "method": "triangle"}  # fmt: skip
    [frame] = shown_frames(answer, {"database": DATABASE}, 2016.0)
    assert [star["name"] for star in frame.stars] == ["Procyon", "Gaia …23456789"]


def test_a_refusal_has_the_words_of_the_matcher(client):
    few = asked(client, centroids="10 10\n200 300\n30 400")
    assert few.status_code == 200
    assert "fewer than 4 centroids of the frame are usable" in few.text
    assert "find more stars" in few.text
    none = asked(client, centroids="10 10\n200 300\n30 400\n17 90\n400 22\n350 351")
    assert "not identified" in none.text


def test_what_was_sent_stays_in_the_form_and_large_files_are_refused(client):
    assert "1 2 3\n4 five 6</textarea>" in asked(client, centroids="1 2 3\n4 five 6").text
    large = {"file": ("big.csv", b"x_px,y_px\n" + b"1,2\n" * 600_000)}
    assert asked(client, large).status_code == 413


def test_a_seed_is_the_same_frame_and_no_other(client):
    first, same, other = (
        client.get(f"/identify/frame/{DATABASE}?seed={seed}").content for seed in (1, 1, 2)
    )
    assert first == same != other
    assert client.get(f"/identify/frame/{DATABASE}?seed=-1").status_code == 422
    assert client.get(f"/identify/frame/{'0' * 16}").status_code == 404


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("# only a comment\n\n", "no centroid was pasted"),
        ("1 2\n3", "line 2: '3'; expected two or three numbers"),
        ("1 2\n\n3 4 5", "line 3: 3 numbers, the lines before have 2"),
        ("x y", "line 1: 'x y'"),
        ("1 2\n" * 20_001, "line 20001: more than 20,000 centroids"),
    ],
)
def test_pasted_lines_are_reported_by_their_number(text, words):
    with pytest.raises(ConfigError, match=re.escape(words)):
        centroid_file(text)


def test_pasted_files_are_files_already():
    text = json.dumps({"centroids_px": [[1, 2]]})
    assert centroid_file(f" {text}\n") == (".json", text)
    assert centroid_file("x_px,y_px,mag\n1,2,3") == (".csv", "x_px,y_px,mag\n1,2,3\n")
    assert centroid_file("1 2 3.5", "mag") == (".csv", "x_px,y_px,mag\n1,2,3.5\n")


numbers = st.floats(-1e6, 1e6, allow_nan=False).map(lambda value: round(value, 3))


@given(st.lists(st.tuples(numbers, numbers), min_size=1, max_size=20), st.sampled_from(" ,;\t"))
def test_pasted_numbers_arrive_as_they_are(pairs, separator):
    import tempfile

    suffix, content = centroid_file("\n".join(f"{x}{separator}{y}" for x, y in pairs))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"frame{suffix}"
        path.write_text(content)
        [frame] = read_centroid_files(path)
    assert frame.centroids_px.tolist() == [list(pair) for pair in pairs]
    assert frame.mag is None


def test_the_page_names_every_format_that_it_takes(client):
    page = client.get("/identify").text
    for name in ("FITS", "PNG", "TIFF", "JPEG", "HEIC", "BMP", "CSV", "JSON"):
        assert name in page


# The page Plan.

TABLE = (
    "time,ra_deg,dec_deg,roll_deg\n2027-03-01T06:30:00,83.8,-5.4,0\n2027-03-01T06:31:00,85,-5,0\n"
)
AEM = Path(__file__).parents[3] / "tests" / "data" / "five_attitudes.aem"


def test_attitudes_are_planned_as_in_python(client, small_database, tmp_path):
    angles = {"keep_out.Sun": "179", "noise_px": "0.5"}
    answer = client.post("/plan", data={"database": DATABASE, "attitudes": TABLE, **angles})
    assert answer.status_code == 200, answer.text
    [packed] = re.findall(r'href="data:application/json;base64,([^"]+)"', answer.text)
    plan = json.loads(base64.b64decode(packed))
    (tmp_path / "table.csv").write_text(TABLE)
    expected = starcat.plan(
        small_database, tmp_path / "table.csv", keep_out_deg={"Sun": 179.0}, noise_px=0.5
    )
    assert plan["summary"] == expected.summary
    assert plan["attitudes"] == [expected.attitude(row) for row in range(2)]
    assert plan["first_stars"] == expected.stars_of(0)
    assert "0 of 2 attitudes usable" in answer.text
    assert "2027-03-01T06:31:00Z" in answer.text
    [plot] = re.findall(r'<img src="data:image/svg[+]xml;base64,([^"]+)"', answer.text)
    assert b"<svg" in base64.b64decode(plot)
    uploaded = client.post(
        "/plan", data={"database": DATABASE}, files={"file": ("../a.aem", AEM.read_bytes())}
    )
    assert "of 5 attitudes usable" in uploaded.text


def test_a_table_that_is_too_long_is_refused(client):
    answer = client.post("/plan", data={"database": DATABASE, "attitudes": "x\n" * 20_000})
    assert answer.status_code == 413
    assert "more than 10,000 lines" in answer.text


@pytest.mark.parametrize(
    ("field", "value", "status"),
    [
        *[("tolerance_px", "0.001", 200), ("tolerance_px", "0.0009", 422)],
        *[("tolerance_px", "200", 200), ("tolerance_px", "201", 422)],
        *[("field_error", "50", 200), ("field_error", "51", 422)],
    ],
)
def test_a_number_of_the_form_has_the_range_of_the_option(client, simulated, field, value, status):
    few = "\n".join(pasted(simulated).splitlines()[:3])  # more take long with 200 px
    frame = {"centroids": few, "brightness": "mag"}
    assert asked(client, **frame, **{field: value}).status_code == status


def test_the_hints_of_the_form_are_the_descriptions_of_the_options(client):
    page = html.unescape(client.get("/identify").text)
    for name in ("tolerance_px", "fov_error", "time", "camera_error", "most_spots"):
        assert OPTIONS[name].description in page
    assert "instead of “Tolerance”." in page
    assert all(f'name="{name}"' in page for name in OPTION_FIELDS)
