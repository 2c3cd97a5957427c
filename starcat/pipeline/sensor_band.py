"""The stars of a build in the band of its sensor, where the spec states a response.

Catalogs whose photometry is used as well are matched by the cross-identification of the product
``crossmatch``, one at a time; a star takes the entry that is its only or by far likeliest one.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from starcat.bands.response import Response
from starcat.catalog.sensor_band import ALONE, InBand, Other, in_sensor_band, other_of
from starcat.pipeline.counterparts import read_and_match, source_facts
from starcat.pipeline.draft import Draft, stage
from starcat.specs.build_spec import BuildSpec
from starcat.stars.star_table import add_nearest_neighbours


def _band_plan(spec: BuildSpec) -> str | None:
    wanted = spec.camera.response
    if wanted.name is None:
        return None
    others = f", also from {', '.join(wanted.photometry)}" if wanted.photometry else ""
    return f"predict magnitudes in {wanted.name}{others}"


@stage("photometry", "read", _band_plan, lambda spec: spec.camera.response.photometry)
def to_sensor_band(draft: Draft) -> None:
    """Predict the magnitudes of stars in the band of the sensor."""
    spec, stars = draft.spec, draft.stars
    response = spec.camera.response.response()
    if response is None:
        return
    others: list[Other] = []
    for name in spec.camera.response.photometry:
        others.append(_photometry(name, response, draft))
    draft.in_band = in_sensor_band(stars, spec.catalog.source, response, others)
    # The neighbours' differences of magnitude are the sensor's too.
    draft.stars = add_nearest_neighbours(draft.in_band.stars, draft.workers)
    draft.note(to_sensor_band.name, *_notes(draft.in_band, spec))


def _photometry(name: str, response: Response, draft: Draft) -> Other:
    """Return what a source says of the magnitudes of stars, and add what was read to the draft."""
    read, matches = read_and_match(name, to_sensor_band, draft.stars, draft)
    is_sure = pc.is_in(matches["verdict"], pa.array(["unique", "best"]))
    best = matches.filter(pc.and_(is_sure, pc.equal(matches["rank"], 1)))
    place = np.searchsorted(read.stars["star_id"].to_numpy(), best["counterpart_id"].to_numpy())
    rows = best["star"].to_numpy().astype(np.int64)
    draft.sources.append(replace(source_facts(read, "photometry"), joined=len(best)))
    draft.note(to_sensor_band.name, *read.notes)
    return other_of(read.stars.take(pa.array(place)), rows, name, response)


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
