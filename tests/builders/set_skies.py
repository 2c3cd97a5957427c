"""Skies whose stars have sets of distances, and frames about one of their stars."""

from __future__ import annotations

import numpy as np

from starcat.geometry.attitude import matrix_from_radec_roll
from starcat.geometry.camera import Camera
from starcat.geometry.sphere import radec_from_directions
from starcat.matcher.database import Database, ProductArrays
from starcat.products.neighbours import angular_reference_sets, planar_reference_sets

CAMERA = Camera(1024, 1024, fov_x_deg=20.0)


def set_sky(u: np.ndarray, radius_deg: tuple[float, float] = (13.3, 10.0)) -> Database:
    """A database with both products, rows in 16 bits as in a file."""
    products = {}
    for name, make, values, radius in (
        ("hausdorff_angular", angular_reference_sets, "separation_rad", radius_deg[0]),
        ("hausdorff_l2", planar_reference_sets, "ratio", radius_deg[1]),
    ):
        sets = make(u, np.radians(radius))
        columns = {
            "star": sets.star.astype(np.uint16),
            "neighbour": sets.neighbour.astype(np.uint16),
            values: getattr(sets, values),
        }
        products[name] = ProductArrays({**columns, **sets.index.datasets}, sets.index.attributes)
    count = len(u)
    mag = np.random.default_rng(count).uniform(2.0, 6.0, count)
    named = np.full(count, b"star")
    return Database("sky", CAMERA, 2026.0, np.arange(count), u, mag, named, products)


def frame_of(
    sky: Database, matrix: np.ndarray, scale: float = 1.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centroids and stars at an attitude, stretched about the middle, and the attitude."""
    star = np.flatnonzero(sky.directions @ matrix[2] > 0.9)
    px = 512.0 + scale * (CAMERA.pixels_from_directions(sky.directions[star] @ matrix.T) - 512.0)
    inside = CAMERA.contains(px)
    return px[inside], star[inside], matrix


def frame_centred_on(sky: Database, star: int, roll_deg: float, scale: float = 1.0):
    ra, dec = radec_from_directions(sky.directions[star])
    return frame_of(sky, matrix_from_radec_roll(float(ra), float(dec), roll_deg), scale)
