"""A first spec for a camera: the limit, the tiling, the density, and the resulting stars per field.

A matcher looks up triangles, and a database contains triangles of the brightest stars of each
field. So the stars are thinned to slightly more, and few stars of a frame have no triangle.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pydantic import Field

from starcat.arguments import check_type, path_of, text_of_path
from starcat.catalog.sensor_band import in_sensor_band
from starcat.catalog.source import data_source, source_given
from starcat.catalog.source_files import locate
from starcat.catalog.stars.star_table import directions_of, floats_of
from starcat.catalog.store.reading import read_catalog
from starcat.catalog.store.wire import input_paths
from starcat.database.products.coverage import Spread, field_coverage, summarise_coverage
from starcat.database.products.table import USUAL_PRODUCTS
from starcat.database.products.tiling import tile_sphere
from starcat.errors import BuildError, ConfigError, OutputError
from starcat.geometry.camera import Camera
from starcat.geometry.distortion import checked_number
from starcat.pipeline.cost import Cost, base_memory, product_cost
from starcat.pipeline.draft import Inputs
from starcat.pipeline.guide_stars import (
    NEVER_LEFT_OUT,
    STARS_A_FIELD,
    brightest_of_fields,
    check_tiling,
    without_costly,
)
from starcat.pipeline.recipes import field_size, product_inputs, tile_guide_stars
from starcat.pipeline.selection.selecting import reject_dense, select_guide_stars
from starcat.pipeline.specs.build_spec import BuildSpec, CameraSpec, least_boresights
from starcat.pipeline.specs.camera_sensor import USUAL_SIGNAL_TO_NOISE
from starcat.pipeline.specs.keys import CheckedSpec, spec_toml
from starcat.pipeline.specs.reading import spec_from_dict
from starcat.progress import Progress, no_progress
from starcat.resources import PathLike
from starcat.storage.atomic import whole_file

EPOCH_JYEAR = 2026.0
"""Epoch of a spec whose catalog can have proper motions."""

ENOUGH_STARS = 10
"""With this number of stars in nearly every field, enough remain if centroids are missing."""

ENOUGH_SHARE = 0.995
"""Share of the fields that must have `ENOUGH_STARS`."""

BRIGHTEST = 10
"""Number of stars of a field that form triangles: ten stars form 120."""

BRIGHTEST_OF_LEVEL = 8
"""The same for a range of fields; it is smaller, because every candidate takes time to try."""

OVERLAP = 4
"""Multiple of the boresights that leave no hole, so that frames at any roll find triangles."""

MEMORY_BYTES, PRODUCT_BYTES, PRODUCT_ROWS = 1.6e9, 1.0e9, 6_000_000
"""A spec leaves out products until the estimated memory and the rows of all products, which take
the time, are at most these. Products can take `PRODUCT_BYTES` even if the catalog alone takes most
of the memory."""

MAX_LOOKED_AT = 60_000_000
"""Most stars in all fields that are processed: they take some gigabytes."""

MAX_BORESIGHTS = 200_000
"""With more boresights than this, only the limit of the spec itself is examined."""

MANY_FIELDS = 5
"""If a camera sees this many times more stars than the database has, advise to give magnitudes."""


@dataclass(frozen=True)
class StarterCatalog:
    """The star catalog of a first spec, and its files."""

    source: str
    inputs: Inputs = field(default_factory=dict)  # files, folders or addresses by source

    @property
    def is_embedded(self) -> bool:
        """Whether it is the embedded sky, which is always installed."""
        return self.source == "gaia" and not self.inputs

    @property
    def words(self) -> str:
        """Its name in sentences."""
        return "the embedded sky" if self.is_embedded else self.source

    @property
    def band(self) -> str:
        """The band of its magnitudes."""
        return data_source(self.source).bands[0]

    @property
    def epoch_jyear(self) -> float:
        """The epoch of a spec; the stars of the embedded sky have no proper motions."""
        return 2016.0 if self.is_embedded else EPOCH_JYEAR

    @property
    def paths(self) -> list[Path]:
        """Its files, folders or addresses."""
        return locate(self.source, self.inputs)

    def stars(self, progress: Progress = no_progress) -> pa.Table:
        """Read its stars."""
        epoch_jyear = None if self.is_embedded else self.epoch_jyear
        options = {"band": self.band, "epoch_jyear": epoch_jyear, "progress": progress}
        return read_catalog(self.source, self.paths, **options).stars


EMBEDDED = StarterCatalog("gaia")
"""The embedded sky."""

_STEPS_MAG = (-1.0, -0.5, 0.0, 0.5, 1.0)
_SPREAD_PX = 4.0
"""Stars closer than this merge into one spot."""


@dataclass(frozen=True)
class LimitRow:
    """The stars that a magnitude limit leaves in the fields of the tiling."""

    faint_limit_mag: float
    guide_stars: Annotated[int, Field(description="Stars of the sky that pass the selection.")]
    stars: Annotated[Spread, Field(description="How the stars are spread over the fields.")]


@dataclass(frozen=True)
class StarterFigures:
    """A first spec for a camera, as in 'starcat init'."""

    checked: CheckedSpec
    limits: Annotated[list[LimitRow], Field(description="Its own limit, and some around it.")]
    thinned: Annotated[LimitRow, Field(description="Faintest magnitude left after thinning.")]
    estimate: Annotated[Cost, Field(description="What the build will cost.")]
    advice: Annotated[list[str], Field(description="Remarks on the limit.")]
    in_words: Annotated[str, Field(description="Size, memory and time of the build, in one line.")]


@dataclass(frozen=True, repr=False)
class Starter:
    """A first spec, with the stars for its limit and for neighbouring limits.

    Attributes
    ----------
    spec : BuildSpec
        Spec for the camera.
    limits : tuple[LimitRow, ...]
        The spec's own limit, and some brighter and fainter limits.
    deepest_mag : float
        Faintest star of the catalog; fainter limits add none.
    thinned : LimitRow
        Stars left by thinning at the spec's own limit.
    cost : Cost
        Estimated cost of the build.
    catalog : StarterCatalog
        The catalog that the spec reads.
    """

    spec: BuildSpec
    limits: tuple[LimitRow, ...]
    deepest_mag: float
    thinned: LimitRow
    cost: Cost
    catalog: StarterCatalog = EMBEDDED

    def __repr__(self) -> str:
        return f"<Starter {repr(self.spec)[1:-1]}; {self.cost.in_words}>"

    @property
    def figures(self) -> StarterFigures:
        """The figures that REST, the page and ``--json`` show."""
        checked, remarks = CheckedSpec.of(self.spec), list(advice(self))
        limits, words = list(self.limits), self.cost.in_words
        return StarterFigures(checked, limits, self.thinned, self.cost, remarks, words)

    @property
    def band(self) -> str:
        """The band of the limits."""
        return self.spec.camera.response.name or self.catalog.band

    @property
    def left_out(self) -> tuple[str, ...]:
        """Products that the camera could use but that would cost too much."""
        if self.spec.is_for_a_range:
            return ()
        return tuple(name for name in USUAL_PRODUCTS if name not in self.spec.products.requested)

    @property
    def row_of_spec(self) -> LimitRow:
        """The row of the spec's own limit."""
        limit = self.spec.selection.faint_limit_mag
        return next(row for row in self.limits if row.faint_limit_mag == limit)


