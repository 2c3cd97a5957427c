"""The star table's columns about each star's nearest neighbour."""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from starcat.catalog.stars import directions_of, floats_of, with_columns
from starcat.geometry.proximity import nearest_neighbours


def add_nearest_neighbours(stars: pa.Table, workers: int = 2) -> pa.Table:
    """Return a star table with the columns of the nearest neighbour filled in."""
    if len(stars) < 2:
        return stars
    angle, index = nearest_neighbours(directions_of(stars), workers)
    mag = floats_of(stars, "mag")
    columns = {
        "nearest_separation_arcsec": np.degrees(angle) * 3600.0,
        "nearest_delta_mag": mag[index] - mag,
    }
    return with_columns(stars, columns)
