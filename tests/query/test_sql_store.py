"""SQL about catalog stores: the answers of one table, read only from the files of a place."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy
from astropy import units as u
from cdshealpix.nested import healpix_to_lonlat, vertices

from starcat.catalog.store.layout import MAX_ORDER, Pixel, healpix_29
from starcat.errors import ProductError, QueryError
from starcat.geometry.sphere import directions_from_radec, radec_from_directions, separation
from starcat.query.partitions import EXTENT, extents
from starcat.query.session import Session, open_session

STARS = 6000
MAX_ROWS = 120
AWKWARD = [(0.0, 90.0), (0.0, -90.0), (0.0, 0.0), (359.9999999, 0.0), (0.0, 41.8103148957786),
           (45.0, 89.9999), (225.0, -89.9999), (90.0, 0.0), (1e-9, -41.8)]  # fmt: skip
"""Poles, right ascension 0, and corners of pixels."""

Cells = dict[Pixel, np.ndarray]


@dataclass(frozen=True)
class Sky:
    """Stars and the pixels that a store would have of them."""

    table: pa.Table
    directions: np.ndarray
    cells: Cells


@pytest.fixture(scope="module")
def sky() -> Sky:
    generator = np.random.default_rng(12)
    ra = generator.uniform(0.0, 360.0, STARS)
    dec = np.degrees(np.arcsin(generator.uniform(-1.0, 1.0, STARS)))
    # A crowded part, as the Milky Way is, so that partitions are of several orders.
    ra[: STARS // 3], dec[: STARS // 3] = (
        np.mod(generator.normal(0.0, 8.0, STARS // 3), 360.0),
        generator.normal(60.0, 8.0, STARS // 3).clip(-90.0, 90.0),
    )
    ra[: len(AWKWARD)], dec[: len(AWKWARD)] = np.transpose(AWKWARD)
    pixels = healpix_29(ra, dec)
    mag = generator.uniform(2.0, 12.0, STARS)
    columns = {"_healpix_29": pixels, "star_id": np.arange(STARS), "ra_deg": ra, "dec_deg": dec,
               "mag": mag}  # fmt: skip
    return Sky(pa.table(columns), directions_from_radec(ra, dec), dict(cells_of(pixels)))


def cells_of(pixels: np.ndarray) -> Iterator[tuple[Pixel, np.ndarray]]:
    """Give pixels of few enough stars, and the rows of each in the order of their pixels."""
    left = [Pixel(0, number) for number in range(12)]
    while left:
        pixel = left.pop()
        rows = np.flatnonzero((pixels >= pixel.first) & (pixels < pixel.end))
        if len(rows) > MAX_ROWS and pixel.order < 5:
            left += [Pixel(pixel.order + 1, int(number)) for number in pixel.at(pixel.order + 1)]
        elif len(rows):
            yield pixel, rows[np.argsort(pixels[rows], kind="stable")]


def write_catalog(folder: Path, table: pa.Table, cells: Cells, **properties: object) -> Path:
    """Write a HATS catalog with one file per pixel."""
    for pixel, rows in cells.items():
        path = folder / "dataset" / pixel.path
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(table.take(pa.array(rows)), path)
    said = {"obs_collection": "sky", "hats_col_ra": "ra_deg", "hats_col_dec": "dec_deg"}
    folder.mkdir(parents=True, exist_ok=True)
    lines = [f"{key}={value}\n" for key, value in {**said, **properties}.items()]
    (folder / "hats.properties").write_text("".join(lines))
    return folder


@pytest.fixture(scope="module")
def folder(sky: Sky, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with rejected and repeated records and a margin."""
    store = tmp_path_factory.mktemp("stores") / "sky"
    write_catalog(store / "stars", sky.table, sky.cells)
    write_catalog(store / "stars_margin", sky.table, dict(list(sky.cells.items())[:3]))
    (store / "collection.properties").write_text(
        "obs_collection=sky\nhats_primary_table_url=stars\ndefault_margin=stars_margin\n"
    )
    (store / "stars_margin" / "hats.properties").write_text("hats_margin_threshold=10.0\n")
    (store / "rejected").mkdir()
    for k in range(3):
        reason = pa.table({"reason": ["no_magnitude"] * 5, "ra_deg": np.arange(5.0) + 100 * k,
                           "dec_deg": np.zeros(5)})  # fmt: skip
        pq.write_table(reason, store / "rejected" / f"part-{k}.parquet")
    (store / "repeated" / "Norder=0").mkdir(parents=True)
    pq.write_table(sky.table.slice(0, 7), store / "repeated" / "Norder=0" / "r.parquet")
    return store


