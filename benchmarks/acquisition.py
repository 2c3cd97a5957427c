"""Hard acquisition: many stars missing, as many false ones, and noise of 1 or 5 px.

    python benchmarks/acquisition.py [--frames 2000] [--camera-error 0.002] [--peers]
    python benchmarks/acquisition.py --sequences 500 [--camera-error 0.002]

Frames are of ``sao15``, the preset ``sao-12deg`` with a field of 15 deg. Magnitudes have a noise of
0.3. Each star is missing with a probability, and there are as many false spots as stars are missing
on average, with magnitudes that are drawn from the sky. Fu, Lin and Li 2025 (Sensors 25, 4201) use
such frames.

An answer is right as in ``judging.py``: no place of the frame is off by more than the tolerance and
five times the error that the noise of the named spots makes. A frame that has no answer is compared
with its true attitude: if an agreement with it is accepted, the search has missed the frame;
otherwise the bound on false matches, or the share of the frame, permits no answer. Times are
processor time of a call from Python, with the attitude and the star numbers read.

With ``--sequences`` only sequences of three frames, 1 s apart, are identified by a `Tracker`. The
camera turns at a constant rate of up to 0.8 deg/s, and the noise is stated. A sequence ends with
its first answer. A fourth of the sequences without a sky, of those that lose the sky after their
first frame, and of those with priors that are wrong by 3 deg where 1 deg is allowed, is made in
addition: none of them may have a wrong answer.

The lens of these frames is exactly the stated one. ``--camera-error`` states that it is calibrated.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from false_frames import Scene, Trial
from judging import judge_answer
from matcher import answers_of, count_answers, write_frames
from rows import Options, Rows, database, ended

from starcat.arrays import Matrix
from starcat.geometry.attitude import (
    Turn,
    after_turn,
    matrix_from_quaternion,
    quaternion_from_matrix,
    random_attitudes,
)
from starcat.matcher.c_engine import _neighbours, _onboard, c_engine
from starcat.matcher.database import MatcherDatabase
from starcat.matcher.matcher import Matcher
from starcat.matcher.observation import as_frame, observe
from starcat.matcher.pose import pose_at
from starcat.matcher.settings import CERTAIN, Settings
from starcat.matcher.tracking import Tracker
from starcat.matcher.verification import agree
from starcat.pipeline.simulation.simulate import Noise, SimulatedFrame, Sky, simulate_frame

NOISE_MAG = 0.3
SEED = 37
FIELD_DEG = "15"
MAX_MS = 50.0
PART_ALONE = 5
"""One in this many frames is also identified without votes, which takes long."""

FRAMES_OF_SEQUENCE = 3
MAX_TURN_DEG = 1.0
RATE_DEG = 0.8
WRONG_DEG = 3.0

PEERS = ("tetra3rs", "cedar-solve", "ruststartracker")


@dataclass(frozen=True)
class Kind:
    """The frames of one row, and its required results."""

    noise_px: float
    share: float  # share of missing stars, and of false spots
    rate: float  # least share of the frames with an answer, or with one that is permitted
    mean_ms: float

    @property
    def name(self) -> str:
        """What the row is called."""
        part = f"{100.0 * self.share:.0f}"
        return f"{self.noise_px:g} px, {part} % / {part} %"


KINDS = (
    Kind(1.0, 0.25, 0.999, 0.35), Kind(1.0, 0.5, 0.99, 1.0),
    Kind(5.0, 0.25, 0.99, 2.0), Kind(5.0, 0.5, 0.971, 5.0),
)  # fmt: skip


@dataclass
class Found:
    """What became of the frames of a row."""

    verdicts: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)  # why frames have no answer
    milliseconds: list[float] = field(default_factory=list)


def made_frames(stars: MatcherDatabase, kind: Kind, count: int) -> list[SimulatedFrame]:
    """Return the frames of a row."""
    generator = np.random.default_rng([SEED, KINDS.index(kind)])
    sky = sky_of(stars)
    attitudes = random_attitudes(count, generator)
    return [made_frame(stars, sky, kind, matrix, generator) for matrix in attitudes]


def sky_of(stars: MatcherDatabase) -> Sky:
    """Return the stars of a database as a sky."""
    mag = np.asarray(stars.mag, dtype=np.float64)
    return Sky(stars.directions, mag, np.arange(len(mag), dtype=np.int32))


def made_frame(
    stars: MatcherDatabase, sky: Sky, kind: Kind, matrix: Matrix, generator: np.random.Generator
) -> SimulatedFrame:
    """Return a frame of a row."""
    camera = stars.camera
    near = sky.zones.near(matrix[2], camera.radius_rad)
    inside = camera.contains(camera.pixels_from_directions(sky.directions[near] @ matrix.T))
    false = round(kind.share * int(inside.sum()))
    noise = Noise(kind.noise_px, kind.share, false, noise_mag=NOISE_MAG)
    return simulate_frame(sky, camera, matrix, noise, generator)


def try_sequences(
    database: Path, kind: Kind, what: str, count: int, calibrated: dict[str, float]
) -> Counter[str]:
    """Identify sequences of a row; return how they ended."""
    generator = np.random.default_rng([SEED, KINDS.index(kind), len(what)])
    stated = {"noise_px": kind.noise_px, "noise_mag": NOISE_MAG} | calibrated
    matcher = Matcher.open(database, **stated)
    stars, sky = matcher.database, sky_of(matcher.database)
    scene, ended = Scene(stars, stars, kind.noise_px), Counter[str]()
    for attitude in random_attitudes(count, generator):
        tracker, end = Tracker(matcher, max_turn_deg=MAX_TURN_DEG), "none"
        frames = made_sequence(stars, sky, kind, what, attitude, generator)
        for number, (frame, given) in enumerate(frames):
            found = tracker.identify(frame.centroids_px, mag=frame.mag, **given)
            truths = (frame.matrix,) if _has_sky(what, number) else ()
            trial = Trial(frame.centroids_px, frame.mag, truths, noise_px=kind.noise_px)
            verdict = judge_answer(found, trial, scene, matcher.settings.tolerance_px)
            if verdict is not None:
                route = "alone" if found.origin == "lost_in_space" else "confirmed"
                end = route if verdict == "right" else "wrong"
                break
        ended[end] += 1
    return ended


def made_sequence(
    stars: MatcherDatabase,
    sky: Sky,
    kind: Kind,
    what: str,
    attitude: Matrix,
    generator: np.random.Generator,
) -> list[tuple[SimulatedFrame, dict[str, Any]]]:
    """Return the frames of a sequence, and the prior of each.

    All are drawn, whatever the answers are, so that versions of starcat see the same frames.
    """
    rate, q = _turn(generator, RATE_DEG * generator.uniform()), quaternion_from_matrix(attitude)
    made, given = [], {}
    for number in range(FRAMES_OF_SEQUENCE):
        frame = made_frame(stars, sky, kind, matrix_from_quaternion(q), generator)
        if not _has_sky(what, number):
            size_px = np.array([stars.camera.width_px, stars.camera.height_px])
            places_px = generator.uniform(0.0, 1.0, frame.centroids_px.shape) * size_px
            frame = replace(frame, centroids_px=places_px)
        if what == "wrong prior":
            wrong = np.array(after_turn(q.tolist(), _turn(generator, WRONG_DEG)))
            given = {"prior": wrong, "prior_error_deg": MAX_TURN_DEG}
        made.append((frame, given))
        q = np.array(after_turn(q.tolist(), rate))
    return made


def _has_sky(what: str, number: int) -> bool:
    return what != "no sky" and (what != "sky lost" or number == 0)


def _turn(generator: np.random.Generator, angle_deg: float) -> Turn:
    x, y, z = generator.normal(size=3)
    scale = np.radians(angle_deg) / np.sqrt(x * x + y * y + z * z)
    return float(x * scale), float(y * scale), float(z * scale)


def print_sequences(database: Path, count: int, calibrated: dict[str, float], rows: Rows) -> None:
    """Print how sequences of three frames ended."""
    print(f"{'':31}  right  alone  confirmed  wrong  none")
    for what in ("sky", "no sky", "sky lost", "wrong prior"):
        for kind in KINDS:
            number = count if what == "sky" else max(1, count // 4)
            ended = try_sequences(database, kind, what, number, calibrated)
            right = 100.0 * (ended["alone"] + ended["confirmed"]) / number
            print(
                f"{what:12} {kind.name:17} {right:6.2f}% {ended['alone']:6}{ended['confirmed']:11}"
                f"{ended['wrong']:7}{ended['none']:6}",
                flush=True,
            )
            rows.expect(not ended["wrong"], f"{what}, {kind.name}: wrong answers")


def why_refused(stars: MatcherDatabase, settings: Settings, frame: SimulatedFrame) -> str:
    """Return why the true attitude is not accepted; "missed" if it would be accepted."""
    given = as_frame(frame.centroids_px, stars.camera, frame.mag)
    observation = observe(given, settings)
    found = agree(pose_at(frame.matrix, 1.0, observation), observation, stars, CERTAIN)
    if found.false_match_probability <= CERTAIN:
        return "missed"
    return found.withheld or "chance"


def solve(
    database: Path,
    kind: Kind,
    frames: list[SimulatedFrame],
    stated: dict[str, float],
    *,
    votes: bool = True,
) -> Found:
    """Identify the frames of a row."""
    matcher, found = Matcher.open(database, engine="c", **stated), Found()
    if not votes:
        matcher._c_engine.image.neighbours = _onboard.ffi.NULL
    matcher.identify(np.zeros((0, 2)))
    scene = Scene(matcher.database, matcher.database, kind.noise_px)
    for frame in frames:
        start = time.process_time()
        answer = matcher.identify(frame.centroids_px, mag=frame.mag)
        if answer.ok:
            _ = answer.q_body_from_icrs, answer.star_ids
        found.milliseconds.append(1e3 * (time.process_time() - start))
        trial = Trial(frame.centroids_px, frame.mag, (frame.matrix,), noise_px=kind.noise_px)
        verdict = judge_answer(answer, trial, scene, matcher.settings.tolerance_px)
        found.verdicts[verdict or "none"] += 1
        if verdict is None:
            settings = Settings(**stated)  # type: ignore[arg-type]
            found.refused[why_refused(matcher.database, settings, frame)] += 1
    return found


def print_table_of_neighbours(database: Path) -> None:
    """Print the size of the table that votes need, and the time that making it takes."""
    stars = Matcher.open(database, engine="c").database
    engine = c_engine(stars, "triangle")
    seconds = []
    for _ in range(5):
        start = time.process_time()
        made = _neighbours(engine.image, stars)
        seconds.append(time.process_time() - start)
    size = 4 * made[0].capacity
    print(f"neighbours of {len(stars.mag):,} stars: {size:,} bytes, {1e3 * min(seconds):.1f} ms")


def print_row(who: str, kind: Kind, found: Found, count: int) -> None:
    """Print what became of the frames of a row."""
    ms = np.array(found.milliseconds)
    right = found.verdicts["right"]
    wrong = sum(found.verdicts.values()) - right - found.verdicts["none"]
    missed, refused = found.refused["missed"], found.refused.total() - found.refused["missed"]
    part = f"{100.0 * right / count:6.2f} %"
    told = "" if not found.refused else f"{missed:7}{refused:9}"
    print(
        f"{who:16} {kind.name:17} {part}{wrong:6}{np.mean(ms):9.3f}{np.median(ms):9.3f}"
        f"{ms.max():8.1f}  {told}",
        flush=True,
    )


def ask_peers(stars: MatcherDatabase, made: dict[str, list[SimulatedFrame]], rows: Rows) -> None:
    """Print the rows of the peers, which see the same frames."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "frames.npz")
        write_frames(stars, made, path)
        for peer in PEERS:
            with rows.row(peer):
                answers = answers_of(peer, path)
                for kind in KINDS:
                    matrices = answers[f"{kind.name}_matrices"]
                    truth = np.array([frame.matrix for frame in made[kind.name]][: len(matrices)])
                    right, wrong, none = count_answers(matrices, truth)
                    found = Found(Counter(right=right, wrong=wrong, none=none))
                    found.milliseconds = (1e3 * answers[f"{kind.name}_seconds"]).tolist()
                    print_row(peer, kind, found, len(matrices))


