"""The catalogs of a spec, read as its build reads them, to be kept for many estimates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from starcat.catalog.observed import with_observed
from starcat.catalog.span import with_span
from starcat.pipeline.build import Inputs, join_all, join_notes, read_sources
from starcat.pipeline.cost import table_bytes
from starcat.pipeline.motions import join_motions
from starcat.pipeline.sensor_band import in_band_of
from starcat.progress import Progress, no_progress
from starcat.selection.rules.distrust import Observed
from starcat.specs.build_spec import BuildSpec
from starcat.stars.star_table import floats_of

SECONDS_PER_RECORD = 4.5e-6
"""Time to read a record of a catalog and to place it."""

SAMPLE_ROWS = 8192
"""Rejected records whose size is measured."""


@dataclass(frozen=True)
class CatalogSnapshot:
    """The catalogs of a spec, read: what every estimate with the same ones starts from."""

    stars: pa.Table  # star table (schema ``stars``) with motions and amplitudes joined, by star_id
    motions: pa.Table | None  # where the motions are from (schema ``motions``), a row a star
    rejected: Mapping[str, int]  # records that reading rejected, by reason
    rejected_bytes: int  # about what those take that the product ``rejected`` lists
    held_bytes: int  # memory that the tables of the catalog take
    records: int  # records in all files of the star catalog
    notes: tuple[str, ...]  # what a user should know of the inputs

    @cached_property
    def by_brightness(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Rows in order of magnitude, those without one at the end, and the magnitudes."""
        mag = floats_of(self.stars, "mag")
        order = np.argsort(mag, kind="stable")
        return order, mag[order]

    @property
    def magnitudes(self) -> tuple[float, float] | None:
        """The brightest and the faintest magnitude; None where no star has one."""
        mag = self.by_brightness[1]
        known = int(np.searchsorted(mag, np.inf))
        return (float(mag[0]), float(mag[known - 1])) if known else None

    @property
    def seconds(self) -> float:
        """Time that reading takes: by estimate, the same on every machine."""
        return SECONDS_PER_RECORD * self.records

    @property
    def nbytes(self) -> int:
        """Memory that it takes."""
        motions = 0 if self.motions is None else self.motions.nbytes
        return int(self.stars.nbytes + motions + 16 * len(self.stars))


def read_snapshot(
    spec: BuildSpec, inputs: Inputs, workers: int = 2, progress: Progress = no_progress
) -> CatalogSnapshot:
    """Read the catalogs of a spec, as its build does."""
    catalog, joins = read_sources(spec, inputs, workers, progress)
    joined = join_motions(catalog, spec, inputs, workers, progress)
    stars, found = join_all(joined.catalog.stars, joins, spec)
    in_band = in_band_of(stars, spec, inputs, workers, progress)
    stars = with_observed(in_band.stars, spec.selection.observed)
    stars = with_span(stars, spec.span_jyear)
    catalog = joined.catalog
    return CatalogSnapshot(
        stars.combine_chunks(),
        joined.table,
        catalog.rejected_by_reason,
        round(len(catalog.rejected) * _bytes_of_a_row(catalog.rejected.slice(0, SAMPLE_ROWS))),
        catalog.stars.nbytes + catalog.rejected.nbytes,
        catalog.rows_read,
        (*catalog.notes, *join_notes(found, spec), *in_band.notes),
    )


def reading_keys(spec: BuildSpec) -> dict[str, Any]:
    """Return all of a spec that reading its catalogs depends on."""
    content = spec.model_dump(mode="json")
    wanted = {
        "catalog": content["catalog"],
        "epoch_jyear": content["epoch_jyear"],
        "join": content["selection"]["variables"]["join"],
    }
    if spec.selection.doubles.join:  # what it flags depends on what the sensor tells apart
        wanted["doubles"] = content["selection"]["doubles"]
    if spec.selection.observed != Observed():
        wanted["observed"] = content["selection"]["observed"]
    if spec.camera.response.name is not None:
        wanted["response"] = content["camera"]["response"]
    if spec.catalog.motions or spec.catalog.merged or spec.camera.response.photometry:
        model = content["products"]["crossmatch"]
        wanted["model"] = {key: model[key] for key in model if key not in ("enabled", "catalogs")}
    return wanted


def _bytes_of_a_row(table: pa.Table) -> float:
    return (table_bytes(table) - table_bytes(table.slice(0, 1))) / max(1, len(table) - 1)
