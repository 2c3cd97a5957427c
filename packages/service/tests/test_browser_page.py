"""What all pages share, in a real browser: the menu and tables of a phone, kept addresses."""

from __future__ import annotations

import pytest
from browsing import LOOKS, NEEDS_BROWSER, complaints_of_axe, look, opened
from served import serve
from services import DATABASE, add_database, token_of

pytestmark = [NEEDS_BROWSER, pytest.mark.timeout(150)]


@pytest.mark.slow
def test_every_page_is_reached_by_the_menu_of_a_phone(page):
    look(page, "light", 360)
    names = []
    for k in range(8):
        page.goto("/")
        assert not page.locator("#menu").is_visible()
        page.get_by_role("button", name="Menu").click()
        link = page.locator("#menu a").nth(k)
        names.append(link.inner_text())
        link.click()
        page.wait_for_url(lambda address: not address.endswith("/"))
        assert page.locator("#menu a[aria-current]").text_content() == names[-1]
    assert {"New database", "Databases", "Releases"} <= set(names)
    look(page, "light", 1280)
    assert page.locator("#menu").is_visible()
    assert not page.get_by_role("button", name="Menu").is_visible()


def test_rows_of_a_table_are_cards_with_the_heads_on_a_phone(page):
    page.goto("/")
    page.evaluate(
        "document.getElementById('content').innerHTML = '<table><thead><tr><th>Name</th><th>Size"
        "</th><th>By</th><th>State</th></tr></thead><tbody><tr><th scope=row>one</th><td>4 MB</td>"
        "<td></td><td>new</td></tr></tbody></table>'"
    )
    page.locator("table.carded").wait_for()
    look(page, "light", 360)
    size = page.locator("td").first
    assert size.evaluate("cell => getComputedStyle(cell, '::before').content") == '"Size"'
    boxes = [page.locator("tbody tr > *").nth(k).bounding_box() for k in (0, 1, 3)]
    assert boxes[0]["y"] < boxes[1]["y"] < boxes[2]["y"]
    assert not page.locator("td").nth(1).is_visible()  # an empty cell is hidden
    look(page, "light", 1280)
    tops = {page.locator("tbody tr > *").nth(k).bounding_box()["y"] for k in (0, 1, 3)}
    assert len(tops) == 1


KEEPING = """(async () => {
  const { kept, keep, startKeeping } = await import(
    document.querySelector("script[type=module]").src.replace("starcat.js", "address.js"));
  document.getElementById("content").innerHTML = `<form data-keeps>
    <input id="limit" name="limit" data-usual="6"><input id="word" name="word" data-unkept>
    <input type="checkbox" id="flip" name="flip" value="yes"><input type="file" name="file"></form>
    <a href="/sign-in">Sign in</a>`;
  startKeeping();
  keep({ sort: "mag" });
  return kept("sort") + kept("nothing");
})()"""


def test_a_form_is_kept_in_the_address_and_through_signing_in(page):
    page.goto("/identify")
    assert page.evaluate(KEEPING) == "mag"
    page.locator("#limit").fill("7")
    page.locator("#word").fill("secret")
    page.locator("#flip").check()
    assert page.url.endswith("/identify?sort=mag&limit=7&flip=yes")
    assert page.locator("#content a").get_attribute("href") == (
        "/sign-in?next=%2Fidentify%3Fsort%3Dmag%26limit%3D7%26flip%3Dyes"
    )
    page.locator("#limit").fill("6")
    page.locator("#flip").uncheck()
    assert page.url.endswith("/identify?sort=mag")


@pytest.mark.slow
def test_who_signs_in_stays_so_and_manages_tokens(browser, tmp_path, picky_database):
    root = tmp_path / "service"
    add_database(root, picky_database)
    token = token_of(root, "operator-with-a-long-name")
    with serve(root, tmp_path / "log") as served, opened(browser, served.address) as page:
        page.goto(f"/sign-in?next=/databases/{DATABASE}/report")
        page.locator("#token").fill(token)
        page.locator("form button[type=submit]").last.click()
        page.wait_for_url("**/report")
        page.get_by_role("link", name="small 1.0.0").click()
        page.wait_for_url(f"**/databases/{DATABASE}")
        page.get_by_role("link", name="Signed in as").click()
        page.get_by_role("link", name="Manage tokens").click()
        page.get_by_label("Name", exact=True).fill("anna")
        page.get_by_label("Role").select_option("builder")
        page.get_by_role("button", name="Create the token").click()
        assert page.locator("#new-token").inner_text().startswith("starcat_")
        assert complaints_of_axe(page) == []
        for theme, width in LOOKS:
            look(page, theme, width)
            # The menu of a phone does not take a line of its own.
            assert page.locator(".head").bounding_box()["height"] < 60
        page.get_by_role("button", name="Revoke the token of anna").click()
        row = page.get_by_role("row").filter(has_text="anna")
        row.get_by_text("revoked").wait_for()
        assert page.get_by_role("button", name="Revoke the token").count() == 0
        # A report can do nothing, not even what a driver of browsers would have it do.
        assert [complaint for complaint in page.complaints if "sandboxed" not in complaint] == []
