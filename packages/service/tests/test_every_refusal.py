"""Every refusal: each row of `data/refusals.tsv` is a request that the service cannot answer.

A refusal has the form that its client reads: a problem in JSON, a VOTable of TAP or of a cone
search, nova's JSON, or a page. A page names no option and no command of the command line.
"""

from __future__ import annotations

import csv
import html
import io
import json
import re
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from fastapi.testclient import TestClient
from httpx2 import Response
from PIL import Image
from services import DATABASE, SPEC, posted

from starcat.matcher.refusal import HINTS
from starcat_service.jobs.job import Attempt, Outcome, begin_next
from starcat_service.jobs.submission import submit_ingest
from starcat_service.pages.wording import advice_in_page_words, problem_in_page_words

TABLE = Path(__file__).parent / "data" / "refusals.tsv"
ATTITUDES = (
    "time,ra_deg,dec_deg,roll_deg\n2027-03-01T06:30:00,83.8,-5.4,0\n2027-03-01T06:31:00,85,-5,0\n"
)
STANDS_FOR = {"DATABASE": DATABASE, "ATTITUDES": json.dumps(ATTITUDES)[1:-1]}


def rows() -> list[tuple[str, str, str, str]]:
    with TABLE.open(encoding="utf-8", newline="") as file:
        return [tuple(row) for row in csv.reader(file, "excel-tab", quoting=csv.QUOTE_NONE)][1:]


def send(client: TestClient, request: str, text: str) -> Response:
    """Send the fields of a row as what its address takes: a query, JSON, or a form with a file."""
    for word, value in STANDS_FOR.items():
        request, text = request.replace(word, value), text.replace(word, value)
    method, address = request.split(" ", 1)
    fields = json.loads(text or "{}")
    if method == "GET":
        return client.get(address, params=fields or None, headers={"Accept": "text/html"})
    if address.startswith("/api/v1/") and "file" not in fields:
        return client.post(address, json=fields)
    if changed := fields.pop("SPEC", None):
        text = SPEC.replace('"1.0.0"', '"9.0.0"').replace(*changed)
        fields |= {"toml": text, "toml-before": ""}
    file = fields.pop("file", None)
    return posted(client, address, fields, files={"file": tuple(file)} if file else None)


def words_of_problem(answer: Response) -> str:
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.json()["status"] == answer.status_code
    if answer.status_code == 422:
        assert answer.json()["title"] == "Unprocessable Content"  # on every Python
    return answer.text


def words_of_tap(answer: Response) -> str:
    """Return the words of an error as DALI has it."""
    assert answer.headers["content-type"].startswith("application/x-votable+xml")
    [status] = [
        element
        for element in ElementTree.fromstring(answer.content).iter()
        if element.get("name") == "QUERY_STATUS"
    ]
    assert status.get("value") == "ERROR"
    return status.text or ""


def words_of_cone(answer: Response) -> str:
    """Return the words of an error of the standard: an INFO directly under VOTABLE."""
    assert answer.headers["content-type"] == "text/xml;content=x-votable"
    root, space = ElementTree.fromstring(answer.content), "{http://www.ivoa.net/xml/VOTable/v1.3}"
    [info] = root.findall(f"{space}INFO")
    assert info.get("name") == "Error"
    assert not root.findall(f".//{space}TABLE")
    return info.get("value") or ""


def words_of_nova(answer: Response) -> str:
    assert answer.json()["status"] == "error"
    return str(answer.json()["errormessage"])


OPTION = re.compile(r"(?<![\w-])--?[a-z][a-z-]*\b")
COMMAND = re.compile(r"'starcat (?!fetch)\w+|run starcat \w+")


def visible(text: str) -> str:
    """Return the visible text of a page, without text to be copied."""
    copied = r'<div class="copybox.*?</div>\s*<pre.*?</pre>|<textarea.*?</textarea>'
    text = re.sub(copied, "", text, flags=re.DOTALL)
    text = re.sub(r"<script.*?</script>|<select.*?</select>", "", text, flags=re.DOTALL)
    return html.unescape(re.sub(r"<[^>]+>", " ", text))


def words_of_page(answer: Response) -> str:
    assert answer.headers["content-type"].startswith("text/html")
    words = visible(answer.text)
    assert OPTION.findall(words) == []
    assert COMMAND.findall(words) == []
    assert re.search('notice|class="error"[^>]*>[^<]|badge warn|badge bad|words"', answer.text)
    assert ("/identify" in answer.url.path) <= ('id="identify"' in answer.text)
    return answer.text


