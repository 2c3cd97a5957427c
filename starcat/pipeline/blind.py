"""The databases for frames of an unknown camera, built once and kept.

The usual one is made from the embedded sky. Others are made if a narrower range of fields or
another catalog is asked for. The name of a folder contains the version of starcat and the digest of
the spec and its files: any change builds it again.
"""

from __future__ import annotations

from hashlib import sha256
from pathlib import Path

from starcat.catalog.source import map_of
from starcat.errors import ConfigError
from starcat.pipeline.build import build_database
from starcat.pipeline.starter import EMBEDDED, StarterCatalog, starter_spec
from starcat.progress import Progress, no_progress
from starcat.specs.build_spec import BuildSpec, CameraSpec
from starcat.storage.atomic import json_bytes
from starcat.storage.cache import cache_folder
from starcat.version import __version__

FIELDS_DEG = (8.0, 90.0)
"""Range of the usual database's fields of view, across the width."""

CAMERA = CameraSpec(width_px=1024, height_px=1024, fov_x_deg=FIELDS_DEG[0])

SHAPES = 1.1
"""Factor by which another range is exceeded at both ends, for frames that are not square."""

NARROWEST_DEG, WIDEST_DEG = 0.1, 119.0
"""Ends of all ranges for which a database is built."""

TESTED = 20
"""Number of frames of its self-test, which tests only the narrowest field."""


def blind_database(
    progress: Progress = no_progress,
    cache: Path | None = None,
    fields_deg: tuple[float, float] | None = None,
    catalog: StarterCatalog = EMBEDDED,
) -> Path:
    """Return the folder of the database for a range of fields; build it at the first call.

    Without ``cache`` it is kept in the folder of downloads (``$STARCAT_CACHE``). The range is
    `FIELDS_DEG` if it is not given, or if these hold it and the catalog is the embedded sky.
    """
    camera, widest_deg = CAMERA, FIELDS_DEG[1]
    low_deg, high_deg = fields_deg or FIELDS_DEG
    if low_deg < FIELDS_DEG[0] or high_deg > FIELDS_DEG[1] or not catalog.is_embedded:
        if low_deg >= WIDEST_DEG or high_deg <= NARROWEST_DEG:
            raise ConfigError(
                f"the range of fields is {low_deg:g} to {high_deg:g} deg; fields of "
                f"{NARROWEST_DEG:g} to {WIDEST_DEG:g} deg can be found (fov_range)",
                key="fov_range",
                value=fields_deg,
                fields=("fov_range",),
            )
        narrowest_deg = max(NARROWEST_DEG, low_deg / SHAPES)
        camera = CAMERA.model_copy(update={"fov_x_deg": round(narrowest_deg, 4)})
        widest_deg = round(min(WIDEST_DEG, high_deg * SHAPES), 4)
    found = starter_spec(
        "blind", camera, progress=progress, widest_fov_x_deg=widest_deg, catalog=catalog
    )
    few = found.spec.self_test.model_copy(update={"frames": TESTED})
    spec = found.spec.model_copy(update={"self_test": few})
    digest = _digest(spec, catalog)
    folder = (cache or cache_folder() / "blind") / f"{__version__}-{digest}"
    made = folder / f"{spec.name}-{spec.version}"
    if not made.is_dir():
        folder.mkdir(parents=True, exist_ok=True)
        build_database(spec, catalog.inputs, folder, progress=progress)
    return made


def _digest(spec: BuildSpec, catalog: StarterCatalog) -> str:
    content = spec.model_dump_json().encode()
    if not catalog.is_embedded:
        content += json_bytes([map_of(catalog.source), *map(_facts_of_file, catalog.paths)])
    return sha256(content).hexdigest()[:12]


def _facts_of_file(path: Path) -> list[str | int]:
    """Return what tells whether a file or folder has changed; an address is only named."""
    if not path.exists():
        return [str(path)]
    status = path.stat()
    return [str(path.resolve()), status.st_size, status.st_mtime_ns]
