"""Guide stars and their features to the bytes of an onboard image.

All values are computed from the directions as the image stores them, so that a reader that
computes them again finds the same values. The same contents give the same bytes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array
from starcat.database.onboard import layout
from starcat.database.onboard.grid import CellGrid, grid_for, most_near
from starcat.database.onboard.layout import ByteOrder, Sizes, check_blocks, in_order
from starcat.errors import ConfigError
from starcat.geometry.camera import Camera
from starcat.geometry.patterns import triangle_area
from starcat.geometry.sphere import separation
from starcat.results import in_record

Rows = NDArray[np.integer[Any]]

LINE_MARGIN = 1e-6
"""Margin of the K-vector's line at both ends, in units of the largest value: more than the rounding
of single precision."""

SMALLEST_MARGIN = 1e-12

AT_ONCE = 8192
"""Features whose values are computed together: their arrays fit into the cache of a processor."""


@dataclass(frozen=True)
class Contents:
    """The contents of an image."""

    name: str  # ``<name>-<version>`` of the database
    epoch_jyear: float  # epoch of the directions, Julian year
    camera: Camera  # size of the detector and focal length are used
    star_id: NDArray[np.int64]  # permanent star numbers; shape (N,)
    directions: Array  # ICRS unit vectors; shape (N, 3)
    mag: Array  # magnitudes; NaN where unknown; shape (N,)
    method: str
    features: Rows  # rows of the stars of each triangle or pair, in any order
    manifest_sha256: bytes = bytes(32)  # 32 bytes; zeros without a manifest
    stars_per_cell: int = 1  # average of the grid

    @property
    def grid(self) -> CellGrid:
        """The grid of the image."""
        return grid_for(len(self.star_id), self.camera.radius_rad, self.stars_per_cell)


@dataclass(frozen=True)
class MadeImage:
    """An image and the origin of its stars."""

    data: bytes = field(repr=False)
    # the row in the contents of each star of the image; shape (N,)
    star_rows: NDArray[np.int64] = field(repr=False)
    n_features: int = field(repr=False)  # triangles or pairs of the image
    most_near: int  # upper bound of the stars in the camera's circle

    @property
    @in_record()
    def image_bytes(self) -> int:
        """Size of the image."""
        return len(self.data)


def make_image(contents: Contents, byte_order: ByteOrder = "little") -> MadeImage:
    """Make the image of guide stars and their triangles or pairs."""
    check_method(contents.method)
    _check_name(contents.name)
    directions, grid = quantised(contents.directions), contents.grid
    u = directions / layout.DIRECTION_SCALE
    cells = grid.cells(u)
    star_rows = np.lexsort((contents.star_id, cells))
    image_row = np.empty(len(u), dtype=np.int32)
    image_row[star_rows] = np.arange(len(u))
    u = u[star_rows]
    features = _sorted_features(image_row, u, contents)
    sizes = Sizes(contents.method, len(u), len(features.rows), grid.n_cells)
    if sizes.total_bytes > layout.MAX_BYTES:
        raise ConfigError(
            f"the image would have {sizes.total_bytes:,} bytes; at most "
            f"{layout.MAX_BYTES:,} can be said in it",
            where=contents.name,
            hint=("Build a smaller database", "pass {max_bytes}"),
        )
    kvector, intercept, slope = _kvector(features.values, sizes.n_kvector)
    quantum_rad = layout.RADIUS_RANGE * contents.camera.diagonal_rad / layout.RADIUS_STEPS
    near = most_near(u, contents.camera.radius_rad)
    facts = {
        "grid_bands": grid.bands,
        "grid_sectors": grid.sectors,
        "most_near": near,
        "kvector_intercept": intercept,
        "kvector_slope": slope,
        "radius_quantum_rad": quantum_rad if contents.method == "triangle" else 0.0,
        "longest_rad": features.longest_rad,
    }
    sections = {
        "directions": directions[star_rows],
        "magnitudes": _stored_mag(contents.mag[star_rows]),
        "star_ids": contents.star_id[star_rows],
        "grid": np.searchsorted(cells[star_rows], np.arange(grid.n_cells + 1), side="left"),
        "kvector": kvector,
        "triangles": features.rows,
        "radii": _stored_radii(features.radii, quantum_rad),
        "pairs": features.rows,
    }
    data = _data(contents, sizes, facts, sections, byte_order)
    return MadeImage(data + check_blocks(data, byte_order), star_rows, len(features.rows), near)


def rows_of_image(
    star_id: NDArray[np.int64], directions: Array, camera: Camera
) -> NDArray[np.int64]:
    """Return the rows of stars in the order of their image, as `MadeImage.star_rows`."""
    grid = grid_for(len(star_id), camera.radius_rad)
    return np.lexsort((star_id, grid.cells(quantised(directions) / layout.DIRECTION_SCALE)))


def check_method(method: str) -> None:
    """Check that there are onboard images for a method."""
    if method not in layout.METHODS:
        raise ConfigError(
            f"method {method!r} has no onboard image",
            key="method",
            value=method,
            hint=f"choose one of {', '.join(layout.METHODS)}",
        )


def _check_name(name: str) -> None:
    size = len(name.encode())
    if size > layout.NAME_BYTES:
        raise ConfigError(
            f"has {size} bytes; an onboard image has room for names of {layout.NAME_BYTES}",
            where=name,
            key="name",
            value=name,
            hint="Build the database under a shorter name",
        )


def quantised(directions: Array) -> NDArray[np.int64]:
    """Return directions as the image stores them."""
    return np.rint(np.clip(directions, -1.0, 1.0) * layout.DIRECTION_SCALE).astype(np.int64)


def longest_pair_rad(camera: Camera) -> float:
    """Return the longest pair that an image holds: the angle across the detector's longer side."""
    half_px = 0.5 * max(camera.width_px, camera.height_px)
    return float(2.0 * np.arctan(half_px / camera.focal_length_px))


