"""Frames whose shape differs from the camera's: other pixels, a lens, a shear, a tilted detector.

Each kind moves the centroids of simulated frames of gaia-12deg, of which a tenth of the stars are
missing and three spots are false. An answer whose boresight is farther than `RIGHT_DEG` from the
true one is wrong; *off* are the right answers whose boresight is off by more than five standard
errors on an axis; *chi-square* is the mean squared error of the boresight in its standard errors,
over both axes, which is 1 if they are right.

It fails if an answer is wrong.

Run: python benchmarks/shapes.py [--frames 2000] [--engine c] [--of KIND ...] [--database FOLDER]
"""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from rows import Options, Rows, database, ended

from starcat.arrays import Array, Pixels
from starcat.geometry.attitude import quaternion_from_matrix, random_attitudes, turn_between
from starcat.geometry.camera import Camera
from starcat.matcher.database import MatcherDatabase
from starcat.matcher.matcher import Matcher
from starcat.matcher.stars import ARCSEC
from starcat.pipeline.simulation.simulate import Noise, Sky, simulate_frame

RIGHT_DEG = 0.1
NOISE = Noise(0.4, 0.1, 3, noise_mag=0.2)
FOV_ERRORS = (0.0, 0.02, 0.05)

Move = Callable[[Pixels, Camera, np.random.Generator], Pixels]
"""Returns the centroids of a frame of another shape, counted from the middle of the detector."""


def either(generator: np.random.Generator, low: float, high: float) -> float:
    """Return a number between two limits, of either sign."""
    return float(generator.uniform(low, high) * generator.choice([-1.0, 1.0]))


def as_stated(q: Pixels, camera: Camera, generator: np.random.Generator) -> Pixels:
    """Return the frame of the camera."""
    return q


def pixels(low: float, high: float) -> Move:
    """Return frames whose pixels are wider than high, or higher than wide."""

    def move(q: Pixels, camera: Camera, generator: np.random.Generator) -> Pixels:
        half = 0.5 * np.log1p(either(generator, low, high))
        return q * np.exp([half, -half])

    return move


def sheared(low: float, high: float) -> Move:
    """Return frames whose rows are shifted along x."""

    def move(q: Pixels, camera: Camera, generator: np.random.Generator) -> Pixels:
        return q + np.outer(q[:, 1], [either(generator, low, high), 0.0])

    return move


def affine(q: Pixels, camera: Camera, generator: np.random.Generator) -> Pixels:
    """Return a frame that any linear map has moved, with 3 % in each entry."""
    return q @ (np.eye(2) + generator.normal(0.0, 0.03, (2, 2)))


def lens(q: Pixels, camera: Camera, generator: np.random.Generator) -> Pixels:
    """Return a frame of a lens that moves the corners by 0.3 to 5 %."""
    corner = 0.25 * (camera.width_px**2 + camera.height_px**2)
    return q * (1.0 + either(generator, 0.003, 0.05) * (q * q).sum(axis=1, keepdims=True) / corner)


def tilted(q: Pixels, camera: Camera, generator: np.random.Generator) -> Pixels:
    """Return a frame of a tilted detector, on which the corners move by 0.3 to 5 %."""
    turn = generator.uniform(0.0, 2.0 * np.pi)
    along = q @ [np.cos(turn), np.sin(turn)] / np.hypot(*camera.middle_px)
    return q * (1.0 + generator.uniform(0.003, 0.05) * along[:, None])


def part(q: Pixels, camera: Camera, generator: np.random.Generator) -> Pixels:
    """Return a frame of which a half or more has other pixels."""
    turn = generator.uniform(0.0, 2.0 * np.pi)
    other = q @ [np.cos(turn), np.sin(turn)] > generator.uniform(-0.3, 0.3) * camera.width_px
    return np.where(other[:, None], pixels(0.01, 0.06)(q, camera, generator), q)


def scaled(q: Pixels, camera: Camera, generator: np.random.Generator) -> Pixels:
    """Return a frame of a camera whose focal length is 1.5 to 25 % beyond the widest range."""
    return q * (1.1 + generator.uniform(0.015, 0.25)) ** generator.choice([-1.0, 1.0])


def mirrored(q: Pixels, camera: Camera, generator: np.random.Generator) -> Pixels:
    """Return a frame whose y counts up."""
    return q * [1.0, -1.0]