@pytest.fixture(scope="module")
def session(folder: Path) -> Iterator[Session]:
    with open_session([str(folder)]) as opened:
        yield opened


def rows(session: Session, text: str, **values: Any) -> list[tuple[Any, ...]]:
    with session.ask(text, values) as answer:
        return answer.rows(100_000)


def ids(session: Session, text: str, **values: Any) -> list[int]:
    return sorted(row[0] for row in rows(session, f"SELECT star_id {text}", **values))


def files_read(session: Session, text: str, **values: Any) -> list[int]:
    """Return the files that each part of a query reads by EXPLAIN; all files if it lists none."""
    [(_, plan)] = rows(session, f"EXPLAIN {text}", **values)
    read = plan.count("READ_PARQUET")
    some = [int(number) for number in re.findall(r"Scanning Files: (\d+)/", plan)]
    return sorted(some + [len(session.views[0].paths)] * (read - len(some)))


def circles(count: int) -> list[tuple[float, float, float]]:
    """Return right ascensions, declinations and radii: random ones and awkward ones."""
    generator = np.random.default_rng(3)
    ra = generator.uniform(-30.0, 400.0, count)
    dec = np.degrees(np.arcsin(generator.uniform(-1.0, 1.0, count)))
    radius = 10 ** generator.uniform(-2.0, np.log10(60.0), count)
    there = [(*place, size) for place in AWKWARD for size in (0.0, 1e-3, 2.5, 40.0)]
    wide = [(10.0, 20.0, 91.0), (200.0, -85.0, 120.0), (0.0, 90.0, 179.0), (5.0, 5.0, 180.0),
            (5.0, 5.0, 400.0)]  # fmt: skip
    anywhere = np.column_stack([ra, dec, radius]).tolist()
    return [*map(tuple, anywhere), *there, *wide]


# Right answers ---------------------------------------------------------------------------------


def test_a_cone_of_a_store_is_what_brute_force_finds(session, sky):
    found_any = 0
    for ra, dec, radius in circles(20):
        apart = np.degrees(separation(sky.directions, directions_from_radec(ra, dec)))
        expected = np.flatnonzero(apart <= radius)
        # The macro and numpy round in other ways: a star at 1e-12 of the end can be in or out.
        unsure = set(np.flatnonzero(np.abs(apart - radius) < 1e-11).tolist())
        found = ids(session, f"FROM cone({ra!r}, {dec!r}, {radius!r})")
        assert set(found) ^ set(expected.tolist()) <= unsure, (ra, dec, radius)
        assert len(set(found)) == len(found)
        found_any += len(found) > 0
    assert found_any > 40


@pytest.mark.parametrize(
    "sides",
    [(350, 10, -20, 20), (0, 360, -90, 90), (10, 350, 60, 90), (350, 10, 60, 90), (0, 0, -1, 1),
     (359.9999, 0.0001, -1, 1), (-10, 10, -30, 30), (-400, 800, -5, 5), (400, 10, -30, 30),
     (350, -10, -30, 30), (90, 91, 41, 42), (44, 46, 89, 90), (200, 300, -90, -80),
     (180, 170, 50, 51), (10, 20, 30, 20), (360, 361, -45, 45)],
)  # fmt: skip
def test_a_box_of_a_store_is_what_brute_force_finds(session, sky, sides):
    west, east, south, north = sides
    ra, dec = (sky.table[name].to_numpy() for name in ("ra_deg", "dec_deg"))
    within = (ra >= west) & (ra <= east) if west <= east else (ra >= west) | (ra <= east)
    expected = np.flatnonzero(within & (dec >= south) & (dec <= north))
    assert ids(session, f"FROM box({west}, {east}, {south}, {north})") == expected.tolist()


