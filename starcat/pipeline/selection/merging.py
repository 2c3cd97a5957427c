"""Close stars that become one: the functions that both merging rules share."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import scipy
from numpy.typing import NDArray

from starcat.arrays import Array, Directions, Rows
from starcat.catalog.stars.star_table import floats_of, with_columns
from starcat.catalog.stars.verdict import Quality
from starcat.geometry.sphere import radec_from_directions
from starcat.pipeline.selection.rule import RuleReason

MERGED = RuleReason("merged", "merged into the brighter star of a close group")

MAX_PAIRS = 10_000_000
"""Largest number of pairs of close stars for a rule; they take up to a gigabyte, and the stars of
any real camera have less than a tenth of them."""


def combined_magnitude(mags: Array) -> float:
    """Return the magnitude of several stars seen as one."""
    brightest = float(np.min(mags))
    return float(brightest - 2.5 * np.log10(np.sum(10.0 ** (-0.4 * (mags - brightest)))))


def group_numbers(pairs: Rows, count: int) -> NDArray[np.int32]:
    """Return the number of the group that each of ``count`` stars is in.

    Stars are in one group if a chain of pairs, shape (M, 2), connects them.
    """
    graph = scipy.sparse.coo_array(
        (np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count)
    )
    _, number = scipy.sparse.csgraph.connected_components(graph, directed=False)
    return np.asarray(number)


def with_merged(stars: pa.Table, rows: Rows, directions: Directions, mag: Array) -> pa.Table:
    """Return a star table whose stars of some rows have the direction and magnitude of a group."""
    ra_deg, dec_deg = radec_from_directions(directions)
    x, y, z = directions.T
    values = {"ra_deg": ra_deg, "dec_deg": dec_deg, "x": x, "y": y, "z": z, "mag": mag}
    columns: dict[str, NDArray[np.float64] | NDArray[np.int32]] = {}
    for name, changed in values.items():
        columns[name] = floats_of(stars, name)
        columns[name][rows] = changed
    flags = stars["quality_flags"].to_numpy().copy()
    flags[rows] |= int(Quality.MERGED | Quality.PHOTOCENTRE)
    return with_columns(stars, {**columns, "quality_flags": flags})
