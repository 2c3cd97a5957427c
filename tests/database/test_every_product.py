"""Every product against its schema, against rotations and against plain double loops."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import Counter
from dataclasses import fields
from functools import cache
from itertools import combinations, pairwise

import numpy as np
import pytest

from starcat.database.products.grid import grid_patterns
from starcat.database.products.hausdorff_angular import angular_reference_sets
from starcat.database.products.hausdorff_l2 import planar_reference_sets
from starcat.database.products.index import Ragged
from starcat.database.products.kind import ProductInputs
from starcat.database.products.neighbours import find_neighbours, position_angles
from starcat.database.products.pairs import find_pairs
from starcat.database.products.radial import radial_patterns
from starcat.database.products.table import PRODUCTS as PRODUCT_KINDS
from starcat.database.products.table import Products
from starcat.database.products.tiling import FieldStars, NominalField, tile_sphere
from starcat.database.products.triangles import distinct_triangles, find_triangles
from starcat.geometry.sphere import directions_from_radec, radec_from_directions
from starcat.pipeline.recipes import table_from_result
from starcat.storage.schema import product_schema

RADIUS, BUFFER = 0.6, 0.1
# An odd grid has the alignment star in the middle of a row, not on an edge.
CELLS, RINGS, SECTORS = 9, 7, 10
ANGLE_BIN, SEPARATION_BIN = 0.7, 0.11

# A dozen roundings of 1e-16, over separations of 0.01 and more.
ROUNDING = 1e-12


SIZE = NominalField(50.0, 50.0)


def triangles(u):
    tiles = tile_sphere(40, u, np.arange(float(len(u))), SIZE)
    return find_triangles(tiles, u, 5)


PRODUCTS = {
    "pairs": lambda u: find_pairs(u, 0.0, RADIUS),
    "triangles": triangles,
    "neighbours": lambda u: find_neighbours(
        u, RADIUS, angle_bin_rad=ANGLE_BIN, separation_bin_rad=SEPARATION_BIN
    ),
    "hausdorff_angular": lambda u: angular_reference_sets(u, RADIUS),
    "hausdorff_l2": lambda u: planar_reference_sets(u, RADIUS),
    "grid": lambda u: grid_patterns(u, RADIUS, buffer_rad=BUFFER, cells_per_side=CELLS),
    "radial": lambda u: radial_patterns(u, RADIUS, rings=RINGS, sectors=SECTORS),
}


def made_as_a_build_makes_it(name):
    """Return a function that makes a product of directions, by its section's defaults."""
    kind = PRODUCT_KINDS[name]
    section = kind.section() if kind.section else None

    def make(u):
        mag = np.arange(float(len(u)))
        inputs = ProductInputs(
            u, mag, tile_sphere(40, u, mag, SIZE), SIZE, boresights=40, brightest=5,
            half_field_deg=25.0, diagonal_rad=1.2, requested={name: section},
        )  # fmt: skip
        return kind.make(inputs, section)

    return make


OF_OTHERS = {"boresights", "levels"}
"""Products of the tiling, and of other products, which have tests of their own."""

PRODUCTS |= {
    name: made_as_a_build_makes_it(name)
    for name, kind in PRODUCT_KINDS.items()
    if kind.make is not None and name not in {*PRODUCTS, *OF_OTHERS}
}


def test_every_field_of_the_list_has_the_product_of_its_name():
    for name, section in Products().sections.items():
        kind = PRODUCT_KINDS[name]
        assert (kind.name, kind.section) == (name, type(section))


SKIES = ["everywhere", "poles", "coincident", "none", "one", "two", "far two"]


def sky(kind):
    generator = np.random.default_rng(31)
    if kind == "poles":
        ra_deg, polar_deg = generator.uniform(0.0, 360.0, 40), generator.uniform(1.0, 50.0, 40)
        dec_deg = (90.0 - polar_deg) * np.where(generator.random(40) < 0.5, 1.0, -1.0)
        at_poles = [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]
        return np.concatenate([directions_from_radec(ra_deg, dec_deg), at_poles])
    if kind == "two":
        return directions_from_radec([10.0, 12.0], [80.0, 85.0])
    if kind == "far two":
        return directions_from_radec([10.0, 12.0], [80.0, -85.0])
    v = generator.normal(size=({"everywhere": 60, "coincident": 24, "one": 1, "none": 0}[kind], 3))
    u = v / np.linalg.norm(v, axis=1)[:, None]
    return np.repeat(u, [1, 2, 3] * 8, axis=0) if kind == "coincident" else u


