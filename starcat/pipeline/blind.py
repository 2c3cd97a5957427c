"""The database for frames of an unknown camera, built once and kept.

It is made from the embedded sky. The name of its folder contains the version of starcat and the
digest of its spec: any change builds it again.
"""

from __future__ import annotations

from hashlib import sha256
from pathlib import Path

from starcat.pipeline.build import build_database
from starcat.pipeline.starter import starter_spec
from starcat.progress import Progress, no_progress
from starcat.specs.build_spec import BuildSpec, CameraSpec
from starcat.storage.cache import cache_folder
from starcat.version import __version__

FIELDS_DEG = (8.0, 90.0)
"""Range of its fields of view, across the width."""

CAMERA = CameraSpec(width_px=1024, height_px=1024, fov_x_deg=FIELDS_DEG[0])

TESTED = 20
"""Number of frames of its self-test, which tests only the narrowest field."""


def blind_database(progress: Progress = no_progress, cache: Path | None = None) -> Path:
    """Return the folder of the database; build it at the first call.

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
