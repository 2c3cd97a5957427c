"""The view of the sky, downloads, tables and notebooks of the pages, on a small database."""

from __future__ import annotations

import base64
import html
import io
import json
import re
import tarfile
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import requests
from served import Served
from services import DATABASE, OTHER, add_database, client_of

from starcat.geometry.camera import Camera
from starcat.geometry.distortion import Distortion
from starcat.geometry.sphere import directions_from_radec, separation
from starcat.pipeline.specs.reading import spec_from_dict
from starcat.storage.toml_files import content_of_toml
from starcat_service.pages.sky import MOST, around, outline_of

SETTINGS = {"anonymous": "publisher"}
PAGE = f"/databases/{DATABASE}"


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory, picky_database: Path) -> Path:
    """The folder of a service whose database has stars that were rejected for two reasons."""
    folder = tmp_path_factory.mktemp("sky") / "service"
    add_database(folder, picky_database)
    return folder


def stars_of(client, **where) -> list[dict]:
    answer = client.get(f"{PAGE}/sky.json", params=where)
    assert answer.status_code == 200, answer.text
    return answer.json()["stars"]


def test_a_view_has_the_brightest_stars_and_the_rejected_ones_with_their_reason(
    client, picky_database
):
    stars = stars_of(client)
    guide = [star for star in stars if star["kind"] == "guide"]
    table = pq.read_table(picky_database / "stars.parquet").sort_by("mag").to_pylist()
    assert [star["mag"] for star in guide] == pytest.approx(
        [row["mag"] for row in table[:MOST]], abs=1e-4
    )
    assert {star["label"] for star in guide} <= {row["designation"] for row in table}
    assert all("reason" not in star for star in guide)
    rejected = [star for star in stars if star["kind"] == "rejected"]
    reasons = {
        row["designation"]: row["reason"]
        for row in pq.read_table(picky_database / "rejected.parquet").to_pylist()
        if row["reason"] != "too_faint" and row["mag"] is not None
    }
    assert {star["label"]: star["reason"].replace(" ", "_") for star in rejected} == reasons
    assert set(reasons.values()) == {"too_bright"}
    assert not [star for star in stars if star["kind"] == "faint"]


def test_a_part_of_the_sky_has_the_stars_within_its_radius(client, picky_database):
    ra, dec, radius = 10.0, 40.0, 25.0
    labels = {star["label"] for star in stars_of(client, ra=ra, dec=dec, radius=radius, faint=True)}
    middle = directions_from_radec(ra, dec)
    expected = set()
    for name in ("stars", "rejected"):
        table = pq.read_table(picky_database / f"{name}.parquet").to_pylist()
        rows = [row for row in table if row["ra_deg"] is not None and row["mag"] is not None]
        u = directions_from_radec(
            np.array([row["ra_deg"] for row in rows]), np.array([row["dec_deg"] for row in rows])
        )
        near = np.degrees(separation(u, middle)) <= radius
        expected |= {row["designation"] for row, is_near in zip(rows, near, strict=True) if is_near}
    assert labels == expected
    assert labels
    for wrong in ({"ra": 400}, {"dec": -91}, {"radius": 0}, {"ra": "x"}):
        assert client.get(f"{PAGE}/sky.json", params=wrong).status_code == 422


def test_the_outline_of_a_field_is_the_edge_of_the_detector():
    camera = Camera(
        1280, 960, 1500.0, principal_point_px=(650.0, 470.0), distortion=Distortion(k1=-0.05)
    )
    outline = np.array(outline_of(camera))
    pixels = camera.pixels_from_directions(outline)
    edge = np.minimum(
        np.minimum(abs(pixels[:, 0]), abs(pixels[:, 0] - 1280)),
        np.minimum(abs(pixels[:, 1]), abs(pixels[:, 1] - 960)),
    )
    assert edge.max() < 0.01
    assert np.allclose(pixels[0], [0, 0], atol=0.01)


