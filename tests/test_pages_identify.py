"""The page *Identify*: what may be given, what is answered, and what is refused."""

from __future__ import annotations

import base64
import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
from fastapi.testclient import TestClient
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from services import DATABASE

from starcat.errors import ConfigError
from starcat.geometry.attitude import quaternion_from_matrix
from starcat.matcher.centroids import read_frames
from starcat.matcher.database import open_database
from starcat.service.pages.identify import NOISE_PX, centroid_file
from starcat.simulation.simulate import Noise, simulate_frames

SEED = 7
SETTINGS = {"anonymous": "reader", "upload_mib": 2.0}


@pytest.fixture(scope="module")
def simulated(small_artifact: Path):
    """The frame that the page simulates, with its truth."""
    stars = open_database(small_artifact)
    noise = Noise(NOISE_PX)
    return next(simulate_frames(stars.directions, stars.camera, 1, noise, SEED, mag=stars.mag))


def quaternion_in(page: str) -> np.ndarray:
    [text] = re.findall(r"<code>\[([-0-9., e]+)\]</code>", page)
    return np.array([float(one) for one in text.split(",")])


def asked(client: TestClient, files: dict | None = None, **fields: str | int):
    return client.post("/identify", data={"database": DATABASE, **fields}, files=files)


def error_rad(page: str, matrix: np.ndarray) -> float:
    """The angle between the attitude of a page and the true one."""
    true = quaternion_from_matrix(matrix)
    return float(2.0 * np.arccos(np.clip(abs(true @ quaternion_in(page)), 0.0, 1.0)))


def test_a_simulated_frame_is_drawn_measured_and_identified(client, simulated):
    answer = asked(client, seed=SEED)
    assert answer.status_code == 200
    assert ">identified<" in answer.text
    assert error_rad(answer.text, simulated.matrix) < 2e-3
    [picture] = re.findall(r'<img src="data:image/jpeg;base64,([^"]+)"', answer.text)
    assert Image.open(io.BytesIO(base64.b64decode(picture))).size[0] > 600
    assert "SAO" in answer.text
    assert answer.text.count('<th scope="row"') >= 4
    assert f'name="seed" value="{SEED + 1}"' in answer.text


def test_the_simulated_frame_can_be_had_and_sent_back(client, simulated):
    frame = client.get(f"/identify/frame/{DATABASE}?seed={SEED}")
    assert frame.headers["content-type"] == "image/png"
    assert Image.open(io.BytesIO(frame.content)).size == (512, 512)
    files = {"file": ("fr<b>ame.png", frame.content)}
    answer = asked(client, files)
    assert answer.status_code == 200
    assert error_rad(answer.text, simulated.matrix) < 2e-3
    assert "<b>" not in answer.text


@pytest.mark.parametrize("separator", [" ", ", ", ";\t"])
def test_centroids_are_pasted(client, simulated, separator):
    lines = [
        separator.join((f"{x:.3f}", f"{y:.3f}", f"{10 ** (-0.4 * mag):.6g}"))
        for (x, y), mag in zip(simulated.centroids_px.tolist(), simulated.mag, strict=True)
    ]
    answer = asked(client, centroids="\r\n".join(lines), brightness="light")
    assert answer.status_code == 200
    assert error_rad(answer.text, simulated.matrix) < 2e-3


def test_a_refusal_has_the_words_of_the_matcher(client):
    few = asked(client, centroids="10 10\n200 300\n30 400")
    assert few.status_code == 200
    assert "fewer than 4 centroids of the frame are usable" in few.text
    assert "find more stars" in few.text
    none = asked(client, centroids="10 10\n200 300\n30 400\n17 90\n400 22\n350 351")
    assert "not identified" in none.text


@pytest.mark.parametrize(
    ("fields", "status", "words"),
    [
        ({}, 422, "no frame was given"),
        ({"centroids": "1 2 3\n4 five 6"}, 422, "line 2: &#39;4 five 6&#39;"),
        ({"centroids": "1 2\n3 4", "tolerance_px": "wide"}, 422, "tolerance_px: &#39;wide&#39;"),
        ({"centroids": "1 2\n3 4", "tolerance_px": "0"}, 422, "tolerance_px: "),
        ({"centroids": "1 2\n3 4", "field_error": "90"}, 422, "fov_error: "),
        ({"centroids": "1 2\n3 4", "method": "guess"}, 422, "guess"),
        ({"database": "0" * 16, "centroids": "1 2"}, 404, "no database has the id"),
        ({"database": "../../etc", "centroids": "1 2"}, 404, "no database has the id"),
        ({"seed": "<script>"}, 422, "&lt;script&gt;"),
    ],
)
def test_what_cannot_be_identified_is_said_beside_the_form(client, fields, status, words):
    answer = asked(client, **fields)
    assert answer.status_code == status
    assert words in answer.text
    assert 'id="identify"' in answer.text
    assert "<script>" not in answer.text.replace("<script src", "").replace("<script type", "")
    if "centroids" in fields:
        assert fields["centroids"].partition("\n")[0] in answer.text


@pytest.mark.parametrize(
    ("name", "content", "status"),
    [
        ("../../../etc/passwd", b"x_px,y_px\n1,2\n", 200),
        ("frame.png", b"no picture", 422),
        ("frame.csv", b"\xff\xfe", 422),
        ("frame.json", b"{", 422),
        ('"><img src=x onerror=alert(1)>.csv', b"a,b\n1,2\n", 422),
        ("big.csv", b"x_px,y_px\n" + b"1,2\n" * 600_000, 413),
    ],
)
def test_a_file_that_is_no_frame_is_refused(client, name, content, status):
    answer = asked(client, {"file": (name, content)})
    assert answer.status_code == status
    assert "<img src=x" not in answer.text
    assert "Traceback" not in answer.text
    assert "passwd.csv" not in answer.text


def test_a_seed_is_the_same_frame_and_no_other(client):
    one, same, other = (
        client.get(f"/identify/frame/{DATABASE}?seed={seed}").content for seed in (1, 1, 2)
    )
    assert one == same != other
    assert client.get(f"/identify/frame/{DATABASE}?seed=-1").status_code == 422
    assert client.get(f"/identify/frame/{'0' * 16}").status_code == 404


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no centroid was pasted"),
        ("# only a comment\n\n", "no centroid was pasted"),
        ("1 2\n3", "line 2: '3'; expected two or three numbers"),
        ("1 2 3 4", "line 1: '1 2 3 4'"),
        ("1 2\n\n3 4 5", "line 3: 3 numbers, the lines before have 2"),
        ("x y", "line 1: 'x y'"),
        ("1 2\n" * 20_001, "line 20001: more than 20,000 centroids"),
    ],
)
def test_pasted_lines_are_told_by_their_number(text, words):
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
        [frame] = read_frames(path)
    assert frame.centroids_px.tolist() == [list(pair) for pair in pairs]
    assert frame.mag is None
