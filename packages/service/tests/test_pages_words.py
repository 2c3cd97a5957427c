"""What pages say where something is wrong or missing: in words of a page, and what to do first."""

from __future__ import annotations

import html
import io
import re

import numpy as np
import pytest
from fastapi.testclient import TestClient
from PIL import Image
from services import DATABASE, client_of
from services import SPEC as SMALL

from starcat.matcher.refusal import HINTS
from starcat_service.jobs.job import Attempt, Outcome, begin_next
from starcat_service.jobs.submission import submit_ingest
from starcat_service.pages.wording import advice_in_page_words, in_page_words

SETTINGS = {"anonymous": "publisher", "upload_mib": 1.0}
PAGE = f"/databases/{DATABASE}"

SPEC = SMALL.replace('"1.0.0"', '"9.0.0"')


def picture(width: int, height: int, *, has_stars: bool = True) -> bytes:
    """Return a frame of noise, with some stars."""
    rng = np.random.default_rng(1)
    pixels = rng.normal(100, 3, (height, width))
    if has_stars:
        for y, x in rng.integers(10, min(width, height) - 10, (12, 2)):
            pixels[y - 1 : y + 2, x - 1 : x + 2] += 200
    file = io.BytesIO()
    Image.fromarray(pixels.clip(0, 255).astype(np.uint8)).save(file, "PNG")
    return file.getvalue()


def sent(client: TestClient, name: str, content: bytes | str, **fields: str):
    data = content if isinstance(content, bytes) else content.encode()
    form = {"database": DATABASE, **fields}
    return client.post("/identify", data=form, files={"file": (name, data)})


def designed(client: TestClient, old: str, new: str, **fields: str):
    form = {"toml": SPEC.replace(old, new), "toml-before": "", "do": "preview", **fields}
    answer = client.post("/new", data=form)
    while "being read, which takes longer" in answer.text:
        answer = client.post("/new", data=form)
    return answer


CASES = {
    "new: a wrong value": (designed, '"gaia"', '"nothing"'),
    "new: a catalog that is not here": (designed, '"gaia"', '"2mass"'),
    "new: no stars": (designed, "4.5", "-20"),
    "new: too wide": (designed, "fov_x_deg = 30.0", "fov_x_deg = 150.0"),
    "new: too dense": (designed, "4.5\n", "9\nboresights.count = 1000000\n"),
    "new: too large a file": (designed, "4.5\n", "9\nproducts.pairs.max_separation_deg = 90\n"),
    "new: an unknown preset": ("get", "/new?preset=nothing"),
    "new: no such job": ("get", "/new?job=nothing"),
    "new: no such database": ("get", "/new?database=0000000000000000"),
    "new: no design": ("get", "/new?name.x=1"),
    "jobs: none": ("get", "/jobs/nothing"),
    "jobs: a wrong state": ("get", "/jobs?state=asleep"),
    "database: none": ("get", "/databases/0000000000000000"),
    "database: no name": ("get", "/databases/nothing"),
    "compare: none": ("get", f"{PAGE}/compare?other=0000000000000000"),
    "sql: no table": ("get", f"{PAGE}/sql?query=FROM+nothing"),
    "sql: a value": ("get", f"{PAGE}/sql?query=SELECT+$x"),
    "sql: a wrong name": ("get", f"{PAGE}/sql?named=nothing&query=FROM+stars"),
    "sql: a file": ("get", f"{PAGE}/sql?query=FROM+read_csv('/etc/passwd')"),
    "sql: writing": ("get", f"{PAGE}/sql?query=CREATE+TABLE+a+AS+FROM+stars"),
    "sql: two": ("get", f"{PAGE}/sql?query=SELECT+1;SELECT+2"),
    "identify: no such database": ("get", "/identify?database=0000000000000000"),
    "identify: nothing": (sent, "", ""),
    "identify: no picture": (sent, "a.png", "text"),
    "identify: a damaged FITS file": (sent, "a.fits", "SIMPLE  = T"),
    "identify: no such format": (sent, "a.xyz", "text"),
    "identify: an empty file": (sent, "a.csv", ""),
    "identify: a wrong centroid": (sent, "a.csv", "x_px,y_px\n1,2\nx,4\n"),
    "identify: centroids outside": (sent, "a.csv", "x_px,y_px\n" + "-1,-2\n" * 9),
    "identify: few centroids": (sent, "a.csv", "x_px,y_px\n1,2\n3,4\n"),
    "identify: JSON of something else": (sent, "a.json", '{"a": 1}'),
    "identify: of another size": (sent, "a.png", picture(300, 200)),
    "identify: no stars": (sent, "a.png", picture(512, 512, has_stars=False)),
    "releases: none": ("post", "/releases", {"database": "0000000000000000"}),
    "sign in: a wrong token": ("post", "/sign-in", {"token": "starcat_x"}),
    "nothing": ("get", "/nowhere"),
}


