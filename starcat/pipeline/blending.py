"""Close stars as the sensor of a spec sees them: two given stars, or stars of the catalog.

The numbers are the same as in a build (`starcat.pipeline.selection.rules.neighbours`), from
magnitudes in the band of the spec.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from starcat.arrays import Rows
from starcat.catalog.stars.star_table import directions_of, floats_of
from starcat.database.products.blends import widths_px
from starcat.database.products.crossmatch import ARCSEC
from starcat.errors import ConfigError, SourceError
from starcat.geometry.sphere import directions_from_radec, radec_from_directions, separation
from starcat.pipeline.draft import Inputs
from starcat.pipeline.estimate import read_draft
from starcat.pipeline.selection.rules.neighbours import seen_by_sensor
from starcat.pipeline.specs.build_spec import BuildSpec
from starcat.progress import Progress, no_progress

MAX_STARS = 100
"""Most stars of one window in the result; the brightest are used."""


@dataclass(frozen=True)
class StarInBlend:
    """One star of a blend, with the sensor's measurement of it."""

    star: str
    ra_deg: float
    dec_deg: float
    mag: float
    separation_arcsec: float  # distance from the requested star
    blend_mag: float  # magnitude of all light in the window of its centroid
    contamination: float  # fraction of this light from other stars
    centroid_offset_arcsec: float  # shift of its centroid by other stars
    centroid_offset_px: float
    is_resolved: bool  # True: it has its own spot; False: it is part of a brighter star's spot
    is_beyond_limits: bool  # the limits are ``max_offset_*`` and ``max_contamination``


@dataclass(frozen=True)
class SensorView:
    """A star and its neighbours as the sensor of a spec sees them."""

    spec: str
    band: str
    pixel_arcsec: float
    psf_sigma_px: float
    max_offset_arcsec: float
    max_contamination: float
    stars: tuple[StarInBlend, ...]  # the requested star first, the others by distance


def sensor_view_of_pair(
    spec: BuildSpec, separation_arcsec: float, mags: Sequence[float]
) -> SensorView:
    """Return how the sensor of a spec sees two stars, whose magnitudes are in its band."""
    checked = np.array([separation_arcsec, *mags])
    if len(mags) != 2 or not (np.isfinite(checked).all() and 0.0 < separation_arcsec <= 36_000.0):
        raise ConfigError(
            f"the separation is {separation_arcsec!r} arcsec and the magnitudes are "
            f"{list(mags)!r}; expected a separation above 0, at most 36,000 arcsec, and two "
            "magnitudes",
            hint="state them with {separation} and {mags}",
        )
    u = directions_from_radec([0.0, separation_arcsec / 3600.0], [0.0, 0.0])
    columns = dict(zip("xyz", u.T, strict=True))
    stars = pa.table({**columns, "mag": list(mags), "star_id": [1, 2], "designation": ["A", "B"]})
    return _view(spec, stars, np.array([0, 1]), spec.catalog.band or "sensor")


def sensor_view_at(
    spec: BuildSpec,
    inputs: Inputs,
    ra_deg: float,
    dec_deg: float,
    *,
    workers: int = 2,
    progress: Progress = no_progress,
) -> SensorView:
    """Return how the sensor of a spec sees the brightest star at a position, and its neighbours.

    The star must be within the window of a centroid. `SourceError` if there is none.
    """
    if not (np.isfinite(ra_deg) and 0.0 <= ra_deg <= 360.0 and -90.0 <= dec_deg <= 90.0):
        raise ConfigError(
            f"the position is RA {ra_deg:g}, Dec {dec_deg:g}; expected degrees, RA 0 to 360 and "
            "Dec -90 to 90"
        )
    reach = _reach_rad(spec)
    stars = read_draft(spec, inputs, workers, progress).stars
    u, mag = directions_of(stars), floats_of(stars, "mag")
    mag_or_inf = np.where(np.isnan(mag), np.inf, mag)
    near = np.flatnonzero(separation(u, directions_from_radec(ra_deg, dec_deg)) <= reach)
    if not np.isfinite(mag_or_inf[near]).any():
        raise SourceError(
            f"no star with a magnitude within {reach / ARCSEC:.0f} arcsec of RA {ra_deg:g}, Dec "
            f"{dec_deg:g} in {', '.join(spec.catalog.catalogs)}",
            hint="check the position, or read a deeper catalog (catalog.source of the spec)",
        )
    star = near[np.argmin(mag_or_inf[near])]
    away = separation(u, u[star])
    rows = np.flatnonzero((away <= reach) & np.isfinite(mag_or_inf))
    rows = rows[np.argsort(mag_or_inf[rows], kind="stable")][:MAX_STARS]
    return _view(spec, stars, rows[np.argsort(away[rows], kind="stable")], stars["band"][0].as_py())


def _reach_rad(spec: BuildSpec) -> float:
    """Return the largest distance of a star that counts; ConfigError if the spec has no spot."""
    rule = spec.selection.neighbours
    if rule.psf_sigma_px is None:
        raise ConfigError(
            "selection.neighbours.psf_sigma_px is missing, the width of a star's spot",
            where=spec.name,
            key="selection.neighbours.psf_sigma_px",
            hint="state it in the spec, such as selection.neighbours.psf_sigma_px = 1.0",
        )
    widths = widths_px(rule.psf_sigma_px, rule.window_px, rule.box_px)
    return widths.reach * spec.camera.camera().pixel_arcsec * ARCSEC


def _view(spec: BuildSpec, stars: pa.Table, rows: Rows, band: str) -> SensorView:
    """Return the view of some stars; the first is the requested star."""
    _reach_rad(spec)
    rule, pixel_arcsec = spec.selection.neighbours, spec.camera.camera().pixel_arcsec
    ascending = np.argsort(rows)
    seen = seen_by_sensor(stars, rows[ascending], rule, pixel_arcsec)
    back = np.argsort(ascending)
    moved, share, blend_mag = seen.moved_arcsec, seen.blends.contamination, seen.mag
    is_beyond = rule.is_beyond(moved, share, pixel_arcsec)
    u = directions_of(stars.take(pa.array(rows)))
    records = zip(
        stars["designation"].take(pa.array(rows)).to_pylist(),
        *(values.tolist() for values in radec_from_directions(u)),
        seen.sky.mag[rows].tolist(),
        (separation(u, u[0]) / ARCSEC).tolist(),
        *(values[back].tolist() for values in (blend_mag, share, moved, moved / pixel_arcsec)),
        (~seen.blends.is_lost[back]).tolist(),
        is_beyond[back].tolist(),
        strict=True,
    )
    limits = rule.max_offset_of(pixel_arcsec), rule.max_contamination
    width = rule.psf_sigma_px or 0.0
    return SensorView(
        spec.name,
        band,
        pixel_arcsec,
        width,
        *limits,
        tuple(StarInBlend(*values) for values in records),
    )
