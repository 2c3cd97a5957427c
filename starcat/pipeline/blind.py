"""The databases for frames of an unknown camera, built once and kept.

The usual one is made from the embedded sky. Others are made if a narrower range of fields or
another catalog is asked for. The name of a folder contains the version of starcat and a digest of
everything that the database depends on: any change builds it again.
"""

from __future__ import annotations

from functools import lru_cache
from hashlib import sha256
from pathlib import Path

from starcat.catalog.source import map_of
from starcat.catalog.source_files import locate
from starcat.errors import AsWritten, ConfigError
from starcat.pipeline.build import build
from starcat.pipeline.specs.build_spec import CameraSpec
from starcat.pipeline.starter import EMBEDDED, StarterCatalog, starter_spec
from starcat.progress import Progress, no_progress
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


NAME = "blind"

PACKAGE = Path(__file__).parents[1]
"""The folder of starcat."""


def blind_folder(
    cache: Path | None = None,
    fields_deg: tuple[float, float] | None = None,
    catalog: StarterCatalog = EMBEDDED,
) -> Path:
    """Return the folder that a database has, or will have; nothing is computed for its name.

    Without ``cache`` it is in the folder of downloads (``$STARCAT_CACHE``). The range is
    `FIELDS_DEG` if it is not given, or if these hold it and the catalog is the embedded sky.
    """
    digest = _digest(*_camera_of(fields_deg, catalog), catalog)
    return (cache or cache_folder() / NAME) / f"{__version__}-{digest}" / f"{NAME}-1.0.0"


def blind_database(
    progress: Progress = no_progress,
    cache: Path | None = None,
    fields_deg: tuple[float, float] | None = None,
    catalog: StarterCatalog = EMBEDDED,
) -> Path:
    """Return the folder of a database (`blind_folder`); build it at the first call."""
    folder = blind_folder(cache, fields_deg, catalog)
    if not folder.is_dir():
        camera, widest_deg = _camera_of(fields_deg, catalog)
        spec = starter_spec(
            NAME, camera, progress=progress, widest_fov_x_deg=widest_deg, catalog=catalog
        ).spec
        few = spec.self_test.model_copy(update={"frames": TESTED})
        spec = spec.model_copy(update={"self_test": few})
        folder.parent.mkdir(parents=True, exist_ok=True)
        build(spec, folder.parent, inputs=catalog.inputs, progress=progress)
    return folder


def _camera_of(
    fields_deg: tuple[float, float] | None, catalog: StarterCatalog
) -> tuple[CameraSpec, float]:
    """Return the camera of the narrowest field of a range, and the widest field."""
    low_deg, high_deg = fields_deg or FIELDS_DEG
    if low_deg >= FIELDS_DEG[0] and high_deg <= FIELDS_DEG[1] and catalog.is_embedded:
        return CAMERA, FIELDS_DEG[1]
    if low_deg >= WIDEST_DEG or high_deg <= NARROWEST_DEG:
        raise ConfigError(
            f"fields of {NARROWEST_DEG:g} to {WIDEST_DEG:g} deg can be found",
            parameter="fov_range",
            value=AsWritten(f"{low_deg:g} to {high_deg:g} deg"),
        )
    narrowest_deg = max(NARROWEST_DEG, low_deg / SHAPES)
    camera = CAMERA.model_copy(update={"fov_x_deg": round(narrowest_deg, 4)})
    return camera, round(min(WIDEST_DEG, high_deg * SHAPES), 4)


def _digest(camera: CameraSpec, widest_deg: float, catalog: StarterCatalog) -> str:
    """Return a digest of the camera, of the catalog and of the code that builds."""
    paths = locate(catalog.source, {}) if catalog.is_embedded else catalog.paths
    sky = [map_of(catalog.source), *map(_facts_of_file, paths)]
    facts = [camera.model_dump(mode="json"), widest_deg, TESTED, sky, _code_sha256()]
    return sha256(json_bytes(facts)).hexdigest()[:12]


def _facts_of_file(path: Path) -> list[str | int]:
    """Return what tells whether a file or folder has changed; an address is only named."""
    if not path.exists():
        return [str(path)]
    status = path.stat()
    return [str(path.resolve()), status.st_size, status.st_mtime_ns]


@lru_cache(maxsize=1)
def _code_sha256() -> str:
    digest = sha256()
    for path in sorted(PACKAGE.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()
