"""Pages of the service: they answer, escape what they show, and bring all they need with them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import urljoin

import pytest
from fastapi.testclient import TestClient
from services import DATABASE, OTHER, SPEC, posted

import starcat_service
from starcat.cli import REFERENCE
from starcat.errors import ConfigError
from starcat.pipeline.specs.reading import preset, preset_names, read_spec
from starcat_service.jobs.job import Attempt, Outcome, begin_next
from starcat_service.pages.documentation import FIGURES, NAMES, read_page, table_of_pages
from starcat_service.pages.draft import (
    draft_of_content,
    draft_of_form,
    draft_of_text,
    without_defaults,
)
from starcat_service.pages.rendering import DIGEST, FILES

PAGE = f"/databases/{DATABASE}"

PAGES = [
    *("/", "/databases", PAGE, f"{PAGE}/coverage", f"{PAGE}/sql?query=FROM+stars+LIMIT+2"),
    *(f"{PAGE}/compare?other={OTHER}", "/identify", "/plan", "/releases"),
]
"""Pages of databases."""

HOSTILE = '"><script>alert(1)</script><img src=x onerror=alert(1)>'


@pytest.fixture(scope="module")
def job(client: TestClient) -> str:
    """A job that failed: its address."""
    for other in client.get("/api/v1/jobs", params={"state": "queued"}).json()["jobs"]:
        client.post(f"/jobs/{other['id']}/cancel")  # jobs of other modules would begin before it
    address = _asked(client, "hostile")
    records = client.app.state.service.records
    attempt = Attempt(records, begin_next(records, ["build"]))
    attempt.report_stage("read gaia", 5_000_000, 19_000_000)
    attempt.log("warning", f"a line {HOSTILE}")
    attempt.report_stage(f"self-test {HOSTILE}", 3, 400)
    problem = {"title": "Unprocessable Content", "status": 422, "detail": f"why {HOSTILE}"}
    attempt.end(Outcome("failed", problem))
    return address


def _asked(client: TestClient, name: str) -> str:
    text = SPEC.replace('"small"', f'"{name}"')
    answer = client.post(
        "/new", data={"toml": text, "toml-before": "", "do": "build"}, follow_redirects=False
    )
    assert answer.status_code == 303, answer.text
    return answer.headers["location"]


class Page(HTMLParser):
    """What a page is made of."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.inline: list[str] = []
        self._in: str | None = None
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        self._in = tag if tag in ("script", "style") else None

    def handle_endtag(self, tag):
        self._in = None

    def handle_data(self, data):
        if self._in and data.strip():
            self.inline.append(data)

    def addresses(self) -> Iterator[str]:
        for tag, attributes in self.tags:
            for name in ("href", "src", "action", "data-preview", "data-tiling", "data-events"):
                if attributes.get(name) and not (tag == "image" and name == "href"):
                    yield attributes[name]


@pytest.fixture(scope="module")
def pages(client: TestClient, job: str) -> dict[str, str]:
    """All pages of this part by address."""
    addresses = ["/new", "/new?preset=sao-12deg-512", f"/new?job={job[6:]}", "/jobs", job]
    addresses += ["/jobs?state=failed", "/jobs?state=done", "/sign-in", "/jobs/nothing"]
    addresses += ["/api/docs", *PAGES]
    return {address: client.get(address).text for address in addresses}


def test_every_page_is_whole_and_has_no_script_or_style_of_its_own(pages):
    for address, text in pages.items():
        page = Page(text)
        tags = [tag for tag, _ in page.tags]
        assert text.startswith("<!doctype html>"), address
        for tag in ("h1", "main", "header", "footer"):
            assert tags.count(tag) == 1, (address, tag)
        assert '<a class="skip" href="#content">' in text
        assert 'lang="en"' in text
        assert 'href="/docs"' in text
        ids = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
        assert len(ids) == len(set(ids)), address
        assert page.inline == [], address
        assert not {"style", "iframe", "object", "embed", "base"} & set(tags), address
        names = {name for _, attributes in page.tags for name in attributes}
        assert [name for name in names if name == "style" or name.startswith("on")] == [], address


def test_a_page_has_no_address_elsewhere_and_its_links_lead_somewhere(pages, client):
    others = ("/databases", "/identify", "/releases", "/sign-out", "/")
    posted = ("/cancel", "/retry", "/preview", "/tiling")
    statuses = {}
    for address, text in pages.items():
        for link in Page(text).addresses():
            if link.startswith("data:application/x-ipynb+json"):
                continue  # a file that the page contains
            assert link.startswith(("/", "#", "?")), (address, link)
            assert not link.startswith("//"), (address, link)
            path = urljoin(address, link).partition("#")[0]
            is_ours = path not in others and not path.startswith(("/databases/", "/api/v1/"))
            is_new = path not in statuses and link[0] != "#"
            if is_ours and is_new and not path.endswith(posted):
                statuses[path] = client.get(path).status_code
    assert {path: status for path, status in statuses.items() if status != 200} == {}
    assert len(statuses) > 8


