"""Tasks of users in a real browser, from a fresh root with one database, with counted clicks.

The view of the sky, identifying, downloads and publishing. A click is a click on an element, a key
in place of a click, or the choice of a file; typing is not counted.
"""

from __future__ import annotations

import hashlib
import io
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from browsing import NEEDS_BROWSER, begin, click, complaints_of_axe, look
from served import Served, serve
from services import DATABASE, add_database

from starcat.frames.images.render import write_simulated
from starcat.geometry.camera import Camera
from starcat.matcher.database import open_database
from starcat.pipeline.simulation.simulate import Noise, simulate_frames

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytestmark = [NEEDS_BROWSER, pytest.mark.slow, pytest.mark.timeout(150)]


@pytest.fixture(scope="module")
def served(picky_database: Path, tmp_path_factory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("tasks")
    add_database(folder / "service", picky_database)
    with serve(folder / "service", folder / "log", anonymous="publisher") as service:
        yield service


def press(page: Page, role: str, name: str | re.Pattern[str]) -> None:
    click(page, page.get_by_role(role, name=name).first)


def sky_of(page: Page, state: str = "stars") -> None:
    page.locator(f".skyview[data-state={state}]").wait_for()


@pytest.fixture(scope="module")
def picture(picky_database: Path, tmp_path_factory) -> Path:
    """A picture by the camera of the database."""
    return picture_by(open_database(picky_database).camera, picky_database, tmp_path_factory)


def picture_by(camera: Camera, database: Path, tmp_path_factory) -> Path:
    stars = open_database(database)
    path = tmp_path_factory.mktemp("frame") / "frame.png"
    frame = next(simulate_frames(stars.directions, camera, 1, Noise(0.2), 7, mag=stars.mag))
    write_simulated(path, frame, camera, 7)
    return path


def test_task_the_weakest_sky(page, picky_database):
    begin(page)
    press(page, "link", "small 1.0.0")
    press(page, "link", "Coverage")
    sky_of(page, "stars")
    press(page, "button", "Emptiest field, next")
    page.locator(".skyview[data-field]").wait_for()
    assert page.clicks == 3
    rows = (picky_database / "report" / "coverage.csv").read_text().splitlines()[1:]
    counts = [int(row.split(",")[3]) for row in rows]
    least = min(counts)
    field = page.locator(".chosen .what").inner_text()
    assert field.startswith(f"Field {counts.index(least)}: {least} guide star")
    page.wait_for_url(re.compile(rf"field={counts.index(least)}"))
    kept = page.url
    press(page, "button", "Emptiest field, next")
    assert page.locator(".chosen .what").inner_text() != field
    page.goto(kept)
    page.locator(".chosen .what", has_text=field).wait_for()  # the address keeps the view
    page.locator(".chosen a", has_text="Its stars as rows").click()
    page.locator("#answer-count", has_text=f"{least} row").wait_for()


def test_the_field_is_in_sight_and_the_way_back_leads_through_the_fields(page):
    page.goto(f"/databases/{DATABASE}/coverage")
    sky_of(page)
    field = page.locator(".skyview .chosen .what")
    fields = []
    for _ in range(3):
        press(page, "button", "Emptiest field, next")
        fields.append(field.inner_text())
        box = page.locator(".skyview canvas").bounding_box()
        assert 0 <= box["y"] < box["y"] + box["height"] <= page.viewport_size["height"]
    for before in (fields[1], fields[0]):
        page.go_back()
        page.locator(".skyview .chosen .what", has_text=before).wait_for()
    press(page, "button", "Emptiest field, next")
    assert field.inner_text() == fields[1]


def test_the_sky_zooms_pans_and_names_its_stars(page):
    page.goto(f"/databases/{DATABASE}/coverage")
    sky_of(page)
    canvas = page.locator(".skyview canvas")
    size = "document.querySelector('.skyview').sky.at.size"
    press(page, "button", "Zoom in")
    assert page.evaluate(size) == 90
    canvas.focus()
    before = page.evaluate("document.querySelector('.skyview').sky.at.ra")
    page.keyboard.press("ArrowLeft")
    assert page.evaluate("document.querySelector('.skyview').sky.at.ra") != before
    page.keyboard.press("+")
    assert page.evaluate(size) < 90
    page.wait_for_url(re.compile(r"[?&]at=[0-9.]+%2C"))
    press(page, "button", "Whole sky")
    assert page.evaluate(size) == 360
    box = canvas.bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.wheel(0, -300)
    assert page.evaluate(size) < 180
    middle = "document.querySelector('.skyview').sky.at.dec"
    dec = page.evaluate(middle)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2 + 60, steps=4)
    page.mouse.up()
    assert page.evaluate(middle) > dec + 1
    page.goto(f"/databases/{DATABASE}/coverage")
    sky_of(page)
    page.evaluate("window.all = document.querySelector('.skyview').sky.stars")
    for kind, words in (("guide", "guide star"), ("rejected", "rejected: ")):
        where = page.evaluate(
            """kind => { const sky = document.querySelector('.skyview').sky;
            const one = window.all.find((star) => star.kind === kind);
            sky.stars = window.all; sky.go(one.ra_deg, one.dec_deg, 12); sky.draw();
            const box = sky.canvas.getBoundingClientRect();
            return [box.left + one.x, box.top + one.y, one.label]; }""",
            kind,
        )
        page.mouse.move(where[0], where[1])
        page.locator(".skyview .readout", has_text=words).wait_for()
        assert where[2] in page.locator(".skyview .readout").inner_text()
        page.mouse.click(where[0], where[1])
        row = page.locator(".chosen a", has_text="Its row").get_attribute("href")
        assert f"/databases/{DATABASE}/sql?query=SELECT" in row
        assert "simbad" in page.locator(".chosen a", has_text="SIMBAD").get_attribute("href")
        assert "I%2F131A" in page.locator(".chosen a", has_text="VizieR").get_attribute("href")
    page.goto(row)
    page.locator("#answer-count", has_text="1 row").wait_for()


