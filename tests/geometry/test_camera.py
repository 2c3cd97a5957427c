"""Camera: the corner convention, the field of view, the lens, and points outside the frame."""

from __future__ import annotations

import copy
import dataclasses
import json
import math
import pickle
import re
from itertools import combinations

import astropy.units as u
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.optimize import root

from starcat.errors import ConfigError, Unstated
from starcat.geometry.camera import Camera
from starcat.geometry.distortion import HORIZON, NO_DISTORTION, Distortion
from starcat.geometry.sphere import separation
from starcat.pipeline.finish import database_facts
from starcat.pipeline.specs.camera_file import camera_toml, read_camera
from starcat.pipeline.specs.reading import preset, preset_names
from starcat.resources import resource_folder

WIDE = Camera(1024, 768, 2000.0)
BARREL = Distortion(-0.3)
ALL_TERMS = Distortion(-0.3, 0.12, -0.03, 2e-3, -1e-3)
LENS = Camera(1024, 768, fov_x_deg=40.0, principal_point_px=(500.0, 400.0), distortion=ALL_TERMS)

sides = st.integers(1, 5000)
focal_lengths = st.floats(10.0, 1e5)
shares = st.floats(-0.5, 1.5)
tangential = st.floats(-5e-3, 5e-3)
radial = (st.floats(-0.5, 0.5), st.floats(-0.3, 0.3), st.floats(-0.1, 0.1))
distortions = st.builds(Distortion, *radial, tangential, tangential)
NOTHING = st.just(NO_DISTORTION)
unit_shares = st.floats(0.0, 1.0)


@st.composite
def cameras(draw):
    """Cameras of all kinds, whose detector stays a tenth short of the fold."""
    width_px, height_px = draw(sides), draw(sides)
    try:
        wider = "fov_x_deg" if width_px > height_px else "fov_y_deg"
        middle_px = width_px * draw(shares), height_px * draw(shares)
        lens = {"principal_point_px": middle_px, "distortion": draw(distortions | NOTHING)}
        camera = Camera(width_px, height_px, **{wider: draw(st.floats(0.5, 90.0))}, **lens)
    except ValueError:
        assume(False)
    assume(math.tan(camera.radius_rad) < 0.9 * camera.distortion.fold_radius)
    return camera


# Arguments --------------------------------------------------------------------------------------


def test_points_are_lists_arrays_or_quantities():
    px = [[100.0, 900.0], [500.0, 400.0]]
    body = LENS.directions_from_pixels(np.array(px))
    for points in (px, [[100, 900], [500, 400]], px * u.pix, np.array(px, dtype=np.float32)):
        assert np.array_equal(LENS.directions_from_pixels(points), body)
        assert LENS.contains(points).tolist() == [False, True]
    for points in (body.tolist(), tuple(body), body * u.one):
        np.testing.assert_allclose(LENS.pixels_from_directions(points), px)
    assert LENS.directions_from_pixels([]).shape == (0, 3)
    assert LENS.pixels_from_directions([]).shape == (0, 2)
    assert LENS.contains([]).shape == (0,)


@pytest.mark.parametrize("values", [[1.0, 2.0], [[1.0, 2.0, 3.0, 4.0]], np.ones((2, 1, 3)), 5.0])
def test_points_of_another_shape_or_unit_are_refused(values):
    shape = re.escape(str(np.shape(values)))
    for ask in (LENS.directions_from_pixels, LENS.contains):
        with pytest.raises(ConfigError, match=rf"^centroids_px: its shape is {shape}; .*\(N, 2\)"):
            ask(values)
        with pytest.raises(ConfigError, match="its unit is 'deg'; expected pix"):
            ask([[1.0, 2.0]] * u.deg)
    with pytest.raises(ConfigError, match=rf"^body: its shape is {shape}; expected \(N, 3\)"):
        LENS.pixels_from_directions(np.array(values))
    with pytest.raises(ConfigError, match="a single row is a list of one row"):
        LENS.pixels_from_directions(np.array([0.0, 0.0, 1.0]))


# Oracles: one point at a time, as the formula is printed in OpenCV's documentation -------------


def by_formula(x, y, lens):
    r2 = x**2 + y**2
    radial = 1 + lens.k1 * r2 + lens.k2 * r2**2 + lens.k3 * r2**3
    return (
        x * radial + 2 * lens.p1 * x * y + lens.p2 * (r2 + 2 * x**2),
        y * radial + lens.p1 * (r2 + 2 * y**2) + 2 * lens.p2 * x * y,
    )


