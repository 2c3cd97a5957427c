"""ADQL: its meaning against brute force, its translation, and the places of refusals."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from astropy import units
from astropy.coordinates import SkyCoord, angular_separation
from matplotlib.path import Path as Outline
from numpy.typing import NDArray

from starcat.errors import QueryError
from starcat.geometry.sphere import directions_from_radec
from starcat.query.session import Session, open_session
from starcat_service.protocols.adql import translate, translate_adql
from starcat_service.protocols.tables import Schema, Tables, TapColumn, TapTable, session_schemas

COUNT = 1500

TABLE = Path(__file__).parent / "data" / "adql.tsv"
QUERIES = [line.split("\t") for line in TABLE.read_text(encoding="utf-8").splitlines()[1:]]
ANSWERED = [(query, answer) for query, answer in QUERIES if not answer.startswith("! ")]
REFUSED = [(query, answer[2:]) for query, answer in QUERIES if answer.startswith("! ")]

Floats = NDArray[np.float64]
Corners = list[tuple[float, float]]


@pytest.fixture(scope="module")
def places() -> Floats:
    """Right ascensions and declinations, degrees: at random, and poles and seams."""
    generator = np.random.default_rng(21)
    ra = generator.uniform(0.0, 360.0, COUNT)
    dec = np.degrees(np.arcsin(generator.uniform(-1.0, 1.0, COUNT)))
    awkward = [(0.0, 90.0), (0.0, -90.0), (0.0, 0.0), (359.999, 1.0), (180.0, 0.0)]
    return np.concatenate([np.column_stack([ra, dec]), awkward])


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory, places: Floats) -> Iterator[Session]:
    path = tmp_path_factory.mktemp("adql") / "places.parquet"
    row = np.arange(len(places))
    ra_deg, dec_deg = places.T
    columns = {
        "row": row, "ra_deg": ra_deg, "dec_deg": dec_deg, "size": row % 7,
        "name": [f"Star {k}" for k in row], "is_odd": row % 2 == 1,
        "maybe": pa.array([None if k % 3 else float(k) for k in row]),
    }  # fmt: skip
    pq.write_table(pa.table(columns), path)
    with open_session([str(path)]) as opened:
        yield opened


@pytest.fixture(scope="module")
def tables(session: Session) -> Tables:
    return Tables(session_schemas(session, {}))


@pytest.fixture(scope="module")
def find(session, tables):
    """Return the columns of the answer to a query."""

    def answer(text: str) -> dict[str, list[object]]:
        return dict(translate_adql(session, translate(text, tables)).read_all().to_pydict())

    return answer


@pytest.fixture(scope="module")
def measured(find):
    """Return numbers of all places, in their order: an array of a row for each expression."""

    def numbers(*expressions: str) -> Floats:
        columns_text = ", ".join(f"{text} AS c{k}" for k, text in enumerate(expressions))
        columns = find(f"SELECT {columns_text} FROM places ORDER BY row")
        return np.array(list(columns.values()), dtype=np.float64)

    return numbers


# Geometry against brute force.


def apart_deg(places: Floats, ra: float, dec: float) -> Floats:
    apart = angular_separation(*np.radians(places.T), np.radians(ra), np.radians(dec))
    return np.asarray(np.degrees(apart))


def star_shaped(seed: int, widest_deg: float = 35.0) -> tuple[Corners, tuple[float, float]]:
    """Return corners around a place, not convex as a rule; some go one way, some the other."""
    generator = np.random.default_rng(seed)
    ra, dec = generator.uniform(0, 360), float(np.degrees(np.arcsin(generator.uniform(-1, 1))))
    count = int(generator.integers(3, 9))
    # No gap between corners is half a turn.
    azimuth = np.radians(360.0 / count) * (np.arange(count) + generator.uniform(0, 0.4, count))
    reach = np.radians(generator.uniform(4.0, widest_deg, count))
    corners = [offset(ra, dec, a, r) for a, r in zip(azimuth, reach, strict=True)]
    return (corners if seed % 2 else corners[::-1]), (ra, dec)


def offset(ra: float, dec: float, azimuth: float, reach: float) -> tuple[float, float]:
    """Return the place in a direction (radians from north through east) at a distance (radians)."""
    d = np.radians(dec)
    s = np.sin(d) * np.cos(reach) + np.cos(d) * np.sin(reach) * np.cos(azimuth)
    x = np.cos(reach) - np.sin(d) * s
    along = np.arctan2(np.sin(azimuth) * np.sin(reach) * np.cos(d), x)
    return float((ra + np.degrees(along)) % 360.0), float(np.degrees(np.arcsin(s)))


def gnomonic(places: Floats, centre: tuple[float, float]) -> tuple[Floats, NDArray[np.bool_]]:
    """Return places on the plane that touches the sphere, where great circles are lines."""
    ra, dec = np.radians(places.T)
    ra0, dec0 = np.radians(centre)
    ahead = np.sin(dec0) * np.sin(dec) + np.cos(dec0) * np.cos(dec) * np.cos(ra - ra0)
    east = np.cos(dec) * np.sin(ra - ra0)
    north = np.cos(dec0) * np.sin(dec) - np.sin(dec0) * np.cos(dec) * np.cos(ra - ra0)
    is_ahead = ahead > 1e-6
    safe = np.where(is_ahead, ahead, 1.0)
    return np.column_stack([east / safe, north / safe]), is_ahead


def within(places: Floats, corners: Corners, centre: tuple[float, float]) -> NDArray[np.bool_]:
    """Return which places are in a polygon, by matplotlib's plane geometry."""
    flat, is_ahead = gnomonic(places, centre)
    outline = Outline(gnomonic(np.array(corners), centre)[0])
    return np.asarray(outline.contains_points(flat)) & is_ahead


