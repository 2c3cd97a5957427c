"""The service in a real browser: one path through all pages, and what a page owes everybody.

Each step of the path is a fixture that gives what the next one needs, so that a test may stand
behind any of them.
"""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from browsing import BUILD_MS, LOOKS, NEEDS_BROWSER, SPEC, complaints_of_axe, look, opened, settled
from served import serve

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = [NEEDS_BROWSER, pytest.mark.slow, pytest.mark.timeout(150)]

MAX_PAINT_MS = 1000.0


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of a service that runs, with a folder of its own."""
    folder = tmp_path_factory.mktemp("browser")
    with serve(folder / "service", folder / "log", anonymous="publisher") as served:
        yield served.address


@pytest.fixture(scope="module")
def page(browser: Browser, service: str) -> Iterator[Page]:
    """The one page that everything is done in; what its console complains of fails the test."""
    with opened(browser, service) as page:
        yield page


@pytest.fixture(autouse=True)
def no_complaints(request: pytest.FixtureRequest) -> Iterator[None]:
    yield
    if "page" in request.fixturenames:
        page = request.getfixturevalue("page")
        complaints, page.complaints = page.complaints, []
        assert complaints == []


# The path


@pytest.fixture(scope="module")
def designed(page: Page) -> str:
    """A spec that was designed with fields, sliders and text: its TOML."""
    page.goto("/new")
    assert page.title() == "New database · starcat"
    text = page.locator("#toml")
    text.fill(SPEC)
    settled(page)
    field = page.get_by_label("Field across the width deg", exact=True)
    assert field.input_value() == "24"
    before = page.locator("#summary").inner_text()
    field.fill("20")
    page.get_by_label("Boresights", exact=True).fill("400")
    settled(page)
    assert page.locator("#summary").inner_text() != before
    page.get_by_label("Faint limit, slider").focus()
    for _ in range(10):
        page.keyboard.press("ArrowLeft")
    page.get_by_label("grid").uncheck()
    settled(page)
    assert page.get_by_label("Faint limit mag", exact=True).input_value() == "5.5"
    assert tomllib.loads(text.input_value()) == tomllib.loads(SPEC) | {
        "selection": {"faint_limit_mag": 5.5},
        "camera": {"width_px": 1024, "height_px": 1024, "fov_x_deg": 20.0},
        "boresights": {"count": 400},
        "products": {"grid": {"enabled": False}},
    }
    return text.input_value()


@pytest.fixture(scope="module")
def job(designed: str, page: Page) -> str:
    """The address of the job that builds it."""
    page.goto("/new")
    page.locator("#toml").fill(designed)
    settled(page)
    page.get_by_role("button", name="Build").click()
    page.wait_for_url(re.compile(r"/jobs/[0-9a-f]{32}$"))
    return page.url[page.url.index("/jobs") :]


@pytest.fixture(scope="module")
def built(job: str, page: Page) -> str:
    """The id of the database that was built, while its page was watched."""
    page.evaluate("window.isTheSame = true")
    page.locator(".badge:is(.done, .failed, .cancelled)").wait_for(timeout=BUILD_MS)
    assert page.locator(".badge.done").count() == 1, page.locator("main").inner_text()
    assert page.evaluate("window.isTheSame"), "the page was loaded again"
    assert page.locator("#steps .done").count() == 5
    return page.get_by_role("link", name="Open the database").get_attribute("href")[-16:]


def test_a_build_is_watched_until_it_is_done(built, page):
    assert re.fullmatch("[0-9a-f]{16}", built)
    log = page.get_by_role("log").inner_text()
    assert "guide stars in 400 fields" in log
    assert "clean frames were identified" in log
    page.goto("/jobs")
    row = page.get_by_role("row").filter(has_text="browser 1.0.0")
    assert row.locator(".badge").inner_text() == "done"


@pytest.fixture(scope="module")
def looked_at(built: str, page: Page) -> str:
    """The database after its facts, its coverage and its report were looked at."""
    page.goto("/databases")
    page.get_by_role("link", name="browser 1.0.0").click()
    page.wait_for_url(f"**/databases/{built}")
    page.get_by_role("link", name="Coverage").click()
    page.locator(".skyview[data-state=stars]").wait_for()
    page.get_by_role("link", name="Build report").click()
    page.wait_for_url("**/report")
    # A report can do nothing, not even what a driver of browsers would have it do.
    page.complaints = [complaint for complaint in page.complaints if "sandboxed" not in complaint]
    return built


@pytest.fixture(scope="module")
def asked(looked_at: str, page: Page) -> str:
    """The database after it was asked in SQL, with the keyboard, and an answer was downloaded."""
    page.goto(f"/databases/{looked_at}/sql")
    page.get_by_label("Query").fill("SELECT designation, mag FROM stars ORDER BY mag LIMIT 7")
    page.keyboard.press("Control+Enter")
    page.locator("#answer-count", has_text="7 rows").wait_for()
    assert page.locator("#answer thead").inner_text().split() == ["designation", "mag", "mag"]
    page.get_by_label("File").select_option("votable")
    with page.expect_download() as download:
        page.get_by_role("button", name="Download all rows").click()
    assert download.value.suggested_filename == "browser-1.0.0.vot"
    page.get_by_role("link", name="emptiest-fields").click()
    page.get_by_label("$count").fill("3")
    page.get_by_role("button", name="Run").click()
    page.locator("#answer-count", has_text="3 rows").wait_for()
    return looked_at


@pytest.fixture(scope="module")
def identified(asked: str, page: Page) -> str:
    """The database after a simulated frame was identified with it."""
    page.goto(f"/databases/{asked}")
    page.get_by_role("link", name="Identify", exact=True).last.click()
    with page.expect_navigation():
        page.get_by_role("button", name="Try with a simulated frame").click()
    page.locator("#attitude .badge", has_text="identified").wait_for()
    with page.expect_download() as download:
        page.get_by_role("link", name="The simulated frame as it came").click()
    assert download.value.path().read_bytes().startswith(b"\x89PNG")
    assert page.locator("#answer .picture img").evaluate("image => image.naturalWidth") > 600
    return asked


def test_the_sky_and_the_table_tell_the_same_fields(looked_at, page):
    page.goto(f"/databases/{looked_at}/coverage?order=number&page=9")
    page.locator(".skyview[data-state=stars]").wait_for()
    rows = page.locator("#field-table tbody tr")
    box = page.locator(".skyview canvas").bounding_box()
    for row in (rows.nth(2), rows.nth(19)):
        number, ra, dec, stars = (row.locator("th, td").nth(k).inner_text() for k in range(4))
        row.locator("th a").click()
        facts = page.locator(".skyview .chosen .what")
        facts.get_by_text(f"Field {number}: {stars} guide stars").wait_for()
        assert f"RA {ra}, Dec {dec.removeprefix('+')}" in facts.inner_text()
    page.mouse.move(0, 0)
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.locator(".skyview .readout", has_text=re.compile("Field|mag")).wait_for()


def test_a_query_that_fails_is_reported_where_the_answer_would_be(asked, page):
    page.goto(f"/databases/{asked}/sql")
    page.get_by_label("Query").fill("SELECT '<img src=x>' FROM star")
    page.get_by_role("button", name="Run").click()
    page.get_by_role("alert").get_by_text("Table with name star does not exist").wait_for()
    assert page.locator("#answer img").count() == 0
    page.complaints = [complaint for complaint in page.complaints if "400" not in complaint]
    page.get_by_label("Query").fill("SELECT $hidden AS shown")
    page.get_by_role("button", name="Run").click()
    page.get_by_label("$hidden").wait_for()  # the page was loaded again, with a field for it
    page.complaints = [complaint for complaint in page.complaints if "400" not in complaint]


def test_a_file_is_dropped(identified, page):
    page.goto("/identify")
    transfer = page.evaluate_handle(
        "() => { const t = new DataTransfer();"
        "t.items.add(new File(['x_px,y_px\\n1,2\\n'], 'dropped.csv')); return t; }"
    )
    page.dispatch_event("#drop", "drop", {"dataTransfer": transfer})
    assert page.locator("#file").evaluate("input => input.files[0].name") == "dropped.csv"
    with page.expect_navigation():
        page.get_by_role("button", name="Identify", exact=True).click()
    assert "fewer than 4 centroids" in page.locator("#answer").inner_text()


# What a page owes everybody


@pytest.fixture(scope="module")
def addresses(job: str, identified: str) -> list[str]:
    """One address of every kind of page."""
    database = f"/databases/{identified}"
    pinned = "/new?selection.faint_limit_mag=4.5&camera.fov_x_deg=20.0&pinned=camera.fov_x_deg%3D20"
    plain = [
        *("/", "/new", pinned, "/jobs", "/jobs?q=browser", "/databases", "/identify", "/plan"),
        *("/catalogs", "/releases", "/sign-in", "/api/docs", "/docs", "/docs/howto-prove"),
        "/nowhere",
    ]
    sky = "/sql?query=SELECT+designation,ra_deg,dec_deg+FROM+stars+LIMIT+9"
    of_database = ["", "/coverage", "/coverage?field=3&at=10,20,60,0", "/compare", sky]
    frame = f"/identify?database={identified}&seed=7"
    return [*plain, job, frame, *(database + path for path in [*of_database, "/sql?query=FROM"])]


@pytest.mark.timeout(400)
def test_every_page_is_painted_soon_fits_its_window_and_passes_axe(addresses, page):
    """Each is pictured too, for people to look at if STARCAT_SCREENSHOTS names a folder."""
    folder, complaints = os.environ.get("STARCAT_SCREENSHOTS"), []
    for address in addresses:
        assert min(_paint_ms(page, address)) < MAX_PAINT_MS, address
        if address.startswith("/new"):
            settled(page)
        complaints += complaints_of_axe(page)
        if page.locator("main details:not([open])").count():
            every = page.locator("main details")
            every.evaluate_all("all => all.forEach((one) => { one.open = true; })")
            complaints += complaints_of_axe(page)
        for theme, width in LOOKS if folder else ():
            look(page, theme, width)
            name = re.sub(r"\W+", "-", address.partition("?")[0]).strip("-") or "start"
            path = Path(folder) / f"{name}-{len(address)}-{width}-{theme}.png"
            page.screenshot(full_page=True, path=path)
        look(page, "light", 1280)
    page.complaints = [
        complaint for complaint in page.complaints if not re.search("40[04]", complaint)
    ]
    assert complaints == []


def _paint_ms(page: Page, address: str) -> Iterator[float]:
    """Return the time of the first paint, in up to three tries: the machine can be busy."""
    for _ in range(3):
        page.goto(address)
        painted = page.wait_for_function(
            "() => performance.getEntriesByName('first-contentful-paint')[0]?.startTime"
        )
        yield float(painted.json_value())
        if painted.json_value() < MAX_PAINT_MS:
            return


def test_a_page_is_used_with_the_keyboard_only(built, page):
    page.goto("/new")
    settled(page)
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.textContent") == "Skip to the content"
    page.keyboard.press("Enter")
    assert page.evaluate("document.activeElement.id") == "content"
    reached = []
    for _ in range(80):
        page.keyboard.press("Tab")
        reached.append(
            page.evaluate(
                "(() => { const e = document.activeElement; const seen = getComputedStyle(e);"
                "return [e.id || e.tagName, parseFloat(seen.outlineWidth) > 0] })()"
            )
        )
        if reached[-1][0] == "build":
            break
    names = [name for name, _ in reached]
    assert names[-1] == "build"
    assert {"name", "camera.fov_x_deg", "selection.faint_limit_mag", "svg", "toml"} <= set(names)
    assert [name for name, has_outline in reached if not has_outline] == []
    page.get_by_role("application", name="Guide stars").focus()
    page.keyboard.press("ArrowUp")
    page.locator(".sky .readout", has_text="Field").wait_for()
    assert re.search(r"Field \d+: \d+ guide stars?, centre", page.locator(".readout").inner_text())


def test_the_theme_is_kept(built, page):
    page.goto("/jobs")
    page.get_by_role("button", name="Theme").click()
    page.get_by_role("button", name="Theme").click()
    assert page.evaluate("document.documentElement.dataset.theme") == "dark"
    page.goto("/sign-in")
    assert page.evaluate("document.documentElement.dataset.theme") == "dark"
    dark = page.evaluate("getComputedStyle(document.body).backgroundColor")
    page.get_by_role("button", name="Theme").click()
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") != dark
    page.goto("/jobs")
    assert page.evaluate("document.documentElement.dataset.theme") is None
