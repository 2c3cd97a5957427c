"""Identification rates of an onboard image in flight: the C library with its default limits.

The simulated frames show all stars of the database that the image was made from, so they also show
stars that the image does not have.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from types import MappingProxyType

import numpy as np
import scipy

from starcat.arrays import Directions
from starcat.database.onboard.flight_limits import FLIGHT_CENTROIDS, FLIGHT_STARS, FLIGHT_STEPS
from starcat.database.onboard.image import Contents, make_image
from starcat.geometry.attitude import quaternion_from_matrix, turn_between
from starcat.geometry.camera import Camera
from starcat.geometry.footprint import Footprint
from starcat.matcher.c_engine import CEngine, is_compiled
from starcat.matcher.database import MatcherDatabase
from starcat.matcher.settings import CERTAIN, TOLERANCE_PX
from starcat.pipeline.simulation.selftest import HARD
from starcat.pipeline.simulation.simulate import Noise, SimulatedFrame, simulate_frames

NOISE_PX = 0.5

KINDS: Mapping[str, Noise] = MappingProxyType(
    {"clean": Noise(NOISE_PX), "hard": Noise(NOISE_PX, noise_mag=0.3, **HARD)}  # type: ignore[arg-type]
)

FRAMES = 200
"""Number of frames of each kind with which an image is tested when it is written."""

SEED = 86_028_121

MAX_ERROR_DEG = 0.5
"""An attitude with a larger error is wrong. A fit to a few stars near each other turns by 0.1."""


@dataclass(frozen=True)
class FlightRates:
    """Results of simulated frames of one kind with an onboard image."""

    kind: str  # ``clean`` or ``hard``
    votes: bool  # true if the library had the table of neighbours
    frames: int
    identified: int  # frames that were identified correctly
    wrong: int  # answered with a wrong attitude
    mean_steps: int
    most_steps: int


def flight_rates(
    contents: Contents,
    sky: Contents,
    frames: int = FRAMES,
    kinds: Mapping[str, Noise] = KINDS,
    part: Footprint | None = None,
) -> tuple[FlightRates, ...]:
    """Return what an image identifies: for each kind of frames, without and with votes.

    Parameters
    ----------
    contents : Contents
        What the image is made of.
    sky : Contents
        The database, whose stars the frames show.
    frames : int
        Frames of each kind, at random attitudes.
    kinds : mapping of str to Noise
        The noise of each kind of frames.
    part : Footprint, optional
        Part of the sphere that the database is for; default: all of it.

    Returns
    -------
    tuple of FlightRates
        Empty if the C library is not compiled, or if it refuses the image in flight. Rates with
        votes are left out if the neighbours are too many for a table.
    """
    image = make_image(contents, sys.byteorder)
    if not is_compiled() or image.most_near > FLIGHT_STARS:
        return ()
    of_sky = sky.camera  # an image does not contain the distortion of the lens
    camera = Camera(of_sky.width_px, of_sky.height_px, of_sky.focal_length_px)
    database = MatcherDatabase(
        contents.name,
        camera,
        contents.epoch_jyear,
        contents.star_id,
        contents.directions,
        contents.mag,
        np.full(len(contents.star_id), b""),
    )
    engine = CEngine(database, image.data)
    table, rates = engine.image.neighbours, []
    simulated = {
        kind: list(simulate_frames(sky.directions, camera, frames, noise, SEED, sky.mag, part))
        for kind, noise in kinds.items()
    }
    null = import_module("starcat.matcher._onboard").ffi.NULL
    for votes in (False, True) if table != null else (False,):
        engine.image.neighbours = table if votes else null
        rates += [_rates(kind, engine, some, votes=votes) for kind, some in simulated.items()]
    return tuple(rates)


def voting_bytes(directions: Directions, radius_rad: float) -> int:
    """Return the memory of the table of neighbours, which votes need.

    Parameters
    ----------
    directions : ndarray of float64, shape (N, 3)
        Unit vectors of the stars of the image.
    radius_rad : float
        Largest separation of neighbours, half of the field's diagonal.

    Returns
    -------
    int
        4 bytes for each neighbour of each star, and 4 for each star and one more.
    """
    if not len(directions):
        return 4
    tree = scipy.spatial.cKDTree(directions)
    chord = 2.0 * math.sin(0.5 * min(radius_rad, math.pi))
    return int(4 * tree.count_neighbors(tree, chord)) + 4  # each star counts as its own neighbour


def _rates(
    kind: str, engine: CEngine, frames: Sequence[SimulatedFrame], *, votes: bool
) -> FlightRates:
    """Let the library identify frames with the options that it has in flight."""
    module = import_module("starcat.matcher._onboard")
    ffi, lib = module.ffi, module.lib
    camera = engine.database.camera
    lens = [camera.width_px, camera.height_px, camera.focal_length_px]
    centre = [0.5 * camera.width_px, 0.5 * camera.height_px]
    fields = [
        engine.image,
        ffi.new("starcat_camera *", [*lens, *centre, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]),
        ffi.new(
            "starcat_options *",
            {
                "tolerance_px": TOLERANCE_PX,
                "log_chance": math.log(CERTAIN),
                "max_steps": FLIGHT_STEPS,
            },
        ),
        engine.rows,
    ]
    search, memory = ffi.new("starcat_search *", fields), ffi.new("starcat_memory *")
    right, wrong, steps = 0, 0, []
    for frame in frames:
        brightest = np.argsort(frame.mag, kind="stable")[:FLIGHT_CENTROIDS]
        px, mag = frame.centroids_px[brightest], frame.mag[brightest]
        status = lib.starcat_identify_one(
            search, len(px), px.tobytes(), mag.tobytes(), ffi.NULL, ffi.NULL, 0.0, memory
        )
        steps.append(int(memory.answer.steps))
        if status == lib.STARCAT_IDENTIFIED:
            truth = quaternion_from_matrix(frame.matrix).tolist()
            turn = turn_between(truth, list(memory.answer.q_body_from_icrs))
            is_right = math.hypot(*turn) <= math.radians(MAX_ERROR_DEG)
            right, wrong = right + is_right, wrong + (not is_right)
    mean = round(sum(steps) / max(1, len(steps)))
    return FlightRates(kind, votes, len(frames), right, wrong, mean, max(steps, default=0))