@dataclass(frozen=True)
class _Features:
    """Features in the order of the image: rows, values, circumradii and the longest side."""

    rows: Rows
    values: Array
    radii: Array
    longest_rad: float


def _sorted_features(image_row: Rows, u: Array, contents: Contents) -> _Features:
    """Return the features by their values; features of equal values by their rows.

    ``image_row`` is the row in the image of each star of the contents.
    """
    _, columns = layout.FEATURES[contents.method]
    rows = _ascending(contents.features.reshape(-1, len(columns)), image_row)
    values, radii, longest = feature_values(u, rows)
    if contents.method == "pyramid":
        is_short = values <= longest_pair_rad(contents.camera)
        rows, values, longest = rows[is_short], values[is_short], longest[is_short]
    order = np.argsort(values)
    is_equal = np.diff(values[order]) == 0.0
    if bool(is_equal.any()):
        tied = np.flatnonzero(np.append(is_equal, False) | np.append(False, is_equal))
        equal = order[tied]
        order[tied] = equal[np.lexsort((*rows[equal].T[::-1], values[equal]))]
    radii = radii[order] if len(radii) else radii
    return _Features(rows[order], values[order], radii, float(longest.max(initial=0.0)))


def feature_values(u: Array, rows: Rows) -> tuple[Array, Array, Array]:
    """Return the values of features, circumradii (of triangles only), and the longest sides."""
    values, radii, longest = np.empty(len(rows)), np.empty(len(rows)), np.empty(len(rows))
    for first in range(0, len(rows), AT_ONCE):
        part = slice(first, first + AT_ONCE)
        corners = [u.take(column, axis=0) for column in rows[part].T]
        if len(corners) == 2:
            values[part] = longest[part] = separation(*corners)
            continue
        v, w, x = corners
        a, b, c = separation(w, x), separation(v, x), separation(v, w)
        area = values[part] = triangle_area(a, b, c)
        radii[part] = np.inf
        np.divide(a * b * c, 4.0 * area, out=radii[part], where=area > 0.0)
        np.maximum(np.maximum(a, b), c, out=longest[part])
    return values, radii if rows.shape[1] == 3 else np.empty(0), longest


