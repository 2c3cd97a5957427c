"""Camera: the corner convention, the field of view, and what is behind or beside the frame."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from starcat.camera import Camera
from starcat.sphere import separation

WIDE = Camera(1024, 768, 2000.0)

sides = st.integers(1, 5000)
focal_lengths = st.floats(10.0, 1e5)
shares = st.floats(-0.5, 1.5)


@given(sides, sides, focal_lengths, shares, shares)
def test_pixel_round_trip(width_px, height_px, focal_length_px, x_share, y_share):
    camera = Camera(width_px, height_px, focal_length_px)
    given_px = np.array([[x_share * width_px, y_share * height_px]])
    back_px = camera.pixels_from_directions(camera.directions_from_pixels(given_px))
    # Some ten roundings of numbers as large as the frame.
    assert np.abs(back_px - given_px).max() <= 1e-14 * max(width_px, height_px)


def test_direction_round_trip(random_directions):
    body = random_directions(500, 1)
    body = body[body[:, 2] > 0.01]
    back = WIDE.directions_from_pixels(WIDE.pixels_from_directions(body))
    # A direction at the horizon lands 2e5 px out.
    assert separation(back, body).max() < 1e-12


def test_the_axis_is_the_middle_of_the_frame():
    assert WIDE.pixels_from_directions(np.array([[0.0, 0.0, 1.0]])).tolist() == [[512.0, 384.0]]
    assert WIDE.directions_from_pixels(np.array([[512.0, 384.0]])).tolist() == [[0.0, 0.0, 1.0]]


def test_the_only_pixel_of_a_one_pixel_camera_has_its_centre_at_a_half():
    camera = Camera(1, 1, 10.0)
    assert camera.pixels_from_directions(np.array([[0.0, 0.0, 1.0]])).tolist() == [[0.5, 0.5]]


def test_x_grows_to_the_right_and_y_downwards():
    right, down = WIDE.pixels_from_directions(np.array([[0.1, 0.0, 1.0], [0.0, 0.1, 1.0]]))
    assert right.tolist() == [712.0, 384.0]
    assert down.tolist() == [512.0, 584.0]


def test_directions_are_of_unit_length():
    pixels = np.random.default_rng(2).uniform(-500.0, 1500.0, (200, 2))
    length = np.linalg.norm(WIDE.directions_from_pixels(pixels), axis=1)
    assert np.abs(length - 1.0).max() < 1e-15


def test_the_fields_of_view_are_the_angles_between_the_edges():
    edges = np.array([[0.0, 384.0], [1024.0, 384.0], [512.0, 0.0], [512.0, 768.0]])
    left, right, top, bottom = WIDE.directions_from_pixels(edges)
    assert WIDE.fov_x_deg == pytest.approx(np.degrees(separation(left, right)), rel=1e-14)
    assert WIDE.fov_y_deg == pytest.approx(np.degrees(separation(top, bottom)), rel=1e-14)


def test_the_diagonal_is_the_angle_between_the_corners():
    one, other = WIDE.directions_from_pixels(np.array([[0.0, 0.0], [1024.0, 768.0]]))
    assert WIDE.diagonal_rad == pytest.approx(float(separation(one, other)), rel=1e-14)


@given(sides, sides, st.floats(0.1, 170.0))
def test_a_camera_of_a_field_has_that_field(width_px, height_px, fov_x_deg):
    camera = Camera.from_fov(width_px, height_px, fov_x_deg)
    assert camera.fov_x_deg == pytest.approx(fov_x_deg, rel=1e-13)
    assert (camera.fov_y_deg > camera.fov_x_deg) == (height_px > width_px)


def test_a_field_of_90_degrees_has_a_focal_length_of_half_the_width():
    assert Camera.from_fov(1000, 500, 90.0).focal_length_px == pytest.approx(500.0, rel=1e-15)


def test_what_is_behind_or_beside_the_camera_has_no_pixel():
    body = np.array([[0.0, 0.0, -1.0], [0.1, 0.1, -0.9], [1.0, 0.0, 0.0], [np.nan] * 3])
    pixels = WIDE.pixels_from_directions(body)
    assert np.isnan(pixels).all()
    assert not WIDE.contains(pixels).any()


@pytest.mark.parametrize(
    ("pixel", "inside"),
    [
        ((0.0, 0.0), True),
        ((0.5, 0.5), True),
        ((np.nextafter(1024.0, 0.0), np.nextafter(768.0, 0.0)), True),
        ((1024.0, 0.0), False),
        ((0.0, 768.0), False),
        ((-1e-9, 5.0), False),
        ((5.0, -1e-9), False),
        ((np.nan, 5.0), False),
        ((5.0, np.nan), False),
        ((np.inf, 5.0), False),
        ((-np.inf, 5.0), False),
    ],
)
def test_the_frame_is_closed_at_left_and_top_and_open_at_right_and_bottom(pixel, inside):
    assert WIDE.contains(np.array([pixel])).tolist() == [inside]


def test_no_pixels():
    none = np.empty((0, 2))
    assert WIDE.directions_from_pixels(none).shape == (0, 3)
    assert WIDE.pixels_from_directions(np.empty((0, 3))).shape == (0, 2)
    assert WIDE.contains(none).shape == (0,)


@pytest.mark.parametrize(
    "arguments", [(0, 10, 100.0), (10, -1, 100.0), (10, 10, 0.0), (10, 10, float("nan"))]
)
def test_an_impossible_camera_is_refused(arguments):
    with pytest.raises(ValueError, match="all three must be positive"):
        Camera(*arguments)