def test_the_outline_of_a_field_turns_with_the_roll(page):
    page.goto(f"/databases/{DATABASE}/coverage?field=3&at=10,20,60,0")
    page.locator(".skyview[data-field='3']").wait_for()
    outline = """roll => { const sky = document.querySelector('.skyview').sky; sky.setRoll(roll);
        const u = sky.outline(sky.fields.ra[3], sky.fields.dec[3], sky.at.roll); return u[0]; }"""
    first, turned, whole = (page.evaluate(outline, roll) for roll in (0, 30, 360))
    assert first == pytest.approx(whole, abs=1e-9)
    assert first != pytest.approx(turned, abs=0.01)
    assert sum(component * component for component in turned) == pytest.approx(1.0)


def test_task_identify_a_picture(page, picture):
    begin(page)
    press(page, "link", "Identify")
    page.get_by_label("Images or files of centroids").set_input_files(picture)
    page.clicks += 1
    press(page, "button", re.compile("^Identify$"))
    page.locator("#attitude .badge", has_text="identified").wait_for()
    assert page.clicks == 3
    sky_of(page)
    assert page.evaluate("document.querySelector('.skyview').sky.marks.length") >= 4
    page.wait_for_url(re.compile(r"centroids="))  # the address has become the answer's
    quaternion = page.locator("#answer dl.facts dd code").first.inner_text()
    page.reload()
    again = page.locator("#answer dl.facts dd code").first.inner_text()
    assert again[:8] == quaternion[:8]


def test_the_picture_of_an_answer_is_zoomed(page):
    page.goto(f"/identify?database={DATABASE}&seed=7")
    box, picture = page.locator(".picture .zoom"), page.locator(".picture img")
    assert picture.evaluate("image => image.naturalWidth") > 600
    before = picture.bounding_box()["width"]
    assert before <= box.bounding_box()["width"] + 1
    press(page, "button", "Enlarge the picture")
    assert picture.bounding_box()["width"] == pytest.approx(1.5 * before, rel=0.05)
    assert box.evaluate("box => box.scrollLeft") > 0  # its middle stays where it was
    press(page, "button", "Whole picture")
    assert picture.bounding_box()["width"] == pytest.approx(before, rel=0.01)
    look(page, "light", 360)  # names are readable: 8 of the 648 points that the picture is wide
    assert 8 / 648 * picture.bounding_box()["width"] > 9
    assert page.evaluate("document.documentElement.scrollWidth") <= 360
    look(page, "light", 1280)


def test_task_identify_one_of_another_camera(page, picky_database, tmp_path_factory):
    camera = Camera(800, 600, fov_x_deg=44.0)
    taken = picture_by(camera, picky_database, tmp_path_factory)
    begin(page)
    press(page, "link", "Identify")
    page.get_by_label("Images or files of centroids").set_input_files(taken)
    page.clicks += 1
    page.locator("#other-camera[open]").wait_for()  # its size is not that of the database's
    assert page.get_by_label("Width px", exact=True).input_value() == "800"
    page.get_by_label("Field across the width deg", exact=True).fill("44")
    press(page, "button", re.compile("^Identify$"))
    page.locator("#attitude .badge", has_text="identified").wait_for()
    assert page.clicks == 3
    field = page.locator("#answer dl.facts").inner_text()
    assert re.search(r"4[34]\.\d{4}°", field)


def test_the_table_of_stars_is_not_cut_and_its_rows_sort_and_filter(page):
    page.goto(f"/identify?database={DATABASE}&seed=7")
    table = page.locator("#star-table")
    assert table.evaluate("t => t.scrollWidth <= t.parentElement.clientWidth")
    press(page, "button", "Magnitude")
    cells = table.locator("tbody tr td:nth-child(2)").all_inner_texts()
    assert [float(cell) for cell in cells] == sorted(float(cell) for cell in cells)
    press(page, "button", "Magnitude")
    assert table.locator("tbody tr td:nth-child(2)").all_inner_texts() == cells[::-1]
    first = table.locator(".star-name").first.inner_text()
    page.get_by_label("Filter").first.fill(first)
    assert table.locator("tbody tr:visible .star-name").first.inner_text() == first
    assert table.locator("tbody tr:visible").count() < len(cells)
    page.reload()
    assert table.locator("tbody tr:visible").count() < len(cells)
    assert "sort.star-table=-Magnitude" in page.url


