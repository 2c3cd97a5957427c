"""Experiments: many frames of one kind, identified in one way, recorded frame by frame.

A paper's rows name the experiments that measure the same as the paper.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, Literal, get_type_hints

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

import starcat
from starcat.catalog.stars import NO_STARS, floats_of
from starcat.database import open_database_folder
from starcat.geometry import (
    Camera,
    Footprint,
    directions_from_radec,
    matrix_from_quaternion,
    matrix_from_radec_roll,
    pairs_within,
    radec_from_directions,
)
from starcat.matcher import REACH, Matcher, TriangleOrder, library_version, open_database
from starcat.pipeline.simulation import Noise, Sky, part_of_database, simulate_frame
from starcat.results import entry
from starcat.storage import whole_file
from starcat_lab.bare_methods import ANSWERS
from starcat_lab.score import Score, score

_TYPES = {int: pa.int64(), float: pa.float64(), bool: pa.bool_(), str: pa.string()}

MEASURED_ROOMS = ("geometry", "matcher", "simulation")
"""Subpackages of starcat that affect the results of an experiment, besides this package."""


@dataclass(frozen=True)
class Attitudes:
    """The attitudes of the frames of an experiment."""

    # "random", "grid", "stars": ``random``: uniform over all rotations. ``grid``: boresights in
    # the middle of cells of ``step_deg`` in right ascension and declination. ``stars``:
    # boresights at guide stars drawn at random
    kind: str = "random"
    # number of frames; 0 for the whole grid. Of a grid, this many cells are drawn, in order
    count: int = 1000
    step_deg: float = 2.0  # step of the grid
    roll_deg: float | None = None  # roll of ``grid`` and ``stars``; None draws it at random


@dataclass(frozen=True)
class Experiment:
    """Many frames of one kind, and how they are identified."""

    name: str  # name of the file of results
    method: str  # name of the matcher's method
    attitudes: Attitudes = field(default_factory=Attitudes)  # the attitudes of the camera
    noise: Noise = field(default_factory=Noise)  # noise of the frames
    camera: Camera | None = None  # the true camera; default: the database's
    assumed: Camera | None = None  # the camera that the matcher assumes; default: the same
    tolerance_px: float = 2.0  # tolerance of the matcher
    # the least certain answer that is recorded; starcat itself accepts answers up to 1e-9
    max_false_match_probability: float = 1e-9
    with_magnitudes: bool = True  # whether the matcher gets magnitudes
    # key of `ANSWERS`: the real matcher, or a paper's method without verification
    answer: str = "matcher"
    # order in which the matcher takes triangles
    selection: TriangleOrder = field(default_factory=TriangleOrder)
    guide_stars_only: bool = False  # whether frames contain only guide stars
    # ``numpy``, whose records are the same everywhere, or the C library if it is installed
    engine: Literal["numpy", "auto"] = "numpy"
    # seed of all random numbers. Each frame has its own: their number changes no frame
    seed: int = 1

    @property
    def attitude_limit_px(self) -> float:
        """Largest displacement of a corner by a right attitude: twice the matcher's reach.

        A few stars in one corner of the frame, all of them right, leave the opposite corner
        that uncertain; a false match is off by hundreds of pixels.
        """
        return 2.0 * REACH * self.tolerance_px


def run_experiment(experiment: Experiment, database: Path, folder: Path) -> Path:
    """Run an experiment, unless its result exists."""
    path = folder / f"{experiment.name}.parquet"
    facts = description(experiment, database)
    if path.is_file() and pq.read_schema(path).metadata.get(b"starcat_trial") == facts:
        return path
    scores = score_frames(experiment, database)
    # Without an attitude its errors are NaN, which a query would take for a number.
    columns = {
        name: pa.array(
            [getattr(frame_score, name) for frame_score in scores], _TYPES[kind], from_pandas=True
        )
        for name, kind in get_type_hints(Score).items()
    }
    table = pa.table(columns).replace_schema_metadata({b"starcat_trial": facts})
    with whole_file(path) as partial:
        pq.write_table(table, partial, compression="zstd")
    return path


def description(experiment: Experiment, database: Path) -> bytes:
    """Return everything that an experiment's result depends on."""
    manifest = (database / "manifest.json").read_bytes()
    facts = {**asdict(experiment), "artifact": database.name, "code_sha256": code_sha256()}
    facts["manifest_sha256"] = hashlib.sha256(manifest).hexdigest()
    if experiment.engine == "auto":
        facts["c_library"] = library_version()
    return json.dumps(facts, sort_keys=True, default=str).encode()


