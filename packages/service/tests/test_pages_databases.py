"""The pages of databases, their console, releases and the start, on a small database."""

from __future__ import annotations

import csv
import html
import io
import json
import re
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from fastapi.testclient import TestClient
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from services import DATABASE, LOCAL, OTHER, add_database, client_of

from starcat.errors import QueryError
from starcat.pipeline.report import coverage_map
from starcat.pipeline.report.coverage_map import project_sky
from starcat.query.gallery import gallery, named_query
from starcat.query.session import open_session
from starcat_service.pages.facts import star_fact_columns
from starcat_service.pages.wording import label_of

PAGE = f"/databases/{DATABASE}"


@pytest.fixture
def empty(tmp_path: Path) -> Iterator[TestClient]:
    address = "https://stars.example.org"
    with client_of(tmp_path, address, public_url=address, anonymous="reader") as client:
        yield client


def text_of(page: str) -> str:
    """The words of a page, blanks made one."""
    words: list[str] = []

    class Words(HTMLParser):
        def handle_data(self, data: str) -> None:
            words.append(data)

    Words().feed(page)
    return re.sub(r"\s+", " ", " ".join(words))


def test_the_list_has_what_there_is(client, small_database):
    words = text_of(client.get("/databases").text)
    manifest = json.loads((small_database / "manifest.json").read_bytes())
    assert "small 1.0.0" in words
    assert "small 1.1.0" in words
    assert f" {manifest['products']['stars']['rows']} " in words
    assert "512 x 512 px, 40 x 40 deg" in words
    assert "not published" in words


def test_one_database_tells_filters_rates_products_and_columns(client, small_database):
    words = text_of(client.get(PAGE).text)
    report = json.loads((small_database / "report" / "report.json").read_bytes())
    for step in report["filters"]:
        assert f"{step['step']} {step['stars']} " in words
    assert f"clean {report['self_test'][0]['noise_px']} " in words
    assert "100.0" in words
    for product in report["products"]:
        assert product in words
    assert "great-circle separation" in words.lower()
    assert '<form method="post"' in client.get(PAGE).text


def test_every_reason_leads_to_its_records(client, small_database):
    manifest = json.loads((small_database / "manifest.json").read_bytes())
    page = client.get(PAGE).text
    [table] = re.findall(r'<table id="rejections-table".*?</table>', page, re.DOTALL)
    rejected = manifest["sources"][0]["rejected"]
    assert rejected
    links = re.findall(r'href="([^"]*)" aria-label="(\d+) records: ([^"]*)"', table)
    assert {name.replace(" ", "_"): int(count) for _, count, name in links} == rejected
    for address, count, name in links:
        answer = text_of(client.get(f"{address}&rows=2000").text)
        assert f"{count} rows" in answer, name


def test_the_attitude_error_of_the_fields_is_on_the_coverage_page(client, small_database):
    report = json.loads((small_database / "report" / "report.json").read_bytes())
    errors = report["coverage"]["attitude_error_arcsec_per_px"]
    text = client.get(f"{PAGE}/coverage").text
    for axis in ("across", "about"):
        figures = " ".join(
            f"{errors[axis][name]:.3g}" for name in ("median", "one_percent", "worst")
        )
        assert f"{axis} the boresight {figures}" in text_of(text.replace("><", "> <"))
    [picture] = re.findall(r'<img src="([^"]*attitude_error.png)"', text)
    assert client.get(picture).headers["content-type"] == "image/png"


def test_the_stars_of_a_field_come_with_what_is_known_of_their_errors(client, small_database):
    manifest = json.loads((small_database / "manifest.json").read_bytes())
    manifest["spec"]["epoch_jyear"] = [2027.0, 2042.0]
    manifest["spec"]["selection"]["neighbours"] = {"psf_sigma_px": 1.0}
    assert star_fact_columns(manifest)[2:5] == [
        "drift_arcsec",
        "centroid_offset_arcsec",
        "contamination",
    ]
    page = client.get(f"{PAGE}/coverage?order=most").text
    link = re.findall(r'href="([^"]*)" aria-label="Stars of field', page)[0]
    answer = client.get(link)
    assert answer.status_code == 200
    words = text_of(answer.text)
    assert "mag_error" in words
    assert "position_error_end_arcsec" in words
    assert "drift_arcsec" not in words.partition("Answer")[2].partition("Named queries")[0]