def _ascending(features: Rows, image_row: Rows) -> Rows:
    """Return the image rows of the stars of each feature, ascending. `np.sort` would be slower."""
    rows = np.empty(features.shape, dtype=image_row.dtype)
    for first in range(0, len(rows), AT_ONCE):
        part = slice(first, first + AT_ONCE)
        low, *middle, high = (image_row.take(column) for column in features[part].T)
        low, high = np.minimum(low, high), np.maximum(low, high)
        for other in middle:
            rows[part, 1] = np.maximum(low, np.minimum(high, other))
            low, high = np.minimum(low, other), np.maximum(high, other)
        rows[part, 0], rows[part, -1] = low, high
    return rows


def _kvector(values: Array, n_kvector: int) -> tuple[NDArray[np.int64], float, float]:
    first, last = (float(values[0]), float(values[-1])) if len(values) else (0.0, 0.0)
    margin = max(LINE_MARGIN * last, SMALLEST_MARGIN)
    intercept = first - margin
    slope = (last + margin - intercept) / (n_kvector - 1)
    line = intercept + slope * np.arange(n_kvector)
    return np.searchsorted(values, line, side="right"), intercept, slope


def _stored_mag(mag: Array) -> NDArray[np.int64]:
    is_known = np.isfinite(mag)
    steps = np.rint(np.where(is_known, mag, 0.0) * layout.MAG_SCALE)
    largest = -layout.MAG_UNKNOWN - 1
    return np.where(is_known, np.clip(steps, -largest, largest), layout.MAG_UNKNOWN).astype(
        np.int64
    )


def _stored_radii(radii: Array, quantum_rad: float) -> NDArray[np.int64]:
    steps = np.rint(radii / quantum_rad)
    return np.where(steps <= layout.RADIUS_STEPS, steps, layout.RADIUS_UNKNOWN).astype(np.int64)


def _data(
    contents: Contents,
    sizes: Sizes,
    facts: Mapping[str, float],
    sections: Mapping[str, NDArray[Any]],
    byte_order: ByteOrder,
) -> bytes:
    data, table = bytearray(sizes.data_bytes), sizes.table()
    header = np.zeros(1, dtype=in_order(layout.HEADER, byte_order))
    values = {
        "magic": layout.MAGIC,
        "byte_order": layout.ORDER_WORD,
        "version_major": layout.VERSION[0],
        "version_minor": layout.VERSION[1],
        "header_bytes": layout.HEADER_BYTES,
        "total_bytes": sizes.total_bytes,
        "data_bytes": sizes.data_bytes,
        "method": layout.METHOD_NUMBERS[sizes.method],
        "n_stars": sizes.n_stars,
        "n_features": sizes.n_features,
        "n_kvector": sizes.n_kvector,
        "index_bytes": sizes.index_bytes,
        "n_sections": len(sizes.sections()),
        "width_px": contents.camera.width_px,
        "height_px": contents.camera.height_px,
        "focal_length_px": contents.camera.focal_length_px,
        "epoch_jyear": contents.epoch_jyear,
        "block_bytes": layout.BLOCK_BYTES,
        "manifest_sha256": np.void(contents.manifest_sha256),
        "name": contents.name.encode(),
        **facts,
    }
    for name, value in values.items():
        header[name] = value
    head = header.tobytes() + table.astype(in_order(layout.SECTION, byte_order)).tobytes()
    data[: len(head)] = head
    for (name, dtype, shape), entry in zip(sizes.sections(), table, strict=False):
        stored = sections[name].reshape(shape).astype(in_order(dtype, byte_order))
        data[int(entry["offset"]) : int(entry["offset"] + entry["bytes"])] = stored.tobytes()
    return bytes(data)