@cache
def code_sha256() -> str:
    """Return the digest of the code that simulates, identifies and judges."""
    package = Path(starcat.__file__).parent
    folders = [Path(__file__).parent, *(package / room for room in MEASURED_ROOMS)]
    paths = [path for folder in folders for path in folder.rglob("*.py")]
    digest = hashlib.sha256()
    for path in sorted(paths):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def frame_count(experiment: Experiment) -> int:
    """Return the number of frames of an experiment."""
    attitudes = experiment.attitudes
    if attitudes.kind != "grid":
        return attitudes.count
    whole = round(360.0 / attitudes.step_deg) * round(180.0 / attitudes.step_deg)
    return min(whole, attitudes.count) if attitudes.count else whole


def score_frames(experiment: Experiment, database: Path) -> list[Score]:
    """Simulate, identify and score the frames of an experiment."""
    matcher, sky = _opened(database, experiment)
    camera = experiment.camera or matcher.database.camera
    assumed = experiment.assumed or camera
    answer: Callable[..., Any] = ANSWERS[experiment.answer]
    scores, stars = [], matcher.database.directions
    part = part_of_database(matcher.database.folder)
    for number in range(frame_count(experiment)):
        generator = np.random.default_rng([experiment.seed, number])
        matrix = attitude_of(experiment, number, stars, generator, part)
        frame = simulate_frame(sky, camera, matrix, experiment.noise, generator)
        mag = frame.mag if experiment.with_magnitudes else None
        begun = time.process_time()
        result = answer(matcher, frame.centroids_px, assumed, mag)
        time_ms = 1000.0 * (time.process_time() - begun)
        reach_px = REACH * experiment.tolerance_px
        scores.append(score(number, frame, result, matcher.database, camera, reach_px, time_ms))
    return scores


@lru_cache(maxsize=4)
def _opened(database: Path, experiment: Experiment) -> tuple[Matcher, Sky]:
    matcher = Matcher.open(
        database,
        experiment.method,
        tolerance_px=experiment.tolerance_px,
        max_false_match_probability=experiment.max_false_match_probability,
        selection=experiment.selection,
        engine=experiment.engine,
    )
    # Stars below the limit that noise can make brighter than it belong to the sky.
    sky = _whole_sky(database).brighter(
        experiment.noise.limit_mag + 6.0 * experiment.noise.noise_mag
    )
    if experiment.guide_stars_only:
        guides = sky.star_index >= 0
        sky = Sky(sky.directions[guides], sky.mag[guides], sky.star_index[guides])
    return matcher, sky


@lru_cache(maxsize=4)
def _whole_sky(database: Path) -> Sky:
    return sky_of_database(database)


def attitude_of(
    experiment: Experiment,
    number: int,
    guide_stars: NDArray[np.float64],
    generator: np.random.Generator,
    part: Footprint | None = None,
) -> NDArray[np.float64]:
    """Return the attitude of one frame of an experiment.

    Random boresights are in the part of the sphere that the database is for.
    """
    attitudes = experiment.attitudes
    if attitudes.kind == "random" and part is None:
        return matrix_from_quaternion(generator.normal(size=4))
    roll_deg = generator.uniform(0.0, 360.0) if attitudes.roll_deg is None else attitudes.roll_deg
    if attitudes.kind == "random" and part is not None:
        [ra_deg], [dec_deg] = radec_from_directions(part.random_directions(1, generator))
        return matrix_from_radec_roll(float(ra_deg), float(dec_deg), float(roll_deg))
    if attitudes.kind == "stars":
        x, y, z = guide_stars[generator.integers(len(guide_stars))]
        ra_deg, dec_deg = np.degrees([np.arctan2(y, x), np.arcsin(z)])
        return matrix_from_radec_roll(float(ra_deg), float(dec_deg), float(roll_deg))
    columns = round(360.0 / attitudes.step_deg)
    whole = columns * round(180.0 / attitudes.step_deg)
    cell = number * whole // frame_count(experiment)
    row, column = divmod(cell, columns)
    ra_deg, dec_deg = column * attitudes.step_deg, -90.0 + (row + 0.5) * attitudes.step_deg
    return matrix_from_radec_roll(ra_deg, dec_deg, float(roll_deg))


def sky_of_database(folder: Path) -> Sky:
    """Return the whole catalog of a database, blended as in a camera."""
    doubles = open_database_folder(folder).manifest["spec"]["selection"]["doubles"]
    return blend(catalog_of_database(folder), float(np.radians(doubles["min_separation_deg"])))


