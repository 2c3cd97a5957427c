"""SQL and identification over REST, on a small database: the same answers as the commands give."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from fastapi.testclient import TestClient
from services import CATALOG, DATABASE

from starcat.query.session import SCRATCH_PREFIX

SQL = "/api/v1/sql"
IDENTIFY = f"/api/v1/identify/{DATABASE}"


def ask(client: TestClient, query: str, targets: list[str] | None = None, **more):
    asked = {"targets": targets or [DATABASE], "query": query, **more}
    return client.post(SQL, json=asked)


def test_rows_are_those_of_the_table_with_units(client, small_database):
    answer = ask(client, "SELECT star_id, mag FROM stars ORDER BY mag, star_id", max_rows=3).json()
    stars = pq.read_table(small_database / "stars.parquet").sort_by([("mag", "ascending")])
    assert [row[1] for row in answer["rows"]] == stars["mag"].to_pylist()[:3]
    assert answer["is_cut"]
    assert [column["unit"] for column in answer["columns"]] == ["", "mag"]
    assert answer["columns"][1]["description"]


def test_values_and_named_queries_are_as_those_of_the_command(client, starcat, small_database):
    text = "SELECT designation FROM cone($ra, $dec, 20) ORDER BY mag"
    answer = ask(client, text, values={"ra": 10.0, "dec": 20.0}).json()
    ran = starcat(["sql", small_database, text, "--set", "ra=10", "--set", "dec=20", "--json"])
    assert [row[0] for row in answer["rows"]] == [row["designation"] for row in json.loads(ran.out)]
    named = {"targets": [DATABASE], "named": "densest-fields", "values": {"count": 3}}
    answer = client.post(SQL, json=named).json()
    ran = starcat(
        ["sql", small_database, "--named", "densest-fields", "--set", "count=3", "--json"]
    )
    assert answer["rows"] == [list(row.values()) for row in json.loads(ran.out)]


def test_rows_are_sent_in_formats_that_are_written_row_by_row_or_as_a_whole(client):
    """Each format is tested in tests/exchange."""
    read = {"json": json.loads, "npz": lambda data: np.load(io.BytesIO(data))["star_id"]}
    for form in read:
        query = "SELECT star_id, mag FROM stars ORDER BY star_id"
        answer = ask(client, query, format=form, max_rows=7)
        assert answer.status_code == 200, answer.text
        assert int(answer.headers["content-length"]) == len(answer.content)
        assert answer.headers["x-starcat-rows"] == "7"
        assert answer.headers["x-starcat-cut"] == "true"
        assert len(read[form](answer.content)) == 7


def test_an_answer_never_has_more_rows_than_the_operator_allows(client, monkeypatch):
    service = client.app.state.service
    monkeypatch.setattr(service, "settings", service.settings.model_copy(update={"max_rows": 500}))
    answer = ask(client, "SELECT range FROM range(1000)", format="csv", max_rows=10**6)
    assert len(answer.text.splitlines()) == 1 + 500
    assert answer.headers["x-starcat-cut"] == "true"


@pytest.mark.parametrize("name", ["small-1.0.0", "sao", f"{CATALOG}.parquet"])
def test_a_database_has_an_id_and_a_title_a_catalog_a_name_and_a_source(client, name):
    assert ask(client, "SELECT count(*) FROM stars", [name]).json()["rows"][0][0] > 100


def test_whole_numbers_that_readers_round_are_texts(client):
    answer = ask(
        client, "SELECT 9007199254740993, 1, 'nan'::DOUBLE, [1.5, NULL], DATE '2026-01-02'"
    )
    assert answer.json()["rows"] == [["9007199254740993", 1, None, [1.5, None], "2026-01-02"]]


def test_gallery_macros_and_views_are_listed(client, small_database):
    assert "densest-fields" in [query["name"] for query in client.get(f"{SQL}/queries").json()]
    assert "cone" in [macro["name"] for macro in client.get(f"{SQL}/macros").json()]
    views = client.get(f"{SQL}/views", params={"target": DATABASE}).json()
    manifest = json.loads((small_database / "manifest.json").read_bytes())
    assert {view["view"] for view in views} == set(manifest["products"])
    assert all(column["description"] for view in views for column in view["columns"])


def test_nothing_is_left_in_scratch(client, shared_root):
    ask(client, "SELECT * FROM stars", format="fits")
    ask(client, "SELECT nothing FROM stars", format="fits")
    client.post(IDENTIFY, json={"centroids_px": []})
    # Sessions that are kept for the next query have a folder each.
    kept = ("matplotlib", "tap-", SCRATCH_PREFIX)
    names = [
        path.name for path in (shared_root / "scratch").iterdir() if not path.name.startswith(kept)
    ]
    assert names == []


@pytest.fixture(scope="module")
def frame(tmp_path_factory: pytest.TempPathFactory, small_database: Path) -> Path:
    from starcat.frames.images.render import write_simulated
    from starcat.matcher.database import open_database
    from starcat.pipeline.simulation.simulate import Noise, simulate_frames

    database = open_database(small_database)
    eye, folder = database.camera, tmp_path_factory.mktemp("frames")
    frames = simulate_frames(database.directions, eye, 1, Noise(0.2), 3, mag=database.mag)
    simulated = next(frames)
    for suffix in (".csv", ".png"):
        write_simulated(folder / f"frame{suffix}", simulated, eye, 3)
    return folder / "frame.csv"


@pytest.mark.parametrize("suffix", [".csv", ".png"])
def test_an_upload_is_answered_as_by_the_command(client, starcat, small_database, frame, suffix):
    path = frame.with_suffix(suffix)
    with path.open("rb") as file:
        answer = client.post(IDENTIFY, files={"file": (path.name, file)})
    assert answer.status_code == 200, answer.text
    answer = answer.json()
    ran = starcat(["identify", small_database, path, "--json"])
    [mine], [theirs] = answer["frames"], json.loads(ran.out)
    differing = {key: (value, theirs[key]) for key, value in mine.items() if value != theirs[key]}
    assert differing.keys() <= {"time_s"}, differing
    assert answer["frames"][0]["status"] == "identified"
    assert answer["database"] == "small-1.0.0"


def test_centroids_are_answered_with_options(client, frame):
    rows = np.loadtxt(frame, delimiter=",", skiprows=1)
    asked = {"centroids_px": rows[:, :2].tolist(), "mag": rows[:, 2].tolist(), "name": "mine"}
    [result] = client.post(IDENTIFY, json=asked).json()["frames"]
    assert (result["status"], result["frame"]) == ("identified", "mine")
    assert len(result["q_body_from_icrs"]) == 4
    assert any(star["star"] for star in result["stars"])
    asked["options"] = {"method": "pyramid", "tolerance_px": 1.0, "max_steps": 1}
    [result] = client.post(IDENTIFY, json=asked).json()["frames"]
    assert result["status"] != "identified"
    assert result["refusal"]["message"]


@pytest.mark.parametrize("kind", ["png", "svg"])
def test_the_frame_is_drawn(client, frame, kind):
    with frame.open("rb") as file:
        answer = client.post(
            f"{IDENTIFY}/picture", params={"format": kind}, files={"file": (frame.name, file)}
        )
    assert answer.status_code == 200
    assert answer.content.startswith(b"\x89PNG") if kind == "png" else b"<svg" in answer.content


def test_other_contents_are_refused(client):
    assert (
        client.post(IDENTIFY, content=b"x", headers={"Content-Type": "text/x"}).status_code == 415
    )
    assert client.post(IDENTIFY, files={"other": b"x"}).status_code == 422
    long = {"centroids_px": [], "options": {"camera": "x" * 30_000}}
    assert client.post(IDENTIFY, json=long).json()["key"] == "options.camera"


HUGE = "7" * 400  # more than a float can be
LONG = "7" * 5_000  # more digits than Python reads
FRAMES = {
    "deep.json": b"[" * 200_000,
    "huge.json": f'{{"centroids_px": [[{HUGE}, 1]]}}'.encode(),
    "long.json": f'{{"centroids_px": [[{LONG}, 1]]}}'.encode(),
    "huge-mag.json": f'{{"centroids_px": [[1, 1]], "mag": [{HUGE}]}}'.encode(),
    "utf-32.csv": "x_px,y_px\n1,2\n".encode("utf-32"),
    "nulls.csv": b"x_px,y_px\n\0,\0\n",
    "quotes.csv": b'x_px,y_px\n"' + b"1" * 200_000,
    "surrogate.json": b'{"centroids_px": [[1, 2]], "name": "\\ud800", "mag": ["\\ud800"]}',
    "true.json": b"true",
    "x.svg": b"<svg xmlns='http://www.w3.org/2000/svg'><path d='M 1,2'/></svg>",
}


def test_a_file_of_frames_is_refused_at_every_address(client):
    for name, content in FRAMES.items():
        file = {"file": (name, content)}
        answer = client.post(IDENTIFY, files=file)
        assert 400 <= answer.status_code < 500, (name, answer.text[:300])
    markup = client.post(IDENTIFY, files={"file": ("x.svg", FRAMES["x.svg"])}).json()
    assert "the file has markup, as SVG and HTML have; send an image" in markup["detail"]
    for name in ("deep.json", "surrogate.json"):
        file = {"file": (name, FRAMES[name])}
        assert 400 <= client.post(f"{IDENTIFY}/picture", files=file).status_code < 500
        page = client.post("/identify", files=file, data={"database": DATABASE})
        assert page.status_code < 500
        assert page.headers["content-type"].startswith("text/html")
