"""Frames without a true answer: patterns, mirror images, other scales, only false spots."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from starcat.matcher.database import MatcherDatabase
from starcat.pipeline.simulation.simulate import Noise, simulate_frames

Array = NDArray[np.float64]
Spots = tuple[Array, Array | None]
Make = Callable[[np.random.Generator, MatcherDatabase], Spots]

ALLOWED = 0.02
"""Error of the focal length that is allowed; frames of another scale are beyond it."""


def _size(database: MatcherDatabase) -> Array:
    return np.array([database.camera.width_px, database.camera.height_px], dtype=np.float64)


def _with_or_without_magnitudes(px: Array, generator: np.random.Generator) -> Spots:
    return px, generator.normal(size=len(px)) if generator.random() < 0.5 else None


def grid(generator: np.random.Generator, database: MatcherDatabase) -> Spots:
    """Return a square grid, turned and shifted."""
    step, angle = generator.uniform(60.0, 200.0), generator.uniform(0.0, np.pi)
    cells = np.stack(np.meshgrid(np.arange(-20, 21), np.arange(-20, 21)), -1).reshape(-1, 2)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    px = step * cells @ turn.T + 0.5 * _size(database) + generator.uniform(-step, step, 2)
    noise_px = generator.choice([0.0, 0.3])
    return _with_or_without_magnitudes(
        px + generator.normal(scale=noise_px, size=px.shape), generator
    )


def lines(generator: np.random.Generator, database: MatcherDatabase) -> Spots:
    """Return spots along one to three straight lines."""
    parts = []
    for _ in range(generator.integers(1, 4)):
        angle, middle = generator.uniform(0.0, np.pi), generator.random(2) * _size(database)
        along = generator.uniform(-700.0, 700.0, (int(generator.integers(5, 25)), 1))
        parts.append(middle + along * [np.cos(angle), np.sin(angle)])
    px = np.concatenate(parts)
    return _with_or_without_magnitudes(px + generator.normal(scale=0.3, size=px.shape), generator)


def clusters(generator: np.random.Generator, database: MatcherDatabase) -> Spots:
    """Return one to three clusters of false spots."""
    parts = [
        generator.random(2) * _size(database)
        + generator.normal(
            scale=generator.uniform(5.0, 60.0), size=(int(generator.integers(5, 25)), 2)
        )
        for _ in range(generator.integers(1, 4))
    ]
    return _with_or_without_magnitudes(np.concatenate(parts), generator)


def points(generator: np.random.Generator, database: MatcherDatabase) -> Spots:
    """Return false spots all over the frame."""
    px = generator.random((int(generator.integers(4, 120)), 2)) * _size(database)
    return _with_or_without_magnitudes(px, generator)


def _frame(generator: np.random.Generator, database: MatcherDatabase) -> Spots:
    u, camera, seed = database.directions, database.camera, int(generator.integers(2**40))
    [frame] = simulate_frames(u, camera, 1, Noise(0.3, 0.1, 3), seed, database.mag)
    return frame.centroids_px, frame.mag


def mirrored(generator: np.random.Generator, database: MatcherDatabase) -> Spots:
    """Return the mirror image of a true frame."""
    px, mag = _frame(generator, database)
    return px * [-1.0, 1.0] + [database.camera.width_px, 0.0], mag


def scaled(generator: np.random.Generator, database: MatcherDatabase) -> Spots:
    """Return a true frame of a camera with another focal length than `ALLOWED`."""
    px, mag = _frame(generator, database)
    longer = generator.uniform(1.05, 2.0)
    middle = 0.5 * _size(database)
    return (px - middle) * (longer if generator.random() < 0.5 else 1.0 / longer) + middle, mag


KINDS: dict[str, Make] = {
    make.__name__: make for make in (grid, lines, clusters, points, mirrored, scaled)
}


def hostile_frame(number: int, database: MatcherDatabase) -> tuple[str, Array, Array | None, float]:
    """Return a frame that no answer belongs to: its kind, spots, magnitudes and allowed error.

    The kinds take turns with the number. Some spots are off the detector; the error of the focal
    length that is allowed is 0 or `ALLOWED`.
    """
    generator = np.random.default_rng(number)
    kind = list(KINDS)[number % len(KINDS)]
    px, mag = KINDS[kind](generator, database)
    return kind, px, mag, float(generator.choice([0.0, ALLOWED]))
