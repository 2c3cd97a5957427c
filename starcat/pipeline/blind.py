"""The database that frames of an unknown camera are identified with, built once and kept.

It is made of the embedded sky, in a folder named by the version of starcat and by the digest of
its spec: any change of either builds it again.
"""

from __future__ import annotations

from hashlib import sha256
from pathlib import Path

from starcat.catalog.source_files import cache_folder
from starcat.pipeline.build import build_database
from starcat.pipeline.starter import starter_spec
from starcat.progress import Progress, no_progress
from starcat.specs.build_spec import BuildSpec, CameraSpec
from starcat.version import __version__

FIELDS_DEG = (8.0, 90.0)
"""Fields of view that it serves, across the width."""

CAMERA = CameraSpec(width_px=1024, height_px=1024, fov_x_deg=FIELDS_DEG[0])

TESTED = 20
"""Frames of its self-test, which is of the narrowest field alone."""


def blind_database(progress: Progress = no_progress, cache: Path | None = None) -> Path:
    """Return the folder of the database, which is built the first time.

    Without ``cache`` it is kept in the folder of downloads (``$STARCAT_CACHE``).
    """
    spec = starter_spec("blind", CAMERA, progress=progress, widest_fov_x_deg=FIELDS_DEG[1]).spec
    few = spec.self_test.model_copy(update={"frames": TESTED})
    spec = spec.model_copy(update={"self_test": few})
    folder = (cache or cache_folder() / "blind") / f"{__version__}-{_digest(spec)}"
    made = folder / f"{spec.name}-{spec.version}"
    if not made.is_dir():
        folder.mkdir(parents=True, exist_ok=True)
        build_database(spec, {}, folder, progress=progress)
    return made


def _digest(spec: BuildSpec) -> str:
    return sha256(spec.model_dump_json().encode()).hexdigest()[:12]
