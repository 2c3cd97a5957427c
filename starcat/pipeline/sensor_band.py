"""The stars of a build in the band of its sensor, where the spec states a response.

Catalogs whose photometry is used as well are matched by the cross-identification of the product
``crossmatch``, one at a time; a star takes the entry that is its only or by far likeliest one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from starcat.artifact.manifest import SourceFacts
from starcat.bands.response import Response
from starcat.catalog.sensor_band import ALONE, InBand, Other, in_sensor_band, other_of
from starcat.pipeline.counterparts import read_and_match, source_facts
from starcat.progress import Progress, no_progress
from starcat.specs.build_spec import BuildSpec
from starcat.stars.star_table import add_nearest_neighbours


@dataclass(frozen=True)
class SensorBand:
    """The stars in the band that limits are in, and what a user should know of it."""

    stars: pa.Table
    made: InBand | None = None  # None where the band is the catalog's
    sources: tuple[SourceFacts, ...] = ()  # the catalogs whose photometry is used as well
    notes: tuple[str, ...] = ()


def in_band_of(
    stars: pa.Table,
    spec: BuildSpec,
    inputs: Mapping[str, Sequence[Path]],
    workers: int = 2,
    progress: Progress = no_progress,
) -> SensorBand:
    """Return the stars of a spec's catalog in the band of its sensor."""
    response = spec.camera.response.response()
    if response is None:
        return SensorBand(stars)
    others: list[Other] = []
    sources: list[SourceFacts] = []
    notes: list[str] = []
    for name in spec.camera.response.photometry:
        other, facts, told = _photometry(name, stars, response, spec, inputs, workers, progress)
        others.append(other)
        sources.append(facts)
        notes += told
    made = in_sensor_band(stars, spec.catalog.source, response, others)
    # The neighbours' differences of magnitude are the sensor's too.
    stars = add_nearest_neighbours(made.stars, workers)
    return SensorBand(stars, made, tuple(sources), (*notes, *_notes(made, spec)))


def _photometry(
    name: str,
    stars: pa.Table,
    response: Response,
    spec: BuildSpec,
    inputs: Mapping[str, Sequence[Path]],
    workers: int,
    progress: Progress,
) -> tuple[Other, SourceFacts, Sequence[str]]:
    """Return what another catalog says of the magnitudes of stars, and what it is."""
    read, matches = read_and_match(
        name, "photometry", stars, spec.products.crossmatch, inputs, workers, progress
    )
    is_sure = pc.is_in(matches["verdict"], pa.array(["unique", "best"]))
    best = matches.filter(pc.and_(is_sure, pc.equal(matches["rank"], 1)))
    place = np.searchsorted(read.stars["star_id"].to_numpy(), best["counterpart_id"].to_numpy())
    other = other_of(
        read.stars.take(pa.array(place)), best["star"].to_numpy().astype(np.int64), name, response
    )
    own = source_facts(read, "photometry")
    return other, replace(own, joined=len(best)), read.notes


def _notes(made: InBand, spec: BuildSpec) -> tuple[str, ...]:
    notes = []
    alone = made.counts.get(f"{made.band}{ALONE}", 0)
    if alone:
        notes.append(
            f"{spec.catalog.source}: {alone:,} of {len(made.stars):,} stars have neither colour "
            f"nor spectral type; their magnitudes in {made.response.name} are those of a star of "
            "the mean colour, with an error to match; camera.response.photometry names catalogs "
            "that know more of them"
        )
    if spec.catalog.read_limit_mag is not None:
        notes.append(
            f"catalog.read_limit_mag {spec.catalog.read_limit_mag:g} is in the catalog's band "
            f"{made.band}, the limits of [selection] are in {made.response.name}: it has to be so "
            "faint that no star that the sensor sees is left out"
        )
    return tuple(notes)
