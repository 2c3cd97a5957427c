"""Tasks of users in a real browser, from a fresh root, with counted clicks: designing a database.

A click is a click on an element; typing is not counted.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from browsing import (
    BUILD_MS,
    NEEDS_BROWSER,
    SPEC,
    begin,
    click,
    complaints_of_axe,
    look,
    opened,
    settled,
)
from served import Served, serve
from services import add_database, service_photographs, token_of

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytestmark = [NEEDS_BROWSER, pytest.mark.slow, pytest.mark.timeout(150)]


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("new")
    with serve(folder / "service", folder / "log", anonymous="builder") as service:
        yield service


def fill(page: Page, label: str, text: str) -> None:
    """Click into a field, type over what is there, and wait for the estimate."""
    field = page.get_by_label(label, exact=True)
    click(page, field)
    changed = "() => document.getElementById('design').dataset.state"
    before = page.evaluate(changed)
    field.fill(text)
    assert before != "changed"
    settled(page)


def design(page: Page) -> None:
    begin(page)
    click(page, page.get_by_role("link", name="New database").first)
    page.wait_for_url("**/new")
    settled(page)


def test_the_field_of_view_and_the_limits_are_on_the_first_screen(page):
    design(page)
    bar = page.locator(".bar").bounding_box()["y"]
    for label in ("Field across the width", "Faint limit", "Bright limit"):
        slider = page.get_by_label(f"{label}, slider").bounding_box()
        assert 0 < slider["y"] < slider["y"] + slider["height"] < bar, label
    fill(page, "Faint limit mag", "99")
    fill(page, "Bright limit mag", "98")
    assert page.locator("#wrong .notice").count() == 1
    assert "2 fields are wrong" in page.locator("#wrong").inner_text()
    page.goto("/new?selection.faint_limit_mag=99")
    settled(page)
    assert "Counting" not in page.locator("#body").inner_text()


def test_a_box_makes_a_database_of_many_fields(page):
    design(page)
    widest = page.get_by_label("Widest field deg", exact=True)
    assert not widest.is_visible()
    click(page, page.get_by_label("Many fields of view"))
    settled(page)
    fill(page, "Widest field deg", "24")
    assert page.clicks <= 4
    assert "widest_fov_x_deg = 24" in page.locator("#toml").input_value()
    assert page.get_by_role("button", name="Build").is_enabled()


def test_task_two_limits_are_compared(page):
    design(page)
    click(page, page.get_by_role("button", name="Pin to compare"))
    page.locator(".pinned").wait_for()
    settled(page)
    fill(page, "Faint limit mag", "4.5")
    assert page.clicks <= 3
    row = page.locator(".pinned tr", has_text="selection.faint_limit_mag")
    assert [row.locator("td").nth(k).inner_text() for k in range(2)] == ["4.5", "6.0"]
    verdicts = page.locator(".verdict").all_inner_texts()
    assert "of the sky is blind" in verdicts[0]
    assert verdicts[1].startswith("Good")
    colours = page.locator("#body .legend").evaluate_all("all => all.map((one) => one.innerText)")
    assert len(colours) == 2
    assert colours[0] == colours[1]
    stars = page.locator("dl.figures .figure", has_text="guide stars").first
    now, pinned = (
        int(re.sub(r"\D", "", stars.locator(selector).inner_text()))
        for selector in (".value", ".was")
    )
    assert 0 < now < pinned
    page.get_by_role("button", name="Unpin").click()
    page.locator(".pinned").wait_for(state="detached")


def test_task_a_design_is_shared_by_its_link(page, browser, served):
    design(page)
    fill(page, "Field across the width deg", "17.5")
    page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    click(page, page.get_by_role("link", name="Link to this design"))
    page.get_by_role("link", name="Copied").wait_for()
    assert page.clicks <= 3
    link = page.evaluate("navigator.clipboard.readText()")
    assert link == page.url
    with opened(browser, served.address) as other:
        other.goto(link)
        settled(other)
        assert other.locator("#toml").input_value() == page.locator("#toml").input_value()
        assert other.get_by_label("Name", exact=True).input_value() == "gaia-12deg"
        other.reload()
        settled(other)
        assert other.get_by_label("Field across the width deg", exact=True).input_value() == "17.5"


def test_a_link_has_what_was_typed_last(page):
    design(page)
    page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    page.route("**/new/preview", lambda _: None)  # the estimate does not answer
    page.get_by_label("Field across the width deg", exact=True).fill("18.5")
    page.get_by_role("link", name="Link to this design").click()
    page.get_by_role("link", name="Copied").wait_for()
    assert page.evaluate("navigator.clipboard.readText()").endswith("/new?camera.fov_x_deg=18.5")
    page.unroute("**/new/preview")


def test_a_build_that_is_pressed_before_the_estimate_asks(page):
    design(page)
    page.route("**/new/preview", lambda _: None)
    page.get_by_label("Faint limit mag", exact=True).fill("2.5")
    page.get_by_role("button", name="Build").click()
    page.locator(".notice.bad", has_text="of the sky is blind").first.wait_for()
    assert page.url.endswith("/new") or "faint_limit_mag=2.5" in page.url
    page.unroute("**/new/preview")
    page.complaints.clear()  # the answer is a refusal, of which the console tells


def test_enter_in_a_field_updates_the_estimate(page):
    design(page)
    field = page.get_by_label("Field across the width deg", exact=True)
    field.fill("19")
    field.press("Enter")
    settled(page)
    assert page.url.endswith("camera.fov_x_deg=19.0")
    assert "photographs" not in page.locator("#wrong").inner_text()


@pytest.fixture
def reading(tmp_path: Path) -> Iterator[tuple[Served, str]]:
    """A service in which everybody may read, and the token of a publisher."""
    token = token_of(tmp_path, "anna")
    with serve(tmp_path, tmp_path / "log", anonymous="reader") as service:
        yield service, token


@pytest.mark.parametrize("name", ["Sign in to build", "Sign in"])
def test_a_design_that_was_just_typed_outlasts_the_sign_in(browser, reading, name):
    served, token = reading
    with opened(browser, served.address) as page:
        page.goto("/new")
        page.route("**/new/preview", lambda _: None)
        page.get_by_label("Field across the width deg", exact=True).fill("17")
        role = "button" if name == "Sign in to build" else "link"
        page.get_by_role(role, name=name, exact=True).click()
        page.wait_for_url("**/sign-in?**")
        page.get_by_label("Token").fill(token)
        page.locator("main").get_by_role("button", name="Sign in").click()
        page.wait_for_url("**/new?camera.fov_x_deg=17.0")
        assert page.get_by_label("Field across the width deg", exact=True).input_value() == "17"
        description = page.get_by_label("Description").input_value()
        assert description == "Guide stars for a field of 17 x 17 deg, from gaia, G <= 6"
        assert page.get_by_role("button", name="Build").count() == 1


def test_a_design_outlasts_another_page_and_the_way_back(page):
    design(page)
    fill(page, "Faint limit mag", "5.25")
    page.get_by_role("link", name="Databases").first.click()
    page.wait_for_url("**/databases")
    page.go_back()
    settled(page)
    assert page.get_by_label("Faint limit mag", exact=True).input_value() == "5.25"


def test_nothing_wrong_can_be_built_and_an_error_stands_next_to_its_field(page):
    design(page)
    build = page.get_by_role("button", name="Build")
    limit = page.get_by_label("Faint limit mag", exact=True)
    assert build.is_enabled()
    fill(page, "Faint limit mag", "99")
    assert build.is_disabled()
    assert limit.get_attribute("aria-invalid") == "true"
    assert "at most 40" in page.locator("[id='selection.faint_limit_mag-error']").inner_text()
    fill(page, "Faint limit mag", "-29")  # no star is that bright: what the build would say
    assert build.is_disabled()
    fill(page, "Faint limit mag", "5")
    assert build.is_enabled()
    assert limit.get_attribute("aria-invalid") is None
    assert "guide stars" in page.locator("#summary").inner_text()
    page.locator("#toml").fill("name = ")
    settled(page)
    assert "not a readable TOML file" in page.locator("#toml-error").inner_text()
    assert limit.input_value() == "5"


def test_the_map_is_in_sight_while_the_sliders_move_on_a_phone(page):
    design(page)
    look(page, "light", 360)
    for label in ("Field across the width, slider", "Faint limit, slider", "Boresights, slider"):
        slider = page.get_by_label(label)
        slider.scroll_into_view_if_needed()
        slider.focus()
        page.keyboard.press("ArrowRight")
        settled(page)
        seen = page.locator("#body .hero svg").first.bounding_box()
        moved, height = slider.bounding_box(), page.viewport_size["height"]
        assert 0 <= seen["y"] < seen["y"] + seen["height"] < moved["y"], label
        assert moved["y"] + moved["height"] < height - 60, label
        assert page.locator("#verdict").is_visible()
    look(page, "light", 1280)


def test_task_a_database_of_20_degrees_is_designed_and_built(page):
    design(page)
    fill(page, "Field across the width deg", "20")
    click(page, page.get_by_role("button", name="Suggest for this camera"))
    page.locator("#wrong", has_text="For 20 x 20 deg: faint limit 5.2").wait_for()
    settled(page)
    click(page, page.get_by_role("button", name="Build"))
    page.wait_for_url(re.compile(r"/jobs/[0-9a-f]{32}$"))
    assert page.clicks <= 4
    page.locator(".badge:is(.done, .failed)").wait_for(timeout=BUILD_MS)
    assert page.locator(".badge.done").count() == 1, page.locator("main").inner_text()
    page.goto("/new?camera.fov_x_deg=20.0&name=gaia-12deg")
    settled(page)
    assert "is there already" in page.locator("[id='version-error']").inner_text()
    assert page.get_by_role("button", name="Build").is_disabled()


@pytest.mark.timeout(600)
def test_task_photographs_tell_their_camera(page, tmp_path_factory):
    """The database that finds cameras is built meanwhile, by a job that the page waits for."""
    photographs = service_photographs(tmp_path_factory.mktemp("sky"), tmp_path_factory)
    design(page)
    click(page, page.get_by_text("Find the camera of photographs"))
    page.get_by_label("Photographs of stars").set_input_files(photographs)
    click(page, page.get_by_role("button", name="Find the camera"))
    page.locator("#wrong", has_text="is being built, once for all users").wait_for()
    page.locator("#wrong", has_text="2 files, 2 identified").wait_for(timeout=3 * BUILD_MS)
    settled(page)
    assert page.clicks + 1 <= 6
    field = page.get_by_label("Field across the width deg", exact=True)
    assert float(field.input_value()) == pytest.approx(31.7, rel=0.003)
    assert page.get_by_role("button", name="Build").is_enabled()


def test_a_response_is_dropped_and_its_numbers_are_in_the_address(page):
    expect = pytest.importorskip("playwright.sync_api").expect
    begin(page)
    page.goto("/new")
    settled(page)
    page.locator("#sensor-fields > summary").click()
    assert complaints_of_axe(page) == []
    rows = "".join(f"{nm},{0.001 * (nm - 350)}\n" for nm in range(400, 901, 50))
    file = {"name": "blue sensor.csv", "mimeType": "text/csv", "buffer": rows.encode()}
    page.locator("#response_file").set_input_files([file])
    response = page.locator("#camera\\.response\\.name")
    expect(response).to_have_value("blue-sensor", timeout=BUILD_MS)
    settled(page)
    assert "camera.response.wavelength_nm=" in page.url
    assert page.locator("#response_file").input_value() == ""
    page.goto(page.url)
    settled(page)
    expect(response).to_have_value("blue-sensor")
    assert page.locator("#sensor-fields").get_attribute("open") is not None
    response.select_option("")
    settled(page)
    assert "camera.response" not in page.url


def test_task_another_version_is_built_and_compared(page):
    job = page.request.post("/api/v1/jobs", data={"kind": "build", "spec": SPEC}).json()
    page.goto(f"/jobs/{job['id']}")
    page.locator(".badge.done").wait_for(timeout=BUILD_MS)
    begin(page)
    click(page, page.get_by_role("link", name="browser 1.0.0").first)
    click(page, page.get_by_role("link", name="New version"))
    settled(page)
    fill(page, "Version", "1.1.0")
    fill(page, "Faint limit mag", "5.8")
    click(page, page.get_by_role("button", name="Build"))
    page.wait_for_url(re.compile(r"/jobs/[0-9a-f]{32}$"))
    assert page.clicks <= 6
    page.locator(".badge.done").wait_for(timeout=BUILD_MS)
    begin(page)
    click(page, page.get_by_role("link", name="browser 1.1.0"))
    click(page, page.get_by_role("link", name="Compare"))
    page.get_by_role("heading", name="Side by side").wait_for()
    assert page.clicks <= 6
    assert [heading.split("-")[1] for heading in page.locator(".columns h3").all_inner_texts()] == [
        "1.0.0",
        "1.1.0",
    ]
    assert page.locator(".sky image").count() == 2
    assert "Identified in the self-test: clean" in page.locator("main").inner_text()
    assert complaints_of_axe(page) == []
    for width in (360, 1280):
        look(page, "light", width)
        values = page.locator("[aria-label='Table: both databases'] td").first.bounding_box()
        assert 0 < values["x"] < values["x"] + values["width"] <= width


def test_task_how_good_is_it(page, served, picky_database: Path):
    add_database(served.root, picky_database)
    begin(page)
    click(page, page.get_by_role("link", name=f"{picky_database.name}".replace("-1.0.0", " 1.0.0")))
    click(page, page.get_by_role("button", name="Evaluate"))
    page.wait_for_url(re.compile(r"/jobs/[0-9a-f]{32}$"))
    page.locator("#headline").wait_for(timeout=BUILD_MS)
    assert page.clicks <= 2
    words = page.locator("#found").inner_text()
    assert "of all pointings, clean frames" in words
    assert re.search(r"interval of 95 %\n\d+\.\d to \d+\.\d %", words)
    assert page.locator(".chart").count() == 3
    assert "100" in page.locator(".chart svg").first.get_attribute("aria-label")
    click(page, page.get_by_role("link", name="Open the database"))
    page.locator("#headline").wait_for()  # it is kept with its database
    assert page.clicks <= 6
    assert complaints_of_axe(page) == []
