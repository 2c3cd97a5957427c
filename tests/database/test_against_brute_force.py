"""Neighbours, pairs and fields against computations that look at every star for every other."""

from __future__ import annotations

import numpy as np
import pytest

from starcat.database.products.pairs import find_pairs
from starcat.database.products.tiling import FieldStars, NominalField, stars_in_fields, tile_sphere
from starcat.geometry.attitude import matrix_from_radec_roll
from starcat.geometry.camera import Camera
from starcat.geometry.proximity import nearest_chords, nearest_neighbours, pairs_within
from starcat.geometry.sphere import (
    directions_from_radec,
    radec_from_directions,
    saff_kuijlaars,
    separation,
)

# Both sides round their coordinates; nothing else differs.
ROUNDING_RAD = 1e-15


def sky(kind: str, random_directions) -> np.ndarray:
    generator = np.random.default_rng(5)
    if kind == "poles":
        ra_deg, polar_deg = generator.uniform(0.0, 360.0, 150), generator.uniform(0.0, 3.0, 150)
        dec_deg = (90.0 - polar_deg) * np.where(generator.random(150) < 0.5, 1.0, -1.0)
        return np.concatenate([directions_from_radec(ra_deg, dec_deg), [[0, 0, 1.0], [0, 0, -1.0]]])
    if kind == "coincident":
        return np.repeat(random_directions(60, 2), [1, 2, 3] * 20, axis=0)
    if kind == "meridian":
        ra_deg, dec_deg = generator.uniform(-3.0, 3.0, 200), generator.uniform(-3.0, 3.0, 200)
        return directions_from_radec(ra_deg % 360.0, dec_deg)
    return random_directions({"everywhere": 300, "none": 0, "one": 1, "two": 2}[kind], 2)


SKIES = ["everywhere", "poles", "meridian", "coincident", "none", "one", "two"]


def all_separations(u: np.ndarray) -> np.ndarray:
    return separation(u[:, None, :], u[None, :, :])


@pytest.mark.parametrize("kind", [kind for kind in SKIES if kind not in ("none", "one")])
def test_nearest_neighbours(kind, random_directions):
    u = sky(kind, random_directions)
    dense = all_separations(u)
    np.fill_diagonal(dense, np.inf)
    found, index = nearest_neighbours(u)
    rows = np.arange(len(u))
    assert (index != rows).all()
    # By separation, not by row: of equally near ones either will do.
    assert np.abs(found - dense.min(axis=1)).max() < ROUNDING_RAD
    assert np.abs(dense[rows, index] - dense.min(axis=1)).max() < ROUNDING_RAD


@pytest.mark.parametrize("name", ["even", "twins", "cluster"])
def test_nearest_neighbours_of_many_are_those_of_each_alone(name, random_directions):
    u = random_directions(12_000, 7)
    if name == "twins":  # several at the same distance, of which the lowest rank counts
        u = np.concatenate([u[:6000], u[:4000], u[:3000]])
    elif name == "cluster":
        u[::2] = u[0] + 1e-3 * u[::2]
        u /= np.linalg.norm(u, axis=1)[:, None]
    rows, rank = np.arange(len(u)), np.random.default_rng(3).permutation(len(u))
    chord, index = nearest_chords(u, u, rows, rank)
    parts = [nearest_chords(u[k], u, k, rank) for k in np.array_split(rows, 3)]
    assert chord.tobytes() == np.concatenate([part[0] for part in parts]).tobytes()
    assert index.tolist() == np.concatenate([part[1] for part in parts]).tolist()


def test_nearest_neighbours_of_antipodes(random_directions):
    for u in random_directions(200, 3):
        found, index = nearest_neighbours(np.array([u, -u]))
        assert index.tolist() == [1, 0]
        # The last 1e-16 of a chord of 2 is an angle of 3e-8: no star has its nearest there.
        assert found == pytest.approx([np.pi, np.pi], abs=1e-7)


@pytest.mark.parametrize("limit_deg", [0.0, 1e-9, 0.5, 5.0, 60.0, 180.0, 200.0])
@pytest.mark.parametrize("kind", SKIES)
def test_pairs_within(kind, limit_deg, random_directions):
    u = sky(kind, random_directions)
    pairs, angle = pairs_within(u, np.radians(limit_deg))
    i, j = np.triu_indices(len(u), 1)
    dense = separation(u[i], u[j])
    near = dense <= np.radians(limit_deg)
    assert pairs.tolist() == np.stack([i[near], j[near]], axis=-1).tolist()
    assert np.array_equal(angle, dense[near])


def test_a_pair_at_the_limit_is_within_it(random_directions):
    u = random_directions(100, 4)
    i, j = np.triu_indices(100, 1)
    for row in range(0, len(i), 50):
        limit_rad = float(separation(u[i[row]], u[j[row]]))
        pairs, _ = pairs_within(u, limit_rad)
        assert [i[row], j[row]] in pairs.tolist()
        below, _ = pairs_within(u, float(np.nextafter(limit_rad, 0.0)))
        assert [i[row], j[row]] not in below.tolist()