def pixel_by_formula(camera, body):
    x, y = by_formula(body[0] / body[2], body[1] / body[2], camera.distortion)
    cx, cy = camera.principal_point_px
    return x * camera.focal_length_px + cx, y * camera.focal_length_px + cy


def direction_by_search(camera, pixel):
    """Invert the formula with scipy's solver, outwards from the axis to stay inside the fold."""
    image = (np.array(pixel) - camera.principal_point_px) / camera.focal_length_px
    # Away from 0, because the solver's steps are a share of the number itself.
    found = np.array([3.0, 3.0])
    for share in np.linspace(0.0, 1.0, 17):
        found = root(
            lambda p, goal: by_formula(*p - 3.0, camera.distortion) - goal,
            found,
            share * image,
            tol=1e-15,
        ).x
    found = found - 3.0
    assert np.abs(by_formula(*found, camera.distortion) - image).max() < 1e-13
    body = np.array([*found, 1.0])
    return body / np.linalg.norm(body)


def points_of(width_px, height_px):
    x, y = np.meshgrid(np.linspace(0.0, width_px, 9), np.linspace(0.0, height_px, 9))
    return np.column_stack([x.ravel(), y.ravel()])


def images_of(points, lens):
    """Return the images of points with rows x, y."""
    return lens.distorted(np.array([complex(*point) for point in points]))


# The pinhole ----------------------------------------------------------------------------------


@given(sides, sides, focal_lengths, shares, shares)
def test_pixel_round_trip(width_px, height_px, focal_length_px, x_share, y_share):
    camera = Camera(width_px, height_px, focal_length_px)
    given_px = np.array([[x_share * width_px, y_share * height_px]])
    back_px = camera.pixels_from_directions(camera.directions_from_pixels(given_px))
    # Some ten roundings of numbers as large as the frame.
    assert np.abs(back_px - given_px).max() <= 1e-14 * max(width_px, height_px)


@pytest.mark.parametrize(
    ("camera", "point"),
    [
        (WIDE, [512.0, 384.0]),
        (LENS, [500.0, 400.0]),
        (Camera(1024, 768, 2000.0, principal_point_px=(-50, 400)), [-50.0, 400.0]),
        (Camera(1, 1, 10.0), [0.5, 0.5]),
    ],
)
def test_the_axis_is_at_the_principal_point(camera, point):
    axis = [[0.0, 0.0, 1.0]]
    assert camera.pixels_from_directions(np.array(axis)).tolist() == [point]
    assert camera.directions_from_pixels(np.array([point])).tolist() == axis
    # x grows to the right, y downwards.
    right, down = WIDE.pixels_from_directions(np.array([[0.1, 0.0, 1.0], [0.0, 0.1, 1.0]]))
    assert (right.tolist(), down.tolist()) == ([712.0, 384.0], [512.0, 584.0])


@pytest.mark.parametrize("camera", [WIDE, LENS])
class TestAnyCamera:
    def test_directions_are_of_unit_length(self, camera):
        pixels = np.random.default_rng(2).uniform(0.0, 768.0, (200, 2))
        length = np.linalg.norm(camera.directions_from_pixels(pixels), axis=1)
        assert np.abs(length - 1.0).max() < 1e-15
        none = np.empty((0, 2))
        assert camera.directions_from_pixels(none).shape == (0, 3)
        assert camera.pixels_from_directions(np.empty((0, 3))).shape == (0, 2)
        assert camera.contains(none).shape == (0,)

    def test_what_is_behind_or_beside_the_camera_has_no_pixel(self, camera):
        body = np.array([[0.0, 0.0, -1.0], [0.1, 0.1, -0.9], [1.0, 0.0, 0.0], [np.nan] * 3])
        pixels = camera.pixels_from_directions(body)
        assert np.isnan(pixels).all()
        assert not camera.contains(pixels).any()

    def test_the_frame_is_closed_at_left_and_top_and_open_at_right_and_bottom(self, camera):
        last = np.nextafter(1024.0, 0.0), np.nextafter(768.0, 0.0)
        inside = [(0.0, 0.0), (0.5, 0.5), last]
        outside = [(1024.0, 0.0), (0.0, 768.0), (-1e-9, 5.0), (5.0, -1e-9)]
        outside += [(np.nan, 5.0), (5.0, np.nan), (np.inf, 5.0), (-np.inf, 5.0)]
        found = camera.contains(np.array(inside + outside)).tolist()
        assert found == [True] * 3 + [False] * 8

    def test_copies_are_equal(self, camera):
        assert re.fullmatch(r"<Camera 1024 x 768 px, [0-9.]+ x [0-9.]+ deg: .* px.*>", repr(camera))
        changed = dataclasses.replace(camera, width_px=900)
        assert changed.principal_point_px == camera.principal_point_px
        assert changed.distortion == camera.distortion
        pixels = points_of(1024, 768)
        body = camera.directions_from_pixels(pixels)
        assert camera.radius_rad > 0.0
        for twin in (pickle.loads(pickle.dumps(camera)), copy.deepcopy(camera), copy.copy(camera)):
            assert twin == camera
            assert hash(twin) == hash(camera)
            assert twin.radius_rad == camera.radius_rad
            np.testing.assert_array_equal(twin.directions_from_pixels(pixels), body)
        # Values computed from the coefficients are not pickled.
        assert len(pickle.dumps(camera)) < 1000


