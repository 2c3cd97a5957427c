"""Skies in memory: databases of directions with the products of a method, and frames of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from starcat.database.products.grid import grid_patterns
from starcat.database.products.hausdorff_angular import angular_reference_sets
from starcat.database.products.hausdorff_l2 import planar_reference_sets
from starcat.database.products.index import Index, Ragged
from starcat.database.products.neighbours import find_neighbours
from starcat.database.products.pairs import find_pairs
from starcat.database.products.radial import radial_patterns
from starcat.database.products.tiling import tile_sphere
from starcat.database.products.triangles import find_triangles
from starcat.geometry.attitude import matrix_from_radec_roll
from starcat.geometry.camera import Camera
from starcat.geometry.kvector import KVector
from starcat.geometry.sphere import radec_from_directions
from starcat.matcher.database import MatcherDatabase, ProductArrays

CAMERA = Camera(1024, 1024, fov_x_deg=20.0)

PATTERN_CAMERA = Camera(1024, 1024, fov_x_deg=16.0)

RADIUS_RAD = np.radians(7.9)
"""A little less than half the field of that camera: a star in the middle has its neighbours in."""

SECTORS = 16

GRID = {"buffer_rad": np.radians(0.3), "cells_per_side": 40}


def product_arrays(product: Any) -> ProductArrays:
    """Return a product as in the HDF5 file, with rows of stars in few bits."""
    arrays = dict(product.index.datasets)
    for column in fields(product):
        value = getattr(product, column.name)
        if isinstance(value, Ragged):
            arrays[f"{column.name}_offsets"] = value.offsets
            arrays[f"{column.name}_values"] = value.values
        elif isinstance(value, KVector):
            arrays["separation_rad"] = value.values
        elif column.name in {"star", "neighbour", "alignment_star"}:
            arrays[column.name] = value.astype(np.uint16)
        elif not isinstance(value, Index):
            arrays[column.name] = value
    numbers = {name: float(number) for name, number in product.index.attributes.items()}
    return ProductArrays(arrays, numbers)


def database(
    u: np.ndarray, camera: Camera, made: Mapping[str, Any], mag: np.ndarray | None = None
) -> MatcherDatabase:
    """Return a database; star numbers are rows plus 1000, so that a mix-up of the two shows."""
    return MatcherDatabase(
        name="sky-1.0.0",
        camera=camera,
        epoch_jyear=2026.0,
        star_id=np.arange(len(u)) + 1000,
        directions=u,
        mag=np.zeros(len(u)) if mag is None else mag,
        designation=np.full(len(u), b"star"),
        products={name: product_arrays(product) for name, product in made.items()},
    )


def pair_sky(u: np.ndarray, camera: Camera, mag: np.ndarray | None = None) -> MatcherDatabase:
    return database(u, camera, {"pairs": find_pairs(u, 0.0, camera.diagonal_rad)}, mag)


def triangle_sky(u: np.ndarray, camera: Camera = CAMERA, boresights: int = 1000) -> MatcherDatabase:
    mag = np.random.default_rng(len(u)).uniform(1.0, 6.0, len(u))
    pairs = find_pairs(u, 0.0, camera.diagonal_rad)
    triangles = find_triangles(tile_sphere(boresights, u, mag, camera), u, 8)
    return database(u, camera, {"pairs": pairs, "triangles": triangles}, mag)


def set_sky(u: np.ndarray, radius_deg: tuple[float, float] = (13.3, 10.0)) -> MatcherDatabase:
    """A database with both sets of distances."""
    angular_rad, planar_rad = np.radians(radius_deg)
    made = {
        "hausdorff_angular": angular_reference_sets(u, angular_rad),
        "hausdorff_l2": planar_reference_sets(u, planar_rad),
    }
    return database(u, CAMERA, made, np.random.default_rng(len(u)).uniform(2.0, 6.0, len(u)))


def pattern_sky(u: np.ndarray, radius_rad: float = RADIUS_RAD) -> MatcherDatabase:
    """A database whose stars have neighbours and patterns."""
    bins = {"angle_bin_rad": np.radians(2.0), "separation_bin_rad": np.radians(0.1)}
    made = {
        "neighbours": find_neighbours(u, radius_rad, **bins),
        "grid": grid_patterns(u, radius_rad, **GRID),
        "radial": radial_patterns(u, radius_rad, rings=60, sectors=SECTORS),
    }
    return database(u, PATTERN_CAMERA, made)


def frame_centred_on(
    sky: MatcherDatabase, star: int, roll_deg: float, scale: float = 1.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centroids and stars about one of them, stretched about the middle, and the attitude."""
    ra, dec = radec_from_directions(sky.directions[star])
    matrix = matrix_from_radec_roll(float(ra), float(dec), roll_deg)
    near, camera = np.flatnonzero(sky.directions @ matrix[2] > 0.9), sky.camera
    px = camera.pixels_from_directions(sky.directions[near] @ matrix.T)
    px = 512.0 + scale * (px - 512.0)
    inside = camera.contains(px)
    return px[inside], near[inside], matrix