def starter_spec(
    name: str,
    camera: CameraSpec,
    faint_limit_mag: float | None = None,
    progress: Progress = no_progress,
    widest_fov_x_deg: float | None = None,
    *,
    catalog: StarterCatalog = EMBEDDED,
    sky: pa.Table | None = None,
    most_field_stars: int = MAX_LOOKED_AT,
    reach_mag: float = -np.inf,
) -> Starter:
    """Return a spec for a camera, by default from the embedded sky.

    ``sky`` are the stars of the catalog, if they have been read. The default limit is the limit
    with enough stars, or ``reach_mag`` if that is fainter.
    """
    name = re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")[:64] or "camera"
    if sky is None:
        sky = catalog.stars(progress)
    response = camera.response.response()
    if response is not None:
        sky = in_sensor_band(sky, catalog.source, response).stars
    mag = np.sort(floats_of(sky, "mag"))
    spec_to = partial(_spec, name, camera, catalog, widest_fov_x_deg)
    shape = spec_to(float(mag[-1]))
    limit = faint_limit_mag
    if limit is None:
        exposure = camera.exposure.exposure(response)
        seen = np.inf if exposure is None else exposure.limit_mag(USUAL_SIGNAL_TO_NOISE)
        limit = min(max(enough_limit(sky, shape), round(reach_mag, 2)), round(float(seen), 2))
    check_tiling(int(np.searchsorted(mag, limit, side="right")), shape, None, most_field_stars)
    spec, thinned, cost = _affordable(sky, spec_to(limit))
    limits = sorted({round(limit + step, 2) for step in _STEPS_MAG} | {limit})
    rows = [
        _row(sky, spec_to(limit_mag))
        for limit_mag in limits
        if limit_mag == limit
        or (limit_mag <= mag[-1] and _is_quick(mag, limit_mag, shape, most_field_stars))
    ]
    return Starter(spec, tuple(rows), float(mag[-1]), thinned, cost, catalog)


