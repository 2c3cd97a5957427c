"""Sessions of the C library that acquire over several frames, compared with a `Tracker`."""

from __future__ import annotations

import math
import subprocess
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from compilers import c_compiler
from frames import needs_c
from slew import steady_turn

from starcat.geometry.attitude import matrix_from_quaternion
from starcat.matcher.c_engine import _onboard
from starcat.matcher.matcher import Matcher
from starcat.matcher.tracking import Tracker
from starcat.pipeline.simulation.simulate import Noise, SimulatedFrame

ONBOARD = Path(__file__).parents[2] / "onboard"
WEAK = Noise(4.0, drop_probability=0.5, false_stars=4, noise_mag=0.3)
STATED = {"noise_px": 4.0, "noise_mag": 0.3}
ERROR_DEG = 1.0
FRAMES_OF_SEQUENCE = 3
CONFIRMED = 3
"""``STARCAT_MODE_CONFIRM`` of ``starcat_session.h``."""


class Answer(NamedTuple):
    """The answer of a session to a frame."""

    status: int
    mode: int
    log_chance: float
    n_matched: int
    q_body_from_icrs: np.ndarray


def answer_sequences(
    program: Path,
    image: Path,
    sequences: Sequence[Sequence[SimulatedFrame]],
    stated: dict[str, float],
) -> list[list[Answer]]:
    """Return the answers of sessions of the C library."""
    lines = []
    for frames in sequences:
        for number, frame in enumerate(frames):
            lines.append(f"{len(frame.centroids_px)} {int(number == 0)}")
            spots = np.column_stack([frame.centroids_px, frame.mag])
            lines += [" ".join(map(repr, spot)) for spot in spots.tolist()]
    text = image.with_suffix(".txt")
    text.write_text("\n".join(lines) + "\n")
    numbers = stated["noise_px"], stated["noise_mag"], math.radians(ERROR_DEG)
    command = [program, image, text, *map(repr, numbers)]
    ran = subprocess.run(command, capture_output=True, text=True, check=True)
    answers = [
        Answer(int(row[0]), int(row[1]), row[2], int(row[3]), row[5:])
        for row in (np.array(line.split(), dtype=np.float64) for line in ran.stdout.splitlines())
    ]
    ends = np.cumsum([len(frames) for frames in sequences]).tolist()
    return [answers[end - len(frames) : end] for frames, end in zip(sequences, ends, strict=True)]


def compile_program(folder: Path) -> Path:
    """Compile the program that answers sequences."""
    program = folder / "sequences"
    sources = [*sorted((ONBOARD / "src").glob("*.c")), ONBOARD / "tests" / "sequences.c"]
    command = [c_compiler(), "-std=c99", "-O2", f"-I{ONBOARD / 'include'}", *sources]
    subprocess.run([*command, "-lm", "-o", program], check=True)
    return program


@needs_c
@pytest.mark.slow
@pytest.mark.timeout(120)
@pytest.mark.parametrize("has_magnitudes", [True, False])
def test_a_session_confirms_what_the_ground_confirms(
    tmp_path, sky_of, random_directions, has_magnitudes
):
    matcher = Matcher(sky_of(random_directions(1200, 1)), engine="c", **STATED)
    matcher.identify(np.zeros((0, 2)))
    engine, generator = matcher._c_engine, np.random.default_rng(5)
    engine.image.neighbours = _onboard.ffi.NULL  # as in flight, without votes
    image = tmp_path / "sky.img"
    image.write_bytes(engine._words.tobytes())
    sequences = [list(steady_turn(matcher.database, WEAK, generator)) for _ in range(120)]
    if not has_magnitudes:
        for frames in sequences:
            frames[:] = (replace(frame, mag=np.full(len(frame.mag), np.nan)) for frame in frames)
    answers = answer_sequences(compile_program(tmp_path), image, sequences, STATED)
    confirmed = 0
    for frames, answered in zip(sequences, answers, strict=True):
        tracker = Tracker(matcher, max_turn_deg=ERROR_DEG)
        for answer, frame in zip(answered, frames, strict=True):
            found = tracker.identify(frame.centroids_px, mag=frame.mag)
            assert found.ok == (answer.status == 0)
            if not found.ok:
                continue
            matrix = matrix_from_quaternion(answer.q_body_from_icrs)
            assert float(matrix[2] @ frame.matrix[2]) > math.cos(math.radians(0.5))
            assert np.allclose(matrix, found.matrix, rtol=0.0, atol=1e-9)
            assert math.log(found.false_match_probability) == pytest.approx(
                answer.log_chance, abs=1e-5
            )
            assert found.n_matched == answer.n_matched
            assert (found.origin == "tracking") == (answer.mode == CONFIRMED)
            confirmed += answer.mode == CONFIRMED
            break  # the next frames are tracked, near other predictions
    assert confirmed >= (10 if has_magnitudes else 4)