def test_a_view_holds_the_places_that_it_is_of():
    places = [{"ra_deg": ra, "dec_deg": 60.0} for ra in (350.0, 10.0)]
    view = around(places)
    assert (view["ra"] % 360.0, view["dec"]) == (
        pytest.approx(0.0, abs=1e-3),
        pytest.approx(60.38, abs=0.02),
    )
    assert 10.0 < view["size"] < 20.0
    everywhere = [{"ra_deg": float(ra), "dec_deg": 0.0} for ra in range(0, 360, 10)]
    assert around(everywhere)["size"] == 360.0


def test_fields_are_ordered_and_filtered_by_their_stars(client, picky_database):
    rows = (picky_database / "report" / "coverage.csv").read_text().splitlines()[1:]
    stars = [int(row.split(",")[3]) for row in rows]
    few = sorted(stars)[30]

    def numbers(query: str) -> list[int]:
        page = client.get(f"{PAGE}/coverage?{query}").text
        return [int(number) for number in re.findall(r'<tr data-field="(\d+)"', page)]

    fields = numbers(f"order=fewest&at_most={few}") + numbers(f"order=fewest&at_most={few}&page=2")
    assert sorted(fields) == [k for k, count in enumerate(stars) if count <= few]
    by_dec = numbers("order=dec")
    dec = [float(rows[k].split(",")[2]) for k in by_dec]
    assert dec == sorted(dec)
    assert client.get(f"{PAGE}/coverage?at_most=-1").status_code == 422


def test_places_in_an_answer_are_shown_in_the_sky(client):
    asked = "SELECT designation, mag, ra_deg, dec_deg FROM stars ORDER BY mag LIMIT 5"
    page = client.get(f"{PAGE}/sql", params={"query": asked}).text
    [view] = re.findall(r'data-sky="([^"]+)"', page)
    marks = json.loads(html.unescape(view))["marks"]
    assert [mark["mag"] for mark in marks] == sorted(mark["mag"] for mark in marks)
    assert len(marks) == 5
    assert all(mark["label"].startswith("SAO ") for mark in marks)
    without = client.get(f"{PAGE}/sql", params={"query": "SELECT count(*) FROM stars"}).text
    assert "data-sky" not in without


def test_what_differs_between_two_databases_is_shown_in_the_sky(
    own_root, small_database, picky_database
):
    add_database(own_root, picky_database, OTHER)
    with client_of(own_root, anonymous="reader") as client:
        page = client.get(f"{PAGE}/compare?other={OTHER}").text
        [link] = re.findall(r'href="([^"]+)">Added and removed stars in the sky', page)
        shown = client.get(html.unescape(link)).text
    [view] = re.findall(r'data-sky="([^"]+)"', shown)
    marks = json.loads(html.unescape(view))["marks"]
    bright = pq.read_table(small_database / "stars.parquet").to_pylist()
    expected = sorted(row["designation"] for row in bright if row["mag"] < 2.2)
    assert sorted(mark["label"] for mark in marks) == expected
    assert {mark["reason"] for mark in marks} == {"removed"}


# Downloads


@pytest.mark.parametrize(
    ("query", "name", "options"),
    [
        ("method=triangle&endian=big", "small-1.0.0.img", ["--endian", "big"]),
        ("profile=small", "small-1.0.0-small.img", ["--profile", "small"]),
    ],
)
def test_a_flight_image_has_the_bytes_of_export(
    client, starcat, picky_database, tmp_path, query, name, options
):
    answer = client.get(f"{PAGE}/image?{query}")
    assert answer.status_code == 200
    assert f'filename="{name}"' in answer.headers["content-disposition"]
    to = ["--to", "onboard", *options, "-o", tmp_path / "made.img"]
    assert starcat(["export", picky_database, *to]).code == 0
    assert answer.content == (tmp_path / "made.img").read_bytes()


def test_an_image_that_cannot_be_made_is_refused_on_a_page(client):
    for wrong in ("method=guess", "profile=small&method=triangle"):
        assert client.get(f"{PAGE}/image?{wrong}").status_code == 422
    page = client.get(PAGE).text
    assert '<option value="small">small, with pyramids</option>' in page
    offered = re.findall(r'<option value="(triangle|pyramid)">', page)
    assert offered
    for method in {"triangle", "pyramid"} - set(offered):
        assert client.get(f"{PAGE}/image?method={method}").status_code == 422


