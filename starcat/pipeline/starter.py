"""A first spec for a camera: the limit, the tiling, and how many stars a field then has."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from starcat.catalog.fetching.locate import locate
from starcat.catalog.ingest import ingest
from starcat.catalog.selection import select_guide_stars
from starcat.catalog.stars import directions_of, floats_of
from starcat.errors import OutputError
from starcat.pipeline.recipes import field_size, tile_guide_stars
from starcat.products.boresights import tile_sphere
from starcat.products.coverage import Spread, field_coverage, summarise_coverage
from starcat.progress import Progress, no_progress
from starcat.specs.build_spec import BuildSpec, CameraSpec
from starcat.specs.spec_toml import spec_toml
from starcat.storage.atomic import whole_file

SOURCE, BAND = "gaia", "G"
"""The embedded sky, which everybody has."""

EPOCH_JYEAR = 2016.0
"""Of the embedded sky, whose stars have no proper motions."""

ENOUGH_STARS = 8
"""So many stars in the emptiest hundredth of the fields leave some when spots are missing."""

_STEPS_MAG = (-1.0, -0.5, 0.0, 0.5, 1.0)
_SPREAD_PX = 4.0
"""Stars that are closer than this blur into one spot."""


@dataclass(frozen=True)
class LimitRow:
    """What a magnitude limit leaves in the fields of the tiling.

    Attributes
    ----------
    faint_limit_mag : float
        The limit.
    guide_stars : int
        Stars of the whole sky that pass the selection.
    stars : Spread
        How the stars are spread over the fields.
    """

    faint_limit_mag: float
    guide_stars: int
    stars: Spread


@dataclass(frozen=True)
class Starter:
    """A first spec, and what it and its neighbours give.

    Attributes
    ----------
    spec : BuildSpec
        For the camera.
    limits : tuple of LimitRow
        The spec's own limit, and some that are brighter and fainter.
    deepest_mag : float
        Faintest star of the catalog; fainter limits add none.
    """

    spec: BuildSpec
    limits: tuple[LimitRow, ...]
    deepest_mag: float

    @property
    def own(self) -> LimitRow:
        """The row of the spec's own limit."""
        limit = self.spec.selection.faint_limit_mag
        return next(row for row in self.limits if row.faint_limit_mag == limit)


def starter_spec(
    name: str,
    camera: CameraSpec,
    faint_limit_mag: float | None = None,
    progress: Progress = no_progress,
) -> Starter:
    """Return a spec for a camera, from the embedded sky.

    Parameters
    ----------
    name : str
        Name of the artifact; what no artifact's name may have becomes a hyphen.
    camera : CameraSpec
        The camera.
    faint_limit_mag : float, optional
        What the camera sees, Gaia's G. By default the limit that leaves at least
        `ENOUGH_STARS` stars in 99 of 100 fields, a tenth of a magnitude at a time.
    progress : Progress
        Passed on.

    Returns
    -------
    Starter
        The spec, and the stars of a field for limits around its own.

    Raises
    ------
    ConfigError
        If the camera or the limit is out of range.
    """
    name = re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")[:64] or "camera"
    sky = ingest(SOURCE, locate(SOURCE, {}), progress=progress).stars
    mag = np.sort(floats_of(sky, "mag"))
    shape = _spec(name, camera, float(mag[-1]))
    limit = faint_limit_mag
    if limit is None:
        limit = min(_enough(sky, shape), round(float(mag[-1]), 1))
    spec = _spec(name, camera, limit)
    limits = sorted({round(limit + step, 2) for step in _STEPS_MAG} | {limit})
    rows = [_row(sky, _spec(name, camera, one)) for one in limits if one <= mag[-1] or one == limit]
    return Starter(spec, tuple(rows), float(mag[-1]))


def write_starter(starter: Starter, path: Path, *, replace: bool) -> None:
    """Write a first spec as a TOML file in which every key is explained.

    Parameters
    ----------
    starter : Starter
        The spec.
    path : Path
        The file.
    replace : bool
        Whether a file that is there may be replaced.

    Raises
    ------
    OutputError
        If a file is there and may not be replaced, or the file cannot be written.
    """
    if path.exists() and not replace:
        raise OutputError(f"{path} is there already; choose another name or --replace", path=path)
    with whole_file(path) as partial:
        partial.write_text(spec_toml(starter.spec), encoding="utf-8")


