"""The star table's columns about each star's nearest neighbour."""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from starcat.catalog.stars import directions_of, floats_of
from starcat.proximity import nearest_neighbours


def add_nearest_neighbours(stars: pa.Table, workers: int = 2) -> pa.Table:
    """Return a star table with the columns of the nearest neighbour filled in.

    Parameters
    ----------
    stars : pyarrow.Table
        Of the stars schema, any number of rows.
    workers : int, default 2
        Threads; the result is the same for any number.

    Returns
    -------
    pyarrow.Table
        The same rows.
    """
    if len(stars) < 2:
        return stars
    angle, index = nearest_neighbours(directions_of(stars), workers)
    mag = floats_of(stars, "mag")
    delta = mag[index] - mag
    columns = {
        "nearest_separation_arcsec": pa.array(np.degrees(angle) * 3600.0),
        "nearest_delta_mag": pa.array(delta, mask=np.isnan(delta)),
    }
    for name, values in columns.items():
        place = stars.schema.get_field_index(name)
        stars = stars.set_column(place, stars.schema.field(place), values)
    return stars
