"""The sky that a camera looks at: guide stars and all the others of their catalog.

A database holds only the stars that a matcher may rely on. A camera sees the rest as well:
doubles that it cannot split, variables, stars just below the limit.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.compute as pc
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from starcat.artifact.reader import open_artifact
from starcat.catalog.stars import floats_of
from starcat.geometry.proximity import pairs_within
from starcat.geometry.sphere import directions_from_radec
from starcat.simulation.sky import Sky


def sky_of_artifact(folder: Path) -> Sky:
    """Return the whole catalog of an artifact as a camera would see it."""
    doubles = open_artifact(folder).manifest["spec"]["selection"]["doubles"]
    return blend(catalog_of_artifact(folder), float(np.radians(doubles["min_separation_deg"])))


def catalog_of_artifact(folder: Path) -> Sky:
    """Return the whole catalog of an artifact."""
    artifact = open_artifact(folder)
    stars, rejected = artifact.table("stars"), artifact.table("rejected")
    # A merged star's companion is in the guide star already.
    there = pc.and_(pc.is_valid(rejected["ra_deg"]), pc.is_valid(rejected["mag"]))
    tables = (stars, rejected.filter(pc.and_(there, pc.not_equal(rejected["reason"], "merged"))))
    ra_deg, dec_deg, mag = (
        np.concatenate([floats_of(table, name) for table in tables])
        for name in ("ra_deg", "dec_deg", "mag")
    )
    index = np.full(len(mag), -1, dtype=np.int32)
    index[: len(stars)] = np.arange(len(stars))
    order = np.argsort(np.concatenate([table["star_id"].to_numpy() for table in tables]))
    u = directions_from_radec(ra_deg, dec_deg)
    return Sky(u[order], mag[order], index[order])


def blend(sky: Sky, limit_rad: float) -> Sky:
    """Join the points that a camera cannot tell apart."""
    pairs, apart = pairs_within(sky.directions, limit_rad)
    i, j = pairs[apart < limit_rad].T
    count = len(sky)
    graph = coo_array((np.ones(len(i)), (i, j)), shape=(count, count))
    groups, label = connected_components(graph, directed=False)
    brightest = np.lexsort((np.arange(count), sky.mag))
    leader = np.empty(groups, dtype=np.int64)
    leader[label[brightest[::-1]]] = brightest[::-1]
    light = 10.0 ** (-0.4 * sky.mag)
    total = np.bincount(label, light, groups)
    centre = np.stack([np.bincount(label, light * u, groups) for u in sky.directions.T], axis=-1)
    alone = np.bincount(label, minlength=groups)[label[leader]] == 1
    order = np.argsort(leader)
    leader, alone = leader[order], alone[order]
    directions, mag = sky.directions[leader].copy(), sky.mag[leader].copy()
    joined = order[~alone]
    directions[~alone] = centre[joined] / np.linalg.norm(centre[joined], axis=1)[:, None]
    mag[~alone] = -2.5 * np.log10(total[joined])
    return Sky(directions, mag, sky.star_index[leader])