@cache
def product(name, kind):
    """Return a product of a sky, made once for all tests."""
    return PRODUCTS[name](sky(kind))


def lists(ragged):
    return rows_between(ragged.offsets, ragged.values)


def rows_between(offsets, values):
    assert offsets[0] == 0
    assert offsets[-1] == len(values)
    return [values[a:b].tolist() for a, b in pairwise(offsets)]


def arrays_of(name, made):
    for column in product_schema(name).columns:
        values = getattr(made, column.name)
        yield from (values.offsets, values.values) if isinstance(values, Ragged) else (values,)
    yield from made.index.datasets.values()


def test_triangles_of_more_stars_than_a_packed_key_holds():
    """Row numbers above 2**21 give the triangles that a plain loop finds, in the same order."""
    generator = np.random.default_rng(8)
    per_field = generator.integers(0, 9, 300)
    offsets = np.concatenate([[0], np.cumsum(per_field)])
    few = generator.choice(40, offsets[-1]) + np.where(generator.random(offsets[-1]) < 0.5, 0, 40)
    small = [np.unique(few[a:b]) for a, b in pairwise(offsets)]
    count = 5_000_000
    rows = np.sort(generator.choice(count, 80, replace=False)).astype(np.int32)
    lengths = np.cumsum([0, *map(len, small)])
    tiles = [
        FieldStars(np.zeros((300, 3)), lengths, np.concatenate(of).astype(np.int32))
        for of in (small, [rows[field] for field in small])
    ]
    expected = Counter(t for field in small for t in combinations(field[:5].tolist(), 3))
    for fields_, star, total in ((tiles[0], np.arange(80), 80), (tiles[1], rows, count)):
        stars, seen = distinct_triangles(fields_, total, 5)
        assert [tuple(row) for row in stars] == [tuple(star[list(t)]) for t in sorted(expected)]
        assert seen.tolist() == [expected[t] for t in sorted(expected)]


@pytest.mark.parametrize("kind", SKIES)
@pytest.mark.parametrize("name", PRODUCTS)
class TestEveryProduct:
    def test_columns_are_those_of_the_schema(self, name, kind):
        made, schema = product(name, kind), product_schema(name)
        for column in schema.columns:
            values = getattr(made, column.name)
            assert isinstance(values, Ragged) == column.is_list
            items = values.values if column.is_list else values
            assert items.dtype == np.dtype(column.item_dtype)
            assert items.ndim == 1
            # A flat triangle has no end of a circumradius.
            if column.name != "circumradius_rad":
                assert np.isfinite(items).all()
        if name != "pairs":  # which has a K-vector in place of its last column
            expected = [column.name for column in schema.columns]
            assert [field.name for field in fields(made)] == [*expected, "index"]
        schema.check(table_from_result(made, schema))

    def test_rows_are_in_order_and_unique(self, name, kind):
        made, schema = product(name, kind), product_schema(name)
        keys = list(zip(*(getattr(made, key).tolist() for key in schema.order), strict=True))
        assert all(a < b for a, b in pairwise(keys))

    def test_stars_are_rows_of_the_table(self, name, kind):
        columns = [column for column in product_schema(name).columns if column.refers_to == "stars"]
        seen = [getattr(product(name, kind), column.name) for column in columns]
        assert all(((star >= 0) & (star < len(sky(kind)))).all() for star in seen)
        assert len(seen) > 0
        assert all((first != second).all() for first, second in pairwise(seen))

    def test_the_same_sky_makes_the_same_bytes(self, name, kind):
        again = PRODUCTS[name](sky(kind))
        for a, b in zip(
            *(arrays_of(name, one) for one in (product(name, kind), again)), strict=True
        ):
            assert a.dtype == b.dtype
            assert a.tobytes() == b.tobytes()


