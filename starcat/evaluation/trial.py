"""Trials: many frames of one kind, identified in one way, written down frame by frame.

A trial is fully described by its fields, and so is its result: a Parquet file that carries
them. A trial whose file is there already is not run again.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, Literal, get_type_hints

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from starcat.evaluation.answers import ANSWERS
from starcat.evaluation.catalog_sky import sky_of_artifact
from starcat.evaluation.judge import Verdict, judge
from starcat.geometry.attitude import matrix_from_quaternion, matrix_from_radec_roll
from starcat.geometry.camera import Camera
from starcat.matcher.c_engine import library_version
from starcat.matcher.matcher import Matcher
from starcat.matcher.settings import MIN_SHARE, REACH, TriangleOrder
from starcat.progress import Progress, no_progress
from starcat.simulation.simulate import Noise, simulate_frame
from starcat.simulation.sky import Sky
from starcat.storage.atomic import whole_file

_TYPES = {int: pa.int64(), float: pa.float64(), bool: pa.bool_(), str: pa.string()}

AT_ONCE = 250
"""Frames of one task of a process."""

MEASURED_ROOMS = ("geometry", "matcher", "simulation", "evaluation")
"""The rooms whose code decides what a trial finds."""


@dataclass(frozen=True)
class Attitudes:
    """Where a trial looks.

    Attributes
    ----------
    kind : {"random", "grid", "stars"}
        ``random``: uniform over all rotations. ``grid``: boresights in the middle of cells of
        ``step_deg`` in right ascension and declination. ``stars``: boresights at guide stars
        drawn at random.
    count : int
        Number of frames; 0 for the whole grid. Of a grid, so many are drawn, in order.
    step_deg : float
        Step of the grid.
    roll_deg : float or None
        Roll of ``grid`` and ``stars``; None draws it at random.
    """

    kind: str = "random"
    count: int = 1000
    step_deg: float = 2.0
    roll_deg: float | None = None


@dataclass(frozen=True)
class Trial:
    """Many frames of one kind, and how they are identified.

    Attributes
    ----------
    name : str
        Name of the file of results.
    method : str
        Name of the matcher's method.
    attitudes : Attitudes
        The attitudes of the camera.
    noise : Noise
        What the frames suffer.
    camera : Camera, optional
        The camera as it is; default: the database's.
    assumed : Camera, optional
        What the matcher is told; default: the same.
    tolerance_px : float
        Tolerance of the matcher.
    max_false_match_probability : float
        The least certain answer that is recorded; 1e-9 is what starcat itself accepts.
    with_magnitudes : bool
        Whether the matcher is given magnitudes.
    answer : str
        Key of `ANSWERS`: the matcher as it is, or a paper's method without verification.
    selection : TriangleOrder
        Order in which the matcher takes triangles.
    guide_stars_only : bool
        Whether nothing but guide stars shines.
    min_share : float
        Smallest share of the frame that an answer explains, as the matcher is told.
    engine : {"numpy", "auto"}
        ``numpy``, whose records are the same everywhere, or the C library where it is installed.
    seed : int
        Seed of all that is random. Each frame has its own, so that their number changes none.
    """

    name: str
    method: str
    attitudes: Attitudes = field(default_factory=Attitudes)
    noise: Noise = field(default_factory=Noise)
    camera: Camera | None = None
    assumed: Camera | None = None
    tolerance_px: float = 2.0
    max_false_match_probability: float = 1e-9
    with_magnitudes: bool = True
    answer: str = "matcher"
    selection: TriangleOrder = field(default_factory=TriangleOrder)
    guide_stars_only: bool = False
    min_share: float = MIN_SHARE
    engine: Literal["numpy", "auto"] = "numpy"
    seed: int = 1

    @property
    def attitude_limit_px(self) -> float:
        """A right attitude moves no corner of the frame by more: twice the matcher's reach.

        A few stars in one corner of the frame, all of them right, leave the opposite corner
        that uncertain; a false match is off by hundreds of pixels.
        """
        return 2.0 * REACH * self.tolerance_px


def run_trial(
    trial: Trial,
    artifact: Path,
    folder: Path,
    *,
    workers: int = 2,
    progress: Progress = no_progress,
) -> Path:
    """Run a trial, unless its result is there."""
    path = folder / f"{trial.name}.parquet"
    facts = description(trial, artifact)
    if path.is_file() and pq.read_schema(path).metadata.get(b"starcat_trial") == facts:
        return path
    count = frame_count(trial)
    starts = range(0, count, AT_ONCE)
    tasks = [(trial, artifact, first, min(first + AT_ONCE, count)) for first in starts]
    verdicts: list[Verdict] = []
    for part in _mapped(tasks, workers):
        verdicts.extend(part)
        progress(trial.name, len(verdicts), count)
    # Without an attitude its errors are NaN, which a query would take for a number.
    columns = {
        name: pa.array(
            [getattr(verdict, name) for verdict in verdicts], _TYPES[kind], from_pandas=True
        )
        for name, kind in get_type_hints(Verdict).items()
    }
    table = pa.table(columns).replace_schema_metadata({b"starcat_trial": facts})
    with whole_file(path) as partial:
        pq.write_table(table, partial, compression="zstd")
    return path


def description(trial: Trial, artifact: Path) -> bytes:
    """Return all that a trial's result depends on."""
    manifest = (artifact / "manifest.json").read_bytes()
    facts = {**asdict(trial), "artifact": artifact.name, "code_sha256": code_sha256()}
    facts["manifest_sha256"] = hashlib.sha256(manifest).hexdigest()
    if trial.engine == "auto":
        facts["c_library"] = library_version()
    return json.dumps(facts, sort_keys=True, default=str).encode()


