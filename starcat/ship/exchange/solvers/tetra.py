"""The npz file of tetra3 and cedar-solve: patterns of four stars in a hash table by their shape.

A pattern's key is its five shorter separations divided by the longest, in bins; quadratic probing
finds its row in a table that is a third full. Patterns are formed by the brightest stars of
overlapping fields all over the sky, by the published rule of cedar-solve: a star too close to a
brighter one for the density is dropped, and groups of four are ordered by their faintest star.
"""

from __future__ import annotations

import math
import zipfile
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from starcat.arrays import Array
from starcat.geometry.proximity import pairs_within
from starcat.geometry.sphere import chord_from_separation, saff_kuijlaars, separation
from starcat.ship.exchange.array_files import add_array
from starcat.ship.exchange.solvers.sky import SolverSky

PATTERN_ERROR = {"tetra3": 0.005, "cedar-solve": 0.001}
"""Default largest error of a ratio of each solver; a quarter of it is the width of a bin."""

_FIELDS_OVER_SKY = 200
"""Number of overlapping fields, as a multiple of the fields that fit on the sky side by side."""
_PATTERNS_PER_FIELD = 70
"""Number of groups of four among the eight brightest stars of a field."""
_STARS_PER_FOV = 150
"""Stars of a field used for verification; the smallest distance between stars follows from it."""
_SCALE_STEP = 1.5
_HASH = np.uint64(2654435761)
_MRAD = 1000.0

Patterns = NDArray[np.int64]


def write_tetra(sky: SolverSky, path: Path, solver: str) -> dict[str, Any]:
    """Write the database of tetra3 or cedar-solve; return its figures."""
    patterns = patterns_of(sky)
    bins = round(0.25 / PATTERN_ERROR[solver])
    ratios, largest_rad, patterns = _shapes(sky.directions, patterns)
    length = 3 * len(patterns)
    places = _places(_hashes((ratios * bins).astype(np.uint64), bins, length), length)
    highest = len(sky.mag) - 1
    catalog = np.zeros((length, 4), dtype=np.min_scalar_type(max(highest, 256)))
    catalog[places] = patterns
    largest_mrad = np.zeros(length, dtype=np.float16)
    largest_mrad[places] = largest_rad * _MRAD
    radec = np.radians(np.stack([sky.ra_deg, sky.dec_deg], axis=-1))
    table = np.concatenate([radec, sky.directions, sky.mag[:, None]], axis=1)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        add_array(archive, "star_table", table.astype(np.float32))
        add_array(archive, "pattern_catalog", catalog)
        add_array(archive, "props_packed", _properties(sky, solver, bins, len(patterns)))
        add_array(archive, "pattern_largest_edge", largest_mrad)
        add_array(archive, "star_catalog_IDs", sky.star_id)
    return {"patterns": len(patterns), "largest_ratio_error": PATTERN_ERROR[solver]}


def patterns_of(sky: SolverSky) -> Patterns:
    """Return the patterns, rows of four stars by increasing row, shape (M, 4)."""
    narrow, wide = np.radians(sky.fov_deg)
    steps = 1 + math.ceil(math.log(wide / narrow) / math.log(_SCALE_STEP))
    is_one = wide / narrow < math.sqrt(_SCALE_STEP)
    fields = [wide] if is_one else np.geomspace(narrow, wide, steps)
    return np.unique(np.concatenate([_patterns_in(sky, float(fov)) for fov in fields]), axis=0)


def _patterns_in(sky: SolverSky, fov_rad: float) -> Patterns:
    apart = 0.6 * fov_rad / math.sqrt(_STARS_PER_FOV)
    kept = np.flatnonzero(_is_brightest_within(sky.directions, apart))
    centres = saff_kuijlaars(_FIELDS_OVER_SKY * math.ceil(4.0 * math.pi / fov_rad**2))
    tree = cKDTree(sky.directions[kept])
    radius = chord_from_separation(0.5 * fov_rad)
    seen: Any = tree.query_ball_point(centres, radius, return_sorted=True)
    brightest = np.full((len(centres), _FOURS.max() + 1), -1, dtype=np.int64)
    for field, stars_in_field in enumerate(seen):
        few = stars_in_field[: brightest.shape[1]]
        brightest[field, : len(few)] = few
    fields = np.unique(brightest, axis=0)
    patterns = fields[:, _FOURS].reshape(-1, 4)
    return np.unique(kept[patterns[(patterns >= 0).all(axis=1)]], axis=0)


