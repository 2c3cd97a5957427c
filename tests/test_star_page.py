"""The page of one star: what it says of the record and of its position, and all of it."""

from __future__ import annotations

import gzip
import importlib
import re
import sys
from pathlib import Path
from types import ModuleType

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import FK5, ICRS, SkyCoord

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def builder() -> ModuleType:
    """The script that writes the page; builders are found by path."""
    sys.path.insert(0, str(ROOT / "tests" / "builders"))
    return importlib.import_module("star_page")


@pytest.fixture(scope="module")
def page() -> str:
    return (ROOT / "docs" / "star.md").read_text(encoding="utf-8")


def sections(builder: ModuleType, catalogs: Path) -> str:
    """The first two sections of the page, of the record in some catalogs."""
    number, record = builder.find_record(catalogs)
    both = builder.record_section(number, record), builder.conversion_section(record)
    return "\n\n".join(map(builder.wrapped, both))


@pytest.fixture(scope="module", params=["page", "made"])
def told(request: pytest.FixtureRequest, builder: ModuleType, page: str) -> str:
    """The committed page, and what the builder writes of a record that is made up."""
    if request.param == "page":
        return page
    return sections(builder, request.getfixturevalue("made_catalogs"))


def cells(told: str, first: str) -> list[str]:
    """The cells of the first table row that begins with a text."""
    line = next(line for line in told.splitlines() if line.startswith(f"| {first} |"))
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_the_first_two_sections_are_what_the_record_says(builder, excerpts, page):
    assert sections(builder, excerpts) in page


@pytest.mark.parametrize(
    "folder", [pytest.param("excerpts", marks=pytest.mark.real), "made_catalogs"]
)
def test_the_bytes_on_the_page_are_in_the_file(builder, page, folder, request):
    catalogs = request.getfixturevalue(folder)
    told = page if folder == "excerpts" else sections(builder, catalogs)
    number = int(re.search(r"line\s(\d+)\sof", told)[1])  # type: ignore[index]
    with gzip.open(catalogs / "sao.dat.gz", "rt", encoding="ascii") as file:
        record = file.read().splitlines()[number - 1]
    shown = re.findall(r"^\| (\d+)(?:-(\d+))? \| (\w+) \| `([^`]*)` \|", told, re.MULTILINE)
    assert len(shown) == 8
    for first, last, name, characters in shown:
        assert record[int(first) - 1 : int(last or first)] == characters, name


def test_astropy_finds_the_positions_on_the_page(told: str) -> None:
    radians = [float(cells(told, place)[2].strip("`")) for place in ("184-193", "194-204")]
    written = SkyCoord(*radians, unit=u.rad, frame=FK5(equinox="J2000"))
    fk5 = cells(told, "FK5, as the record has it")[1:3]
    icrs = cells(told, "ICRS, J2000.0")[1:3]
    # Six decimals of a degree of declination are 1.8 mas.
    for found, frame, truth in ((fk5, FK5(equinox="J2000"), written), (icrs, ICRS(), written.icrs)):
        told = SkyCoord(*map(float, found), unit=u.deg, frame=frame)
        assert told.separation(truth) < 2.0 * u.mas


def test_its_motion_has_the_cosine_of_the_declination_in_it(told: str) -> None:
    seconds, arcsec = (float(cells(told, field)[2].strip("`")) for field in ("161-167", "178-183"))
    cosine = np.cos(float(cells(told, "194-204")[2].strip("`")))
    east, north = map(float, cells(told, "FK5, as the record has it")[3:])
    assert east == pytest.approx(15_000.0 * seconds * cosine, abs=0.005)
    assert north == pytest.approx(1000.0 * arcsec, abs=0.005)


@pytest.mark.slow
def test_the_page_is_what_its_builder_writes(builder, excerpts, page):
    assert builder.star_page(excerpts) == page


@pytest.mark.slow
def test_a_page_of_made_catalogs_has_all_sections(builder, made_catalogs, page):
    written = builder.star_page(made_catalogs)
    headings = re.compile(r"^## .*$", re.MULTILINE)
    assert headings.findall(written) == headings.findall(page)
    assert sections(builder, made_catalogs) in written