@cache
def code_sha256() -> str:
    """Return the digest of the code that simulates, identifies and judges."""
    package = Path(__file__).parents[1]
    paths = [path for room in MEASURED_ROOMS for path in (package / room).rglob("*.py")]
    digest = hashlib.sha256()
    for path in sorted(paths):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def frame_count(trial: Trial) -> int:
    """Return how many frames a trial has."""
    wanted = trial.attitudes
    if wanted.kind != "grid":
        return wanted.count
    whole = round(360.0 / wanted.step_deg) * round(180.0 / wanted.step_deg)
    return min(whole, wanted.count) if wanted.count else whole


def _mapped(tasks: list[tuple[Trial, Path, int, int]], workers: int) -> Iterator[list[Verdict]]:
    if workers == 1 or len(tasks) == 1:
        yield from map(_run_part, tasks)
        return
    with ProcessPoolExecutor(workers) as pool:
        yield from pool.map(_run_part, tasks)


def _run_part(task: tuple[Trial, Path, int, int]) -> list[Verdict]:
    """Identify some frames of a trial: the work of one process."""
    trial, artifact, first, last = task
    matcher, sky = _opened(artifact, trial)
    camera = trial.camera or matcher.database.camera
    assumed = trial.assumed or camera
    answer: Callable[..., Any] = ANSWERS[trial.answer]
    verdicts = []
    for number in range(first, last):
        generator = np.random.default_rng([trial.seed, number])
        matrix = attitude_of(trial, number, matcher.database.directions, generator)
        frame = simulate_frame(sky, camera, matrix, trial.noise, generator)
        mag = frame.mag if trial.with_magnitudes else None
        begun = time.process_time()
        result = answer(matcher, frame.centroids_px, assumed, mag)
        time_ms = 1000.0 * (time.process_time() - begun)
        reach_px = REACH * trial.tolerance_px
        verdicts.append(judge(number, frame, result, matcher.database, camera, reach_px, time_ms))
    return verdicts


@lru_cache(maxsize=4)
def _opened(artifact: Path, trial: Trial) -> tuple[Matcher, Sky]:
    matcher = Matcher.open(
        artifact,
        trial.method,
        tolerance_px=trial.tolerance_px,
        max_false_match_probability=trial.max_false_match_probability,
        selection=trial.selection,
        min_share=trial.min_share,
        engine=trial.engine,
    )
    # Stars that noise may lift over the limit belong to the sky.
    sky = _whole_sky(artifact).brighter(trial.noise.limit_mag + 6.0 * trial.noise.noise_mag)
    if trial.guide_stars_only:
        guides = sky.star_index >= 0
        sky = Sky(sky.directions[guides], sky.mag[guides], sky.star_index[guides])
    return matcher, sky


@lru_cache(maxsize=4)
def _whole_sky(artifact: Path) -> Sky:
    return sky_of_artifact(artifact)


def attitude_of(
    trial: Trial,
    number: int,
    guide_stars: NDArray[np.float64],
    generator: np.random.Generator,
) -> NDArray[np.float64]:
    """Return the attitude of one frame of a trial."""
    wanted = trial.attitudes
    if wanted.kind == "random":
        return matrix_from_quaternion(generator.normal(size=4))
    roll_deg = generator.uniform(0.0, 360.0) if wanted.roll_deg is None else wanted.roll_deg
    if wanted.kind == "stars":
        x, y, z = guide_stars[generator.integers(len(guide_stars))]
        ra_deg, dec_deg = np.degrees([np.arctan2(y, x), np.arcsin(z)])
        return matrix_from_radec_roll(float(ra_deg), float(dec_deg), float(roll_deg))
    columns = round(360.0 / wanted.step_deg)
    whole = columns * round(180.0 / wanted.step_deg)
    cell = number * whole // frame_count(trial)
    row, column = divmod(cell, columns)
    ra_deg, dec_deg = column * wanted.step_deg, -90.0 + (row + 0.5) * wanted.step_deg
    return matrix_from_radec_roll(ra_deg, dec_deg, float(roll_deg))