# The field of view ----------------------------------------------------------------------------


@given(sides, sides, st.floats(0.1, 170.0))
def test_a_camera_of_a_field_has_that_field(width_px, height_px, fov_deg):
    camera = Camera(width_px, height_px, fov_x_deg=fov_deg)
    assert camera.fov_x_deg == pytest.approx(fov_deg, rel=1e-13)
    assert (camera.fov_y_deg > camera.fov_x_deg) == (height_px > width_px)
    camera = Camera(width_px, height_px, fov_y_deg=fov_deg)
    assert camera.fov_y_deg == pytest.approx(fov_deg, rel=1e-13)


@pytest.mark.parametrize("ratio", [0.99899, 0.99901, 1.0, 1.00099, 1.00101])
def test_both_fields_may_be_given_if_they_agree(ratio):
    wide = Camera(1600, 1200, fov_x_deg=16.0)
    fov_y_deg = math.degrees(2.0 * math.atan(600.0 / (ratio * wide.focal_length_px)))
    if abs(ratio - 1.0) < 1e-3:
        assert Camera(1600, 1200, fov_x_deg=16.0, fov_y_deg=fov_y_deg) == wide
        return
    with pytest.raises(ValueError, match=r"expected 12\.0342, which square pixels give"):
        Camera(1600, 1200, fov_x_deg=16.0, fov_y_deg=fov_y_deg)


@given(sides, sides, focal_lengths)
def test_the_angles_of_a_pinhole_are_the_closed_forms(width_px, height_px, focal_length_px):
    camera = Camera(width_px, height_px, focal_length_px)
    half_x, half_y = 0.5 * width_px / focal_length_px, 0.5 * height_px / focal_length_px
    # To the last bit, because the products of a build depend on them.
    assert camera.fov_x_deg == 2.0 * np.degrees(np.arctan(half_x))
    assert camera.fov_y_deg == 2.0 * np.degrees(np.arctan(half_y))
    half_px = 0.5 * np.hypot(width_px, height_px)
    assert camera.diagonal_rad == 2.0 * np.arctan(half_px / focal_length_px)
    assert camera.radius_rad == 0.5 * camera.diagonal_rad
    assert Camera(100, 100, 1e-9).fov_x_deg == pytest.approx(180.0, abs=1e-8)


@settings(max_examples=25)
@given(cameras())
def test_angles_of_any_camera_are_those_of_its_edges_and_corners(camera):
    w, h = camera.width_px, camera.height_px
    middles = [(0.0, h / 2), (w, h / 2), (w / 2, 0.0), (w / 2, h)]
    left, right, top, bottom = (direction_by_search(camera, middle) for middle in middles)
    corners = [direction_by_search(camera, (x, y)) for x in (0.0, w) for y in (0.0, h)]
    widest = max(separation(one, other) for one, other in combinations(corners, 2))
    from_axis = separation(np.array(corners), np.array([0.0, 0.0, 1.0]))
    close = {"rel": 1e-11, "abs": 1e-13}
    assert camera.fov_x_deg == pytest.approx(math.degrees(separation(left, right)), **close)
    assert camera.fov_y_deg == pytest.approx(math.degrees(separation(top, bottom)), **close)
    assert camera.diagonal_rad == pytest.approx(float(widest), **close)
    assert camera.radius_rad == pytest.approx(from_axis.max(), **close)


