"""Simple cone searches: the stars that brute force finds, in the form of the standard."""

from __future__ import annotations

import csv
import io
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy import units
from astropy.coordinates import SkyCoord
from astropy.io.votable import parse
from fastapi.testclient import TestClient
from pyvo.dal import DALQueryError, conesearch
from served import Served
from services import CATALOG, DATABASE

from starcat.database.reader import open_database_folder

PLACES = [
    (83.6, -5.4, 10.0),
    (0.0, 0.0, 15.0),
    (359.9, 30.0, 12.0),
    (10.0, 90.0, 20.0),
    (200.0, -90.0, 14.5),
    (120.0, 45.0, 0.001),
    (360.0, 0.0, 180.0),
]


@pytest.fixture(scope="module")
def stars(small_database: Path) -> dict[str, np.ndarray]:
    table = open_database_folder(small_database).table("stars")
    names = ("designation", "star_id", "ra_deg", "dec_deg", "mag")
    return {name: np.array(table[name].to_pylist()) for name in names}


def near(stars: dict[str, np.ndarray], ra_deg: float, dec_deg: float, sr: float) -> list[str]:
    """Return the stars within a radius, the nearest first, by other means than starcat's."""
    places = SkyCoord(stars["ra_deg"] * units.deg, stars["dec_deg"] * units.deg)
    apart = places.separation(SkyCoord(ra_deg * units.deg, dec_deg * units.deg)).deg
    order = [k for k in np.argsort(apart) if apart[k] <= sr]
    return [str(stars["designation"][k]) for k in order]


def ask(client: TestClient, catalog: str = DATABASE, **parameters: Any) -> Any:
    return client.get(f"/scs/{catalog}", params={"RA": 83.6, "DEC": -5.4, "SR": 20, **parameters})


def fields_of(content: bytes) -> list[Any]:
    # astropy calls the UCDs that the standard asks for out of date.
    return list(parse(io.BytesIO(content), verify="ignore").get_first_table().fields)


# The stars ---------------------------------------------------------------------------------


def test_a_search_finds_what_brute_force_finds(client, stars):
    for ra_deg, dec_deg, sr in PLACES:
        answer = ask(client, RA=ra_deg, DEC=dec_deg, SR=sr)
        assert answer.status_code == 200
        assert answer.headers["content-type"] == "text/xml;content=x-votable"
        rows = parse(io.BytesIO(answer.content)).get_first_table().array
        assert rows["designation"].tolist() == near(stars, ra_deg, dec_deg, sr)
    assert len(rows) == len(stars["mag"]) > 300, "the last search is of the whole sky"
    assert (np.diff(rows["separation_deg"].data) >= 0).all()
    assert sorted(rows["mag"].tolist()) == sorted(stars["mag"].tolist())


@pytest.mark.parametrize("catalog", ["small", "bright", "faint", "sao", f"{CATALOG}.parquet"])
def test_a_catalog_has_several_names(client, stars, catalog):
    rows = parse(io.BytesIO(ask(client, catalog).content)).get_first_table().array
    assert rows["designation"].tolist() == near(stars, 83.6, -5.4, 20.0)


def test_verbosity_chooses_columns_with_the_ucds_of_the_standard(client, small_database):
    fields = {v: fields_of(ask(client, VERB=v).content) for v in (1, 2, 3)}
    names = {v: [field.name for field in fields[v]] for v in fields}
    assert names[1] == ["designation", "ra_deg", "dec_deg", "separation_deg"]
    assert [field.name for field in fields_of(ask(client).content)] == names[2]
    assert {"mag", "band", "pm_dec_mas_yr", "star_id"} <= set(names[2])
    assert "source_line" not in names[2]
    every = open_database_folder(small_database).table("stars").column_names
    assert sorted(names[3]) == sorted([*every, "row", "separation_deg"])
    for columns in fields.values():
        [name] = [field for field in columns if field.ucd == "ID_MAIN"]
        assert name.datatype in ("char", "unicodeChar")
        for ucd in ("POS_EQ_RA_MAIN", "POS_EQ_DEC_MAIN"):
            [field] = [field for field in columns if field.ucd == ucd]
            assert (field.datatype, str(field.unit), field.ref) == ("double", "deg", "starcat.icrs")


def test_a_radius_of_nothing_gives_the_columns_only(client):
    table = parse(io.BytesIO(ask(client, SR=0).content)).get_first_table()
    assert len(table.array) == 0
    assert [f.name for f in table.fields] == [f.name for f in fields_of(ask(client).content)]


@pytest.mark.parametrize(("maxrec", "is_over"), [(0, True), (3, True), (999, False)])
def test_a_search_is_cut_and_says_so(client, stars, maxrec, is_over):
    answer = ask(client, MAXREC=maxrec)
    rows = parse(io.BytesIO(answer.content)).get_first_table().array
    assert rows["designation"].tolist() == near(stars, 83.6, -5.4, 20.0)[:maxrec]
    assert (b'value="OVERFLOW"' in answer.content) == is_over


def test_another_format_has_the_same_stars(client, stars):
    text = ask(client, responseformat="csv", responseformat_=1)
    assert text.headers["content-type"].startswith("text/csv")
    rows = list(csv.DictReader(io.StringIO(text.text)))
    assert [row["designation"] for row in rows] == near(stars, 83.6, -5.4, 20.0)


def test_the_document_is_of_the_database(client):
    document = parse(io.BytesIO(ask(client).content))
    infos = {info.name: info.value for info in document.resources[0].infos}
    assert infos == {"QUERY_STATUS": "OK", "artifact": "small", "version": "1.0.0"}
    [system] = document.resources[0].coordinate_systems
    assert (system.system, system.epoch) == ("ICRS", "J2026")


# Refusals ----------------------------------------------------------------------------------


# Clients of others -------------------------------------------------------------------------


@pytest.fixture
def address(served: Served) -> str:
    """The cone search of a service that runs."""
    return f"{served.address}/scs/{DATABASE}"


def test_pyvo_searches_and_gets_the_error(address, stars):
    rows = conesearch(address, pos=(83.6, -5.4), radius=20.0, verbosity=1)
    expected = near(stars, 83.6, -5.4, 20.0)
    assert [row.id for row in rows] == expected
    first = list(stars["designation"]).index(expected[0])
    assert rows[0].pos.ra.deg == stars["ra_deg"][first]
    assert rows[0].pos.dec.deg == stars["dec_deg"][first]
    with pytest.raises(DALQueryError, match="VERB is '7'; give a whole number from 1 to 3"):
        conesearch(address, pos=(0.0, 0.0), radius=1.0, verbosity=7)


@pytest.mark.slow
@pytest.mark.timeout(120)
@pytest.mark.skipif(shutil.which("stilts") is None, reason="stilts is not installed")
def test_stilts_searches(address, stars, tmp_path):
    out, asked = tmp_path / "found.csv", tmp_path / "asked.csv"
    asked.write_text("ra,dec\n83.6,-5.4\n0,90\n", encoding="ascii")
    subprocess.run(
        ["stilts", "coneskymatch", f"in={asked}", "ifmt=csv", "ra=ra", "dec=dec", "sr=20",
         f"serviceurl={address}", "servicetype=cone", "verb=3", "find=all", f"out={out}",
         "ofmt=csv"],
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    rows = list(csv.DictReader(io.StringIO(out.read_text(encoding="utf-8"))))
    expected = near(stars, 83.6, -5.4, 20.0) + near(stars, 0.0, 90.0, 20.0)
    assert sorted(row["designation"] for row in rows) == sorted(expected)