def _answer(client: TestClient, case: tuple):
    if callable(case[0]):
        return case[0](client, *case[1:])
    method, address, *data = case
    return client.request(method, address, data=data[0] if data else None)


def _visible(text: str) -> str:
    """Return the visible text of a page, without text to be copied."""
    text = re.sub(r'<div class="copybox.*?</div>\s*<pre.*?</pre>|<textarea.*?</textarea>', "", text,
                  flags=re.DOTALL)  # fmt: skip
    text = re.sub(r"<script.*?</script>|<select.*?</select>", "", text, flags=re.DOTALL)
    return html.unescape(re.sub(r"<[^>]+>", " ", text))


OPTION = re.compile(r"(?<![\w-])--?[a-z][a-z-]*\b")
COMMAND = re.compile(r"'starcat (?!fetch)\w+|run starcat \w+")


@pytest.mark.parametrize("name", list(CASES))
def test_an_error_on_a_page_names_no_option_of_the_command_line(client, name):
    client.headers["Accept"] = "text/html"
    answer = _answer(client, CASES[name])
    assert answer.headers["content-type"].startswith("text/html")
    words = _visible(answer.text)
    assert OPTION.findall(words) == []
    assert COMMAND.findall(words) == []
    assert re.search('notice|class="error"[^>]*>[^<]|badge warn|badge bad|words"', answer.text)


def test_the_message_of_a_failed_job_names_no_option(client):
    service = client.app.state.service
    job = submit_ingest(service, "gaia", "me").job
    attempt = Attempt(service.records, begin_next(service.records, ["ingest"]))
    attempt.log("warning", "a.dat: cut off; go on with resume=True")
    detail = "gaia: a.dat already exists and differs; choose another output, or pass replace=True"
    problem = {"title": "Conflict", "status": 409, "detail": detail}
    attempt.end(Outcome("failed", problem | {"fields": ["output", "replace=True"]}))
    for address in (f"/jobs/{job.id}", "/jobs"):
        words = _visible(client.get(address).text)
        assert "a.dat already exists and differs" in words
        assert OPTION.findall(words) == []
        assert "choose another" not in words


@pytest.mark.parametrize(
    ("message", "fields", "words"),
    [
        ("a.png: no stars; check it, or raise it (threshold=8)", ["threshold=8"],
         "a.png: no stars; check it"),
        ("it fits a wider field: fov_error 9%", ["fov_error"],
         "it fits a wider field: “Error of the field” 9%"),
        ("output/a: exists; choose another output, or pass replace=True",
         ["output", "replace=True"], "output/a: exists"),
        ("the query has $m: give it with values[\"m\"]", ['values["m"]'],
         "the query has $m: give it with the field “m”"),
        ("give x_y", ["x_y"], "give x_y"),
        ("nothing to change", [], "nothing to change"),
    ],
    ids=["in brackets", "with a value", "advice", "item", "nothing else", "no parameter"],
)  # fmt: skip
def test_parameters_become_labels_of_a_page(message, fields, words):
    assert in_page_words(message, fields) == words


def test_empty_pages_say_what_to_do_first(tmp_path):
    with client_of(tmp_path, anonymous="publisher") as client:
        for address in ("/", "/jobs", "/databases", "/identify", "/releases"):
            page = client.get(address).text
            main = page.partition("<main")[2].partition("</main>")[0]
            assert 'href="/new"' in main, address
            assert "Every database is published" not in page


def test_advice_of_a_refusal_names_fields_of_the_page():
    said = {reason: advice_in_page_words(hint) for reason, hint in HINTS.items()}
    assert not [text for text in said.values() if re.search(r"_|--|\(flip\)|[;,] *$|,,", text)]
    assert said["scale"].endswith("allow a larger error of it (“Error of the field”)")
    assert said["mirrored"] == "turn the frame over (“y counts up”)"
    assert said["chance"].startswith("give magnitudes, find more stars, or have")