def init(
    camera: Camera,
    name: str = "camera",
    *,
    faint_limit_mag: float | None = None,
    catalog: str | None = None,
    inputs: PathLike | Sequence[PathLike] | None = None,
    output: PathLike | None = None,
    replace: bool = False,
) -> Starter:
    """Propose a build spec for a camera, by default from the embedded sky, like ``starcat init``.

    Parameters
    ----------
    camera : Camera
        The camera; its size and focal length are used.
    name : str, default "camera"
        Name of the database.
    faint_limit_mag : float, optional
        Faintest guide star; by default the brightest limit at which fields have enough stars.
    catalog : str, optional
        Star catalog that ``starcat sources`` lists, or the path of a map of your table; for fields
        or limits that the embedded sky does not serve.
    inputs : path or sequence of paths, optional
        Files or folder of the catalog, or the address of a HATS catalog; searched by default.
    output : str or path-like, optional
        TOML file to write, with an explanation of every key.
    replace : bool, default False
        Whether an existing file may be replaced.

    Returns
    -------
    Starter
        ``spec`` for `build`, and the numbers of stars for other limits.

    Raises
    ------
    ConfigError, BuildError, OutputError
        In the same cases as ``starcat init``.
    """
    check_type("camera", camera, Camera, "a starcat.Camera")
    check_type("name", name, str, "text")
    if faint_limit_mag is not None:
        faint_limit_mag = checked_number("faint_limit_mag", faint_limit_mag)
    stars = EMBEDDED
    if catalog is not None:
        source = source_given(text_of_path("catalog", catalog))
        files = {} if inputs is None else {source.name: input_paths("inputs", inputs)}
        stars = StarterCatalog(source.name, files)
    elif inputs is not None:
        raise ConfigError("inputs are files of a catalog", hint="name it with {catalog}")
    if output is not None:
        expect_new(path_of("output", output), replace=replace)
    camera_spec = CameraSpec(
        width_px=camera.width_px, height_px=camera.height_px, fov_x_deg=camera.fov_x_deg
    )
    starter = starter_spec(name, camera_spec, faint_limit_mag, catalog=stars)
    if output is not None:
        write_starter(starter, path_of("output", output), replace=replace)
    return starter