def test_what_others_have_written_is_text(pages, job):
    for text in pages.values():
        assert "<script>alert" not in text
        assert "<img src=x" not in text
    assert pages[job].count("&lt;script&gt;alert(1)") >= 3


def test_static_files_stay_and_nothing_else_is_given(client):
    for name, content in FILES.items():
        answer = client.get(f"/static/{DIGEST}/{name}")
        assert answer.status_code == 200
        assert answer.content == content
        assert "immutable" in answer.headers["cache-control"]
        urls = re.findall(rb"https?://[^\s\"')]+", content)
        assert [url for url in urls if url != b"http://www.w3.org/2000/svg"] == [], name
    for path in (f"/static/{DIGEST}/nothing.css", "/static/0/starcat.css"):
        assert client.get(path).status_code == 404
    for path in ("..%2f__init__.py", "%2e%2e/rendering.py", "..\\rendering.py"):
        assert client.get(f"/static/{DIGEST}/{path}").status_code in (400, 404)


def test_the_package_has_the_styles_and_scripts_of_the_pages_and_no_other():
    folder = Path(starcat_service.__file__).parent / "pages" / "templates"
    texts = [path.read_text(encoding="utf-8") for path in folder.glob("*.html")]
    texts += [content.decode() for content in FILES.values()]
    used = re.compile(r"static\('([^']+)'\)|from \"\./([^\"]+)\"")
    names = {first or second for text in texts for first, second in used.findall(text)}
    assert names == set(FILES)


# The draft: a form and a text that follow each other


def _form(text: str, **changes: str) -> dict[str, str]:
    draft = draft_of_text(text)
    form = {**draft.values, "lens": draft.lens, "products": "shown"}
    form |= {f"products.{name}.enabled": "on" for name, on in draft.products.items() if on}
    return {**form, "toml": draft.text, "toml-before": draft.text, **changes}


@pytest.mark.parametrize("name", preset_names())
def test_a_form_that_comes_back_unchanged_leaves_the_text_as_it_is(name, tmp_path):
    draft = draft_of_content(without_defaults(preset(name).recorded()))
    assert draft.error is None
    assert draft.spec == preset(name)
    assert draft_of_form(_form(draft.text)).text == draft.text
    (tmp_path / "spec.toml").write_text(draft.text, encoding="utf-8")
    assert read_spec(tmp_path / "spec.toml") == preset(name)


def test_a_text_that_was_edited_wins_over_the_fields():
    form = _form(SPEC, **{"selection.faint_limit_mag": "3"})
    draft = draft_of_form({**form, "toml": SPEC.replace("4.5", "5.5  # mine")})
    assert draft.values["selection.faint_limit_mag"] == "5.5"
    assert "# mine" in draft.text


def test_a_text_that_cannot_be_read_leaves_the_fields_as_they_were():
    form = _form(SPEC, **{"selection.faint_limit_mag": "3"})
    draft = draft_of_form({**form, "toml": "name = "})
    assert list(draft.errors) == ["toml"]
    assert draft.values["selection.faint_limit_mag"] == "3"
    assert draft.bands == ("G",)


def test_a_camera_changes_between_its_field_and_its_lens():
    draft = draft_of_form(_form(SPEC, lens="focal"))
    assert draft.spec is not None
    assert draft.spec.camera.fov_x_deg is None
    assert draft.spec.camera.pixel_um == 5.5
    assert draft.spec.camera.camera().fov_x_deg == pytest.approx(30.0, abs=1e-3)
    back = draft_of_form(_form(draft.text, lens="field"))
    assert back.spec is not None
    assert back.spec.camera.fov_x_deg == pytest.approx(30.0, abs=1e-3)


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("selection.faint_limit_mag", "", "missing"),
        ("selection.faint_limit_mag", "bright", "found 'bright'"),
        ("selection.bright_limit_mag", "9", "they may be swapped"),
    ],
)
def test_an_error_is_reported_next_to_its_field_in_the_words_of_the_command(
    key, value, words, tmp_path
):
    draft = draft_of_form(_form(SPEC, **{key: value}))
    assert list(draft.errors) == [key]
    assert words in draft.errors[key]
    assert draft.values[key] == value
    (tmp_path / "spec").write_text(draft.text, encoding="utf-8")
    with pytest.raises(ConfigError) as raised:
        read_spec(tmp_path / "spec")
    assert str(raised.value).removeprefix("spec: ") == draft.errors[key]