def polygon(corners: Corners) -> str:
    return f"POLYGON({', '.join(f'{ra!r}, {dec!r}' for ra, dec in corners)})"


def edge_points(corners: Corners, each: int = 400) -> Floats:
    """Return places along the sides of a polygon."""
    u = directions_from_radec(*np.array(corners).T)
    parts = np.linspace(0.0, 1.0, each)[:, None]
    points = np.concatenate(
        [(1 - parts) * a + parts * b for a, b in zip(u, np.roll(u, -1, axis=0), strict=True)]
    )
    points /= np.linalg.norm(points, axis=1)[:, None]
    ra = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    return np.column_stack([ra, np.degrees(np.arcsin(points[:, 2]))])


CIRCLES = [
    (10.0, 20.0, 15.0), (0.0, 90.0, 30.0), (359.5, -2.0, 8.0), (200.0, -89.9, 1.5),
    (90.0, 0.0, 180.0), (90.0, 0.0, 120.0), (45.0, 10.0, 0.0), (-30.0, 5.0, 9.0),
]  # fmt: skip


def test_a_circle_holds_what_is_near(measured, places):
    asked = [
        f"CONTAINS(POINT(ra_deg, dec_deg), CIRCLE({ra}, {dec}, {r}))" for ra, dec, r in CIRCLES
    ]
    inside = measured(*asked)
    for (ra, dec, radius), answers in zip(CIRCLES, inside, strict=True):
        assert np.array_equal(answers == 1, apart_deg(places, ra, dec) <= radius)
        assert set(answers) <= {0.0, 1.0}


def test_polygons_hold_what_their_sides_enclose(measured, places):
    shapes = [star_shaped(seed) for seed in range(6)]
    asked = [f"CONTAINS(POINT(ra_deg, dec_deg), {polygon(corners)})" for corners, _ in shapes]
    inside = measured(*asked)
    for (corners, centre), answers in zip(shapes, inside, strict=True):
        expected = within(places, corners, centre)
        assert expected.any()
        assert np.array_equal(answers == 1, expected)


def test_polygons_of_columns_are_those_of_numbers(measured):
    corners = [(10.0, -20.0), (50.0, -10.0), (30.0, 40.0)]
    moved = ", ".join(f"{ra} + 0 * row, {dec} + 0 * row" for ra, dec in corners)
    point = "POINT(ra_deg, dec_deg)"
    [of_numbers, of_columns] = measured(
        f"CONTAINS({point}, {polygon(corners)})", f"CONTAINS({point}, POLYGON({moved}))"
    )
    assert np.array_equal(of_numbers, of_columns)
    assert 0 < of_numbers.sum() < COUNT