def rows_of_csv(database: Path) -> list[dict[str, str]]:
    text = (database / "report" / "coverage.csv").read_text()
    return list(csv.DictReader(text.splitlines()))


def fields_of_table(page: str) -> list[int]:
    return [int(number) for number in re.findall(r'<th scope="row"><a [^>]*>(\d+)</a>', page)]


def test_all_fields_are_in_the_table_those_with_few_stars_first(client, small_database):
    rows = rows_of_csv(small_database)
    seen: list[int] = []
    for page in range(1, 9):
        seen += fields_of_table(client.get(f"{PAGE}/coverage?page={page}").text)
    assert sorted(seen) == list(range(len(rows))) == list(range(200))
    stars = [int(rows[number]["stars"]) for number in seen]
    assert stars == sorted(stars)
    beyond = client.get(f"{PAGE}/coverage?page=9999").text
    assert fields_of_table(beyond) == seen[-25:]
    most = fields_of_table(client.get(f"{PAGE}/coverage?order=most").text)
    assert int(rows[most[0]]["stars"]) == max(stars)
    assert client.get(f"{PAGE}/coverage?order=up").status_code == 422


def test_the_map_has_the_colour_of_each_field_at_its_boresight(client, small_database):
    rows = rows_of_csv(small_database)
    content = client.get(f"{PAGE}/fields.json").json()
    assert content["stars"] == [int(row["stars"]) for row in rows]
    assert content["ra_deg"] == pytest.approx([float(row["ra_deg"]) for row in rows], abs=1e-4)
    picture = Image.open(io.BytesIO(client.get(f"{PAGE}/coverage.png").content))
    width, height = picture.size
    pixels = np.asarray(picture.convert("RGBA"))
    assert pixels[0, 0, 3] == 0  # outside of the ellipse
    fields = coverage_map.Fields(
        *(np.array(content[name]) for name in ("ra_deg", "dec_deg", "stars", "stars", "stars"))
    )
    x, y = project_sky(fields.ra_deg, fields.dec_deg)
    column = ((x / coverage_map.HALF_WIDTH + 1.0) * 0.5 * width).astype(int).clip(0, width - 1)
    row = ((1.0 - y / coverage_map.HALF_HEIGHT) * 0.5 * height).astype(int).clip(0, height - 1)
    bins = coverage_map.colour_bins(fields.stars)
    inside = pixels[row, column, 3] > 0
    assert inside.mean() > 0.95  # some lie in the last pixel of the edge
    for number in np.flatnonzero(inside):
        stars = content["stars"][number]
        [colour_bin] = [b for b in bins if b.least <= stars and (b.most is None or stars <= b.most)]
        expected = bytes.fromhex(colour_bin.colour)
        assert bytes(pixels[row[number], column[number], :3].tolist()) == expected


@settings(max_examples=30)
@given(st.lists(st.integers(0, 200), min_size=1, max_size=60))
def test_every_number_of_stars_has_one_colour(stars):
    bins = coverage_map.colour_bins(np.array(stars))
    assert len({colour_bin.name for colour_bin in bins}) == len(bins) <= 10
    for count in range(min(stars), max(stars) + 1):
        fitting = [b for b in bins if b.least <= count and (b.most is None or count <= b.most)]
        assert len(fitting) == 1
        assert (fitting[0].name == "m0") == (count < 4)


