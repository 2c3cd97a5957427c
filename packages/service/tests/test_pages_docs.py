"""The documentation as the service shows it: all of it, with links that lead somewhere."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from starcat.cli import REFERENCE
from starcat_service.pages.documentation import FIGURES, NAMES, read_page, table_of_pages

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
    body = read_page("python").body
    assert "<code>Matcher(" in body
    matcher = body.partition("<code>Matcher(")[2].partition("<h3")[0]
    assert "identify(self, centroids_px" in matcher
    assert "eval-rst" not in body
    assert "autoclass" not in body


def test_every_page_leads_to_the_documentation(client):
    for address in ("/", "/new", "/jobs", "/databases", "/sign-in", "/api/docs"):
        assert 'href="/docs"' in client.get(address).text


@pytest.mark.parametrize("name", ["spec", "formats", "products"])
def test_tables_of_the_documentation_are_tables(name):
    body = read_page(name).body
    assert body.count('<table class="grid">') > 1
    assert "style=" not in body
    assert "|---" not in body


def test_formulas_of_the_documentation_are_formulas():
    bodies = [re.sub(r"(?s)<(pre|code).*?</\1>", "", read_page(name).body) for name in NAMES]
    assert sum(body.count("<math ") for body in bodies) > 100
    assert not [found for body in bodies for found in re.findall(r"\$.*|\\(?:frac|sigma).*", body)]