def boresight_count(camera: CameraSpec) -> int:
    """Return how many boresights a camera's fields want.

    Parameters
    ----------
    camera : CameraSpec
        The camera.

    Returns
    -------
    int
        Eight times as many as leave no hole between the circles inside the fields, from 2,000
        to 50,000; more only where a hole would be left.

    Notes
    -----
    10,000 Saff-Kuijlaars points leave no direction farther than 1.50 deg from the nearest, and
    this distance shrinks with the root of their number.
    """
    least = 1.05 * 10_000 * (1.5 / camera.half_field_deg) ** 2
    wanted = max(least, min(8.0 * least, 50_000.0))
    return int(np.clip(100 * np.ceil(wanted / 100.0), 2000, 1_000_000))


def _spec(name: str, camera: CameraSpec, faint_limit_mag: float) -> BuildSpec:
    field = camera.camera()
    content: dict[str, Any] = {
        "name": name,
        "version": "1.0.0",
        "description": f"Guide stars for a field of {field.fov_x_deg:.4g} x "
        f"{field.fov_y_deg:.4g} deg",
        "epoch_jyear": EPOCH_JYEAR,
        "catalog": {"source": SOURCE, "band": BAND},
        "selection": {
            "faint_limit_mag": faint_limit_mag,
            "doubles": {
                "min_separation_deg": float(
                    f"{min(10.0, _SPREAD_PX * field.fov_x_deg / field.width_px):.2g}"
                ),
                "max_delta_mag": 3.0,
            },
        },
        "camera": camera.model_dump(exclude_none=True),
        "boresights": {"count": boresight_count(camera)},
    }
    return BuildSpec.model_validate(content)


def _enough(sky: pa.Table, spec: BuildSpec) -> float:
    """Return the limit that leaves enough stars in 99 of 100 fields."""
    field = spec.camera.camera()
    fields = 4.0 * np.pi / np.radians(field.fov_x_deg) / np.radians(field.fov_y_deg)
    mag = floats_of(sky, "mag")
    # Ten times as many stars as the emptiest fields need, so that all of them have enough.
    near = np.argsort(mag, kind="stable")[: int(10 * ENOUGH_STARS * max(fields, 1.0)) + 100]
    tiled = tile_sphere(
        min(spec.boresights.count, 5000), directions_of(sky)[near], mag[near], field_size(spec)
    )
    has_enough = tiled.count >= ENOUGH_STARS
    faintest = np.full(len(tiled.count), np.inf)
    rows = tiled.star_index[tiled.offsets[:-1][has_enough] + ENOUGH_STARS - 1]
    faintest[has_enough] = mag[near][rows]
    limit = float(np.sort(faintest)[int(0.99 * len(faintest))])
    return float(np.ceil(limit * 10.0) / 10.0) if np.isfinite(limit) else float(mag.max())


def _row(sky: pa.Table, spec: BuildSpec) -> LimitRow:
    selected = select_guide_stars(sky, spec.selection)
    fields = tile_guide_stars(selected.guide_stars, spec)
    summary = summarise_coverage(field_coverage(fields, spec.boresights.brightest))
    limit = spec.selection.faint_limit_mag
    return LimitRow(limit, len(selected.guide_stars), summary.stars)


def advice(starter: Starter) -> Sequence[str]:
    """Return what to think of before a limit is kept.

    Parameters
    ----------
    starter : Starter
        A first spec.

    Returns
    -------
    sequence of str
        One sentence each; empty where the limit is a good one.
    """
    own, told = starter.own, []
    if starter.spec.selection.faint_limit_mag > starter.deepest_mag:
        told.append(
            f"the embedded sky ends at {BAND} = {starter.deepest_mag:.2f}; take a deeper catalog "
            "for a fainter limit"
        )
    if own.stars.one_percent < ENOUGH_STARS:
        told.append(
            f"1 % of the fields have {own.stars.one_percent} stars or fewer; a frame needs 4, and "
            f"{ENOUGH_STARS} leave some where spots are missing: a fainter limit gives more"
        )
    if own.stars.median > 10 * ENOUGH_STARS:
        told.append(
            f"the middle field has {own.stars.median} stars, many more than a matcher uses: a "
            "brighter limit, or selection.max_stars_per_field, makes the database smaller and "
            "its answers faster"
        )
    return told