def _is_quick(mag: NDArray[np.float64], limit: float, spec: BuildSpec, most: int) -> bool:
    if spec.boresights.count > MAX_BORESIGHTS:
        return False
    try:
        check_tiling(int(np.searchsorted(mag, limit, side="right")), spec, None, most)
    except BuildError:
        return False
    return True


def expect_new(path: Path, *, replace: bool) -> None:
    """Check that a first spec can be written, before it is computed."""
    if path.exists() and not replace:
        raise OutputError(
            f"{path} is there already",
            path=path,
            hint=("choose another name", "pass {replace:True}"),
        )


def write_starter(
    starter: Starter, path: Path, *, replace: bool, remarks: Sequence[str] = ()
) -> None:
    """Write a first spec as a TOML file with some remarks and an explanation of every key."""
    expect_new(path, replace=replace)
    with whole_file(path) as partial:
        above = "".join(f"# {line}\n" for line in remarks)
        partial.write_text(above + spec_toml(starter.spec), encoding="utf-8")


def boresight_count(camera: CameraSpec) -> int:
    """Return the number of boresights for a camera's fields."""
    least = least_boresights(camera.half_field_deg)
    count = max(least, min(OVERLAP * least, 30_000.0))
    return int(np.clip(100 * np.ceil(count / 100.0), 2000, 1_000_000))


def _spec(
    name: str,
    camera: CameraSpec,
    catalog: StarterCatalog,
    widest_fov_x_deg: float | None,
    faint_limit_mag: float,
) -> BuildSpec:
    eye = camera.camera()
    content: dict[str, Any] = {
        "name": name,
        "version": "1.0.0",
        "description": f"Guide stars for a field of {eye.fov_x_deg:.4g} x {eye.fov_y_deg:.4g} deg",
        "epoch_jyear": catalog.epoch_jyear,
        "catalog": {"source": catalog.source, "band": catalog.band},
        "selection": {
            "faint_limit_mag": faint_limit_mag,
            "max_stars_per_field": STARS_A_FIELD,
            "doubles": {
                "min_separation_deg": float(
                    f"{min(10.0, _SPREAD_PX * eye.fov_x_deg / eye.width_px):.2g}"
                ),
                "max_delta_mag": 3.0,
            },
        },
        "camera": camera.model_dump(exclude_none=True),
        "boresights": {"count": boresight_count(camera), "brightest": BRIGHTEST},
    }
    if widest_fov_x_deg is not None:
        content |= _for_a_range(eye, widest_fov_x_deg, content["boresights"]["count"])
    return spec_from_dict(content, "the range of fields")


def _for_a_range(narrowest: Camera, widest_fov_x_deg: float, boresights: int) -> dict[str, Any]:
    """Return the keys of a spec that differ if it serves a range of fields."""
    others = {name: {"enabled": False} for name in USUAL_PRODUCTS if name != NEVER_LEFT_OUT}
    levels = {"enabled": True, "widest_fov_x_deg": widest_fov_x_deg}
    return {
        "description": f"Guide stars for fields of {narrowest.fov_x_deg:.4g} to "
        f"{widest_fov_x_deg:.4g} deg across the width",
        "boresights": {"count": boresights, "brightest": BRIGHTEST_OF_LEVEL},
        "products": {**others, "levels": levels},
    }


def _affordable(sky: pa.Table, spec: BuildSpec) -> tuple[BuildSpec, LimitRow, Cost]:
    """Return a spec without products that cost too much, the stars after thinning, and the cost."""
    selected = select_guide_stars(sky, spec.selection)
    brightest = brightest_of_fields(selected.guide_stars, spec, STARS_A_FIELD)
    selected = reject_dense(selected, brightest)
    guide_stars = selected.guide_stars
    fields = tile_guide_stars(guide_stars, spec)
    base = base_memory(sky.nbytes)
    most_bytes = max(MEMORY_BYTES, base + PRODUCT_BYTES)
    spec, _ = without_costly(
        guide_stars, fields, spec, base,
        lambda cost: cost.memory_bytes <= most_bytes and sum(cost.rows.values()) <= PRODUCT_ROWS,
    )  # fmt: skip
    inputs = product_inputs(guide_stars, fields, spec)
    cost = product_cost(inputs, base, others={"rejected": len(selected.rejected)})
    stars = summarise_coverage(field_coverage(fields, BRIGHTEST)).stars
    return spec, LimitRow(spec.selection.faint_limit_mag, len(guide_stars), stars), cost


