"""Onboard images: made from any sky they read back as they were, and no damage goes unseen."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from compilers import c_compiler
from hypothesis import given
from hypothesis import strategies as st

from starcat.database.onboard import grid, layout
from starcat.database.onboard.c_source import c_header, c_source, c_symbol
from starcat.database.onboard.checking import (
    capacity_problems,
    database_problems,
    shrink,
    value_problems,
)
from starcat.database.onboard.grid import CellGrid, grid_for, most_near
from starcat.database.onboard.image import Contents, longest_pair_rad, make_image
from starcat.database.onboard.layout import BYTE_ORDERS, check_blocks, data_blocks, scrub
from starcat.database.onboard.profiles import FULL, PROFILES
from starcat.database.onboard.reading import read_onboard_image
from starcat.database.products.pairs import find_pairs
from starcat.database.products.tiling import tile_sphere
from starcat.database.products.triangles import find_triangles
from starcat.errors import ConfigError, OnboardImageError, OnboardSizeError, SchemaVersionError
from starcat.geometry.camera import Camera
from starcat.geometry.sphere import separation

CAMERA = Camera(1024, 768, fov_x_deg=20.0)


def sky(count: int, seed: int, method: str = "triangle", n_features: int = 50) -> Contents:
    """Return stars anywhere, poles and equal directions included, and features of any of them."""
    generator = np.random.default_rng(seed)
    u = generator.normal(size=(count, 3))
    special = np.array([[0, 0, 1], [0, 0, -1], [-1, 0, 0], [1, -1e-11, 0], [0, 1, 0], [0, 1, 0]])
    u[: len(special)] = special[:count]
    mag = generator.uniform(-1.5, 9.0, count)
    mag[::7] = np.nan
    width = 3 if method == "triangle" else 2
    n_features = n_features if count >= width else 0
    rows = [generator.choice(count, width, replace=False) for _ in range(n_features)]
    return Contents(
        name="sky-1.0.0",
        epoch_jyear=2026.5,
        camera=CAMERA,
        star_id=generator.permutation(10**12 + np.arange(count)),
        directions=u / np.linalg.norm(u, axis=1)[:, None],
        mag=mag,
        method=method,
        features=np.array(rows, dtype=np.int32).reshape(-1, width),
        manifest_sha256=bytes(range(32)),
    )


@pytest.fixture(scope="module")
def real() -> tuple[Contents, np.ndarray]:
    """A sky of 1,500 stars with the triangles that a build makes of it, and how often each is seen.

    Nothing is left of a frame's stars that a build would not put in.
    """
    stars = sky(1500, 5, n_features=0)
    fields = tile_sphere(500, stars.directions, np.nan_to_num(stars.mag, nan=9.0), CAMERA)
    made = find_triangles(fields, stars.directions, 8)
    features = np.stack([made.i, made.j, made.k], axis=-1)
    return replace(stars, features=features), made.times_seen


@given(
    st.integers(0, 40),
    st.integers(0, 99),
    st.sampled_from(["triangle", "pyramid"]),
    st.sampled_from(BYTE_ORDERS),
    st.integers(0, 12),
)
def test_any_sky_reads_back(count, seed, method, byte_order, n_features):
    contents = sky(count, seed, method, n_features)
    made = make_image(contents, byte_order)
    image = read_onboard_image(made.data)
    assert (image.byte_order, image.method, image.name) == (byte_order, method, "sky-1.0.0")
    assert image.header["epoch_jyear"] == 2026.5
    assert image.camera == CAMERA
    assert image.manifest_sha256 == bytes(range(32)).hex()
    assert sorted(made.star_rows.tolist()) == list(range(count))
    np.testing.assert_array_equal(image.star_id, contents.star_id[made.star_rows])
    theirs = contents.directions[made.star_rows]
    np.testing.assert_allclose(image.directions, theirs, rtol=0, atol=0.51 / 2147483647)
    np.testing.assert_allclose(image.mag, contents.mag[made.star_rows], rtol=0, atol=0.000501)
    features = made.star_rows[image.features]
    u = contents.directions[contents.features]
    is_near = np.ones(len(u), dtype=bool)
    if method == "pyramid":
        is_near = separation(u[:, 0], u[:, 1]) <= longest_pair_rad(CAMERA)
    expected = np.sort(contents.features[is_near], axis=1)
    assert sorted(np.sort(features, axis=1).tolist()) == sorted(expected.tolist())
    assert not [*value_problems(image), *capacity_problems(image)]
    assert not list(database_problems(image, contents))
    assert not scrub(made.data)


def test_the_order_of_features_is_that_of_their_values_and_rows():
    contents = sky(100, 3)
    made = make_image(contents).data
    turned = replace(contents, features=contents.features[::-1, ::-1])
    assert make_image(turned).data == made
    assert make_image(contents, "big").data != made
    contents = sky(12, 1, n_features=0)
    pair = np.array([[4, 6], [5, 6], [4, 7], [5, 7]])  # 4 and 5 are at the same place
    image = read_onboard_image(make_image(replace(contents, method="pyramid", features=pair)).data)
    u = image.directions[image.features]
    order = np.column_stack([separation(u[:, 0], u[:, 1]), image.features]).tolist()
    assert order == sorted(order)


def test_more_stars_than_two_bytes_can_count():
    contents = replace(sky(65_538, 8, n_features=0), features=np.arange(65_538).reshape(-1, 3))
    image = read_onboard_image(make_image(contents, "big").data)
    assert image.header["index_bytes"] == 4
    assert image.sections["triangles"].dtype == np.dtype(">u4")
    assert image.features.max() == 65_537
    assert not list(database_problems(image, contents))


def test_names_and_sizes_that_have_no_room_are_refused(monkeypatch):
    contents = replace(sky(5, 1), name="a" * 91 + "-1.0.0")
    with pytest.raises(ConfigError, match="has 97 bytes"):
        make_image(contents)
    assert read_onboard_image(make_image(replace(contents, name="a" * 90 + "-1.0.0")).data).name
    monkeypatch.setattr(layout, "MAX_BYTES", 8191)
    with pytest.raises(ConfigError, match="would have 8,192 bytes; at most 8,191 can be said"):
        make_image(sky(5, 1))


def test_any_flipped_bit_is_found_and_its_block_named(real):
    sound = make_image(real[0], "big").data
    n_blocks = len(sound) // 4096
    assert n_blocks > 30
    generator = np.random.default_rng(2000)
    ends = [0, 8, 20, 24, len(sound) - 1, len(sound) - 4, data_blocks(len(sound)) * 4096]
    for at in [*ends, *generator.integers(0, len(sound), 2000).tolist()]:
        damaged = bytearray(sound)
        damaged[at] ^= 1 << int(generator.integers(8))
        assert scrub(bytes(damaged)) == [at // 4096], at
    with pytest.raises(OnboardImageError, match=r"damaged in 1 of \d+ blocks of 4096 bytes: \d+;"):
        read_onboard_image(bytes(damaged))


@pytest.mark.parametrize("blocks", [1, 1022, 1023, 2045])
def test_check_blocks_are_separated_from_data_by_the_size(blocks):
    data = bytes(blocks * 4096)
    whole = data + check_blocks(data, "little")
    assert len(whole) == len(data) + layout.check_bytes(len(data))
    assert data_blocks(len(whole)) == blocks
    assert scrub(whole) == []
    assert scrub(whole[:-4096] + b"\1" + whole[-4095:]) == [len(whole) // 4096 - 1]
    assert scrub(whole + b"\0") == [len(whole) // 4096]


def with_checks(image: bytes | bytearray) -> bytes:
    """Return an image that was changed, with CRCs that fit."""
    data = bytes(image[: data_blocks(len(image)) * 4096])
    return data + check_blocks(data, "little")


def sealed(image: bytes, name: str, value: int | float) -> bytes:
    """Return an image with another number in its header, and CRCs that fit."""
    head = np.frombuffer(image, layout.in_order(layout.HEADER, "little"), 1).copy()
    head[name] = value
    return with_checks(head.tobytes() + image[layout.HEADER.itemsize :])


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("n_stars", 70_000, "index_bytes is 2; expected 4"),
        ("n_stars", 29, "most_near|grid|section"),
        ("n_stars", 31, "section directions: 360 bytes"),
        ("n_features", 49, "section|n_kvector"),
        ("n_kvector", 3, "n_kvector is 3; expected 14"),
        ("total_bytes", 4096, "total_bytes is 4096; expected 8192"),
        ("data_bytes", 8192, "data_bytes is 8192; it does not fit"),
        ("data_bytes", 0, "data_bytes is 0"),
        ("header_bytes", 256, "header_bytes is 256; expected 512"),
        ("method", 3, "method is 3; expected 1 or 2"),
        ("method", 2, "section pairs: there 0 times"),
        ("grid_bands", 0, "grid_bands is 0; expected 1 to"),
        ("grid_bands", 2**31, "grid_bands is 2147483648"),
        ("grid_sectors", 9, "section grid"),
        ("most_near", 31, "most_near is 31; expected 0 to 30"),
        ("n_sections", 17, "n_sections is 17"),
        ("width_px", 0, "width_px is 0"),
        ("focal_length_px", 0.0, "focal_length_px is 0.0; expected more than 0"),
        ("focal_length_px", float("nan"), "focal_length_px is nan; expected a finite number"),
        ("kvector_slope", -1.0, "kvector_slope is -1.0"),
        ("radius_quantum_rad", 0.0, "radius_quantum_rad is 0.0; expected more than 0"),
        ("longest_rad", float("inf"), "longest_rad is inf"),
    ],
)
def test_numbers_that_contradict_each_other_are_refused(name, value, words):
    image = make_image(sky(30, 1)).data
    with pytest.raises(OnboardImageError, match=words) as refused:
        read_onboard_image(sealed(image, name, value))
    assert "export it again" in str(refused.value)


def test_another_major_version_is_refused_and_a_later_minor_one_is_read():
    image = make_image(sky(30, 1)).data
    with pytest.raises(SchemaVersionError):
        read_onboard_image(sealed(image, "version_major", 2))
    assert read_onboard_image(sealed(image, "version_minor", 7)).version == "1.7"


def place_of(image: bytes, section: str) -> int:
    """Return the offset of a section."""
    read = read_onboard_image(image)
    counts = (int(read.header[name]) for name in ("n_stars", "n_features"))
    contents = layout.Sizes(read.method, *counts, len(read.sections["grid"]) - 1)
    names = [name for name, _, _ in contents.sections()]
    return int(contents.table()["offset"][names.index(section)])


def test_rows_and_orders_that_cannot_be_are_refused():
    sound = make_image(sky(30, 1)).data
    for section, at, words in (
        ("triangles", 0, "section triangles: row"),
        ("grid", 0, "section grid: does not ascend from 0 to 30"),
        ("kvector", 0, "section kvector: does not ascend from 0 to 50"),
        ("directions", 2, "section directions: not all of length 1"),
    ):
        image = bytearray(sound)
        image[place_of(sound, section) + at] ^= 0x7F
        with pytest.raises(OnboardImageError, match=words):
            read_onboard_image(with_checks(image))


@given(st.integers(0, 2**32 - 1), st.sampled_from(["triangle", "pyramid"]), st.integers(1, 8))
def test_whatever_is_written_in_an_image_it_is_read_or_refused(seed, method, changes):
    """Bytes change anywhere, half of them in header and section table, and the CRCs fit again."""
    generator = np.random.default_rng(seed)
    data = bytearray(make_image(sky(30, 1, method)).data)
    for _ in range(changes):
        end = 512 if generator.integers(2) else data_blocks(len(data)) * 4096
        data[generator.integers(8, end)] = generator.choice([0, 1, 2, 127, 128, 255])
    try:
        image = read_onboard_image(with_checks(data))
    except (OnboardImageError, SchemaVersionError):
        return
    found = [*value_problems(image), *capacity_problems(image)]
    found += database_problems(image, sky(30, 1, method))
    assert all(isinstance(problem, str) for problem in found)


def test_values_that_are_not_those_of_the_stars_are_found(real):
    image = make_image(real[0]).data
    read = read_onboard_image(image)
    radii, counts = read.sections["radii"].copy(), read.sections["kvector"].copy()
    radii[len(radii) // 2] ^= 0x40
    counts[1:-1] = counts[2:]  # still ascends, but is too high at every step
    for section, array, words in (
        ("radii", radii, "section radii: row "),
        ("kvector", counts, "section kvector: not the numbers of values below its line"),
    ):
        place = place_of(image, section)
        data = image[:place] + array.tobytes() + image[place + array.nbytes :]
        changed = read_onboard_image(with_checks(data))
        assert [problem for problem in value_problems(changed) if words in problem]
    for name, value, problems, words in (
        ("kvector_slope", 1e308, value_problems, "section kvector: not the numbers of values"),
        ("most_near", 3, capacity_problems, "most_near is 3; "),
        ("longest_rad", 0.01, value_problems, "longest_rad is 0.01; a side has 0."),
    ):
        assert next(problems(read_onboard_image(sealed(image, name, value)))).startswith(words)


def test_an_image_of_another_database_is_found(real):
    contents = real[0]
    image = read_onboard_image(make_image(contents).data)
    assert not [*database_problems(image, contents)]

    def said(**changes: object) -> str:
        return " ".join(database_problems(image, replace(contents, **changes)))  # type: ignore[arg-type]

    assert "the sha256 of its manifest begins with 000102" in said(manifest_sha256=bytes(32))
    assert "epoch is 2026.5; the database says 2000.0" in said(epoch_jyear=2000.0)
    assert "name is sky-1.0.0" in said(name="sky-2.0.0")
    assert "camera is (1024, 768," in said(camera=Camera(1024, 768, 4000.0))
    assert "1500 stars are not in the database: " in said(star_id=contents.star_id + 10**9)
    moved = contents.directions + 1e-8
    moved /= np.linalg.norm(moved, axis=1)[:, None]
    assert "stars lie elsewhere than in the database, by up to 0.00" in said(directions=moved)
    assert "magnitudes: 1285 stars have other values" in said(mag=contents.mag + 0.002)
    fewer = contents.features[1:]
    assert "section triangles: not all of them are in the database" in said(features=fewer)


def test_the_grid_covers_the_sky_and_knows_its_corners():
    grid = CellGrid(4, 8)
    u = np.array([[0, 0, -1.0], [0, 0, 1], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
    assert grid.cells(u).tolist() == [0, 24, 16, 18, 20, 22]
    almost = np.array([[1.0, -1e-12, 0.0], [1.0, -1e-300, 0.0]])
    assert grid.cells(almost).tolist() == [23, 23]
    assert grid_for(0, 0.1) == CellGrid(1, 2)
    assert grid_for(10**9, 1e-6).n_cells <= 2**20


@pytest.mark.parametrize(("count", "radius_deg"), [(1, 5.0), (300, 10.0), (2000, 3.0), (200, 70.0)])
def test_no_circle_holds_more_stars_than_the_bound(count, radius_deg, random_directions):
    u = random_directions(count, 11)
    u[: count // 3] = u[0] + 0.05 * u[: count // 3]  # a cluster
    u /= np.linalg.norm(u, axis=1)[:, None]
    radius_rad = np.radians(radius_deg)
    bound = most_near(u, radius_rad)
    # The fullest circle has two stars on its edge: all such circles are tried, and more.
    tried = np.concatenate([u, random_directions(5000, 12), _edge_centres(u[:150], radius_rad)])
    most = max(
        int(np.count_nonzero(part @ u.T >= np.cos(radius_rad) - 1e-12, axis=1).max())
        for part in np.array_split(tried, 20)
        if len(part)
    )
    assert most <= bound <= 1.35 * most + 2


@pytest.mark.parametrize("radius_deg", [1.0, 2.0])
def test_the_bound_of_many_cells_changes_no_answer(radius_deg, random_directions, monkeypatch):
    u = random_directions(40_000, 13)
    u[:9000] = u[0] + 0.2 * u[:9000]  # denser, as the Milky Way is
    expected = most_near(u, np.radians(radius_deg))
    monkeypatch.setattr(grid, "MANY_CELLS", 10**9)
    assert most_near(u, np.radians(radius_deg)) == expected


def _edge_centres(u: np.ndarray, radius_rad: float) -> np.ndarray:
    """Return the centres of the circles that have two of the stars on their edge."""
    i, j = np.triu_indices(len(u), 1)
    total, normal = u[i] + u[j], np.cross(u[i], u[j])
    squared = np.einsum("ij,ij->i", total, total)
    along = 2.0 * np.cos(radius_rad) / squared
    height = 1.0 - along**2 * squared
    fits = (height > 0.0) & (np.linalg.norm(normal, axis=1) > 1e-9)
    total, normal, along = total[fits], normal[fits], along[fits]
    across = np.sqrt(height[fits]) / np.linalg.norm(normal, axis=1)
    up, level = across[:, None] * normal, along[:, None] * total
    return np.concatenate([level + up, level - up])


@pytest.fixture(scope="module")
def real_pairs(real) -> Contents:
    """The same sky with all pairs that the camera can see."""
    contents, _ = real
    found = find_pairs(contents.directions, 0.0, CAMERA.diagonal_rad)
    return replace(contents, method="pyramid", features=np.stack([found.i, found.j], axis=-1))


def fields_of(contents: Contents):
    mag = np.nan_to_num(contents.mag, nan=9.0)
    return lambda: tile_sphere(500, contents.directions, mag, CAMERA)


@pytest.mark.parametrize("share", [1.0, 0.999, 0.6, 0.4, 0.25])
@pytest.mark.parametrize("method", ["triangle", "pyramid"])
def test_an_image_is_made_to_fit_by_as_little_as_it_takes(real, real_pairs, method, share):
    contents, seen = real if method == "triangle" else (real_pairs, None)
    whole = len(make_image(contents).data)
    limit = int(share * whole)
    fitted = shrink(contents, seen, fields_of(contents), limit)
    made = make_image(fitted.contents)
    assert len(made.data) <= limit
    assert len(made.data) > limit - 8192
    image = read_onboard_image(made.data)
    assert (image.header["n_stars"], image.header["n_features"]) == (fitted.stars, fitted.features)
    assert not list(database_problems(image, contents))
    assert fitted.stars_before == 1500
    assert fitted.features <= fitted.features_before
    if share == 1.0:
        assert made.data == make_image(contents).data
    if fitted.stars == 1500 and method == "triangle":
        kept = {tuple(row) for row in fitted.contents.features.tolist()}
        left = np.array([tuple(row) in kept for row in contents.features.tolist()])
        assert seen[~left].max(initial=0) <= seen[left].min()
        assert seen[left].sum() >= FULL.least[method] * seen.sum()
    if share <= 0.25:
        assert fitted.stars < 1500
    if fitted.stars < 1500:
        assert fitted.stars_per_field is not None
        _, wanted = fields_of(contents)().brightest(fitted.stars_per_field)
        assert set(contents.star_id[wanted]) == set(fitted.contents.star_id)


def test_a_profile_keeps_the_shortest_pairs_of_the_brightest_stars(real_pairs):
    contents, small = real_pairs, PROFILES["small"]
    fitted = shrink(contents, None, fields_of(contents), None, small)
    _, wanted = fields_of(contents)().brightest(small.stars_per_field)
    assert set(contents.star_id[wanted]) == set(fitted.contents.star_id)
    assert fitted.stars_per_field == small.stars_per_field
    u = fitted.contents.directions
    i, j = fitted.contents.features.T
    longest = separation(u[i], u[j]).max()
    assert longest == pytest.approx(small.most * longest_pair_rad(CAMERA), rel=0.1)
    every = find_pairs(u, 0.0, longest * (1.0 + 1e-12))
    assert set(zip(every.i, every.j, strict=True)) == {tuple(np.sort(row)) for row in np.c_[i, j]}
    image = read_onboard_image(make_image(fitted.contents).data)
    cells = image.header["grid_bands"] * image.header["grid_sectors"]
    assert fitted.stars / cells == pytest.approx(small.stars_per_cell, rel=0.2)
    assert not [*database_problems(image, contents), *value_problems(image)]
    # With less memory there are shorter pairs first, then fewer stars.
    whole = len(image.data)
    less = shrink(contents, None, fields_of(contents), whole - 1, small)
    assert (less.stars, less.features < fitted.features) == (fitted.stars, True)
    least = shrink(contents, None, fields_of(contents), 2 * whole // 3, small)
    assert least.stars_per_field < small.stars_per_field
    # All stars of fields that have few.
    fullest = int(fields_of(contents)().count.max())
    every = replace(small, stars_per_field=fullest)
    fitted = shrink(contents, None, fields_of(contents), None, every)
    assert (fitted.stars, fitted.stars_per_field) == (len(contents.star_id), None)


def test_an_image_that_cannot_be_so_small_is_refused_with_what_it_takes(real):
    contents, seen = real
    with pytest.raises(OnboardSizeError, match="9,000 bytes are too few") as refused:
        shrink(contents, seen, fields_of(contents), 9_000)
    smallest = refused.value.smallest_bytes
    assert f"the smallest that is of use has {smallest:,} bytes" in str(refused.value)
    fitted = shrink(contents, seen, fields_of(contents), smallest)
    assert len(make_image(fitted.contents).data) == smallest
    with pytest.raises(OnboardSizeError):
        shrink(contents, seen, fields_of(contents), smallest - 1)
    # Nothing can be fitted too.
    contents, nothing = sky(0, 1), np.empty(0, np.int32)
    fitted = shrink(contents, nothing, fields_of(contents), 8192)
    assert (fitted.stars, fitted.features) == (0, 0)
    with pytest.raises(OnboardSizeError):
        shrink(contents, nothing, fields_of(contents), 8191)


@pytest.mark.parametrize("byte_order", BYTE_ORDERS)
def test_the_c_source_compiles_to_the_image_where_the_byte_order_is_that_of_the_machine(
    byte_order, tmp_path
):
    name, data = "sky-1.0.0", make_image(sky(30, 1), byte_order).data
    symbol = c_symbol(name)
    (tmp_path / "db.h").write_text(c_header(name, len(data)))
    (tmp_path / "db.c").write_text(c_source(name, data, byte_order, "db.h"))
    (tmp_path / "main.c").write_text(
        '#include "db.h"\n#include <stdio.h>\nint main(void) {\n'
        f"  return fwrite({symbol}, 1, sizeof {symbol}, stdout) != sizeof {symbol};\n}}\n"
    )
    flags = ["-std=c99", "-Wall", "-Wextra", "-Wconversion", "-pedantic", "-Werror"]
    command = [c_compiler(), *flags, "main.c", "db.c", "-o", "main"]
    built = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    if byte_order == sys.byteorder:
        assert built.returncode == 0, built.stderr
        assert subprocess.run([tmp_path / "main"], stdout=-1, check=True).stdout == data
        return
    assert built.returncode != 0
    assert f"{byte_order}-endian: export it with the other --endian" in built.stderr
    words = re.findall(r"0x([0-9A-F]{16})u", (tmp_path / "db.c").read_text())
    ordered = [bytes.fromhex(word)[:: 1 if byte_order == "big" else -1] for word in words]
    assert b"".join(ordered) == data
