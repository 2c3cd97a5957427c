"""Frames that the camera of a database would take, to try an identification with."""

from __future__ import annotations

from pathlib import Path

from starcat.geometry.camera import Camera
from starcat.images.render import write_simulated
from starcat.matcher.database import open_database
from starcat.service.library import Database
from starcat.simulation.simulate import Noise, simulate_frames
from starcat.specs.build_spec import CameraSpec

MAX_PIXELS = 2**23
"""Frames with more are given as centroids, not as pictures."""

NOISE_PX = 0.3
"""Noise of a centroid, each axis."""


def camera_of(database: Database) -> Camera:
    """Return the camera that a database is for."""
    return CameraSpec.model_validate(database.manifest["spec"]["camera"]).camera()


def frame_suffix(database: Database) -> str:
    """Return the suffix of the file of a simulated frame: a picture unless it were too large."""
    camera = camera_of(database)
    return ".png" if camera.width_px * camera.height_px <= MAX_PIXELS else ".csv"


def write_frame(path: Path, database: Database, seed: int) -> None:
    """Write a simulated frame."""
    stars = open_database(database.folder, ())
    frame = next(
        simulate_frames(stars.directions, stars.camera, 1, Noise(NOISE_PX), seed, mag=stars.mag)
    )
    write_simulated(path, frame, stars.camera, seed)