def enough_limit(sky: pa.Table, spec: BuildSpec) -> float:
    """Return the limit with enough stars in nearly all fields, at most the limit of the sky."""
    eye = spec.camera.camera()
    fields = 4.0 * np.pi / np.radians(eye.fov_x_deg) / np.radians(eye.fov_y_deg)
    mag = floats_of(sky, "mag")
    # Ten times as many stars as needed on average, so that the emptiest fields have enough too.
    near = np.argsort(mag, kind="stable")[: int(10 * ENOUGH_STARS * max(fields, 1.0)) + 100]
    tiled = tile_sphere(
        min(spec.boresights.count, 5000), directions_of(sky)[near], mag[near], field_size(spec)
    )
    has_enough = tiled.count >= ENOUGH_STARS
    faintest = np.full(len(tiled.count), np.inf)
    rows = tiled.star_index[tiled.offsets[:-1][has_enough] + ENOUGH_STARS - 1]
    faintest[has_enough] = mag[near][rows]
    limit = float(np.sort(faintest)[int(ENOUGH_SHARE * len(faintest))])
    return float(np.ceil(min(limit, float(mag.max())) * 10.0) / 10.0)


def _row(sky: pa.Table, spec: BuildSpec) -> LimitRow:
    # Fainter stars are rejected, and are companions of no star.
    bright = floats_of(sky, "mag") <= spec.selection.faint_limit_mag
    selected = select_guide_stars(sky.filter(pa.array(bright)), spec.selection)
    fields = tile_guide_stars(selected.guide_stars, spec)
    summary = summarise_coverage(field_coverage(fields, spec.boresights.brightest))
    limit = spec.selection.faint_limit_mag
    return LimitRow(limit, len(selected.guide_stars), summary.stars)


def advice(starter: Starter) -> Sequence[str]:
    """Return remarks on the limit of a first spec."""
    row, spec = starter.row_of_spec, starter.spec
    remarks = [*spec.exposure_notes, *spec.exposure_proposal]
    if starter.spec.selection.faint_limit_mag > starter.deepest_mag + 0.1:
        remarks.append(
            f"{starter.catalog.words} ends at {starter.band} = {starter.deepest_mag:.2f}; take a "
            "deeper catalog for a fainter limit"
        )
    if row.stars.one_percent < ENOUGH_STARS - 2:
        remarks.append(
            f"1 % of the fields have {row.stars.one_percent} stars or fewer; a frame needs 4, and "
            f"{ENOUGH_STARS} leave enough if centroids are missing: "
            + (
                f"{starter.catalog.words} has no fainter stars, and many frames will have no "
                "answer; take a deeper catalog"
                if row.faint_limit_mag >= starter.deepest_mag
                else "a fainter limit gives more"
            )
        )
    if row.stars.median > MANY_FIELDS * STARS_A_FIELD:
        remarks.append(
            f"the middle field has {row.stars.median} stars up to the limit, and the database "
            f"keeps the {STARS_A_FIELD} brightest of each field "
            "(selection.max_stars_per_field): give the matcher the brightness of the centroids, so "
            "that it begins with these"
        )
    if starter.left_out:
        remarks.append(
            f"left out, as they would cost too much: {', '.join(starter.left_out)}; "
            "products.<name>.enabled = true makes them"
        )
    return remarks