def catalog_of_database(folder: Path) -> Sky:
    """Return the whole catalog of a database: its guide stars and the stars that were rejected."""
    database = open_database_folder(folder)
    stars, rejected = database.table("stars"), database.table("rejected")
    # A merged star's companion is in the guide star already.
    elsewhere = pa.array(["merged", *(reason.name for reason in NO_STARS)])
    is_known = pc.and_(pc.is_valid(rejected["ra_deg"]), pc.is_valid(rejected["mag"]))
    is_star = pc.and_not(is_known, pc.is_in(rejected["reason"], elsewhere))
    tables = (stars, rejected.filter(is_star))
    ra_deg, dec_deg, mag = (
        np.concatenate([floats_of(table, name) for table in tables])
        for name in ("ra_deg", "dec_deg", "mag")
    )
    index = np.full(len(mag), -1, dtype=np.int32)
    index[: len(stars)] = np.arange(len(stars))
    star_id = np.concatenate([table["star_id"].to_numpy() for table in tables])
    order = np.argsort(star_id, kind="stable")
    u = directions_from_radec(ra_deg, dec_deg)
    return Sky(u[order], mag[order], index[order])


def blend(sky: Sky, limit_rad: float) -> Sky:
    """Join points closer than a limit, in the order of each group's brightest member."""
    pairs, apart = pairs_within(sky.directions, limit_rad)
    i, j = pairs[apart < limit_rad].T
    count = len(sky)
    graph = coo_array((np.ones(len(i)), (i, j)), shape=(count, count))
    groups, label = connected_components(graph, directed=False)
    brightest = np.lexsort((np.arange(count), sky.mag))
    leader = np.empty(groups, dtype=np.int64)
    leader[label[brightest[::-1]]] = brightest[::-1]
    light = 10.0 ** (-0.4 * sky.mag)
    total = np.bincount(label, light, groups)
    centre = np.stack([np.bincount(label, light * u, groups) for u in sky.directions.T], axis=-1)
    alone = np.bincount(label, minlength=groups)[label[leader]] == 1
    order = np.argsort(leader)
    leader, alone = leader[order], alone[order]
    directions, mag = sky.directions[leader].copy(), sky.mag[leader].copy()
    joined = order[~alone]
    directions[~alone] = centre[joined] / np.linalg.norm(centre[joined], axis=1)[:, None]
    mag[~alone] = -2.5 * np.log10(total[joined])
    return Sky(directions, mag, sky.star_index[leader])


@dataclass(frozen=True)
class ExperimentRow:
    """One line of a paper's table or one point of its curves."""

    group: str  # title of the table or curve
    label: str  # name of the line
    preset: str  # the database that is used, by its preset
    # the frames and the method; results.json has called it a trial since its first version
    experiment: Experiment = field(metadata=entry(key="trial"))
    rule: str  # the paper's rule of success: a key of `RULES`
    published_percent: float | None = None  # success rate that the paper prints
    published_ms: float | None = None
    goal_percent: float | None = None  # starcat's goal
    goal_ms: float | None = None  # starcat's goal for the mean time
    # Whether the goal counts all frames or only frames with at least four guide stars
    goal_over: Literal["all", "4+"] = "all"
    x: float | None = None  # abscissa, if the group is a curve
    note: str = ""  # differences from the paper


@dataclass(frozen=True)
class Statistic:
    """A number that needs no experiment, such as a count of triangles or bytes."""

    group: str  # title of the table, and name of the line
    label: str
    measured: float  # the number that starcat measures
    unit: str = ""  # unit of the numbers; empty for counts
    # the number that the paper prints, and starcat's goal
    published: float | None = None
    goal: float | None = None
    # whether the goal is an upper limit; None if it must be met within 1 percent
    is_lower_better: bool | None = None
    note: str = ""  # differences from the paper


@dataclass(frozen=True)
class Paper:
    """A paper and everything that is reproduced of it."""

    name: str  # ``S1`` to ``S5``
    title: str  # its subject; authors, journal, year
    citation: str
    presets: tuple[str, ...]  # databases that it needs
    rows: Callable[[bool], list[ExperimentRow]] = (
        lambda quick: []
    )  # for a quick run (True) with fewer frames
    # made from the databases' folders, by preset
    statistics: Callable[[dict[str, Path], bool], list[Statistic]] = lambda databases, quick: []
    deviations: tuple[str, ...] = ()  # choices that the paper does not state


def tolerance_for(noise_px: float) -> float:
    """Return the matcher's tolerance for a position noise."""
    return max(1.0, 3.0 * noise_px)


def paper_experiment(
    name: str, method: str, attitudes: Attitudes, noise: Noise, **others: Any
) -> Experiment:
    """Return an experiment of a paper, which accepts less certain answers than starcat."""
    usual = {"tolerance_px": tolerance_for(noise.noise_px), "max_false_match_probability": 1e-3}
    slug = name.lower().replace(" ", "-").replace(",", "")
    return Experiment(slug, method, attitudes, noise, **{**usual, **others})


def product_mib(database: Path, product: str) -> float:
    """Return the size of a product in the database."""
    arrays = open_database(database, (product,)).products[product].arrays
    return sum(values.nbytes for values in arrays.values()) / 2**20