FORMS: dict[str, Callable[[Response], str]] = {
    "/api/v1/": words_of_problem, "/tap/": words_of_tap, "/scs/": words_of_cone,
    "/api/": words_of_nova, "/": words_of_page,
}  # fmt: skip
"""The form of a refusal by what an address begins with."""


def lasting(root: Path) -> list[Path]:
    """Return the files of a service that a refused request must not change."""
    folders = [root / name for name in ("databases", "registry", "catalogs")]
    return sorted(path for folder in folders for path in folder.rglob("*"))


class TestEveryRefusal:
    @pytest.mark.parametrize(("request_", "fields", "status", "words"), rows())
    def test_it_has_its_form_and_says_what_is_wrong(
        self, client, shared_root, request_, fields, status, words
    ):
        before = lasting(shared_root)
        answer = send(client, request_, fields)
        assert str(answer.status_code) == status, answer.text[:300]
        begins = next(prefix for prefix in FORMS if request_.split(" ")[1].startswith(prefix))
        assert words in FORMS[begins](answer)
        hidden = ["Traceback", str(shared_root), "root:x:0"]
        if begins == "/":
            hidden += ["<script>alert", "<img src=x"]
        assert [text for text in hidden if text in answer.text] == []
        assert lasting(shared_root) == before

    def test_a_page_about_a_picture_has_its_own_words(self, client):
        """The picture is of another size than the camera's."""
        random = np.random.default_rng(1)
        pixels = random.normal(100, 3, (200, 300))
        for y, x in random.integers(10, 190, (12, 2)):
            pixels[y - 1 : y + 2, x - 1 : x + 2] += 200
        file = io.BytesIO()
        Image.fromarray(pixels.clip(0, 255).astype(np.uint8)).save(file, "PNG")
        files = {"file": ("a.png", file.getvalue())}
        words_of_page(client.post("/identify", data={"database": DATABASE}, files=files))


def test_the_message_of_a_failed_job_names_no_option(client):
    service = client.app.state.service
    job = submit_ingest(service, "gaia", "me").job
    attempt = Attempt(service.records, begin_next(service.records, ["ingest"]))
    attempt.log("warning", "a.dat: cut off; go on with resume=True")
    text, advice = "a.dat already exists and differs", ["choose another {output}"]
    problem = {"title": "Conflict", "status": 409, "detail": f"{text}; choose another output"}
    attempt.end(Outcome("failed", problem | {"problem": text, "advice": advice}))
    for address in (f"/jobs/{job.id}", "/jobs"):
        words = visible(client.get(address).text)
        assert "a.dat already exists and differs" in words
        assert OPTION.findall(words) == []
        assert "choose another" not in words


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"problem": "no stars", "where": "a.png", "advice": ["check it", "raise {max_bytes:8}"]},
         "a.png: no stars; check it"),
        ({"problem": "no stars", "advice": ["set {threshold:8}", "state {noise_px}"]},
         "no stars; set “Threshold” 8, or state “Noise” in px"),
        ({"problem": "expected 9%", "parameter": "fov_error"}, "“Error of the field”: expected 9%"),
        ({"problem": "a: exists", "advice": ["choose another {output}", "pass {replace:True}"]},
         "a: exists"),
        ({"problem": "the query has $m", "advice": ["give it with {values[m]}"]},
         "the query has $m; give it with the field “m”"),
        ({"problem": "expected 1", "parameter": "x_y", "value": "3"}, "x_y is 3; expected 1"),
        ({"detail": "no problem of starcat"}, "no problem of starcat"),
    ],
    ids=["part of the advice", "label", "parameter", "advice", "item", "no label", "plain"],
)  # fmt: skip
def test_parameters_become_labels_of_a_page(fields, words):
    assert problem_in_page_words(fields) == words


def test_advice_of_a_refusal_names_fields_of_the_page():
    said = {reason: advice_in_page_words(hint) for reason, hint in HINTS.items()}
    assert not [text for text in said.values() if re.search(r"_|--|\(flip\)|[;,] *$|,,", text)]
    assert said["scale"].endswith("allow a larger error of it (“Error of the field”)")
    assert said["mirrored"] == "turn the frame over (“y counts up”)"
    assert said["chance"].startswith(
        "give magnitudes, state the noise of magnitudes (“Noise” in mag), state the noise of "
        "centroids in place of a tolerance (“Noise” in px), check the field of view and the size"
    )