@pytest.mark.parametrize(
    "text",
    ["[" * 5000, "selection = 1", "name = 2020-01-01\n[[camera]]\nx = [{a = 1}]", "faint = nan\n"],
    ids=range(4),
)
def test_a_text_that_is_not_a_spec_is_reported_and_nothing_is_lost(text):
    draft = draft_of_text(text)
    assert draft.error is not None
    assert draft.spec is None
    assert draft.text == text
    again = draft_of_form({**_form(SPEC), "toml": text, "toml-before": text})
    assert (again.error is None) == (again.spec is not None)


@pytest.mark.parametrize(
    "text",
    [
        "# mine\n" + SPEC.replace("faint_limit_mag = 4.5", "faint_limit_mag = 4.5  # seen"),
        SPEC.replace("[selection]\nfaint_limit_mag = 4.5", "") + "[selection]  # mine\n"
        "faint_limit_mag = 4.5\n",
    ],
)
def test_a_form_changes_its_keys_and_keeps_comments(text):
    parsed = draft_of_text(text)
    assert parsed.spec is not None
    changes = {"selection.faint_limit_mag": "4", "selection.max_stars_per_field": "20"}
    draft = draft_of_form(_form(text, **changes))
    assert draft.error is None
    assert "# mine" in draft.text
    assert "doubles" not in draft.text, "a usual value is not written"
    assert draft.spec.selection.faint_limit_mag == 4.0
    assert draft.spec.selection.max_stars_per_field == 20


def test_a_form_changes_any_way_to_write_a_spec():
    text = (
        'name = "mycam"\nversion = "1.0.0"\nepoch_jyear = 2016.0\ncatalog.source = "gaia"\n'
        "selection.faint_limit_mag = 6.0\n"
        "camera = { width_px = 1024, height_px = 1024, fov_x_deg = 12.0 }\n"
    )
    changes = {"catalog.source": "sao", "selection.faint_limit_mag": "5", "camera.width_px": "512"}
    form = _form(text, **changes, lens="focal")
    del form["products.grid.enabled"]
    draft = draft_of_form(form)
    assert draft.error is None
    assert (draft.spec.catalog.band, draft.spec.camera.width_px) == ("V", 512)
    assert draft.bands == ("V", "P")
    assert draft.spec.camera.fov_x_deg is None
    assert not draft.spec.products.grid.enabled
    again = _form(draft.text, **{"products.grid.enabled": "on"})
    assert "grid" not in draft_of_form(again).text


# What the page answers


def test_a_page_works_without_scripts(client):
    sent = {**_form(SPEC), "name": "other", "selection.faint_limit_mag": "4", "do": "preview"}
    page = posted(client, "/new", sent)
    assert page.status_code == 200
    assert "faint_limit_mag = 4.0" in page.text
    assert re.search(r"\d+ guide stars", page.text)
    assert "data:image/png;base64," in page.text


def test_a_script_gets_the_new_content_of_the_form(client):
    sent = {**_form(SPEC), "name": "other", "selection.faint_limit_mag": "4"}
    sent["camera.fov_x_deg"] = "40"
    state = posted(client, "/new/preview", sent).json()
    assert state["errors"] == {}
    assert state["values"]["camera.fov_x_deg"] == "40"
    assert len(state["stars"]) == 300
    tiling = client.get("/new/tiling?count=300").json()
    assert len(tiling["ra_deg"]) == len(tiling["dec_deg"]) == 300
    assert state["region_tiling"] is None
    assert "<svg" in state["result"]
    wrong = posted(client, "/new/preview", {**sent, "camera.fov_x_deg": "500"}).json()
    assert list(wrong["errors"]) == ["camera.fov_x_deg"]
    assert not wrong["is_known"]
    assert "To the field" in wrong["wrong"]
    assert wrong["values"]["camera.fov_x_deg"] == "500"


def test_a_script_gets_the_fields_of_a_region(client):
    sent = {**_form(SPEC), "name": "other", "selection.region.zone": "-30, 30"}
    state = posted(client, "/new/preview", sent).json()
    assert state["errors"] == {}
    fields = state["region_tiling"]
    assert 0 < len(state["stars"]) == len(fields["ra_deg"]) == len(fields["dec_deg"]) < 300
    assert max(map(abs, fields["dec_deg"])) <= 30.0


def test_a_catalog_that_is_not_here_is_reported(client, monkeypatch):
    monkeypatch.setenv("STARCAT_CACHE", "/nonexistent")
    monkeypatch.setenv("STARCAT_CATALOGS", "/nonexistent")
    text = SPEC.replace('"gaia"', '"sao"')
    page = client.post("/new", data={"toml": text, "toml-before": "", "do": "preview"})
    assert page.status_code == 422
    [message] = re.findall(r'id="catalog.source-error">([^<]*)<', page.text)
    assert "no file found" in message
    assert "Ask the operator of this service" in message
    assert "--input" not in page.text


