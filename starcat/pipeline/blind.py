"""The database for frames of an unknown camera, built once and kept.

It is made from the embedded sky. The name of its folder contains the version of starcat and a
digest of everything that the database depends on: any change builds it again.
"""

from __future__ import annotations

from functools import lru_cache
from hashlib import sha256
from pathlib import Path

from starcat.catalog.source_files import cache_folder, locate
from starcat.pipeline.build import build_database
from starcat.pipeline.starter import SOURCE, starter_spec
from starcat.progress import Progress, no_progress
from starcat.specs.build_spec import CameraSpec
from starcat.storage import file_sha256, json_bytes
from starcat.version import __version__

FIELDS_DEG = (8.0, 90.0)
"""Range of its fields of view, across the width."""

CAMERA = CameraSpec(width_px=1024, height_px=1024, fov_x_deg=FIELDS_DEG[0])

TESTED = 20
"""Number of frames of its self-test, which tests only the narrowest field."""


NAME = "blind"

PACKAGE = Path(__file__).parents[1]
"""The folder of starcat."""


def blind_folder(cache: Path | None = None) -> Path:
    """Return the folder that the database has, or will have; nothing is computed for its name.

    Without ``cache`` it is in the folder of downloads (``$STARCAT_CACHE``).
    """
    return (cache or cache_folder() / NAME) / f"{__version__}-{_digest()}" / f"{NAME}-1.0.0"


def blind_database(progress: Progress = no_progress, cache: Path | None = None) -> Path:
    """Return the folder of the database (`blind_folder`); build it at the first call."""
    made = blind_folder(cache)
    if not made.is_dir():
        spec = starter_spec(NAME, CAMERA, progress=progress, widest_fov_x_deg=FIELDS_DEG[1]).spec
        few = spec.self_test.model_copy(update={"frames": TESTED})
        made.parent.mkdir(parents=True, exist_ok=True)
        build_database(
            spec.model_copy(update={"self_test": few}), {}, made.parent, progress=progress
        )
    return made


def _digest() -> str:
    """Return a digest of the camera, of the embedded sky and of the code that builds."""
    sky = [file_sha256(path) for path in locate(SOURCE, {})]
    given = [CAMERA.model_dump(mode="json"), FIELDS_DEG, TESTED, sky, _code_sha256()]
    return sha256(json_bytes(given)).hexdigest()[:12]


@lru_cache(maxsize=1)
def _code_sha256() -> str:
    found = sha256()
    for path in sorted(PACKAGE.rglob("*.py")):
        found.update(path.read_bytes())
    return found.hexdigest()