@pytest.mark.parametrize("limits_deg", [(0.0, 5.0), (1.0, 1.5), (0.0, 0.0), (2.0, 1.0)])
@pytest.mark.parametrize("kind", SKIES)
def test_find_pairs(kind, limits_deg, random_directions):
    u = sky(kind, random_directions)
    low, high = np.radians(limits_deg)
    found = find_pairs(u, low, high)
    i, j = np.triu_indices(len(u), 1)
    dense = separation(u[i], u[j])
    expected = sorted((a, p, q) for a, p, q in zip(dense, i, j, strict=True) if low <= a <= high)
    assert list(zip(found.separation_rad, found.i, found.j, strict=True)) == expected
    assert found.i.dtype == found.j.dtype == np.int32
    assert found.kvector.exact(low, high) == slice(0, len(expected))


CAMERAS = {
    "square": Camera(512, 512, fov_x_deg=12.0),
    "wide": Camera(800, 200, fov_x_deg=20.0),
    "tall": Camera(200, 800, fov_x_deg=5.0),
    "very wide": Camera(1000, 1000, fov_x_deg=120.0),
}


def by_projection(boresights: np.ndarray, u: np.ndarray, camera: Camera) -> list[set[int]]:
    fields = []
    for ra_deg, dec_deg in np.transpose(radec_from_directions(boresights)):
        body = u @ matrix_from_radec_roll(ra_deg, dec_deg, 0.0).T
        fields.append(set(np.flatnonzero(camera.contains(camera.pixels_from_directions(body)))))
    return fields


def as_sets(found: FieldStars) -> list[set[int]]:
    return [set(part) for part in np.split(found.star_index, found.offsets[1:-1])]


@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.parametrize("kind", ["everywhere", "poles", "meridian"])
def test_stars_in_rectangular_fields(kind, name, random_directions):
    u = sky(kind, random_directions)
    mag = np.random.default_rng(6).uniform(0.0, 8.0, len(u))
    boresights = np.concatenate([saff_kuijlaars(150), [[1.0, 0.0, 0.0]]])
    found = stars_in_fields(boresights, u, mag, CAMERAS[name])
    assert as_sets(found) == by_projection(boresights, u, CAMERAS[name])
    assert found.count.sum() > 0


@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.parametrize("kind", SKIES)
def test_stars_in_circular_fields(kind, name, random_directions):
    u = sky(kind, random_directions)
    mag = np.random.default_rng(6).uniform(0.0, 8.0, len(u))
    camera = CAMERAS[name]
    radius = 0.5 * np.radians(min(camera.fov_x_deg, camera.fov_y_deg))
    found = tile_sphere(150, u, mag, camera, "circular")
    dense = separation(found.boresights[:, None, :], u[None, :, :]) <= radius
    assert as_sets(found) == [set(np.flatnonzero(row)) for row in dense]


@pytest.mark.parametrize("kind", ["everywhere", "poles", "meridian"])
def test_stars_in_a_stated_field(kind, random_directions):
    u = sky(kind, random_directions)
    found = tile_sphere(200, u, np.zeros(len(u)), NominalField(16.0, 9.0))
    fields = []
    for ra_deg, dec_deg in np.transpose(radec_from_directions(found.boresights)):
        x, y, z = matrix_from_radec_roll(ra_deg, dec_deg, 0.0) @ u.T
        across, down = np.degrees(np.arctan2(np.abs(x), z)), np.degrees(np.arctan2(np.abs(y), z))
        fields.append(set(np.flatnonzero((across <= 8.0) & (down <= 4.5))))
    assert as_sets(found) == fields
    assert found.count.sum() > 0


@pytest.mark.parametrize("field", ["rectangular", "circular"])
def test_a_star_on_the_boresight_is_in_its_field(field):
    points = saff_kuijlaars(20)
    found = stars_in_fields(points, points, np.zeros(20), Camera(100, 100, fov_x_deg=5.0), field)
    assert found.star_index.tolist() == list(range(20))


def test_fields_list_their_stars_brightest_first(random_directions):
    u = sky("everywhere", random_directions)
    mag = np.random.default_rng(7).integers(0, 4, len(u)).astype(float)
    found = tile_sphere(100, u, mag, CAMERAS["very wide"])
    offsets, brightest = found.brightest(5)
    assert found.count.max() > 5
    for row in range(100):
        stars = found.star_index[found.offsets[row] : found.offsets[row + 1]].tolist()
        assert stars == sorted(stars, key=lambda star: (mag[star], star))
        assert brightest[offsets[row] : offsets[row + 1]].tolist() == stars[:5]


@pytest.mark.parametrize("kind", ["none", "one"])
@pytest.mark.parametrize("field", ["rectangular", "circular"])
def test_fields_of_hardly_any_star(kind, field, random_directions):
    u = sky(kind, random_directions)
    found = tile_sphere(50, u, np.zeros(len(u)), CAMERAS["square"], field)
    assert found.offsets.shape == (51,)
    assert found.offsets.dtype == np.int64
    assert found.star_index.dtype == np.int32
    assert found.offsets[-1] == len(found.star_index)
    assert found.brightest(3)[0].shape == (51,)
