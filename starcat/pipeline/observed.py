"""Results from flight applied to a star table: the sensor's magnitudes, and distrusted stars."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from starcat.catalog.stars.star_table import floats_of, with_columns
from starcat.errors import BuildError
from starcat.pipeline.selection.rules.distrust import Observed, rows_named

SOURCE = "observed"
"""Values of `mag_source` and `band` for a magnitude with the colour term of a flown sensor."""

_MAX_NAMED = 5


def with_observed(stars: pa.Table, observed: Observed) -> pa.Table:
    """Return stars with the sensor's magnitudes; ``catalog_mag`` keeps the catalog's."""
    _check_numbers(stars, observed)
    if observed.colour_term == 0.0:
        return stars
    _check_bands(stars, observed)
    redder = floats_of(stars, "colour_mag") - observed.reference_colour_mag
    has_colour = pa.array(~np.isnan(redder))
    return with_columns(
        stars,
        {
            "mag": floats_of(stars, "mag") + observed.colour_term * np.nan_to_num(redder),
            "band": SOURCE,
            "mag_source": pc.if_else(has_colour, SOURCE, stars["mag_source"]),
            # If the spec has already predicted a sensor's magnitude, catalog_mag is already set.
            "catalog_mag": pc.coalesce(stars["catalog_mag"], stars["mag"]),
            "catalog_band": pc.coalesce(stars["catalog_band"], stars["band"]),
        },
    )


def _check_bands(stars: pa.Table, observed: Observed) -> None:
    bands = sorted(filter(None, pc.unique(stars["colour_bands"]).to_pylist()))
    if bands != [observed.colour_bands]:
        raise BuildError(
            f"selection.observed.colour_term is for the colour {observed.colour_bands}; the stars "
            f"have {', '.join(bands) or 'none'}",
            hint="Learn it from frames of a database of this catalog, or leave colour_term out",
        )


def _check_numbers(stars: pa.Table, observed: Observed) -> None:
    rows_by_number = rows_named(stars, observed.reject)
    unknown = [number for number, rows in rows_by_number.items() if not rows]
    if unknown:
        named = ", ".join(map(str, unknown[:_MAX_NAMED]))
        more = ", ..." if len(unknown) > _MAX_NAMED else ""
        raise BuildError(
            f"selection.observed.reject: {named}{more}: {len(unknown)} of {len(rows_by_number)} "
            "are not a star_id of the catalog",
            hint="learn from frames of a database of this catalog",
        )
    for number, rows in rows_by_number.items():
        if len(rows) > 1:
            names = [f'"{stars["catalog"][row].as_py()} {number}"' for row in rows]
            raise BuildError(
                f"selection.observed.reject: {number} is a star_id of {len(rows)} of the merged "
                "catalogs",
                hint=f"write which star is meant: {' or '.join(names)}",
            )