def test_the_stated_field_is_that_of_the_pinhole():
    barrel = Camera(1000, 1000, fov_x_deg=40.0, distortion=Distortion(-0.1))
    pincushion = Camera(1000, 1000, fov_x_deg=40.0, distortion=Distortion(0.1))
    assert barrel.focal_length_px == pincushion.focal_length_px
    assert pincushion.fov_x_deg < 40.0 < barrel.fov_x_deg
    assert pincushion.diagonal_rad < 2.0 * Camera(1000, 1000, fov_x_deg=40.0).radius_rad


# The lens -------------------------------------------------------------------------------------


def test_the_formula_by_hand():
    lens = Distortion(k1=0.1, k2=0.01, k3=0.001, p1=0.01, p2=0.02)
    # At (1, 2) r^2 is 5 and the radial factor 1 + 0.5 + 0.25 + 0.125.
    x = 1.875 + 2 * 0.01 * 2 + 0.02 * (5 + 2)
    y = 3.75 + 0.01 * (5 + 8) + 2 * 0.02 * 2
    image = images_of([(1.0, 2.0)], lens)[0]
    assert image.real == pytest.approx(x, rel=1e-15)
    assert image.imag == pytest.approx(y, rel=1e-15)


@given(cameras(), unit_shares, unit_shares)
def test_projection_is_the_formula_and_directions_are_those_of_a_search(camera, x_share, y_share):
    pixel = np.array([x_share * camera.width_px, y_share * camera.height_px])
    body = direction_by_search(camera, pixel)
    assert separation(camera.directions_from_pixels(pixel[None])[0], body) < 1e-12
    found = camera.pixels_from_directions(3.0 * body[None])[0]
    # Some ten roundings of a number as large as the offset of the principal point.
    assert np.abs(found - pixel_by_formula(camera, body)).max() < 1e-10
    assert np.abs(found - pixel).max() < 1e-9
    pixels = points_of(camera.width_px, camera.height_px)
    back = camera.pixels_from_directions(camera.directions_from_pixels(pixels))
    assert np.abs(back - pixels).max() < 1e-9


@given(distortions, st.integers(0, 2**32 - 1))
def test_directions_inside_the_fold_come_back(lens, seed):
    generator = np.random.default_rng(seed)
    size = min(lens.fold_radius, 3.0) * np.sqrt(generator.uniform(0.0, 0.99, 50))
    z = size * np.exp(2j * np.pi * generator.uniform(size=50))
    back = lens.undistorted(lens.distorted(z))
    body, again = (np.column_stack([p.real, p.imag, np.ones(50)]) for p in (z, back))
    assert separation(body, again).max() < 1e-12


def test_no_distortion_is_the_pinhole(random_directions):
    body = random_directions(200, 3)
    expected = WIDE.pixels_from_directions(body)
    assert Distortion().is_none
    some = Camera(1024, 768, 2000.0, distortion=Distortion())
    assert some == WIDE
    np.testing.assert_array_equal(some.pixels_from_directions(body), expected)
    for name in ("k1", "k2", "k3", "p1", "p2"):
        tiny = Distortion(**{name: -1e-30})
        assert not tiny.is_none
        found = Camera(1024, 768, 2000.0, distortion=tiny).pixels_from_directions(body)
        np.testing.assert_allclose(found, expected, rtol=1e-14)


# The fold -------------------------------------------------------------------------------------


def test_what_is_beyond_the_fold_is_not_in_the_frame():
    camera = Camera(90, 90, 100.0, distortion=BARREL)
    fold = 1.0 / math.sqrt(0.9)  # where 1 - 0.9 r^2 is 0
    # The image of r = sqrt(1/0.3) would be the principal point itself.
    radii = np.array([0.5, fold * (1 - 1e-9), fold * (1 + 1e-9), math.sqrt(1 / 0.3), 1.9, 1e6])
    body = np.column_stack([radii, np.zeros(6), np.ones(6)])
    pixels = camera.pixels_from_directions(body)
    assert np.isfinite(pixels).all(axis=1).tolist() == [True, True, False, False, False, False]
    assert not np.isfinite(pixels[2:]).any()
    assert pixels[1, 0] == pytest.approx(45.0 + 100.0 * fold * 2.0 / 3.0, rel=1e-12)


