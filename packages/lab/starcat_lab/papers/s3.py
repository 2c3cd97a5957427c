"""S3: optimised selection of observation triangles (Li et al. 2015)."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array
from starcat.geometry import Camera, matrix_from_radec_roll
from starcat.matcher import is_well_shaped
from starcat_lab.experiment import Paper, Statistic, catalog_of_database

PRESET = "sao-12deg-512"

LIMIT_MAG = 6.0
"""Faintest magnitude that the paper's camera detects."""

CAMERA = Camera(512, 512, fov_x_deg=12.0)
"""The paper's field; its focal length and pixels (40 mm, 16 um) would make 11.7 degrees."""

MIN_SIDE_PX, MIN_ANGLE_DEG = 10.0, 15.0
"""d_min and theta_min, which the paper does not print: these values reproduce its counts."""

BRIGHTEST = 6
"""Stars of a field whose triangles are counted."""

_FIRST = ((0, 1, 2), (0, 1, 3), (0, 1, 4))


def field_centroids(database: Path, step_deg: float) -> list[Array]:
    """Return the stars of fields on a grid of boresights, brightest first."""
    sky = catalog_of_database(database).brighter(LIMIT_MAG)
    fields = []
    rows = round(180.0 / step_deg)
    for dec_deg in -90.0 + (np.arange(rows) + 0.5) * step_deg:
        for ra_deg in np.arange(2 * rows) * step_deg:
            matrix = matrix_from_radec_roll(float(ra_deg), float(dec_deg), 0.0)
            near = np.flatnonzero(sky.directions @ matrix[2] >= np.cos(CAMERA.radius_rad))
            px = CAMERA.pixels_from_directions(sky.directions[near] @ matrix.T)
            inside = CAMERA.contains(px)
            near, px = near[inside], px[inside]
            fields.append(px[np.lexsort((near, sky.mag[near]))])
    return fields


def passes(centroids_px: Array, triples: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Return which triangles (rows of centroids, shape (T, 3)) meet S3's two constraints."""
    u, v, w = (centroids_px[triples[:, n]] for n in range(3))
    a, b, c = (np.hypot(*(p - q).T) for p, q in ((v, w), (u, w), (u, v)))
    return is_well_shaped(a, b, c, MIN_SIDE_PX, float(np.radians(MIN_ANGLE_DEG)))


def statistics(databases: dict[str, Path], quick: bool) -> list[Statistic]:
    """Count the triangles that pass, in the way of the paper's tables."""
    fields = field_centroids(databases[PRESET], 9.0 if quick else 3.0)
    scale = 7200.0 / len(fields)
    six = np.array([t for t in np.ndindex(BRIGHTEST, BRIGHTEST, BRIGHTEST) if t[0] < t[1] < t[2]])
    failing = float(np.mean([(~passes(px, six[six[:, 2] < len(px)])).sum() for px in fields]))
    fails_first = np.array([[not _usable(px, choice) for choice in _FIRST] for px in fields])
    in_a_row = np.logical_and.accumulate(fails_first, axis=1).sum(axis=0) * scale
    enough = [px for px in fields if len(px) >= 3]
    optimised = sum(_optimised(px) is not None for px in enough)
    note = f"counts times {scale:g}" if quick else ""
    group = "Triangles of the brightest stars"
    return [
        Statistic(
            group, "of 20 triangles of 6 stars, failing", failing, "", 7.74, 7.82, None,
            f"over {len(fields):,} fields",
        ),
        *(
            Statistic(group, f"fields failing with {label}", float(count), "", paper, goal, None,
                      note)
            for label, count, paper, goal in zip(
                ("stars 1,2,3", "1,2,4 as well", "1,2,5 as well"),
                in_a_row, (2729.0, 1343.0, 671.0), (2821.0, 1344.0, 687.0), strict=True,
            )
        ),
        Statistic(
            group, "first triangle usable, before", 100.0 * float(1.0 - fails_first[:, 0].mean()),
            "%", 62.1, None, None, "the three brightest stars",
        ),
        Statistic(
            group, "first triangle usable, after", 100.0 * optimised / max(1, len(enough)), "%",
            100.0, 99.9, False, f"of {len(enough)} fields with 3 stars or more, by the 13 steps",
        ),
    ]  # fmt: skip


def _usable(centroids_px: Array, choice: tuple[int, int, int]) -> bool:
    if len(centroids_px) <= max(choice):
        return False
    return bool(passes(centroids_px, np.array([choice]))[0])


def optimised_triangle(
    separation_px: Array, min_side_px: float, min_angle_rad: float
) -> tuple[int, int, int] | None:
    """Return S3's triangle: the brightest stars that are not a double star and not in a line.

    Distances between the centroids, shape (N, N), are brightest first. Both limits, S3's d_min and
    theta_min, must be exceeded. Rows ascend; None if no triangle passes.

    The flow chart's 13 steps: start from stars N, N + 1, N + 2. If a side is too short, drop its
    fainter star; if an angle is too narrow, drop the faintest of the three. The next star takes its
    place. When the stars run out, N moves on by one.
    """
    count = len(separation_px)
    for start in range(count - 2):
        triangle, following = [start, start + 1, start + 2], start + 3
        while True:
            dropped = _to_drop(separation_px, triangle, min_side_px, min_angle_rad)
            if dropped is None:
                i, j, k = triangle
                return i, j, k
            if following >= count:
                break
            triangle = [*(star for star in triangle if star != dropped), following]
            following += 1
    return None


def _to_drop(
    separation_px: Array, triangle: list[int], min_side_px: float, min_angle_rad: float
) -> int | None:
    for i, j in combinations(triangle, 2):
        if separation_px[i, j] <= min_side_px:
            return j
    i, j, k = triangle
    a, b, c = separation_px[[j, i, i], [k, k, j]].reshape(3, 1)
    return None if is_well_shaped(a, b, c, min_side_px, min_angle_rad)[0] else k


def _optimised(centroids_px: Array) -> tuple[int, int, int] | None:
    apart = np.hypot(*(centroids_px[:, None] - centroids_px[None, :]).transpose(2, 0, 1))
    return optimised_triangle(apart, MIN_SIDE_PX, float(np.radians(MIN_ANGLE_DEG)))


PAPER = Paper(
    name="S3",
    title="Optimised selection of observation triangles",
    citation="Li et al. 2015, Journal of Astronautics",
    presets=(PRESET,),
    statistics=statistics,
    deviations=(
        "The paper does not print d_min and theta_min. 10 px and 15 deg reproduce its counts to "
        "within 3 percent.",
        "The paper does not say where its 7,200 boresights lie. Here: right ascension 0, 3, ..., "
        "declination -88.5, -85.5, ..., roll 0.",
        "The stars are all 5,103 of SAO with V <= 6.0, doubles included. Their magnitudes have one "
        "decimal, so many are equally bright; equal ones go by star number. Other orders of equal "
        "magnitudes change the second count by up to 8 percent and the third by 9.",
    ),
)
