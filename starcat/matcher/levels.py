"""The levels of a database as databases of their own.

A level is for frames of about one field of view. Its database has the stars and the triangles of
that level alone, so that every method finds in it what it would find in an artifact that was
built for such a camera.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from starcat.errors import ProductError
from starcat.geometry.camera import Camera
from starcat.geometry.patterns import triangle_area
from starcat.matcher.database import Database, ProductArrays

PRODUCT = "levels"


@dataclass(frozen=True)
class Level:
    """One level.

    Attributes
    ----------
    half_width : float
        Tangent of half the field of view: the geometric mean of those across width and height,
        so that it does not depend on which of the two is longer.
    database : Database
        Its stars, and triangles with the rows of these.
    rows : ndarray of int64, shape (N,)
        Rows of its stars in the artifact.
    """

    half_width: float
    database: Database
    rows: NDArray[np.int64]

    def focal_length_px(self, camera: Camera) -> float:
        """Return the focal length with which a detector has the level's field of view."""
        return 0.5 * math.sqrt(camera.width_px * camera.height_px) / self.half_width


def levels(database: Database) -> tuple[Level, ...]:
    """Return the levels of a database, made once."""
    return database.derived(_levels)


def _levels(database: Database) -> tuple[Level, ...]:
    for name in (PRODUCT, "triangles"):
        if name not in database.products:
            raise ProductError(
                f"{database.name}: has no product {name!r}, so that it serves one field of view; "
                f"set 'products.{name}.enabled = true' in its spec and build it again",
                product=name,
            )
    camera, product = database.camera, database.products[PRODUCT]
    if not len(product["level"]):
        raise _damaged("there are none")
    own = Level(
        0.5 * math.sqrt(camera.width_px * camera.height_px) / camera.focal_length_px,
        database,
        np.arange(len(database.mag)),
    )
    return own, *(_level(database, product, n) for n in range(len(product["level"])))


def _level(database: Database, product: ProductArrays, row: int) -> Level:
    stars = _list(product, "stars", row)
    lists = [_list(product, name, row) for name in "ijk"]
    is_sound = len({len(one) for one in lists}) == 1 and bool((stars[1:] > stars[:-1]).all())
    if not is_sound or not all(np.isin(one, stars).all() for one in lists):
        raise _damaged(f"the triangles of level {row + 1} are not of its stars")
    place = np.searchsorted(stars, np.stack(lists))
    half = [math.tan(math.radians(0.5 * product[f"fov_{axis}_deg"][row])) for axis in "xy"]
    part = replace(
        database,
        star_id=database.star_id[stars],
        directions=database.directions[stars],
        mag=database.mag[stars],
        designation=database.designation[stars],
        products={"triangles": _triangles(place, database.directions[stars])},
    )
    return Level(math.sqrt(half[0] * half[1]), part, stars)


def _damaged(what: str) -> ProductError:
    return ProductError(
        f"{PRODUCT}: {what}; the database is damaged. Build the artifact again, or fetch it again",
        product=PRODUCT,
    )


def _list(product: ProductArrays, name: str, row: int) -> NDArray[np.int64]:
    offsets = product[f"{name}_offsets"]
    values = product[f"{name}_values"][offsets[row] : offsets[row + 1]]
    return np.asarray(values, dtype=np.int64)


def _triangles(corners: NDArray[np.int64], directions: NDArray[np.float64]) -> ProductArrays:
    """Return the columns that triangles of an unknown scale are looked up by."""
    u, v, w = (directions[rows] for rows in corners)
    a, b, c = (
        2.0 * np.arcsin(0.5 * np.linalg.norm(one - other, axis=1))
        for one, other in ((v, w), (u, w), (u, v))
    )
    area = triangle_area(a, b, c)
    radius = np.divide(a * b * c, 4.0 * area, out=np.full(len(a), np.inf), where=area > 0.0)
    columns: dict[str, NDArray[Any]] = dict(zip("ijk", corners, strict=True))
    columns |= {
        "area_rad2": area.astype(np.float32),
        "circumradius_rad": radius.astype(np.float32),
    }
    return ProductArrays(columns)
