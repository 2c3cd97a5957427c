"""Skies whose stars have neighbours and patterns, and frames of them."""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from starcat.geometry.attitude import matrix_from_quaternion
from starcat.geometry.camera import Camera
from starcat.matcher.database import Database, ProductArrays
from starcat.products.index import Index, Ragged
from starcat.products.neighbours import find_neighbours
from starcat.products.star_patterns import grid_patterns, radial_patterns
from starcat.simulation.simulate import Frame, Noise, simulate_frames

CAMERA = Camera(1024, 1024, fov_x_deg=16.0)

RADIUS_RAD = np.radians(7.9)
"""A little less than half the field, so that a star in the middle has its neighbours in it."""

SECTORS = 16

GRID = {"buffer_rad": np.radians(0.3), "cells_per_side": 40}


def product_arrays(product) -> ProductArrays:
    """Return a product as the HDF5 file holds it, rows of stars in few bits."""
    arrays = {}
    for column in fields(product):
        value = getattr(product, column.name)
        if isinstance(value, Ragged):
            arrays |= {
                f"{column.name}_offsets": value.offsets,
                f"{column.name}_values": value.values,
            }
        elif isinstance(value, Index):
            numbers = {name: float(number) for name, number in value.attributes.items()}
            arrays |= value.datasets
        elif column.name in {"star", "neighbour", "alignment_star"}:
            arrays[column.name] = value.astype(np.uint16)
        else:
            arrays[column.name] = value
    return ProductArrays(arrays, numbers)


def database(u: np.ndarray, radius_rad: float = RADIUS_RAD) -> Database:
    bins = {"angle_bin_rad": np.radians(2.0), "separation_bin_rad": np.radians(0.1)}
    products = {
        "neighbours": find_neighbours(u, radius_rad, **bins),
        "grid": grid_patterns(u, radius_rad, **GRID),
        "radial": radial_patterns(u, radius_rad, rings=60, sectors=SECTORS),
    }
    return Database(
        name="sky-1.0.0",
        camera=CAMERA,
        epoch_jyear=2026.0,
        star_id=np.arange(len(u)) + 1000,
        directions=u,
        mag=np.zeros(len(u)),
        designation=np.full(len(u), b"star"),
        products={name: product_arrays(product) for name, product in products.items()},
    )


def frames(sky: Database, count: int, noise: Noise | None = None, seed: int = 3) -> list[Frame]:
    return list(simulate_frames(sky.directions, CAMERA, count, noise or Noise(), seed))


def is_right(found, frame: Frame) -> bool:
    # 0.01 rad is far more than noise can do and far less than a wrong attitude.
    return bool(np.abs(matrix_from_quaternion(found.q_body_from_icrs) - frame.matrix).max() < 0.01)
