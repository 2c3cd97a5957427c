"""Pictures by cameras of 5 to 30 deg, identified with one database and no other information."""

from __future__ import annotations

import numpy as np
import pytest

from starcat.catalog.ingest import ingest_catalog
from starcat.catalog.source_files import locate
from starcat.catalog.stars.star_table import directions_of, floats_of
from starcat.frames.images.centroiding import find_spots
from starcat.frames.images.render import Optics, render_image
from starcat.geometry.attitude import matrix_from_quaternion, random_attitudes
from starcat.geometry.camera import Camera
from starcat.matcher.matcher import Matcher
from starcat.pipeline.build import build
from starcat.pipeline.specs.build_spec import CameraSpec
from starcat.pipeline.starter import starter_spec

RANGE_DEG = (5.0, 30.0)
SIZE_PX = (1024, 768)

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]


@pytest.fixture(scope="module")
def matcher(tmp_path_factory):
    camera = CameraSpec(width_px=SIZE_PX[0], height_px=SIZE_PX[1], fov_x_deg=RANGE_DEG[0])
    spec = starter_spec("range", camera, widest_fov_x_deg=RANGE_DEG[1]).spec
    return Matcher.open(build(spec, tmp_path_factory.mktemp("range")).folder)


@pytest.fixture(scope="module")
def sky():
    stars = ingest_catalog("gaia", locate("gaia", {})).stars
    return directions_of(stars), floats_of(stars, "mag")


def picture(sky, fov_deg, generator):
    """Return the spots of a picture, and the camera and the attitude that it was taken with.

    The aperture shrinks with the focal length, as in real lenses, but more slowly.
    """
    directions, mag = sky
    camera = Camera(*SIZE_PX, fov_x_deg=fov_deg)
    matrix = random_attitudes(1, generator)[0]
    optics = Optics(zero_point_e=600_000.0 * RANGE_DEG[0] / fov_deg)
    seen = directions @ matrix[2] > np.cos(1.02 * camera.radius_rad)
    px = camera.pixels_from_directions(directions[seen] @ matrix.T)
    image = render_image(px, mag[seen], SIZE_PX, optics, int(generator.integers(1 << 31)))
    return find_spots(image), camera, matrix


def is_right(result, spots, camera, matrix, directions):
    """Return whether attitude, focal length and every star of an answer are true."""
    turned = matrix_from_quaternion(result.q_body_from_icrs) @ matrix.T
    angle_rad = np.linalg.norm(turned - np.eye(3)) / np.sqrt(2.0)
    has_star = result.star_index >= 0
    there = camera.pixels_from_directions(directions[result.star_index[has_star]] @ matrix.T)
    off_px = np.hypot(*(there - spots.centroids_px[has_star]).T)
    scale = result.camera.focal_length_px / camera.focal_length_px
    return (
        angle_rad * camera.focal_length_px < 5.0 and abs(scale - 1.0) < 0.005 and off_px.max() < 4
    )


def test_pictures_of_any_field_are_identified(matcher, sky):
    generator, right, wrong = np.random.default_rng(14), 0, 0
    for fov_deg in np.exp(generator.uniform(*np.log(RANGE_DEG), size=100)):
        spots, camera, matrix = picture(sky, float(fov_deg), generator)
        result = matcher.identify(
            spots.centroids_px, Camera(*SIZE_PX, fov_x_deg=10.0),
            mag=spots.mag, fov_deg=RANGE_DEG,
        )  # fmt: skip
        if result.ok:
            good = is_right(result, spots, camera, matrix, matcher.database.directions)
            right, wrong = right + good, wrong + (not good)
    assert wrong == 0
    assert right >= 95


def test_pictures_of_other_fields_and_random_points_get_no_answer(matcher, sky):
    generator = np.random.default_rng(15)
    frames = [picture(sky, fov_deg, generator)[0] for fov_deg in (3.0, 45.0) for _ in range(10)]
    given = [(spots.centroids_px, spots.mag) for spots in frames]
    for _ in range(15):
        count = int(generator.integers(8, 120))
        given.append((generator.uniform((0, 0), SIZE_PX, (count, 2)), generator.normal(size=count)))
    camera = Camera(*SIZE_PX, fov_x_deg=10.0)
    answers = [matcher.identify(px, camera, mag=mag, fov_deg=RANGE_DEG) for px, mag in given]
    assert [answer.status for answer in answers] == ["no_match"] * len(answers)