def test_a_box_is_the_polygon_of_its_corners(measured):
    corners = [(30.4, -15.0), (20.4, -15.0), (20.4, -25.0), (30.4, -25.0)]
    [in_box, in_polygon, area, same] = measured(
        "CONTAINS(POINT(ra_deg, dec_deg), BOX(25.4, -20.0, 10, 10))",
        f"CONTAINS(POINT(ra_deg, dec_deg), {polygon(corners)})",
        "AREA(BOX('ICRS', POINT(25.4, -20), 10, 10))",
        f"AREA({polygon(corners)})",
    )
    assert np.array_equal(in_box, in_polygon)
    assert in_box.any()
    assert area[0] == pytest.approx(same[0], rel=1e-12)


def test_areas_are_sums_of_spherical_triangles(measured):
    shapes = [star_shaped(seed) for seed in range(30, 36)]
    areas = measured(*(f"AREA({polygon(corners)})" for corners, _ in shapes))[:, 0]
    for (corners, centre), area in zip(shapes, areas, strict=True):
        turns = zip(corners, corners[1:] + corners[:1], strict=True)
        expected = sum(excess(centre, a, b) for a, b in turns)
        assert area == pytest.approx(np.degrees(np.degrees(expected)), rel=1e-9)


def excess(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> float:
    """Return the area of a triangle by the law of L'Huilier, steradians."""
    pairs = ((b, c), (c, a), (a, b))
    sides = [np.radians(apart_deg(np.array([p]), *q)[0]) for p, q in pairs]
    half = sum(sides) / 2.0
    product = np.tan(half / 2.0) * np.prod([np.tan((half - side) / 2.0) for side in sides])
    return float(4.0 * np.arctan(np.sqrt(max(0.0, product))))


def test_areas_of_circles(measured):
    [small, half, all_] = measured(
        "AREA(CIRCLE(1, 2, 0.001))", "AREA(CIRCLE(1, 2, 90))", "AREA(CIRCLE(1, 2, 180))"
    )[:, 0]
    sphere = 4.0 * np.degrees(np.degrees(np.pi))
    assert small == pytest.approx(np.pi * 1e-6, rel=1e-9)
    assert half == pytest.approx(sphere / 2.0)
    assert all_ == pytest.approx(sphere)


def test_the_middle_of_a_polygon_is_that_of_its_places(measured):
    generator = np.random.default_rng(3)
    everywhere = generator.normal(size=(200_000, 3))
    everywhere /= np.linalg.norm(everywhere, axis=1)[:, None]
    ra = np.degrees(np.arctan2(everywhere[:, 1], everywhere[:, 0]))
    sky = np.column_stack([ra, np.degrees(np.arcsin(everywhere[:, 2]))])
    for seed in (50, 51, 52):
        corners, centre = star_shaped(seed)
        [lon, lat] = measured(
            f"COORD1(CENTROID({polygon(corners)}))", f"COORD2(CENTROID({polygon(corners)}))"
        )[:, 0]
        mean = everywhere[within(sky, corners, centre)].mean(axis=0)
        middle = directions_from_radec(np.array([lon]), np.array([lat]))[0]
        # Of some thousand places the mean is known to a part of a degree.
        assert np.degrees(np.arccos(middle @ mean / np.linalg.norm(mean))) < 0.5
        assert 0.0 <= lon < 360.0


def test_circles_and_polygons_meet_where_their_places_do(measured):
    generator = np.random.default_rng(8)
    asked, expected = [], []
    for seed in range(60, 70):
        corners, centre = star_shaped(seed)
        ra, dec = offset(*centre, generator.uniform(0, 6), np.radians(generator.uniform(0, 60)))
        radius = generator.uniform(1.0, 25.0)
        nearest = apart_deg(edge_points(corners), ra, dec).min()
        is_inside = within(np.array([[ra, dec]]), corners, centre)[0]
        if abs(nearest - radius) < 0.05:
            continue
        shapes = f"CIRCLE({ra}, {dec}, {radius})", polygon(corners)
        asked += [f"INTERSECTS({shapes[0]}, {shapes[1]})", f"INTERSECTS({shapes[1]}, {shapes[0]})",
                  f"CONTAINS({shapes[0]}, {shapes[1]})"]  # fmt: skip
        meets = bool(is_inside or nearest <= radius)
        expected += [meets, meets, bool(is_inside and nearest >= radius)]
    numbers = measured(*asked)[:, 0]
    assert np.array_equal(numbers, expected)
    assert {0.0, 1.0} == set(numbers)


def test_polygons_meet_where_their_places_do(measured):
    asked, expected = [], []
    for seed in range(100, 112):
        corners, centre = star_shaped(seed)
        generator = np.random.default_rng(seed)
        ra, dec = offset(*centre, generator.uniform(0, 6), np.radians(generator.uniform(0, 40)))
        shifted = [offset(ra, dec, a, np.radians(8)) for a in np.radians([10, 100, 190, 280])]
        inside = within(edge_points(shifted), corners, centre)
        around = within(edge_points(corners), shifted, (ra, dec))
        asked += [f"INTERSECTS({polygon(shifted)}, {polygon(corners)})",
                  f"CONTAINS({polygon(shifted)}, {polygon(corners)})"]  # fmt: skip
        expected += [bool(inside.any() or around.any()), bool(inside.all())]
    numbers = measured(*asked)[:, 0]
    assert np.array_equal(numbers, expected)
    assert 2 < numbers.sum() < len(numbers) - 2


def test_shapes_within_circles(measured):
    numbers = measured(
        "CONTAINS(CIRCLE(10, 10, 3), CIRCLE(12, 10, 5))",
        "CONTAINS(CIRCLE(10, 10, 3), CIRCLE(14, 10, 5))",
        "INTERSECTS(CIRCLE(10, 10, 3), CIRCLE(17, 10, 5))",
        "INTERSECTS(CIRCLE(10, 10, 3), CIRCLE(19, 10, 5))",
        "CONTAINS(BOX(10, 10, 2, 2), CIRCLE(10, 10, 2))",
        "CONTAINS(BOX(10, 10, 3, 3), CIRCLE(10, 10, 2))",
        "CONTAINS(POINT(10, 10), POINT(10, 10))",
        "INTERSECTS(POINT(10, 10), CIRCLE(10, 11, 2))",
        "CONTAINS(CIRCLE(10, 10, 0), POINT(10, 10))",
    )[:, 0]
    assert numbers.tolist() == [1, 0, 1, 0, 1, 0, 1, 1, 0]


def test_a_place_without_numbers_is_nowhere(find):
    query = "SELECT COUNT(*) AS n FROM places WHERE {} = CONTAINS(POINT(maybe, 0), CIRCLE(0, 0, 5))"
    inside, outside = (find(query.format(k))["n"][0] for k in (1, 0))
    assert inside + outside == find("SELECT COUNT(maybe) AS n FROM places")["n"][0]


def test_shapes_are_selected_as_dali_writes_them(find):
    columns = find(
        "SELECT TOP 1 POINT(1, 2) AS p, CIRCLE('ICRS', 1, 2, 3) AS c, POLYGON(1, 2, 3, 4, 5, 0) "
        "AS s, COORDSYS(POINT('ICRS', 1, 2)) AS f, COORD2(POINT(1, 2)) AS y FROM places"
    )
    assert columns == {"p": [[1, 2]], "c": [[1, 2, 3]], "s": [[1, 2, 3, 4, 5, 0]], "f": ["ICRS"],
                     "y": [2.0]}  # fmt: skip


# Everything else: the queries of `data/adql.tsv`. Its last place has row 1500 and ra_deg 0.


@pytest.mark.parametrize(("text", "expected"), ANSWERED)
def test_every_query_of_the_table_has_its_answer(find, text, expected):
    [answer] = find(text.replace("⏎", "\n")).values()
    values = json.loads(expected)
    if isinstance(values[0], float):
        assert answer == pytest.approx(values, rel=1e-14)
    else:
        assert answer == values


def test_random_numbers_are_between_0_and_1(find):
    numbers = np.array(find("SELECT RAND() AS a, RAND(5) AS b FROM places")["a"])
    assert 0.0 <= numbers.min() < 0.1
    assert 0.9 < numbers.max() < 1.0


def test_galactic_places_are_those_of_astropy(measured, places):
    """Both are defined by the pole of B1950; the difference is 0.05 arc seconds."""
    ra, dec = places.T
    sky = SkyCoord(ra, dec, unit="deg").galactic
    centre = SkyCoord(30.0, -10.0, unit="deg", frame="galactic").icrs
    expressions = [
        "DISTANCE(POINT('GALACTIC', 30, -10), POINT(ra_deg, dec_deg))",
        "DISTANCE(POINT('galactic', ra_deg, dec_deg), POINT('ICRS', 12.5, -40))",
        "CONTAINS(POINT(ra_deg, dec_deg), CIRCLE('GALACTIC', 30, -10, 20))",
        "CONTAINS(POINT(ra_deg, dec_deg), BOX('GALACTIC', 30, 0, 40, 20))",
    ]
    apart, moved, circle, box = measured(*expressions)
    arcsec = 1.0 / 3600.0
    assert np.abs(apart - apart_deg(places, centre.ra.deg, centre.dec.deg)).max() < 0.1 * arcsec
    other = SkyCoord(ra, dec, unit="deg", frame="galactic").icrs
    turned = np.column_stack([other.ra.deg, other.dec.deg])
    assert np.abs(moved - apart_deg(turned, 12.5, -40.0)).max() < 0.1 * arcsec
    assert np.array_equal(circle, apart <= 20.0)
    inner = (np.abs(sky.l.wrap_at(210 * units.deg).deg - 30) < 19.9) & (np.abs(sky.b.deg) < 9.9)
    assert inner.any()
    assert (box[inner] == 1).all()
    assert (box[np.abs(sky.b.deg) > 12.0] == 0).all()


BOXES = [
    (0, 0, 20, 20), (359, 10, 10, 10), (0, 0, 360, 180), (180, 0, 360, 180), (0, 0, 360, 20),
    (10, 0, 200, 40), (350, 20, 300, 30), (40, 80, 90, 40), (0, -80, 360, 30), (12, 3, 720, 400),
]  # fmt: skip


def test_boxes_over_the_seam_the_poles_and_the_whole_sky_hold_what_they_say(measured, places):
    ra, dec = places.T
    inside = measured(*(
        f"CONTAINS(POINT(ra_deg, dec_deg), BOX({', '.join(map(str, box))}))" for box in BOXES
    ))  # fmt: skip
    for (lon, lat, width, height), answers in zip(BOXES, inside, strict=True):
        beside = np.abs((ra - lon + 180.0) % 360.0 - 180.0)
        up = np.abs(dec - lat)
        inner = (beside < width / 2.0) & (up < height / 2.0 - 0.5)
        outer = (beside > width / 2.0) | (up > height / 2.0 + 0.5)
        assert inner.any()
        assert (answers[inner] == 1).all(), (lon, lat)
        assert (answers[outer] == 0).all(), (lon, lat)
    [sky, half] = measured("AREA(BOX(0, 0, 360, 180))", "AREA(BOX(0, 45, 360, 90))")[:, 0]
    assert sky == pytest.approx(4.0 * np.degrees(np.degrees(np.pi)))
    assert half == pytest.approx(sky / 2.0)


def test_a_separation_below_a_number_is_what_contains_asks(find, tables):
    point, other = "POINT(a.ra_deg, a.dec_deg)", "POINT(b.ra_deg, b.dec_deg)"
    query = (
        "SELECT a.row AS i, b.row AS j FROM places AS a JOIN places AS b ON {} "
        "WHERE a.row < 400 ORDER BY i, j"
    )
    forms = [
        f"1 = CONTAINS({point}, CIRCLE(b.ra_deg, b.dec_deg, 2.5))",
        f"DISTANCE({point}, {other}) < 2.5",
        f"DISTANCE({other}, {point}) <= 2.5",
        f"2.5 > DISTANCE({point}, {other})",
        "DISTANCE(a.ra_deg, a.dec_deg, b.ra_deg, b.dec_deg) < 2.5 AND a.row >= 0",
        f"NOT DISTANCE({point}, {other}) >= 2.5",
    ]
    expected = find(query.format(forms[0]))
    assert len(expected["i"]) > 400
    for form in forms[1:]:
        assert find(query.format(form)) == expected
        is_negated = form == forms[-1]
        assert (" BETWEEN " in translate(query.format(form), tables).sql) != is_negated
    near = "SELECT row FROM places WHERE DISTANCE(POINT(12, 3), POINT(ra_deg, dec_deg)) < 20"
    assert '"dec_deg" BETWEEN' in translate(near, tables).sql
    inside = "1 = CONTAINS(POINT(ra_deg, dec_deg), CIRCLE(12, 3, 20))"
    circle = translate(f"SELECT row FROM places WHERE {inside}", tables).sql
    assert '"dec_deg" BETWEEN' in circle  # DuckDB looks at declinations first
    assert "CAST" not in circle
    assert sorted(find(near)["row"]) == sorted(
        find(f"SELECT row FROM places WHERE {inside}")["row"]
    )


def test_units_are_those_that_are_asked_for(measured, places):
    [ra_rad] = measured("IN_UNIT(ra_deg, 'rad')")
    assert ra_rad == pytest.approx(np.radians(places[:, 0]), rel=1e-15)


def test_columns_keep_what_is_known_of_them(session):
    ra = TapColumn("ra_deg", unit="deg", ucd="pos.eq.ra", description="where")
    table = TapTable("places", "places", (ra, TapColumn("row", "long")))
    tables = Tables((Schema("places", "", (table,)),))
    query = (
        "WITH w AS (SELECT ra_deg AS r, row FROM places) SELECT r, r AS other, r + 1, w.*, "
        "MAX(row) AS biggest_deg FROM (SELECT * FROM w) AS w GROUP BY r, row"
    )
    fields = translate_adql(session, translate(query, tables)).schema
    assert fields.names == ["r", "other", "col_3", "r_2", "row", "biggest_deg"]
    meanings = [(field.metadata or {}).get(b"description") for field in fields]
    assert meanings == [b"where", b"where", None, b"where", None, None]
    assert fields.field("biggest_deg").metadata[b"unit"] == b"deg"


REFUSED += [
    ("SELECT " + "(" * 3000 + "1" + ")" * 3000 + " FROM places", "nested too deeply"),
    ("SELECT row FROM places WHERE name = '" + "x" * 50_000 + "'", "at most 50,000"),
    ("SELECT INTERSECTS(POLYGON(" + "1, 2, " * 199 + "3, 4), POLYGON(" + "5, 6, " * 199 + "7, 8)) "
     "FROM places", "too much arithmetic"),
    ("SELECT INTERSECTS(POLYGON(" + "ra_deg, dec_deg, " * 39 + "7, 8), POLYGON(" + "5, 6, " * 39
     + "7, 8)) FROM places", "too much arithmetic"),
    ("SELECT CONTAINS(CENTROID(POLYGON(ra_deg, 0, ra_deg, 1, ra_deg, 2)), POLYGON("
     + "5, 6, " * 199 + "7, 8)) FROM places", "too much arithmetic"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "words"), REFUSED, ids=range(len(REFUSED)))
def test_refusals_say_what_and_where(tables, text, words):
    with pytest.raises(QueryError) as caught:
        translate(text, tables)
    assert words in str(caught.value)


@pytest.mark.slow
@pytest.mark.timeout(30)
@pytest.mark.parametrize(
    "text",
    [
        "SELECT row FROM places WHERE " + " OR ".join(f"row={k}" for k in range(4000)),
        "SELECT row FROM places WHERE row IN (" + ", ".join(f"{k}.5" for k in range(6000)) + ")",
        "SELECT row FROM places WHERE "
        + " OR ".join("row IN (SELECT row FROM places)" for _ in range(1200)),
    ],
)
def test_long_queries_take_no_longer_than_they_are(tables, text):
    """What looks upwards from every part would take the square of that: minutes."""
    assert len(translate(text, tables).sql) >= len(text)


def test_a_refusal_points_to_the_place(tables):
    with pytest.raises(QueryError) as caught:
        translate("SELECT row\nFROM places\nWHERE rov = 3", tables)
    message = str(caught.value)
    assert "(line 3, character 7)" in message
    line, mark = message.splitlines()[-2:]
    assert line.index("rov") == mark.index("^")