def test_pixels_that_no_direction_reaches():
    camera = Camera(90, 90, 100.0, distortion=BARREL)
    fold_px = 100.0 * 2.0 / 3.0 / math.sqrt(0.9)
    x = 45.0 + fold_px * np.array([1 - 1e-9, 1 + 1e-9, 2.0, 1e6, np.nan, np.inf])
    body = camera.directions_from_pixels(np.column_stack([x, np.full(6, 45.0)]))
    assert np.isfinite(body[0]).all()
    assert np.isnan(body[1:]).all()
    # They do not spoil the others. The tangential part keeps the limit from being a circle.
    far, on_detector = [[5e3, 0.0], [np.nan, 1.0], [-1e7, 2e6]], [[1.0, 2.0], [900.0, 700.0]]
    found = LENS.directions_from_pixels(np.array(far + on_detector))
    assert np.isnan(found[:3]).all()
    expected = LENS.directions_from_pixels(np.array(on_detector))
    assert separation(found[3:], expected).max() < 1e-15


@pytest.mark.parametrize(
    ("lens", "fold"),
    [
        (Distortion(k1=-4 / 3, k2=3 / 5), 1.0 / math.sqrt(3.0)),  # 1 - 4 s + 3 s^2
        (Distortion(k1=-2 / 3, k2=1 / 5), 1.0),  # (1 - s)^2 only touches 0
        (Distortion(k1=-2 / 0.9, k2=1 / 0.45), math.sqrt(0.3)),  # (1 - s / 0.3)^2
        (Distortion(k1=-1.98 / 3, k2=0.99 / 5), HORIZON),  # (1 - s)^2 comes as near as 0.01
        (Distortion(k1=1 / 3, k2=-2 / 5), 1.0),  # 1 + s - 2 s^2
        (Distortion(k1=0.3, p2=0.25), (1.5 - math.sqrt(1.05)) / 0.6),  # 1 + 0.3 r^2 - 1.5 r
        (Distortion(p1=0.6 / 60, p2=0.8 / 60), 10.0),
        (Distortion(k1=0.3, k2=0.1, k3=0.1), HORIZON),
        (Distortion(k1=-1e-30), HORIZON),
        (NO_DISTORTION, HORIZON),
    ],
)
def test_where_the_image_folds(lens, fold):
    assert lens.fold_radius == pytest.approx(fold, rel=1e-7)


@given(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0), st.floats(-2.0, 2.0))
def test_the_radial_fold_is_the_first_place_where_the_image_turns_back(k1, k2, k3):
    lens = Distortion(k1, k2, k3)
    r = np.linspace(0.0, 4.0, 40_001)
    image = r * (1.0 + k1 * r**2 + k2 * r**4 + k3 * r**6)
    backward = np.flatnonzero(np.diff(image) <= 0.0)
    if len(backward):
        assert abs(lens.fold_radius - r[backward[0]]) < 2e-4
    else:
        # The steps can miss a point where the slope only touches 0.
        assert lens.fold_radius > 4.0 - 2e-4 or np.diff(image).min() < 1e-7


@given(distortions, st.floats(0.0, 3.0), st.integers(0, 2**32 - 1))
def test_no_two_directions_inside_the_fold_share_an_image(lens, stronger, seed):
    lens = dataclasses.replace(lens, p1=lens.p1 * 30.0 * stronger, p2=lens.p2 * 30.0 * stronger)
    generator = np.random.default_rng(seed)
    size = min(lens.fold_radius, 5.0) * np.sqrt(generator.uniform(0.0, 1.0, 200))
    z = size * np.exp(2j * np.pi * generator.uniform(size=200))
    # As the gradient of a convex function: images differ along what their directions do.
    image = np.array([complex(*by_formula(p.real, p.imag, lens)) for p in z])
    along = ((image[:, None] - image) * (z[:, None] - z).conj()).real
    assert (along[~np.eye(200, dtype=bool)] > 0.0).all()


@given(tangential, tangential)
def test_the_tangential_fold_is_where_the_image_turns_back_first(p1, p2):
    strength = math.hypot(p1, p2)
    assume(strength > 1e-6)
    lens = Distortion(p1=p1, p2=p2)
    towards = np.array([-p2, -p1]) / strength
    at_shares = [by_formula(*(towards * lens.fold_radius * k), lens) for k in (0.98, 1.0, 1.02)]
    inner, fold, outer = np.array(at_shares) @ towards
    assert inner < fold > outer


@given(distortions, st.floats(-180.0, 180.0))
def test_every_image_within_the_image_radius_has_a_direction(lens, angle_deg):
    angle = math.radians(angle_deg)
    image = 0.9999 * min(lens.image_radius, 10.0) * np.array([np.exp(1j * angle)])
    found = lens.undistorted(image)
    assert abs(found[0]) < lens.fold_radius
    assert abs(lens.distorted(found)[0] - image[0]) < 1e-13 * max(1.0, abs(image[0]))