def test_a_job_shows_its_steps_and_why_it_failed(pages, job):
    text = pages[job]
    assert "It failed." in text
    steps = re.findall(r'<li class="(\w+)" data-words', text)
    assert steps == ["done", "done", "failed", "open", "open"]
    assert "Try again" in text
    assert "&#34;hostile&#34;" in text


def test_a_job_is_cancelled_and_tried_again(client):
    address = _asked(client, "cancelled")
    assert ">Cancel<" in client.get(address).text
    answer = client.post(f"{address}/cancel", follow_redirects=False)
    assert (answer.status_code, answer.headers["location"]) == (303, address)
    page = client.get(address).text
    assert "It was cancelled." in page
    assert ">Cancel<" not in page
    client.post(f"{address}/retry")
    assert "Waits for a worker." in client.get(address).text


def test_jobs_are_listed_by_state_and_page(client, job):
    assert f'href="{job}"' in client.get("/jobs?state=failed").text
    assert f'href="{job}"' not in client.get("/jobs?state=queued").text
    assert "No job is running" in client.get("/jobs?state=running").text
    assert client.get("/jobs?page=1000").status_code == 200


# The documentation as the service shows it: all of it, with links that lead somewhere.

DOCS = Path(__file__).parents[3] / "docs"


def test_every_page_of_the_documentation_is_in_the_contents():
    listed = [name for part in table_of_pages() for name, _ in part.pages]
    assert sorted([*listed, "index"]) == sorted(
        {path.stem for path in DOCS.glob("*.md")} | REFERENCE.keys()
    )
    assert all(title[0].isupper() for part in table_of_pages() for _, title in part.pages)


def test_links_of_the_documentation_lead_somewhere(client):
    pages = {name: client.get(f"/docs/{name}" if name != "index" else "/docs") for name in NAMES}
    assert {page.status_code for page in pages.values()} == {200}
    anchors = {name: set(re.findall(r' id="([^"]+)"', page.text)) for name, page in pages.items()}
    count = 0
    for name, page in pages.items():
        body = page.text.partition('<article class="words">')[2].partition("</article>")[0]
        for target in re.findall(r'(?:href|src)="([^"]+)"', body):
            count += 1
            if target.startswith(("http://", "https://")):
                continue
            path, _, anchor = target.partition("#")
            if path.startswith("/docs/figures/"):
                assert path.rpartition("/")[2] in FIGURES, (name, target)
                continue
            there = path.removeprefix("/docs").strip("/") or ("index" if path else name)
            assert there in NAMES, (name, target)
            assert not anchor or anchor in anchors[there], (name, target)
    assert count > 60


def test_pictures_of_the_documentation_are_there(client):
    for name in FIGURES:
        answer = client.get(f"/docs/figures/{name}")
        assert answer.status_code == 200
        assert answer.headers["content-type"].startswith("image/")
    assert client.get("/docs/figures/..%2findex.md").status_code in (400, 404)
    assert client.get("/docs/figures/nothing.png").status_code == 404


def test_a_page_that_is_not_there_is_reported(client):
    answer = client.get("/docs/nothing", headers={"Accept": "text/html"})
    assert answer.status_code == 404
    assert "the documentation has no page &#39;nothing&#39;" in answer.text
    moved = client.get("/docs/tutorial.md", follow_redirects=False)
    assert (moved.status_code, moved.headers["location"]) == (308, "/docs/tutorial")


def test_functions_are_described_from_the_program_itself():
    body = read_page("python-identify").body
    assert "<code>Matcher(" in body
    matcher = body.partition("<code>Matcher(")[2].partition("<h3")[0]
    assert "identify(self, centroids_px" in matcher
    assert "eval-rst" not in body
    assert "autoclass" not in body
    summary = read_page("python").body
    assert "<li><code>Tracker</code>: " in summary
    assert "autosummary" not in summary


def test_tables_and_formulas_of_the_documentation_are_tables_and_formulas():
    pages = {name: read_page(name).body for name in NAMES}
    for name in ("spec", "formats", "products"):
        assert pages[name].count('<table class="grid">') > 1
        assert "style=" not in pages[name]
        assert "|---" not in pages[name]
    bodies = [re.sub(r"(?s)<(pre|code).*?</\1>", "", body) for body in pages.values()]
    assert sum(body.count("<math ") for body in bodies) > 100
    assert not [
        formula for body in bodies for formula in re.findall(r"\$.*|\\(?:frac|sigma).*", body)
    ]
