"""The stars of a build in the band of its sensor, where the spec states a response."""

from __future__ import annotations

from dataclasses import dataclass

import pyarrow as pa

from starcat.catalog.sensor_band import InBand, in_sensor_band
from starcat.catalog.stars import add_nearest_neighbours
from starcat.specs.build_spec import BuildSpec


@dataclass(frozen=True)
class SensorBand:
    """The stars in the band that limits are in, and what a user should know of it."""

    stars: pa.Table
    made: InBand | None = None  # None where the band is the catalog's
    notes: tuple[str, ...] = ()


def in_band_of(stars: pa.Table, spec: BuildSpec, workers: int) -> SensorBand:
    """Return the stars of a spec's catalog in the band of its sensor."""
    response = spec.camera.response.response()
    if response is None:
        return SensorBand(stars)
    made = in_sensor_band(stars, spec.catalog.source, response)
    # The neighbours' differences of magnitude are the sensor's too.
    return SensorBand(add_nearest_neighbours(made.stars, workers), made, _notes(made, spec))


def _notes(made: InBand, spec: BuildSpec) -> tuple[str, ...]:
    notes = []
    alone = made.counts.get(f"{made.band} alone", 0)
    if alone:
        notes.append(
            f"{spec.catalog.source}: {alone:,} of {len(made.stars):,} stars have neither colour "
            f"nor spectral type; their magnitudes in {made.response.name} are those of a star of "
            "the mean colour, with an error to match"
        )
    if spec.catalog.read_limit_mag is not None:
        notes.append(
            f"catalog.read_limit_mag {spec.catalog.read_limit_mag:g} is in the catalog's band "
            f"{made.band}, the limits of [selection] are in {made.response.name}: it has to be so "
            "faint that no star that the sensor sees is left out"
        )
    return tuple(notes)