def test_both_ways_end_at_the_same_fold():
    # In other directions the image of this lens continues beyond the radius of the fold.
    lens = Distortion(p1=1 / 60)
    y = 10.0 * np.array([1 - 1e-10, 1 + 1e-10])
    image = [complex(*by_formula(0.0, number, lens)) for number in y]
    assert np.isnan(lens.distorted(1j * y)).tolist() == [False, True]
    assert np.isnan(lens.undistorted(np.array(image))).tolist() == [False, True]


def test_a_detector_beyond_the_fold_is_refused():
    # The fold at 1.0541 focal lengths has its image at two thirds of that.
    expected = (
        "distortion: it folds the image back at 70.2728 px from the principal point, but the "
        "detector reaches out to 707.107 px; expected a fold beyond that"
    )
    with pytest.raises(ValueError, match=f"^{expected}$"):
        Camera(1000, 1000, 100.0, distortion=BARREL)
    at = {"principal_point_px": (-20.0, 0.5), "distortion": BARREL}
    focal = math.hypot(30.0 + 20.0, 0.5) / (2.0 / 3.0 / math.sqrt(0.9))
    Camera(30, 1, focal * (1 + 1e-9), **at)
    with pytest.raises(ValueError, match=r"folds the image back at 50\.00"):
        Camera(30, 1, focal * (1 - 1e-9), **at)


@pytest.mark.parametrize(
    "lens",
    [
        Distortion(k1=9e13),
        Distortion(k3=9e13, k1=-1e-9),
        Distortion(k1=14984415421791.152, k3=-8563154440.0),
        Distortion(k1=-0.6, k2=1e9),
    ],
)
def test_a_lens_that_bends_all_it_can_has_an_inverse(lens):
    camera = Camera(1000, 1000, 110.0, distortion=lens)
    pixels = points_of(1000, 1000)
    back = camera.pixels_from_directions(camera.directions_from_pixels(pixels))
    assert np.abs(back - pixels).max() < 1e-9


def test_the_horizon_has_no_pixel_behind_a_lens():
    camera = Camera(100, 100, 100.0, distortion=Distortion(k3=1.0))
    body = np.array([[1.0, 0.0, 1e-7], [1.0, 0.0, 1e-9], [1.0, 1.0, 1e-300]])
    assert np.isfinite(camera.pixels_from_directions(body)).all(axis=1).tolist() == [1, 0, 0]


# The object -----------------------------------------------------------------------------------


def test_cameras_and_distortions_are_values():
    again = Camera(1024, 768, 2000, principal_point_px=np.array([512, 384]))
    assert again == WIDE
    assert hash(again) == hash(WIDE)
    assert Camera(1024, 768, 2000.0, principal_point_px=None, distortion=None) == WIDE
    assert len({WIDE, again, LENS}) == 2
    assert Camera(1024, 768, 2000.0, distortion=BARREL) != WIDE
    assert Camera(1024, 768, 2000.0, principal_point_px=(512.0, 384.5)) != WIDE
    assert (type(again.focal_length_px), type(again.principal_point_px[0])) == (float, float)
    assert type(Camera(np.int32(8), np.int64(9), 2.0).width_px) is int
    with pytest.raises(dataclasses.FrozenInstanceError):
        again.width_px = 5
    with pytest.raises(dataclasses.FrozenInstanceError):
        LENS.distortion.k1 = 0.0
    assert Distortion() == NO_DISTORTION
    assert hash(Distortion(1, p2=2)) == hash(Distortion(1.0, 0.0, 0.0, 0.0, 2.0))
    assert type(Distortion(k1=1).k1) is float


USUAL = {"width_px": 10, "height_px": 10, "focal_length_px": 100.0}


@pytest.mark.parametrize(
    ("name", "expected", "values"),
    [
        ("width_px", "a whole number from 1 to 1000000", (0, 10.0, True, 1_000_001)),
        ("height_px", "a whole number from 1 to 1000000", (-1, "9")),
        ("focal_length_px", "a finite number above 0", (0.0, -5, np.nan, np.inf, True, "9")),
        ("principal_point_px", "two finite num", ((1.0,), (1, 2, 3), 5, "12", (0, np.inf))),
        ("distortion", "a Distortion", (-0.1,)),
    ],
)
def test_an_impossible_camera_is_refused(name, expected, values):
    for value in values:
        with pytest.raises(ValueError, match="expected") as refused:
            Camera(**USUAL | {name: value})
        assert str(refused.value).startswith(f"{name} is {value!r}; expected {expected}")


