"""The page of one star: the record, the position and the motion that it shows."""

from __future__ import annotations

import gzip
import re
from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import FK5, ICRS, SkyCoord

PAGE = (Path(__file__).parents[2] / "docs" / "star.md").read_text(encoding="utf-8")


def cells(first: str) -> list[str]:
    """Return the cells of the first table row that begins with a text."""
    line = next(line for line in PAGE.splitlines() if line.startswith(f"| {first} |"))
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_the_bytes_on_the_page_are_in_the_file(excerpts):
    number = int(re.search(r"line\s(\d+)\sof", PAGE)[1])  # type: ignore[index]
    with gzip.open(excerpts / "sao.dat.gz", "rt", encoding="ascii") as file:
        record = file.read().splitlines()[number - 1]
    shown = re.findall(r"^\| (\d+)(?:-(\d+))? \| (\w+) \| `([^`]*)` \|", PAGE, re.MULTILINE)
    assert len(shown) == 8
    for first, last, name, characters in shown:
        assert record[int(first) - 1 : int(last or first)] == characters, name


def test_astropy_finds_the_positions_on_the_page() -> None:
    radians = [float(cells(place)[2].strip("`")) for place in ("184-193", "194-204")]
    written = SkyCoord(*radians, unit=u.rad, frame=FK5(equinox="J2000"))
    fk5 = cells("FK5, as the record has it")[1:3]
    icrs = cells("ICRS, J2000.0")[1:3]
    # Six decimals of a degree of declination are 1.8 mas.
    for found, frame, truth in ((fk5, FK5(equinox="J2000"), written), (icrs, ICRS(), written.icrs)):
        printed = SkyCoord(*map(float, found), unit=u.deg, frame=frame)
        assert printed.separation(truth) < 2.0 * u.mas


def test_its_motion_has_the_cosine_of_the_declination_in_it() -> None:
    seconds, arcsec = (float(cells(field)[2].strip("`")) for field in ("161-167", "178-183"))
    cosine = np.cos(float(cells("194-204")[2].strip("`")))
    east, north = map(float, cells("FK5, as the record has it")[3:])
    assert east == pytest.approx(15_000.0 * seconds * cosine, abs=0.005)
    assert north == pytest.approx(1000.0 * arcsec, abs=0.005)
