"""A real browser for tests, and what pages are looked at with."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Locator, Page

CHROMIUM = Path("/usr/bin/chromium")

NEEDS_BROWSER = pytest.mark.skipif(
    not CHROMIUM.exists(), reason=f"no browser: {CHROMIUM} is missing (Debian's chromium)"
)

FLAGS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]

SPEC = """\
name = "browser"
version = "1.0.0"
epoch_jyear = 2016.0

[catalog]
source = "gaia"
read_limit_mag = 7.0

[selection]
faint_limit_mag = 6.0

[camera]
width_px = 1024
height_px = 1024
fov_x_deg = 24.0

[self_test]
frames = 20
"""
"""What a path begins with: fainter stars are not needed, and take time."""

BUILD_MS = 90_000.0
"""A build of the path takes 5 s on a machine that does nothing else."""


@contextmanager
def launched() -> Iterator[Browser]:
    """Give a browser."""
    sync_api = pytest.importorskip("playwright.sync_api")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=str(CHROMIUM), args=FLAGS)
        yield browser
        browser.close()


@contextmanager
def opened(browser: Browser, address: str, width: int = 1280) -> Iterator[Page]:
    """Give a page; what its console complains of is in its ``complaints``."""
    context = browser.new_context(
        base_url=address, viewport={"width": width, "height": 900}, reduced_motion="reduce"
    )
    page = context.new_page()
    page.set_default_timeout(20_000)
    page.complaints = []
    page.on("pageerror", lambda error: page.complaints.append(str(error)))
    page.on("console", lambda said: said.type == "error" and page.complaints.append(said.text))
    yield page
    context.close()


def look(page: Page, theme: str, width: int) -> None:
    """Look at a page in a theme and a width."""
    page.emulate_media(color_scheme=theme)
    page.set_viewport_size({"width": width, "height": 900 if width > 500 else 780})


def settled(page: Page) -> None:
    """Wait until the estimate belongs to the present content of the form."""
    page.wait_for_function("() => document.getElementById('design').dataset.state === 'settled'")


LOOKS = (("light", 360), ("dark", 1280), ("dark", 360), ("light", 1280))
"""Themes and widths in which a page is looked at."""


def complaints_of_axe(page: Page) -> list[tuple[object, ...]]:
    """Check in all looks that a page fits its window; return what axe finds to be wrong."""
    axe = pytest.importorskip("axe_playwright_python.sync_playwright").Axe()
    complaints = []
    for theme, width in LOOKS:
        look(page, theme, width)
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        for violation in axe.run(page).response["violations"]:
            nodes = [node["html"][:160] for node in violation["nodes"][:3]]
            complaints.append((page.url, theme, width, violation["id"], nodes))
    look(page, "light", 1280)
    return complaints


def begin(page: Page) -> None:
    """Begin a task at the start, with no click yet."""
    look(page, "light", 1280)
    page.goto("/")
    page.clicks = 0


def click(page: Page, target: Locator) -> None:
    """Click on something, and count it."""
    target.click()
    page.clicks += 1