# Plain spherical trigonometry, a pair at a time.


def places(u):
    ra_deg, dec_deg = radec_from_directions(u)
    return list(zip(np.radians(ra_deg).tolist(), np.radians(dec_deg).tolist(), strict=True))


def haversine(a, b):
    half_ra, half_dec = 0.5 * (b[0] - a[0]), 0.5 * (b[1] - a[1])
    squared = math.sin(half_dec) ** 2 + math.cos(a[1]) * math.cos(b[1]) * math.sin(half_ra) ** 2
    return 2.0 * math.asin(math.sqrt(min(squared, 1.0)))


def bearing(a, b):
    if a == b:
        return 0.0
    d = b[0] - a[0]
    east = math.sin(d) * math.cos(b[1])
    north = math.cos(a[1]) * math.sin(b[1]) - math.sin(a[1]) * math.cos(b[1]) * math.cos(d)
    return math.atan2(east, north) % (2.0 * math.pi)


def gnomonic(a, b):
    d = b[0] - a[0]
    along = math.sin(a[1]) * math.sin(b[1]) + math.cos(a[1]) * math.cos(b[1]) * math.cos(d)
    north = math.cos(a[1]) * math.sin(b[1]) - math.sin(a[1]) * math.cos(b[1]) * math.cos(d)
    return math.cos(b[1]) * math.sin(d) / along, north / along


def around(place, star):
    """Neighbours of a star: (separation, row), nearest first."""
    others = ((haversine(place[star], place[n]), n) for n in range(len(place)) if n != star)
    return sorted(other for other in others if other[0] <= RADIUS)


def turn_between(a, b):
    return abs((a - b + math.pi) % (2.0 * math.pi) - math.pi)


def by_pair(made, *names):
    columns = [getattr(made, name).tolist() for name in names]
    keys = zip(made.star.tolist(), made.neighbour.tolist(), strict=True)
    return dict(zip(keys, zip(*columns, strict=True), strict=True))


@pytest.mark.parametrize("kind", SKIES)
def test_separations_by_loops(kind):
    place = places(sky(kind))
    expected = {(s, n): (sep,) for s in range(len(place)) for sep, n in around(place, s)}
    found = by_pair(product("hausdorff_angular", kind), "separation_rad")
    assert found.keys() == expected.keys()
    for key, value in expected.items():
        assert found[key] == pytest.approx(value, abs=ROUNDING)


@pytest.mark.parametrize("kind", SKIES)
def test_ratios_by_loops(kind):
    place = places(sky(kind))
    made = product("hausdorff_l2", kind)
    found = by_pair(made, "ratio")
    expected = {}
    for s in range(len(place)):
        apart = [n for _, n in around(place, s) if place[n] != place[s]]
        distance = {n: math.hypot(*gnomonic(place[s], place[n])) for n in apart}
        least = min(distance.values(), default=math.nan)
        assert made.index.datasets["smallest_distance"][s] == pytest.approx(
            least, rel=ROUNDING, nan_ok=True
        )
        expected.update({(s, n): (d / least,) for n, d in distance.items()})
    assert found.keys() == expected.keys()
    for key, value in expected.items():
        assert found[key] == pytest.approx(value, rel=ROUNDING)
    assert (made.ratio >= 1.0).all()


@pytest.mark.parametrize("kind", SKIES)
def test_neighbours_by_loops(kind):
    place = places(sky(kind))
    made = product("neighbours", kind)
    found = by_pair(made, "position_angle_rad", "successive_angle_rad", "separation_rad")
    offsets = made.index.datasets["star_offsets"]
    for s, neighbours in enumerate(rows_between(offsets, made.neighbour)):
        expected = {n: (bearing(place[s], place[n]), sep) for sep, n in around(place, s)}
        assert set(neighbours) == expected.keys()
        successive = 0.0
        for n, following in zip(neighbours, neighbours[1:] + neighbours[:1], strict=True):
            angle, step, separation_rad = found[s, n]
            assert 0.0 <= angle < 2.0 * math.pi
            assert turn_between(angle, expected[n][0]) < ROUNDING
            assert separation_rad == pytest.approx(expected[n][1], abs=ROUNDING)
            assert turn_between(step, expected[following][0] - expected[n][0]) < ROUNDING
            successive += step
        assert not neighbours or successive == pytest.approx(2.0 * math.pi, abs=ROUNDING)


