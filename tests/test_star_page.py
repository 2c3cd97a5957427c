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


def cells(page: str, first: str) -> list[str]:
    """The cells of the first table row that begins with a text."""
    line = next(line for line in page.splitlines() if line.startswith(f"| {first} |"))
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_the_first_two_sections_are_what_the_record_says(
    builder: ModuleType, catalogs: Path, page: str
) -> None:
    number, record = builder.find_record(catalogs)
    for section in (builder.record_section(number, record), builder.conversion_section(record)):
        assert builder.wrapped(section) in page


def test_the_bytes_on_the_page_are_in_the_file(catalogs: Path, page: str) -> None:
    number = int(re.search(r"line\s(\d+)\sof", page)[1])  # type: ignore[index]
    with gzip.open(catalogs / "sao.dat.gz", "rt", encoding="ascii") as file:
        record = file.read().splitlines()[number - 1]
    shown = re.findall(r"^\| (\d+)(?:-(\d+))? \| (\w+) \| `([^`]*)` \|", page, re.MULTILINE)
    assert len(shown) == 8
    for first, last, name, characters in shown:
        assert record[int(first) - 1 : int(last or first)] == characters, name


def test_astropy_finds_the_positions_on_the_page(page: str) -> None:
    radians = [float(cells(page, place)[2].strip("`")) for place in ("184-193", "194-204")]
    written = SkyCoord(*radians, unit=u.rad, frame=FK5(equinox="J2000"))
    fk5 = cells(page, "FK5, as the record has it")[1:3]
    icrs = cells(page, "ICRS, J2000.0")[1:3]
    # Six decimals of a degree of declination are 1.8 mas.
    for found, frame, truth in (
        (fk5, FK5(equinox="J2000"), written),
        (icrs, ICRS(), written.icrs),
    ):
        told = SkyCoord(*map(float, found), unit=u.deg, frame=frame)
        assert told.separation(truth) < 2.0 * u.mas


def test_its_motion_has_the_cosine_of_the_declination_in_it(page: str) -> None:
    seconds, arcsec = (float(cells(page, field)[2].strip("`")) for field in ("161-167", "178-183"))
    cosine = np.cos(float(cells(page, "194-204")[2].strip("`")))
    east, north = map(float, cells(page, "FK5, as the record has it")[3:])
    assert east == pytest.approx(15_000.0 * seconds * cosine, abs=0.005)
    assert north == pytest.approx(1000.0 * arcsec, abs=0.005)


@pytest.mark.slow
def test_the_page_is_what_its_builder_writes(
    builder: ModuleType, catalogs: Path, page: str
) -> None:
    assert builder.star_page(catalogs) == page