def test_the_report_of_a_build_can_do_nothing_but_lead_back(client, small_database):
    answer = client.get(f"{PAGE}/report")
    before, body, after = answer.text.partition("<body>")
    head, end, report = after.rpartition("</nav>")
    assert f'href="{PAGE}"' in head
    assert 'href="/identify"' in head
    assert end
    written = (small_database / "report" / "index.html").read_text("utf-8")
    shown = before + body + report
    assert re.sub("[,\N{NARROW NO-BREAK SPACE}]", "", shown) == written.replace(",", "")
    assert re.search(r">\d{1,3}(,\d{3})+<", shown) is None
    assert answer.headers["content-security-policy"] == (
        "default-src 'none'; img-src data:; style-src 'unsafe-inline'; sandbox allow-same-origin"
    )


def test_two_versions_are_compared(client):
    words = text_of(client.get(f"{PAGE}/compare?other={OTHER}").text)
    assert "version 1.0.0 1.1.0" in words
    from_the_newer = client.get(f"/databases/{OTHER}/compare?other={DATABASE}").text
    assert "version 1.0.0 1.1.0" in text_of(from_the_newer)
    assert "Stars added (0)" in words
    assert "same" in words.split()
    assert client.get(f"{PAGE}/compare?other={'0' * 16}").status_code == 404
    assert f'value="{OTHER}" selected' in client.get(f"{PAGE}/compare").text


def asked(client: TestClient, query: str, **fields: str | int):
    return client.get(f"{PAGE}/sql", params={"query": query, "part": "answer", **fields})


def test_an_answer_has_units_and_rows(client):
    answer = asked(client, "SELECT designation, mag, ra_deg FROM stars ORDER BY mag LIMIT 3")
    assert "<html" not in answer.text
    words = text_of(answer.text)
    assert "3 rows" in words
    assert "mag mag" in words
    assert "ra_deg deg" in words
    cut = text_of(asked(client, "FROM stars", rows=20).text)
    assert "20 rows, and there are more" in cut


def test_an_error_has_the_words_of_the_command(client, small_database):
    with open_session([str(small_database)]) as session:
        for query in ("SELECT * FROM star", "COPY stars TO 'x.csv'", "FROM stars WHERE $x"):
            with pytest.raises(QueryError) as raised, session.ask(query) as running:
                running.rows(1)
            answer = asked(client, query)
            assert answer.status_code == 400
            words = raised.value.message(label_of)
            assert re.sub(r"\s+", " ", words).strip() in text_of(answer.text)


def test_values_of_an_answer_are_escaped(client):
    answer = asked(client, "SELECT '<script>alert(1)</script>' AS \"<i>x</i>\"")
    assert answer.status_code == 200
    assert "<script>" not in answer.text
    assert "<i>" not in answer.text
    whole = client.get(f"{PAGE}/sql", params={"query": "SELECT '</textarea><script>' AS x"})
    assert whole.status_code == 200
    assert "<script>'" not in whole.text
    assert "</textarea><script>" not in whole.text


@pytest.mark.parametrize("name", gallery())
def test_a_named_query_stands_in_the_console_with_its_values(client, name):
    query = named_query(name)
    page = client.get(f"{PAGE}/sql", params={"named": name}).text
    for value in query.values:
        assert f'name="value.{value.name}"' in page
    assert query.help in text_of(page)
    assert ('name="other"' in page) == (query.targets == 2)


def test_named_queries_are_answered_with_values_of_their_types(client):
    query = named_query("emptiest-fields").text
    named = {"named": "emptiest-fields", "value.count": "4"}
    assert "4 rows" in text_of(asked(client, query, **named).text)
    refused = asked(client, query, **{**named, "value.count": "many"})
    assert refused.status_code == 400
    assert "the field “count” is 'many'; expected a whole number" in text_of(refused.text)
    changed = {"named": "changed-stars", "other": OTHER}
    assert "0 rows" in text_of(asked(client, named_query("changed-stars").text, **changed).text)
    alone = asked(client, named_query("changed-stars").text, named="changed-stars")
    assert "is about 2 targets" in text_of(alone.text)
    unnamed = asked(client, "SELECT $a + 1 AS b", **{"value.a": "2"})
    assert "1 row" in text_of(unnamed.text)