@pytest.mark.parametrize("kind", SKIES)
def test_grid_by_loops(kind):
    place = places(sky(kind))
    made = product("grid", kind)
    reach = math.tan(RADIUS)
    edges = [reach * (2.0 * k / CELLS - 1.0) for k in range(1, CELLS)]
    expected = []
    for s in range(len(place)):
        beyond = [n for sep, n in around(place, s) if sep > BUFFER]
        if not beyond:
            continue
        plane = [gnomonic(place[s], place[n]) for n in beyond]
        east, north = plane[0]
        cells = set()
        for xi, eta in plane:
            x = (xi * east + eta * north) / math.hypot(east, north)
            # East is left of north on the sky as seen.
            y = (xi * north - eta * east) / math.hypot(east, north)
            cells.add(bisect_right(edges, y) * CELLS + bisect_right(edges, x))
        expected.append((s, beyond[0], sorted(cells)))
    found = zip(made.star.tolist(), made.alignment_star.tolist(), lists(made.cells), strict=True)
    assert list(found) == expected


@pytest.mark.parametrize("kind", SKIES)
def test_radial_by_loops(kind):
    place = places(sky(kind))
    made = product("radial", kind)
    rings = lists(made.rings)
    assert made.star.tolist() == list(range(len(place)))
    for s in range(len(place)):
        near = around(place, s)
        assert rings[s] == sorted({min(int(sep * RINGS / RADIUS), RINGS - 1) for sep, _ in near})
        angles = [bearing(place[s], place[n]) for _, n in near if place[n] != place[s]]
        bits = ["0"] * SECTORS
        for angle in angles:
            bits[int((angle - angles[0]) % (2.0 * math.pi) / (2.0 * math.pi) * SECTORS)] = "1"
        # Bit 0 is written last.
        text = "".join(bits)[::-1]
        assert made.sector_pattern[s] == min(int(text[k:] + text[:k], 2) for k in range(SECTORS))


# Look-ups against the columns themselves.


@pytest.mark.parametrize("kind", SKIES)
@pytest.mark.parametrize("name", ["neighbours", "hausdorff_angular", "hausdorff_l2"])
def test_star_offsets(name, kind):
    made = product(name, kind)
    rows = rows_between(made.index.datasets["star_offsets"], np.arange(len(made.star)))
    assert rows == [np.flatnonzero(made.star == s).tolist() for s in range(len(sky(kind)))]


@pytest.mark.parametrize("kind", SKIES)
def test_neighbour_lookup(kind):
    made = product("neighbours", kind)
    data, numbers = made.index.datasets, made.index.attributes
    a_count, s_count = math.ceil(2.0 * math.pi / ANGLE_BIN), math.ceil(RADIUS / SEPARATION_BIN)
    assert (numbers["n_angle_bins"], numbers["n_separation_bins"]) == (a_count, s_count)
    assert (numbers["angle_bin_rad"], numbers["separation_bin_rad"]) == (ANGLE_BIN, SEPARATION_BIN)
    expected = [[] for _ in range(a_count * s_count)]
    pairs = zip(made.successive_angle_rad.tolist(), made.separation_rad.tolist(), strict=True)
    for row, (angle, separation_rad) in enumerate(pairs):
        expected[int(angle / ANGLE_BIN) * s_count + int(separation_rad / SEPARATION_BIN)].append(
            row
        )
    assert data["lookup_rows"].dtype == np.int32
    assert rows_between(data["lookup_offsets"], data["lookup_rows"]) == expected


@pytest.mark.parametrize("kind", SKIES)
@pytest.mark.parametrize(
    ("name", "column", "key", "count"),
    [("grid", "cells", "cell", CELLS**2), ("radial", "rings", "ring", RINGS)],
)
def test_inverted_lookups(name, column, key, count, kind):
    made = product(name, kind)
    ragged, data = getattr(made, column), made.index.datasets
    assert len(ragged.offsets) == len(made.star) + 1
    expected = [[] for _ in range(count)]
    for row, values in enumerate(lists(ragged)):
        for value in values:
            expected[value].append(row)
    assert data[f"{key}_rows"].dtype == np.int32
    assert rows_between(data[f"{key}_offsets"], data[f"{key}_rows"]) == expected


