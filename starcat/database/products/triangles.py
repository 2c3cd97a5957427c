"""The product ``triangles``: of the brightest stars of each field, by area, with a K-vector.

The sides of a triangle are great-circle separations and the triangle is the plane one with those
sides, so that its features do not depend on where in a frame it lies.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Directions
from starcat.database.products.counting import count_triangles
from starcat.database.products.index import Index, kvector_index
from starcat.database.products.kind import Extent, ProductInputs, ProductKind, ProductSection
from starcat.database.products.tiling import FieldStars
from starcat.geometry.kvector import build_kvector
from starcat.geometry.patterns import triangle_area
from starcat.geometry.sphere import separation


class Triangles(ProductSection):
    """Triangles of the brightest stars of each boresight's field (S4)."""


_PACKED_BITS = 21  # three row numbers of this many bits fit into one int64
AT_ONCE = 1 << 19  # number of triangles whose features are computed together


@dataclass(frozen=True)
class FieldTriangles:
    """Distinct triangles, by area."""

    # i, j, k: shape (M,): rows of the star table, i < j < k
    i: NDArray[np.int32]
    j: NDArray[np.int32]
    k: NDArray[np.int32]
    # area_rad2, circumradius_rad, inradius_rad: shape (M,): features of the plane triangle, in
    # square radians and radians
    area_rad2: NDArray[np.float32]
    circumradius_rad: NDArray[np.float32]
    inradius_rad: NDArray[np.float32]
    # shape (M,): number of boresights whose brightest stars include the three
    times_seen: NDArray[np.int32]
    index: Index  # the K-vector over ``area_rad2``, and the attribute ``records``

    @property
    def records(self) -> int:
        """Triangles over all boresights, repeats included: the papers' count of features."""
        return int(self.times_seen.sum())


def find_triangles(fields: FieldStars, directions: Directions, brightest: int) -> FieldTriangles:
    """Find all triangles of the brightest stars of each field.

    Sorted by (area, i, j, k); n stars of a field make n (n - 1) (n - 2) / 6. Collinear
    triangles have area 0, inradius 0 and an infinite circumradius.

    Liao and Zhang 2024 (S4), eqs. 4 and 7.
    """
    stars, seen = distinct_triangles(fields, len(directions), brightest)
    narrow, circumradius, inradius = _features(stars, directions)
    # The triangles come in order of (i, j, k), which a stable sort keeps for equal areas.
    order = np.argsort(narrow, kind="stable")
    kvector = kvector_index(build_kvector(narrow[order].astype(np.float64)))
    i, j, k = np.ascontiguousarray(stars[order].astype(np.int32).T)
    return FieldTriangles(
        i,
        j,
        k,
        narrow[order],
        circumradius[order],
        inradius[order],
        seen[order].astype(np.int32),
        Index(kvector.datasets, {**kvector.attributes, "records": float(seen.sum())}),
    )


def _features(
    stars: NDArray[np.int64], directions: Directions
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Return area, circumradius and inradius of triangles, some at a time to save memory."""
    features = np.empty((3, len(stars)), dtype=np.float32)
    for first in range(0, len(stars), AT_ONCE):
        part = slice(first, first + AT_ONCE)
        u, v, w = (directions[stars[part, n]] for n in range(3))
        a, b, c = separation(v, w), separation(u, w), separation(u, v)
        area = triangle_area(a, b, c)
        circumradius = np.full(len(area), np.inf)
        inradius = np.zeros(len(area))
        real = area > 0.0
        np.divide(a * b * c, 4.0 * area, out=circumradius, where=real)
        np.divide(2.0 * area, a + b + c, out=inradius, where=real)
        features[:, part] = area, circumradius, inradius
    return features[0], features[1], features[2]


def distinct_triangles(
    fields: FieldStars, count: int, brightest: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the distinct triangles of all fields.

    Rows i < j < k, shape (M, 3), in order, and the number of fields that have the triangle.
    """
    triples = _triples(fields, brightest)
    return _distinct_packed(triples) if count <= 1 << _PACKED_BITS else _distinct_rows(triples)


def _triples(fields: FieldStars, brightest: int) -> Iterator[NDArray[np.int64]]:
    """Yield the triangles of all fields, rows i < j < k, for fields of 3, 4, ... stars in turn."""
    offsets, star_index = fields.brightest(brightest)
    size = np.diff(offsets)
    yield np.empty((0, 3), dtype=np.int64)
    for length in range(3, brightest + 1):
        start = offsets[:-1][size == length]
        members = star_index[start[:, None] + np.arange(length)].astype(np.int64)
        choices = np.array(list(combinations(range(length), 3)))
        yield np.sort(members[:, choices].reshape(-1, 3), axis=1)


def _distinct_packed(
    triples: Iterable[NDArray[np.int64]],
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return distinct rows and how often each occurs: three numbers in one key sort fastest."""
    low = (1 << _PACKED_BITS) - 1
    keys = [(t[:, 0] << 2 * _PACKED_BITS) | (t[:, 1] << _PACKED_BITS) | t[:, 2] for t in triples]
    packed, seen = np.unique(np.concatenate(keys), return_counts=True)
    i, j = packed >> 2 * _PACKED_BITS, (packed >> _PACKED_BITS) & low
    return np.stack([i, j, packed & low], axis=-1), seen


def _distinct_rows(
    triples: Iterable[NDArray[np.int64]],
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    rows = np.concatenate(list(triples))
    rows = rows[np.lexsort(rows.T[::-1])]
    is_first = np.ones(len(rows), dtype=bool)
    is_first[1:] = (rows[1:] != rows[:-1]).any(axis=1)
    first = np.flatnonzero(is_first)
    return rows[first], np.diff(first, append=len(rows))


def _count(inputs: ProductInputs, section: Triangles) -> Extent:
    records, distinct = count_triangles(inputs.fields, len(inputs.directions), inputs.brightest)
    return Extent(distinct, steps=records)


KIND = ProductKind(
    name="triangles",
    make=lambda inputs, section: find_triangles(inputs.fields, inputs.directions, inputs.brightest),
    section=Triangles,
    count=_count,
)