@pytest.mark.slow
def test_a_field_of_a_store_is_that_of_one_table(session, sky, tmp_path):
    pq.write_table(sky.table, tmp_path / "stars.parquet")
    with open_session([str(tmp_path / "stars.parquet")]) as plain:
        for ra, dec, size in circles(20):
            asked = f"FROM field({ra!r}, {dec!r}, 30, {min(size, 150)!r}, {min(size, 120)!r})"
            assert ids(session, asked) == ids(plain, asked), asked


def test_places_need_not_be_numbers(session, sky):
    near = "FROM cone({}, {}, {})"
    star = sky.table.slice(5, 1).to_pylist()[0]
    expected = ids(session, near.format(star["ra_deg"], star["dec_deg"], 6.5))
    assert len(expected) > 1
    queries = [f"(SELECT {c} FROM stars WHERE star_id = 5)" for c in ("ra_deg", "dec_deg")]
    assert ids(session, near.format(*queries, "13 / 2")) == expected
    values = {"ra": star["ra_deg"], "dec": star["dec_deg"], "radius": 6.5}
    assert ids(session, near.format("$ra", "$dec", "$radius"), **values) == expected
    joined = (
        "SELECT s.star_id, c.star_id FROM (FROM stars WHERE star_id BETWEEN 5 AND 9) AS s, "
        "LATERAL (FROM {}) AS c ORDER BY ALL"
    )
    pairs = rows(session, joined.format("cone(s.ra_deg, s.dec_deg, 6.5)"))
    assert [pair[1] for pair in pairs if pair[0] == 5] == expected
    assert len({pair[0] for pair in pairs}) == 5
    wide = "(s.ra_deg - 1, s.ra_deg + 1, s.dec_deg - 1, s.dec_deg + 1)"
    assert len(rows(session, joined.format("box" + wide))) >= 5
    assert len(rows(session, joined.format("field(s.ra_deg, s.dec_deg, 0, 5, 5)"))) >= 5


def test_cones_within_other_queries(session, sky):
    one, two = "cone(10, 60, 4)", "cone(200, -30, 20)"
    first, second = ids(session, f"FROM {one}"), ids(session, f"FROM {two}")
    both = ids(session, f"FROM (FROM {one} UNION ALL FROM {two})")
    assert both == sorted(first + second)
    either = f"FROM stars WHERE star_id IN (SELECT star_id FROM {one}) OR star_id IN (SELECT star_id FROM {two})"  # noqa: E501
    assert ids(session, either) == sorted({*first, *second})
    join = f"SELECT count(*) FROM {one} AS a JOIN {one} AS b USING (star_id) WHERE a.mag < 6 OR b.mag > 8"  # noqa: E501
    mag = sky.table["mag"].to_numpy()[first]
    assert rows(session, join) == [(int(((mag < 6) | (mag > 8)).sum()),)]
    with_name = f"WITH near AS MATERIALIZED (FROM {one}) SELECT count(*) FROM near"
    assert rows(session, with_name) == [(len(first),)]


def test_a_cone_of_a_store_that_does_not_exist_is_an_error(session):
    for numbers in ("10, 5, -1", "10, 5, 'nan'::DOUBLE", "10, -95, 5", "10, 5, -40"):
        with pytest.raises(QueryError, match="does not exist: give "):
            ids(session, f"FROM cone({numbers})")


# Files that are read ---------------------------------------------------------------------------