# Small enough to check by hand.


@pytest.mark.parametrize("own_ra_deg", [0.0, 30.0, 200.0])
def test_position_angles_at_a_pole_follow_its_own_right_ascension(own_ra_deg):
    u = directions_from_radec([own_ra_deg, 50.0], [90.0, 89.0])
    angle = position_angles(u, np.array([0]), np.array([1]))
    # North is away from the meridian of the star, and east is a right angle on from its own.
    assert np.degrees(angle) == pytest.approx((180.0 - (50.0 - own_ra_deg)) % 360.0, abs=1e-9)


def test_the_alignment_star_of_an_even_grid_is_above_the_middle():
    made = grid_patterns(sky("everywhere"), RADIUS, buffer_rad=BUFFER, cells_per_side=8)
    for cells in lists(made.cells):
        assert any(cell in range(4 * 8 + 4, 5 * 8) for cell in cells)


def test_a_neighbour_at_the_radius_counts():
    u = sky("two")
    radius = float(angular_reference_sets(u, RADIUS).separation_rad[0])
    assert len(angular_reference_sets(u, radius).star) == 2
    assert lists(radial_patterns(u, radius, rings=5, sectors=31).rings) == [[4], [4]]
    single = find_neighbours(u, radius, angle_bin_rad=1.0, separation_bin_rad=radius)
    assert single.index.attributes["n_separation_bins"] == 1
    assert len(grid_patterns(u, radius, buffer_rad=0.0, cells_per_side=3).star) == 2
    # At the buffer a neighbour is still within it.
    assert len(grid_patterns(u, 1.0, buffer_rad=radius, cells_per_side=3).star) == 0


def test_ratios_that_round_to_the_same_go_by_neighbour():
    ra_deg = np.random.default_rng(3).uniform(0.0, 360.0, 300)
    u = directions_from_radec([0.0, *ra_deg], [90.0] + [80.0] * 300)
    made = PRODUCTS["hausdorff_l2"](u)
    keys = list(zip(made.star, made.ratio, made.neighbour, strict=True))
    assert keys == sorted(keys)


def test_neighbours_in_a_line_are_in_the_first_sector_or_beside_it():
    axes, _ = np.linalg.qr(np.random.default_rng(4).normal(size=(50, 3, 2)))
    angle = np.linspace(0.0, 0.5, 20)[:, None]
    for start, towards in axes.transpose(0, 2, 1):
        u = start * np.cos(angle) + towards * np.sin(angle)
        assert PRODUCTS["radial"](u).sector_pattern[0] in (0b1, 0b11)


@pytest.mark.parametrize(
    ("call", "named"),
    [
        (lambda u: planar_reference_sets(u, np.pi / 2.0), "radius_rad"),
        (lambda u: planar_reference_sets(u, np.nan), "radius_rad"),
        (lambda u: find_neighbours(u, 1, angle_bin_rad=0, separation_bin_rad=1), "angle_bin_rad"),
        (
            lambda u: find_neighbours(u, 1, angle_bin_rad=1, separation_bin_rad=-1),
            "separation_bin_rad",
        ),
        (lambda u: grid_patterns(u, 1.6, buffer_rad=0, cells_per_side=5), "radius_rad"),
        (lambda u: grid_patterns(u, 1.0, buffer_rad=-0.1, cells_per_side=5), "buffer_rad"),
        (lambda u: grid_patterns(u, 1.0, buffer_rad=0, cells_per_side=0), "cells_per_side"),
        (lambda u: radial_patterns(u, 0.0, rings=5, sectors=5), "radius_rad"),
        (lambda u: radial_patterns(u, 1.0, rings=0, sectors=5), "rings"),
        (lambda u: radial_patterns(u, 1.0, rings=5, sectors=32), "sectors"),
    ],
)
def test_arguments_out_of_range_are_named(call, named):
    with pytest.raises(ValueError, match=f"^{named} is "):
        call(sky("two"))