KINDS: dict[str, Move] = {
    "as stated": as_stated,
    "pixels 1 to 3 %": pixels(0.01, 0.03),
    "pixels 3 to 10 %": pixels(0.03, 0.10),
    "sheared 1 to 10 %": sheared(0.01, 0.10),
    "affine 3 %": affine,
    "lens 0.3 to 5 %": lens,
    "tilted 0.3 to 5 %": tilted,
    "part, pixels 1 to 6 %": part,
    "scaled beyond": scaled,
    "mirrored": mirrored,
}


@dataclass
class Outcome:
    """The answers to the frames of a row."""

    right: int = 0
    wrong: int = 0
    off: int = 0  # right, and farther from the true boresight than five standard errors
    refused: Counter[str] = field(default_factory=Counter)
    squares: list[float] = field(default_factory=list)

    def add(self, matrix: Array, answered: Array, covariance_arcsec2: Array) -> None:
        """Add an answer."""
        q = (quaternion_from_matrix(one).tolist() for one in (matrix, answered))
        x, y, _ = turn_between(*q)
        if np.degrees(np.hypot(x, y)) > RIGHT_DEG:
            self.wrong += 1
            return
        self.right += 1
        in_sigmas = np.array([x, y]) * ARCSEC / np.sqrt(np.diag(covariance_arcsec2)[:2])
        self.off += bool((np.abs(in_sigmas) > 5.0).any())
        self.squares.append(float(np.mean(in_sigmas**2)))


def answered(matcher: Matcher, kind: str, fov_error: float, frames: int) -> Outcome:
    """Return what a matcher says of simulated frames of a kind."""
    stars: MatcherDatabase = matcher.database
    camera, outcome = stars.camera, Outcome()
    sky = Sky(stars.directions, stars.mag, np.arange(len(stars.mag), dtype=np.int32))
    generator = np.random.default_rng([41, list(KINDS).index(kind), round(1000 * fov_error)])
    for matrix in random_attitudes(frames, generator):
        frame = simulate_frame(sky, camera, matrix, NOISE, generator)
        q = frame.centroids_px - camera.middle_px
        px = camera.middle_px + KINDS[kind](q, camera, generator)
        inside = camera.contains(px)
        answer = matcher.identify(px[inside], mag=frame.mag[inside], fov_error=fov_error)
        if answer.refusal is not None:
            outcome.refused[answer.refusal.reason] += 1
        else:
            outcome.add(matrix, answer.matrix, answer.covariance_arcsec2)
    return outcome


def main(rows: Rows) -> None:
    """Print a row for each kind and each error that is allowed."""
    options = Options(__doc__)
    options.size("--frames", 500, 1, "of each row")
    options.add_argument("--engine", default="auto", help="of the matcher")
    options.add_argument("--database", type=Path, help="its folder; by default it is built")
    options.add_argument("--of", nargs="+", choices=KINDS, default=list(KINDS), help="kinds")
    asked = options.asked()
    with tempfile.TemporaryDirectory() as folder:
        path = asked.database or database("gaia-12deg", Path(folder)).folder
        headings = "frames", "noise", "range", "right", "wrong", "off", "chi-square", "refused"
        print(f"| {' | '.join(headings)} |\n|{'---|' * len(headings)}")
        for kind in asked.of:
            for stated in ({}, {"noise_px": NOISE.noise_px, "noise_mag": NOISE.noise_mag}):
                matcher = Matcher.open(path, engine=asked.engine, **stated)
                for fov_error in FOV_ERRORS:
                    outcome = answered(matcher, kind, fov_error, asked.frames)
                    said = "stated" if stated else "no"
                    chi = f"{np.mean(outcome.squares):.2f}" if outcome.squares else ""
                    reasons = ", ".join(f"{name} {n}" for name, n in outcome.refused.most_common())
                    cells = [
                        kind, said, f"{fov_error:.0%}", str(outcome.right), str(outcome.wrong),
                        str(outcome.off), chi, reasons,
                    ]  # fmt: skip
                    print(f"| {' | '.join(cells)} |", flush=True)
                    where = f"{kind}, {said}, {fov_error:.0%}"
                    rows.expect(outcome.wrong == 0, f"{where}: {outcome.wrong} wrong")


if __name__ == "__main__":
    ended(main)