def test_explain_tells_the_files_of_every_part_of_a_query(session, sky):
    every = len(sky.cells)
    for one in ("cone(10, -60, 1)", "field(10, -60, 0, 1, 1)", "box(9, 11, -61, -59)"):
        assert files_read(session, f"SELECT star_id FROM {one}")[0] <= 4 < every
    assert files_read(session, "SELECT star_id FROM cone($ra, -60, 1)", ra=10.0)[0] <= 4
    union = "SELECT star_id FROM cone(10, -60, 1) UNION ALL SELECT star_id FROM cone(90, 0, 1)"
    assert max(files_read(session, union)) <= 5
    join = "SELECT count(*) FROM cone(10, -60, 1) AS a JOIN stars AS b USING (star_id)"
    fewest, most = files_read(session, join)
    assert fewest <= 4 < most == every
    nested = f"SELECT mag FROM (SELECT * FROM ({union}) JOIN cone(10, -60, 2) USING (star_id))"
    assert max(files_read(session, nested)) <= 5
    assert files_read(session, "SELECT star_id FROM stars") == [every]


def test_a_partition_that_is_not_reached_is_not_read(session, folder, sky, tmp_path):
    copied = tmp_path / "sky"
    shutil.copytree(folder, copied)
    near = "FROM cone(10, -60, 5)"
    touched = {Pixel(*place) for place in files_named(session, near)}
    assert 0 < len(touched) < 10
    for pixel in set(sky.cells) - touched - {min(sky.cells, key=lambda p: p.first)}:
        path = copied / "stars" / "dataset" / pixel.path
        path.write_bytes(b"PAR1" + b"\xff" * 200 + b"PAR1")
    with open_session([str(copied)]) as damaged:
        assert ids(damaged, near) == ids(session, near)
        with pytest.raises(QueryError, match="parquet"):
            rows(damaged, "SELECT sum(mag) FROM stars")
        assert ids(damaged, near) == ids(session, near)


def files_named(session: Session, text: str) -> set[tuple[int, int]]:
    """Return orders and numbers of the partitions that a query reads, as EXPLAIN names them."""
    [(_, plan)] = rows(session, f"EXPLAIN (FORMAT json) SELECT star_id {text}")
    found = re.findall(r"Norder=(\d+)/Dir=\d+/Npix=(\d+)", plan)
    return {(int(order), int(number)) for order, number in found}


@pytest.mark.parametrize("order", [0, 1, 2, 4])
def test_pixels_are_within_their_circles_and_boxes(order):
    deeper = 3
    cells = np.arange(12 * 4**order)
    found = extents([Pixel(order, int(cell)) for cell in cells])
    _, _, _, _, _, reach, ra_from, ra_to, dec_from, dec_to = found.T
    lon, lat = healpix_to_lonlat(cells, order)
    centres = found[:, :3]
    assert separation(centres, directions_from_radec(lon.deg, lat.deg)).max() < 1e-14
    small = np.arange(12 * 4 ** (order + deeper))
    ra, dec = (corners.to_value(u.deg) for corners in vertices(small, order + deeper))
    cell = np.repeat(small >> 2 * deeper, 4)
    ra, dec = ra.ravel(), dec.ravel()
    apart = np.degrees(separation(directions_from_radec(ra, dec), centres[cell]))
    assert (apart < reach[cell]).all()
    assert (apart.reshape(len(cells), -1).max(axis=1) > reach - 2e-6).all()
    assert ((dec_from[cell] < dec) & (dec < dec_to[cell])).all()
    width = (ra_to - ra_from)[cell]
    is_within = np.mod(ra - ra_from[cell], 360.0) < width
    assert (is_within | (np.abs(dec) > 89.9999999)).all()
    assert width.max() < 90.1


def test_pixels_of_the_highest_order_have_extents():
    deep = int(healpix_29(np.array([123.4]), np.array([-5.6]))[0])
    found = dict(zip(EXTENT, extents([Pixel(MAX_ORDER, deep), Pixel(0, 3)])[0], strict=True))
    centre = np.array([found["x"], found["y"], found["z"]])
    apart = separation(centre, directions_from_radec(123.4, -5.6))
    assert np.degrees(apart) < found["reach"] < 2e-6


# Views -----------------------------------------------------------------------------------------