@pytest.mark.parametrize(
    ("scale", "message"),
    [
        ((None, None, None), "found no scale; expected one of focal_length_px, fov_x_deg"),
        ((9.0, 9.0, None), "found focal_length_px and fov_x_deg; expected one of focal_length"),
        ((9.0, 9.0, 9.0), "found focal_length_px and fov_x_deg and fov_y_deg; expected one of"),
        ((None, 0.0, None), "fov_x_deg is 0.0; expected a finite number above 0 and below 178.8"),
        ((None, None, 180.0), "fov_y_deg is 180.0; expected a finite number above 0 and below"),
        ((None, 40.0, np.nan), "fov_y_deg is nan; expected a finite number above 0 and below"),
        ((None, 90.0, 60), "fov_y_deg is 60; expected 90, which square pixels give with fov_x_deg"),
    ],
)
def test_an_impossible_scale_is_refused(scale, message):
    given_scale = dict(zip(("focal_length_px", "fov_x_deg", "fov_y_deg"), scale, strict=True))
    with pytest.raises(ValueError, match=f"^{message}"):
        Camera(**USUAL | given_scale)


@pytest.mark.parametrize("name", ["k1", "k2", "k3", "p1", "p2"])
@pytest.mark.parametrize("value", [np.nan, -np.inf, 1e14, "1", None, False, 10**400])
def test_an_impossible_distortion_is_refused(name, value):
    with pytest.raises(ValueError, match=f"^{name} is .*; expected a finite number above -1e.14"):
        Distortion(**{name: value})
    Distortion(**{name: np.nextafter(1e14, 0.0)})


# Files ----------------------------------------------------------------------------------------


@pytest.fixture
def read(tmp_path):
    """Read a camera from TOML text."""

    def read(text: str) -> Camera:
        path = tmp_path / "cam.toml"
        path.write_text(text, encoding="utf-8")
        return read_camera(path)

    return read


@given(camera=cameras())
def test_a_camera_that_is_written_and_read_is_the_same(camera, tmp_path_factory):
    path = tmp_path_factory.mktemp("camera") / "camera.toml"
    path.write_text(camera_toml(camera), encoding="utf-8")
    assert read_camera(path) == camera
    path.write_text(f"[camera]\n{camera_toml(camera).replace('[dist', '[camera.dist')}")
    assert read_camera(path) == camera


def test_the_time_of_a_readout_is_read_from_files_of_cameras_and_specs(read):
    camera = read(f"{SIZE}fov_x_deg = 12\nreadout_s = 0.05")
    assert camera == Camera(1000, 500, fov_x_deg=12.0, readout_s=0.05)
    assert "readout 0.05 s" in repr(camera)
    assert read(camera_toml(camera)) == camera
    assert camera.with_focal_length(9.0).readout_s == 0.05
    spec = preset("sao-12deg", {"camera.readout_s": "0.05"})
    assert spec.camera.camera().readout_s == 0.05
    assert spec.recorded()["camera"]["readout_s"] == 0.05
    assert json.loads(database_facts(spec)["camera"])["readout_s"] == 0.05
    with pytest.raises(ConfigError, match="readout_s is -1; expected a finite number above 0"):
        read(f"{SIZE}fov_x_deg = 12\nreadout_s = -1")


def test_a_spec_without_the_time_of_a_readout_is_recorded_as_before():
    spec = preset("sao-12deg")
    assert "readout_s" not in spec.recorded()["camera"]
    assert "readout_s" not in database_facts(spec)["camera"]
    assert spec.camera.camera().readout_s is None


def test_a_camera_file_as_it_is_written():
    camera = Camera(
        16, 9, 2e22, principal_point_px=(0.1, 1e-7), distortion=Distortion(-0.1, p2=2e-17)
    )
    expected = """\
width_px = 16
height_px = 9
focal_length_px = 2e+22
principal_point_px = [0.1, 1e-07]

[distortion]
k1 = -0.1
k2 = 0.0
k3 = 0.0
p1 = 0.0
p2 = 2e-17
"""
    assert camera_toml(camera) == expected


SIZE = "width_px = 1000\nheight_px = 500\n"