def test_task_the_flight_image_is_that_of_export(page, picky_database, starcat, tmp_path):
    begin(page)
    press(page, "link", "small 1.0.0")
    with page.expect_download() as download:
        press(page, "button", "Download the flight image")
    assert page.clicks == 2
    download.value.save_as(tmp_path / "browser.img")
    assert download.value.suggested_filename == "small-1.0.0.img"
    to = ["--to", "onboard", "-o", tmp_path / "own.img"]
    assert starcat(["export", picky_database, *to]).code == 0
    digests = {hashlib.sha256((tmp_path / name).read_bytes()).digest()
               for name in ("browser.img", "own.img")}  # fmt: skip
    assert len(digests) == 1


def test_task_publish_and_pull(page, starcat, tmp_path):
    begin(page)
    press(page, "link", "small 1.0.0")
    press(page, "link", "Publish")
    press(page, "button", "Publish")
    page.get_by_text("Publish small 1.0.0 for good?").wait_for()
    assert complaints_of_axe(page) == []
    press(page, "button", "Publish for good")
    page.get_by_text("small-1.0.0 is published.").wait_for()
    assert page.clicks == 4
    pull = page.locator("#small-1\\.0\\.0 pre code").inner_text()
    lock = ["--lock", tmp_path / "starcat.lock"]
    pulled = starcat([*pull.split()[1:], "--output", tmp_path / "pulled", *lock])
    assert pulled.code == 0, pulled.err
    assert (tmp_path / "pulled" / "small-1.0.0" / "database.h5").is_file()


def test_an_answer_of_sql_is_in_the_sky_and_in_its_address(page):
    page.goto(f"/databases/{DATABASE}/sql")
    page.get_by_label("Query").fill("SELECT star_id, mag, ra_deg, dec_deg FROM stars LIMIT 8")
    page.keyboard.press("Control+Enter")
    page.locator("#answer-count", has_text="8 rows").wait_for()
    assert "query=SELECT+star_id" in page.url
    page.get_by_text("In the sky").click()
    sky_of(page)
    assert page.evaluate("document.querySelector('#answer .skyview').sky.marks.length") == 8
    page.goto(f"/databases/{DATABASE}/sql")
    page.get_by_text("Recent queries").click()
    page.locator("#recent a", has_text="LIMIT 8").click()
    page.locator("#answer-count", has_text="8 rows").wait_for()


def test_task_attitudes_are_planned(page):
    begin(page)
    press(page, "link", "Plan")
    table = "time,ra_deg,dec_deg,roll_deg\n2027-03-01T06:30:00,83,-5,0\n2027-03-01T07:00:00,9,20,0"
    page.get_by_label("Attitudes", exact=True).fill(table)
    press(page, "button", "Plan")
    page.locator("#attitude-table").wait_for()
    assert page.clicks == 2
    assert page.locator(".picture img").evaluate("one => one.naturalWidth") > 500
    assert complaints_of_axe(page) == []


@pytest.mark.slow
def test_the_table_of_a_plan_fits_its_card_and_its_plot_is_dark_in_the_dark(page):
    page.goto("/plan")
    rows = [f"2027-03-01T06:{minute:02d}:00,{10 * minute}.123456,-5.4,0" for minute in range(12)]
    table = "\n".join(["time,ra_deg,dec_deg,roll_deg", *rows])
    page.get_by_label("Attitudes", exact=True).fill(table)
    page.locator("summary", has_text="Keep-out angles").click()
    page.get_by_label("Sun").fill("170")
    page.locator("#plan").get_by_role("button", name="Plan").click()
    attitudes = page.locator("#attitude-table")
    attitudes.wait_for()
    assert "Too near, or in the frame" in attitudes.inner_text()
    assert "Earth" not in attitudes.inner_text(), "there is no orbit"
    for width in (1100, 1280):
        look(page, "light", width)
        box = attitudes.evaluate("one => [one.scrollWidth, one.parentElement.clientWidth]")
        assert box[0] <= box[1], width
    # A pixel of the margin of the plot, as the browser draws it.
    light = brightness(page)
    look(page, "dark", 1280)
    dark = brightness(page)
    look(page, "light", 1280)
    assert light > 0.9
    assert dark < 0.3


def brightness(page: Page) -> float:
    """Return how bright the corner of the plot is, from 0 to 1."""
    from PIL import Image

    image = Image.open(io.BytesIO(page.locator(".plot img").screenshot())).convert("L")
    return float(image.getpixel((12, 12))) / 255.0


def test_task_a_database_is_removed(page):
    begin(page)
    press(page, "link", "small 1.0.0")
    page.get_by_text("Remove this database").click()
    press(page, "button", "Remove small-1.0.0 for good")
    page.wait_for_url("**/databases")
    assert page.clicks + 1 <= 6
    assert "No database yet" in page.locator("main").inner_text()
