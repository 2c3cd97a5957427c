"""Simulated frames: what a camera at a known attitude would measure of a list of stars."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from starcat.attitude import random_attitudes
from starcat.camera import Camera

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Frame:
    """One simulated frame.

    Attributes
    ----------
    matrix : ndarray of float64, shape (3, 3)
        True attitude, ``body = matrix @ icrs``.
    centroids_px : ndarray of float64, shape (N, 2)
        Measured centroids, in random order.
    star_index : ndarray of int64, shape (N,)
        Row of each centroid's star; -1 for a false one.
    """

    matrix: Array
    centroids_px: Array
    star_index: NDArray[np.int64]

    @property
    def n_stars(self) -> int:
        """Centroids that are stars."""
        return int((self.star_index >= 0).sum())


@dataclass(frozen=True)
class Noise:
    """What a frame suffers.

    Attributes
    ----------
    noise_px : float
        Standard deviation of a centroid, each axis.
    drop_probability : float
        Chance of a star to be missing.
    false_stars : int
        Spots at random places.
    """

    noise_px: float = 0.0
    drop_probability: float = 0.0
    false_stars: int = 0


def simulate_frames(
    directions: Array, camera: Camera, count: int, noise: Noise, seed: int
) -> Iterator[Frame]:
    """Simulate frames at attitudes uniform over all rotations.

    Parameters
    ----------
    directions : ndarray of float64, shape (N, 3)
        ICRS directions of the stars that the camera can see.
    camera : Camera
        The camera.
    count : int
        Number of frames.
    noise : Noise
        What they suffer.
    seed : int
        Of all that is random; the same seed gives the same frames.

    Yields
    ------
    Frame
        Centroids that noise moves off the detector are lost, as they would be.
    """
    generator = np.random.default_rng(seed)
    half_angle = 0.55 * camera.diagonal_rad
    for matrix in random_attitudes(count, generator):
        near = np.flatnonzero(directions @ matrix[2] >= np.cos(half_angle))
        centroids = camera.pixels_from_directions(directions[near] @ matrix.T)
        inside = camera.contains(centroids)
        centroids, star = centroids[inside], near[inside]
        seen = generator.random(len(star)) >= noise.drop_probability
        centroids, star = centroids[seen], star[seen]
        centroids = centroids + generator.normal(scale=noise.noise_px, size=centroids.shape)
        false = generator.random((noise.false_stars, 2)) * [camera.width_px, camera.height_px]
        centroids = np.concatenate([centroids, false])
        star = np.concatenate([star, np.full(noise.false_stars, -1)])
        order = generator.permutation(len(star))
        order = order[camera.contains(centroids[order])]
        yield Frame(matrix, centroids[order], star[order])