@pytest.mark.parametrize(
    ("scale", "focal_length_px"),
    [
        ("focal_length_px = 500", 500.0),
        ("fov_x_deg = 90", 500.0),
        ("fov_y_deg = 90.0", 250.0),
        ("fov_y_deg = 53.1301\nfov_x_deg = 90", 500.0),
        ("focal_length_mm = 40\npixel_um = 16.0", 2500.0),
    ],
)
def test_the_ways_to_say_the_scale(read, scale, focal_length_px):
    camera = read(SIZE + scale)
    assert camera.focal_length_px == pytest.approx(focal_length_px, rel=1e-15)
    assert camera == Camera(1000, 500, camera.focal_length_px)
    # Whole numbers will do for any number.
    whole = read(f"{SIZE}{scale}\nprincipal_point_px = [1, 2]\ndistortion = {{ k1 = 0 }}")
    assert whole == dataclasses.replace(camera, principal_point_px=(1.0, 2.0))


@pytest.mark.parametrize("name", preset_names())
def test_a_build_spec_is_a_camera_file(name):
    path = resource_folder("pipeline/specs/presets") / f"{name}.toml"
    assert read_camera(path) == preset(name).camera.camera()


FIELD = SIZE + "fov_x_deg = 9\n"


@pytest.mark.parametrize(
    ("text", "key", "value", "message"),
    [
        ("", "width_px", None, ": missing; every camera needs it"),
        ("camera = 5", "camera", 5, ": found 5; expected a table"),
        (SIZE, None, None, "found no scale; expected one of focal_length_px, fov_x_deg, fov_y_deg"),
        (SIZE + "pixel_um = 5", None, None, "found pixel_um; expected one of focal_length_px, "),
        (SIZE + "fov_deg = 9", "fov_deg", 9, ": unknown key; did you mean 'fov_y_deg'? known keys"),
        (SIZE + '"\\u0007" = 9', "'\\x07'", 9, ": unknown key; known keys here: width_px"),
        (FIELD + "distortion.k4 = 1.0", "distortion.k4", 1.0, ": unknown key; did you mean 'k3'? "),
        ("width_px = 0\nheight_px = 5\nfov_x_deg = 9", "width_px", 0, " is 0; expected a whole"),
        (f"[camera]\n{FIELD}width_px = 5.0".replace("width_px = 1000\n", ""),
         "camera.width_px", 5.0, " is 5.0; expected a whole number from 1 to 1000000"),
        (f"[camera]\n{FIELD}[distortion]\nk1 = 1.0",
         "distortion", {"k1": 1.0}, ": found outside [camera]; expected in it"),
        (f"{SIZE}focal_length_mm = inf\npixel_um = 5",
         "focal_length_mm", math.inf, " is inf; expected a finite number above 0"),
        (
            SIZE + "focal_length_mm = 25.0\npixel_um = [5.5, 6.0]",
            "pixel_um",
            [5.5, 6.0],
            ": found [5.5, 6.0]; expected one number; for pixels that are not square",
        ),
        (SIZE + "fov_x_deg = true", "fov_x_deg", True, " is true; expected a finite number"),
        (FIELD + "distortion = -0.1", "distortion", -0.1, ": found -0.1; expected a table"),
        (f"[camera]\n{FIELD}distortion.p1 = true",
         "camera.distortion.p1", True, " is true; expected a finite number above"),
        (f"[camera]\n{SIZE}fov_x_deg = 120\ndistortion.k1 = -0.3",
         "camera.distortion", {"k1": -0.3}, ": it folds the image back at 202.86 px from the"),
    ],
)  # fmt: skip
def test_a_wrong_camera_file_is_refused(read, tmp_path, text, key, value, message):
    with pytest.raises(ConfigError) as refused:
        read(text)
    assert str(refused.value).startswith(f"{tmp_path / 'cam.toml'}: {key or ''}{message}")
    stated = Unstated.UNSTATED if key is None else value
    assert (refused.value.key, refused.value.value) == (key, stated)


def test_an_unreadable_camera_file_is_refused(tmp_path):
    path = tmp_path / "cam.toml"
    with pytest.raises(ConfigError, match="is a folder; give a file; expected a TOML file"):
        read_camera(tmp_path)
    unreadable = {b"width_px = ": "not a readable TOML file: ", b"\xff\xfe": "is not in UTF-8"}
    for content, words in unreadable.items():
        path.write_bytes(content)
        with pytest.raises(ConfigError, match=rf"cam\.toml: {words}"):
            read_camera(path)