def _fours() -> NDArray[np.int64]:
    """Return groups of four ranks, sorted by their faintest star, then by the next."""
    fours = sorted(combinations(range(8), 4), key=lambda four: four[::-1])
    return np.array(fours[:_PATTERNS_PER_FIELD])


_FOURS = _fours()


def _is_brightest_within(directions: Array, apart_rad: float) -> NDArray[np.bool_]:
    """Return the mask of stars without a brighter kept star nearby; rows are by brightness."""
    pairs, _ = pairs_within(directions, apart_rad)
    is_kept = np.ones(len(directions), dtype=np.bool_)
    for brighter, fainter in pairs.tolist():
        if is_kept[brighter]:
            is_kept[fainter] = False
    return is_kept


def _shapes(directions: Array, patterns: Patterns) -> tuple[Array, Array, Patterns]:
    """Return ratios (M, 5), longest separations, and patterns by distance from their middle."""
    u = directions.astype(np.float32).astype(np.float64)[patterns]
    sides = np.stack([separation(u[:, i], u[:, j]) for i, j in combinations(range(4), 2)], axis=-1)
    sides.sort(axis=1)
    distance = np.square(u - u.mean(axis=1, keepdims=True)).sum(axis=2)
    order = np.argsort(distance, axis=1, kind="stable")
    return (
        sides[:, :-1] / sides[:, -1:],
        sides[:, -1],
        np.take_along_axis(patterns, order, axis=1),
    )


def _hashes(keys: NDArray[np.uint64], bins: int, length: int) -> NDArray[np.uint64]:
    powers = np.uint64(bins) ** np.arange(keys.shape[1], dtype=np.uint64)
    # The product wraps at 64 bits, like in cedar-solve; tetra3 has too few bins to wrap.
    combined: NDArray[np.uint64] = (keys * powers).sum(axis=1, dtype=np.uint64)
    return np.asarray(combined * _HASH % np.uint64(length))


def _places(hashes: NDArray[np.uint64], length: int) -> NDArray[np.int64]:
    """Return the row of the table for each pattern: the first free row of its probing sequence.

    All remaining patterns try their next row at once; if several try the same, the first gets it.
    """
    places = np.empty(len(hashes), dtype=np.int64)
    is_taken = np.zeros(length, dtype=np.bool_)
    unplaced = np.arange(len(hashes))
    probe = 0
    while len(unplaced):
        rows = ((hashes[unplaced] + np.uint64(probe * probe)) % np.uint64(length)).astype(np.int64)
        free = np.flatnonzero(~is_taken[rows])
        _, first = np.unique(rows[free], return_index=True)
        placed = free[first]
        places[unplaced[placed]] = rows[placed]
        is_taken[rows[placed]] = True
        unplaced = np.delete(unplaced, placed)
        probe += 1
    return places


def _properties(sky: SolverSky, solver: str, bins: int, patterns: int) -> NDArray[Any]:
    everywhere = (np.nan, np.nan)
    small, real = np.uint16, np.float32
    fields: list[tuple[str, Any, Any]] = [
        ("pattern_mode", "U64", "edge_ratio"),
        ("pattern_size", small, 4),
        ("pattern_bins", small, bins),
        ("pattern_max_error", real, PATTERN_ERROR[solver]),
        ("max_fov", real, sky.fov_deg[1]),
        ("min_fov", real, sky.fov_deg[0]),
        ("star_catalog", "U64", sky.source),
        ("epoch_equinox", small, 2000),
        ("epoch_proper_motion", real, sky.epoch_jyear),
        ("lattice_field_oversampling", small, _FIELDS_OVER_SKY // 2),
        ("anchor_stars_per_fov", small, _FIELDS_OVER_SKY // 2),
        ("pattern_stars_per_fov", small, _FIELDS_OVER_SKY // 2),
        ("patterns_per_lattice_field", small, _PATTERNS_PER_FIELD),
        ("patterns_per_anchor_star", small, _PATTERNS_PER_FIELD),
        ("verification_stars_per_fov", small, _STARS_PER_FOV),
        ("star_max_magnitude", real, sky.mag[-1]),
        ("simplify_pattern", np.bool_, True),
        ("range_ra", (real, (2,)), everywhere),
        ("range_dec", (real, (2,)), everywhere),
        ("presort_patterns", np.bool_, True),
        ("num_patterns", np.uint32, patterns),
    ]
    kinds = [(name, *kind) if isinstance(kind, tuple) else (name, kind) for name, kind, _ in fields]
    return np.array(tuple(value for _, _, value in fields), dtype=kinds)