def test_the_whole_database_and_its_spec_are_downloaded(client, picky_database):
    page = client.get(PAGE).text
    archive = client.get(re.findall(r'href="([^"]+/archive)"', page)[0]).content
    with tarfile.open(fileobj=io.BytesIO(archive)) as packed:
        stars = packed.extractfile("small-1.0.0/stars.parquet")
        assert stars.read() == (picky_database / "stars.parquet").read_bytes()
    text = client.get(re.findall(r'href="([^"]+/spec.toml)"', page)[0]).text
    spec = spec_from_dict(content_of_toml(text, "spec.toml"), "spec.toml")
    manifest = json.loads((picky_database / "manifest.json").read_bytes())
    assert spec == spec_from_dict(manifest["spec"], "manifest")


# Notebooks


def python_of(page: str) -> str:
    """The Python on a page, which has to be the same in the notebook that it gives."""
    [code] = re.findall(r'<code id="python"[^>]*>(.*?)</code>', page, re.DOTALL)
    [book] = re.findall(r'href="data:application/x-ipynb\+json;base64,([^"]+)"', page)
    notebook = json.loads(base64.b64decode(html.unescape(book)))
    assert "".join(notebook["cells"][0]["source"]) == html.unescape(code)
    assert (notebook["nbformat"], notebook["cells"][0]["cell_type"]) == (4, "code")
    assert len(html.unescape(code).strip().splitlines()) <= 12
    return html.unescape(code)


def ran(served: Served, address: str, capsys: pytest.CaptureFixture[str], **query: str) -> str:
    page = requests.get(served.address + address, params=query, timeout=20)
    assert page.status_code == 200
    exec(compile(python_of(page.text), address, "exec"), {})  # the code of our own page
    return capsys.readouterr().out


@pytest.mark.slow
def test_the_python_of_a_database_opens_it(served, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    out = ran(served, PAGE, capsys)
    assert "small" in out
    assert (tmp_path / "databases" / "small-1.0.0" / "manifest.json").is_file()


QUOTES = "SELECT designation, mag FROM stars WHERE mag < $limit AND '\"\"\"\\' <> ''\nORDER BY mag"
PRINTED = [
    ("sql", {"query": QUOTES, "value.limit": "5", "rows": "20"}, r"<tr><td[^>]*>(SAO \d+)</td>"),
    ("coverage", {"order": "fewest", "page": "2", "at_most": "500"}, r'<tr data-field="(\d+)"'),
]
"""Pages with their parameters, and the first cells of their rows."""


@pytest.mark.parametrize(("page", "query", "cell"), PRINTED, ids=["sql", "coverage"])
def test_the_python_of_a_page_prints_its_rows(served, capsys, page, query, cell):
    out = ran(served, f"{PAGE}/{page}", capsys, **query)
    text = requests.get(f"{served.address}{PAGE}/{page}", params=query, timeout=20).text
    shown = re.findall(cell, text)
    assert [line.split("\t")[0] for line in out.splitlines()[1:]] == shown
    assert len(shown) >= 20


def test_the_python_of_a_comparison_prints_the_stars_of_the_page(served, capsys):
    query, address = {"other": DATABASE}, f"/databases/{OTHER}/compare"
    out = ran(served, address, capsys, **query)
    page = requests.get(f"{served.address}{address}", params=query, timeout=20).text
    [table] = re.findall(r'<table id="came-table".*?</table>', page, re.DOTALL)
    names = re.findall(r">(SAO \d+)</a>", table)
    lines = [line.split("\t") for line in out.splitlines()[1:]]
    assert [line[1] for line in lines if line[0] == "came"] == names
    assert names
    assert {line[3] for line in lines} == {"too_bright"}


@pytest.mark.slow
def test_the_python_of_an_answer_identifies_the_frame(served, capsys):
    query = {"database": DATABASE, "seed": "7"}
    out = ran(served, "/identify", capsys, **query)
    page = requests.get(f"{served.address}/identify", params=query, timeout=20).text
    [ra] = re.findall(r'class="value">(\d+\.\d{4})°', page)[:1]
    status, found_ra, _ = out.splitlines()[0].split()
    assert status == "identified"
    assert float(found_ra) == pytest.approx(float(ra), abs=2e-3)
    assert "SAO" in out
