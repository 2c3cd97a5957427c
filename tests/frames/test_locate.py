"""The search for inputs: the places in their order, and the error that names all of them."""

from __future__ import annotations

from pathlib import Path

import pytest

from starcat.catalog.archives.gaia import completed_sky
from starcat.catalog.archives.hipparcos2 import embedded_hipparcos2
from starcat.catalog.source_files import locate
from starcat.errors import SourceMissing

PLACES = ("given", "beside", "variable", "cache")
"""Folders that a test may fill, in the order in which they are searched."""


@pytest.fixture
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name in PLACES:
        (tmp_path / name).mkdir()
    monkeypatch.setenv("STARCAT_CATALOGS", str(tmp_path / "variable"))
    monkeypatch.setenv("STARCAT_CACHE", str(tmp_path / "cache"))
    return tmp_path


def fill(folder: Path, name: str = "hip_main.dat") -> Path:
    path = folder / name
    path.write_bytes(b"x")
    return path


@pytest.mark.parametrize("first", [1, 2, 3])
def test_the_first_place_that_holds_the_source_wins(places: Path, first: int) -> None:
    for name in PLACES[first:]:
        fill(places / name)
    other = {"sao": [fill(places / "beside", "sao.dat")]}
    assert locate("hipparcos", other) == [places / PLACES[first]]


def test_what_is_given_for_the_source_is_taken_unseen(places: Path) -> None:
    fill(places / "cache")
    assert locate("hipparcos", {"hipparcos": []}) == [places / "cache"]
    for name in PLACES:
        fill(places / name)
    given = [places / "given" / "any name", places / "nowhere"]
    assert locate("hipparcos", {"hipparcos": given}) == given


def test_other_inputs_lend_their_folders_in_their_order(places: Path) -> None:
    fill(places / "beside")
    fill(places / "variable")
    sao = fill(places / "beside", "sao.dat")
    for given in (sao, sao.parent):
        assert locate("hipparcos", {"sao": [given]}) == [places / "beside"]
    fill(places / "given")
    others = {"sao": [places / "given" / "sao.dat"], "gcvs": [places / "beside" / "gcvs.tsv"]}
    assert locate("hipparcos", others) == [places / "given"]
    assert locate("hipparcos", dict(reversed(others.items()))) == [places / "beside"]


TYCHO2_PARTS = tuple(f"tyc2.dat.{part:02d}.gz" for part in range(20))


@pytest.mark.parametrize(
    ("source", "names"),
    [
        ("hipparcos", ["hip_main.dat.gz"]),
        ("tycho2", ["tyc2.dat"]),
        ("tycho2", TYCHO2_PARTS),
        ("tycho2", ["tyc2.dat.gz", "tyc2.dat.07", "suppl_1.dat"]),
    ],
)
def test_a_complete_set_makes_the_place(places: Path, source: str, names: list[str]) -> None:
    for name in names:
        fill(places / "variable", name)
    assert locate(source, {}) == [places / "variable"]
    # A stray part of an earlier place does not hide it.
    for name in ("tyc2.dat.07.gz", "suppl_1.dat"):
        fill(places / "beside", name)
    assert locate(source, {"sao": [places / "beside" / "sao.dat"]}) == [places / "variable"]


def test_the_error_names_every_place_once(places: Path, monkeypatch) -> None:
    given = {"sao": [places / "beside" / "sao.dat"], "gcvs": [places / "beside"]}
    with pytest.raises(SourceMissing) as caught:
        locate("hipparcos", given)
    searched = ", ".join(str(places / name) for name in PLACES[1:])
    assert f"no file found in {searched}. " in str(caught.value)
    assert 'inputs["hipparcos"]' in str(caught.value)
    assert caught.value.source == "hipparcos"
    for variable in ({"STARCAT_CATALOGS": ""}, {}):  # without it only the cache is left
        monkeypatch.delenv("STARCAT_CATALOGS")
        for name, value in variable.items():
            monkeypatch.setenv(name, value)
        with pytest.raises(SourceMissing, match=r"no file found in [^,]*cache\. "):
            locate("hipparcos", {})
    # A folder that does not exist is passed over.
    monkeypatch.setenv("STARCAT_CATALOGS", str(places / "nowhere"))
    fill(places / "cache")
    assert locate("hipparcos", {}) == [places / "cache"]


def test_gaia_is_in_its_package_unless_it_is_found(places: Path) -> None:
    assert locate("gaia", {}) == completed_sky()
    assert all(path.is_file() for path in completed_sky())
    assert locate("hipparcos2", {}) == [embedded_hipparcos2()]
    incomplete = places / "cache" / "gaia_merged.bin"
    incomplete.mkdir()
    assert locate("gaia", {}) == completed_sky()
    incomplete.rmdir()
    fill(places / "cache", "gaia_merged.bin")
    assert locate("gaia", {}) == [places / "cache"]