def main(rows: Rows) -> None:
    """Print the table."""
    options = Options(__doc__)
    options.size("--frames", 2000, 20, "frames of each row")
    options.add_argument("--peers", action="store_true", help="ask other identifiers, too")
    options.add_argument("--sequences", type=int, help="only sequences, this many of each row")
    options.add_argument("--camera-error", type=float, help="stated error of a calibrated camera")
    asked = options.asked()
    calibrated = {} if asked.camera_error is None else {"camera_error": asked.camera_error}
    with tempfile.TemporaryDirectory() as scratch:
        changes = {"name": '"sao15"', "camera.fov_x_deg": FIELD_DEG}
        folder = database("sao-12deg", Path(scratch), changes).folder
        if asked.sequences:
            print_sequences(folder, asked.sequences, calibrated, rows)
            return
        stars = Matcher.open(folder).database
        made = {kind.name: made_frames(stars, kind, asked.frames) for kind in KINDS}
        print_table_of_neighbours(folder)
        print(f"{'':34}  right  wrong  mean ms   median     most   missed  refused")
        for kind in KINDS:
            few = made[kind.name][: max(20, asked.frames // PART_ALONE)]
            stated = {"noise_px": kind.noise_px, "noise_mag": NOISE_MAG} | calibrated
            print_row(
                "without votes", kind, solve(folder, kind, few, stated, votes=False), len(few)
            )
        for who in ("noise stated", "magnitudes", "nothing stated"):
            for kind in KINDS:
                stated = {"noise_px": kind.noise_px, "noise_mag": NOISE_MAG}
                if who != "noise stated":
                    stated = {"tolerance_px": 3.0 * kind.noise_px} if who == "magnitudes" else {}
                found = solve(folder, kind, made[kind.name], stated | calibrated)
                print_row(who, kind, found, asked.frames)
                wrong = found.verdicts.keys() - {"right", "none"}
                rows.expect(not wrong, f"{who}, {kind.name}: wrong answers")
                if who == "noise stated" and not asked.quick:
                    judge_row(kind, found, asked.frames, rows)
        if asked.peers:
            ask_peers(stars, made, rows)


def judge_row(kind: Kind, found: Found, count: int, rows: Rows) -> None:
    """Compare a row with its required results."""
    permitted = count - found.refused.total() + found.refused["missed"]
    least = min(kind.rate * count, permitted)
    ms = found.milliseconds
    rows.expect(found.verdicts["right"] >= least, f"{kind.name}: fewer than {least:.0f}")
    rows.expect(float(np.mean(ms)) <= kind.mean_ms, f"{kind.name}: mean above {kind.mean_ms} ms")
    rows.expect(max(ms) <= MAX_MS, f"{kind.name}: a frame above {MAX_MS} ms")


if __name__ == "__main__":
    sys.exit(ended(main))