def test_an_answer_comes_as_a_file(client):
    """Other formats are tested with the REST interface, which writes them in the same way."""
    query = {"query": "SELECT designation, mag FROM stars ORDER BY mag LIMIT 5", "form": "csv"}
    answer = client.get(f"{PAGE}/sql/file", params=query)
    assert answer.status_code == 200
    assert answer.headers["content-disposition"].startswith('attachment; filename="small-1.0.0.')
    assert len(answer.text.splitlines()) == 6


def test_a_release_is_published_with_a_note_after_a_question(client):
    note = "For June.\r\n<script>alert(1)</script>"
    question = client.post("/releases", data={"database": DATABASE, "note": note}).text
    assert "Publish small 1.0.0 for good?" in question
    assert "cannot be changed or taken back" in question
    assert client.get("/api/v1/releases").json()["releases"] == []
    fields = dict(re.findall(r'<input type="hidden" name="(\w+)" value="([^"]*)"', question))
    assert fields["confirmed"] == "true"
    form = {name: html.unescape(value) for name, value in fields.items()}
    answer = client.post("/releases", data=form, follow_redirects=False)
    assert answer.status_code == 303
    page = client.get(answer.headers["location"].partition("#")[0]).text
    words = text_of(page)
    assert "small-1.0.0 is published." in words
    assert "For June. <script>alert(1)</script>" in words
    assert "<script>alert" not in page
    assert f"starcat pull small@1.0.0 --registry {LOCAL}/registry" in words
    assert f'value="{DATABASE}"' not in page
    assert f'value="{OTHER}"' in page
    assert " published " in text_of(client.get(PAGE).text)
    made_up = text_of(client.get("/releases?published=other-1.0.0").text)
    assert "other-1.0.0" not in made_up
    for link in re.findall(r'href="(/registry/[^"]+)"', page):
        assert client.get(link).status_code == 200


def test_another_content_of_a_release_is_refused_in_words(own_root, database_version):
    add_database(own_root, database_version("1.0.0"), OTHER)
    with client_of(own_root, anonymous="publisher") as client:
        sound = {"database": DATABASE, "confirmed": "true"}
        assert client.post("/releases", data=sound).status_code == 200
        form = {"database": OTHER, "note": "kept <b>", "confirmed": "true"}
        answer = client.post("/releases", data=form)
        assert answer.status_code == 409
        assert "has small-1.0.0 already, with another content" in text_of(answer.text)
        assert "kept &lt;b&gt;</textarea>" in answer.text
        answer = client.post("/api/v1/releases", json={"database": OTHER})
        assert (answer.status_code, "raise the version" in answer.json()["detail"]) == (409, True)
        [listed] = client.get("/api/v1/releases").json()["releases"]
        assert listed["database"] == DATABASE
        page = client.get("/databases").text
        assert (page.count(">published<"), page.count(">not published<")) == (1, 1)


def test_the_start_says_how_programs_reach_the_service_and_what_to_do_first(client, empty):
    words = text_of(client.get("/").text)
    assert f"{LOCAL}/tap" in words
    assert f"starcat --server {LOCAL} sql small-1" in words
    away = text_of(empty.get("/").text)
    assert "https://stars.example.org/tap" in away
    assert "Design a database" in away
    assert "No database yet" in text_of(empty.get("/databases").text)
    assert "No database to identify with" in text_of(empty.get("/identify").text)
    assert "Nothing was published yet" in text_of(empty.get("/releases").text)
    for address in ("/", "/jobs", "/databases", "/identify", "/releases"):
        main = empty.get(address).text.partition("<main")[2].partition("</main>")[0]
        assert 'href="/new"' in main, address
        assert "Every database is published" not in main