def test_the_views_of_a_store(session, sky):
    assert [view.name for view in session.views] == ["stars", "rejected", "repeated"]
    assert session.targets[0].name == "sky"
    assert rows(session, "SELECT sum(star_id) FROM sky.stars") == [(STARS * (STARS - 1) // 2,)]
    for text, count in (
        ("sky.stars", STARS), ("rejected WHERE reason = 'no_magnitude'", 15), ("repeated", 7),
        ("cone(101, 0, 1.5, of := 'rejected')", 3),
        ("cone(10, 60, 9, of := 'STARS')", len(ids(session, "FROM cone(10, 60, 9)"))),
    ):  # fmt: skip
        assert rows(session, f"SELECT count(*) FROM {text}") == [(count,)]
    names = [row[0] for row in rows(session, "DESCRIBE stars")]
    assert names == sky.table.column_names
    described = [row[0] for row in rows(session, "DESCRIBE FROM cone(1, 2, 3)")]
    assert described == [*names, "separation_deg"]
    tables = {row[0] for row in rows(session, "SHOW TABLES")}
    assert {"stars"} <= tables <= {"stars", "rejected", "repeated"}


def test_two_stores_at_once(folder, sky, tmp_path):
    other = write_catalog(tmp_path / "other", sky.table, sky.cells)
    with open_session([str(folder), str(other)]) as both:
        first = rows(both, "SELECT star_id FROM a.cone(10, 60, 3) ORDER BY star_id")
        assert first == rows(both, "SELECT star_id FROM other.cone(10, 60, 3) ORDER BY star_id")
        joined = "SELECT count(*) FROM a.cone(10, 60, 3) JOIN b.cone(10, 60, 3) USING (star_id)"
        assert rows(both, joined) == [(len(first),)]
        assert max(files_read(both, joined)) < 20


def test_pairs_across_partitions_are_found(folder, sky, tmp_path):
    shifted = sky.directions + np.random.default_rng(4).normal(scale=1e-4, size=(STARS, 3))
    shifted /= np.linalg.norm(shifted, axis=1)[:, None]
    ra, dec = radec_from_directions(shifted)
    table = pa.table({"ra_deg": ra, "dec_deg": dec, "row": np.arange(STARS)})
    pq.write_table(table, tmp_path / "shifted.parquet")
    with open_session([str(folder), str(tmp_path / "shifted.parquet")]) as both:
        asked = "SELECT a_star_id, b_row FROM crossmatch('a', 'b', 60)"
        with both.ask(asked) as answer:
            found = answer.rows(10**6)
    apart = scipy.spatial.cKDTree(sky.directions).sparse_distance_matrix(
        scipy.spatial.cKDTree(shifted), 2 * np.sin(np.radians(30 / 3600)), output_type="ndarray"
    )
    assert sorted(found) == sorted(zip(apart["i"].tolist(), apart["j"].tolist(), strict=True))
    pixels = healpix_29(*radec_from_directions(sky.directions)), healpix_29(ra, dec)
    assert any(pixels[0][i] >> 42 != pixels[1][j] >> 42 for i, j in found), "across borders"


def test_the_preamble_of_a_store_gives_any_duckdb_the_same(starcat, folder, session):
    with duckdb.connect() as connection:
        connection.execute(starcat(["sql", folder, "--preamble"]).out)
        query = "SELECT count(*) FROM cone(10, 60, 3)"
        assert connection.execute(query).fetchall() == rows(session, query)
        [(_, plan)] = connection.execute(f"EXPLAIN {query}").fetchall()
        assert "Scanning Files" in plan


# Catalogs of others ----------------------------------------------------------------------------


def theirs(sky: Sky, folder: Path, ra_from: float) -> Path:
    """Write the sky as others do: other names, and columns whose names mean something here."""
    ra = np.where(sky.table["ra_deg"].to_numpy() >= 360.0 + ra_from, -360.0, 0.0)
    table = pa.table({
        "filename": pa.array(["theirs"] * STARS), "Norder": np.full(STARS, 77, np.int32),
        "RAJ2000": sky.table["ra_deg"].to_numpy() + ra, "DEJ2000": sky.table["dec_deg"],
        "x": np.full(STARS, 5.0), "star_id": sky.table["star_id"], "ra": np.zeros(STARS),
        "_healpix_29": sky.table["_healpix_29"],
    })  # fmt: skip
    named = {"hats_col_ra": "raj2000", "hats_col_dec": "DEJ2000"}
    return write_catalog(folder, table, sky.cells, **named)


@pytest.mark.parametrize("ra_from", [0.0, -180.0])
def test_catalogs_of_others_have_places(sky, session, tmp_path, ra_from):
    with open_session([str(theirs(sky, tmp_path / "Theirs.v1", ra_from))]) as opened:
        for place in ("cone(359.5, 60, 4)", "cone(0, 90, 30)", "box(350, 10, -20, 20)",
                      "box(170, 200, -40, 60)", "field(0, 60, 20, 8, 6)"):  # fmt: skip
            assert ids(opened, f"FROM {place}") == ids(session, f"FROM {place}")
            assert files_read(opened, f"SELECT star_id FROM {place}")[0] < len(sky.cells)
        [row] = rows(opened, "SELECT filename, Norder, x FROM cone(0, 60, 4) GROUP BY ALL")
        assert row == ("theirs", 77, 5.0)
        assert rows(opened, "SELECT count(*) FROM theirs_v1.stars") == [(STARS,)]


def test_a_partition_can_be_a_folder_of_files(sky, session, tmp_path):
    store = write_catalog(tmp_path / "many", sky.table, sky.cells, hats_npix_suffix="/")
    for path in sorted(store.rglob("Npix=*.parquet")):
        whole = pq.read_table(path, partitioning=None)
        path.unlink()
        path.with_suffix("").mkdir()
        for k, part in enumerate((whole.slice(0, len(whole) // 2), whole.slice(len(whole) // 2))):
            pq.write_table(part, path.with_suffix("") / f"part{k}.parquet")
    with open_session([str(store)]) as opened:
        assert ids(opened, "FROM cone(10, 60, 4)") == ids(session, "FROM cone(10, 60, 4)")
        assert files_read(opened, "SELECT mag FROM cone(10, -60, 1)")[0] <= 8
        assert ids(opened, "FROM stars") == list(range(STARS))


@pytest.mark.parametrize("kind", ["store", "file"])
def test_a_table_without_places_is_reported(sky, tmp_path, kind):
    table = sky.table.rename_columns(["_healpix_29", "star_id", "alpha", "dec_deg", "mag"])
    target = tmp_path / "stars.parquet"
    if kind == "store":
        target = write_catalog(tmp_path / "odd", table, sky.cells)
    else:
        pq.write_table(table, target)
    with open_session([str(target)]) as opened:
        assert rows(opened, "SELECT count(*) FROM stars") == [(STARS,)]
        words = "stars has no column ra_deg; cone, box, field and crossmatch"
        for place in ("cone(1, 2, 3)", "box(1, 2, 3, 4)", "field(1, 2, 3, 4, 5)",
                      "crossmatch('stars', 'stars', 1)"):  # fmt: skip
            with pytest.raises(QueryError, match=words):
                rows(opened, f"FROM {place}")


# Damage ----------------------------------------------------------------------------------------


def test_a_missing_partition_is_reported(sky, tmp_path):
    store = write_catalog(tmp_path / "sky", sky.table, sky.cells)
    pixels = "".join(f"{pixel.order},{pixel.number}\n" for pixel in sky.cells)
    (store / "partition_info.csv").write_text(f"Norder,Npix\n{pixels}")
    (store / "dataset" / list(sky.cells)[5].path).unlink()
    words = r"partition Norder=.* is missing; the catalog is not whole"
    with pytest.raises(ProductError, match=words), open_session([str(store)]):
        pass


def test_a_store_behind_a_link_with_an_awkward_name_is_opened(sky, session, tmp_path):
    store = write_catalog(tmp_path / 'it\'s a "sky" [1]; --', sky.table, sky.cells)
    (tmp_path / "link").symlink_to(store)
    with open_session([str(tmp_path / "link")]) as opened:
        assert ids(opened, "FROM cone(10, 60, 4)") == ids(session, "FROM cone(10, 60, 4)")
        assert files_read(opened, "SELECT mag FROM cone(10, -60, 1)")[0] <= 4
