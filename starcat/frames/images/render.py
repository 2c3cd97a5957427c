"""Star images: the image that a detector records of stars at known places, with all of its noise.

The input is centroids and magnitudes, the output is one frame of 16 bits. The point spread function
is a Gaussian, integrated over each pixel. Smear, blooming, cosmic rays and spots that change over
the field are not drawn.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy
from numpy.typing import NDArray

from starcat.arrays import Array, Pixels
from starcat.errors import ConfigError
from starcat.frames.images.image_file import WRITTEN_KINDS, write_image
from starcat.geometry.camera import Camera
from starcat.matcher.centroids import write_centroids
from starcat.pipeline.simulation.simulate import SimulatedFrame

CENTROIDS_SUFFIX = ".csv"  # suffix of the file that a simulated frame's centroids are written to
_REACH_SIGMA = 6.0  # a star is drawn this far to each side: 4e-9 of its light falls outside
_HOT_RANGE = (0.02, 0.5)  # electrons of a hot pixel, as parts of the full well
_MAX_ELECTRONS = 1e15  # above it a count has no digits left; numpy draws none above 9e18


@dataclass(frozen=True)
class Optics:
    """A lens and a detector, for one exposure.

    The light of a star follows Liebe 2002, "Accuracy performance of star trackers - a
    tutorial", IEEE Transactions on Aerospace and Electronic Systems 38 (2), 587-599.
    """

    psf_sigma_px: float = 1.0  # standard deviation of the Gaussian spot, pixels
    # electrons of a star of magnitude 0. The default is 19,100 electrons per second and mm2
    # through an aperture of 20 mm in 0.1 s.
    zero_point_e: float = 600_000.0
    background_e: float = 20.0  # electrons of sky and dark current in a pixel
    read_noise_e: float = 8.0  # standard deviation of the read-out, electrons
    gain_e_per_adu: float = 1.0  # electrons of one step of the file
    bias_adu: float = 100.0  # steps added to every pixel, so that noise does not fall below zero
    full_well_e: float = 50_000.0  # electrons that a pixel can hold; more are lost
    hot_pixels: int = 0  # pixels with a high dark current, at places that the seed gives


def star_electrons(
    centroids_px: Pixels, mag: Array, camera_size: tuple[int, int], optics: Optics
) -> Array:
    """Return the mean number of electrons that stars release, without background or noise."""
    width, height = camera_size
    centroids_px, mag = np.asarray(centroids_px), np.asarray(mag)
    image = np.zeros((height, width))
    drawn = np.isfinite(centroids_px).all(axis=1)
    electrons = optics.zero_point_e * 10.0 ** (-0.4 * mag[drawn])
    columns, first_column = _profiles(centroids_px[drawn, 0], optics.psf_sigma_px)
    rows, first_row = _profiles(centroids_px[drawn, 1], optics.psf_sigma_px)
    size = columns.shape[1]
    near = (
        (first_column < width)
        & (first_column + size > 0)
        & (first_row < height)
        & (first_row + size > 0)
    )
    for star in np.flatnonzero(near):
        x, y = int(first_column[star]), int(first_row[star])
        across = columns[star, max(-x, 0) : width - x]
        down = rows[star, max(-y, 0) : height - y]
        patch = image[max(y, 0) : y + size, max(x, 0) : x + size]
        patch += electrons[star] * down[:, None] * across
    return image


def _profiles(centre: Array, sigma: float) -> tuple[Array, NDArray[np.int64]]:
    """Return each star's light in the pixels along one axis, and the first of these pixels."""
    first = np.floor(np.clip(centre, -1e9, 1e9) - _REACH_SIGMA * sigma).astype(np.int64)
    edges = first[:, None] + np.arange(int(np.ceil(2.0 * _REACH_SIGMA * sigma)) + 2)
    below = 0.5 * scipy.special.erf((edges - centre[:, None]) / (np.sqrt(2.0) * sigma))
    return np.diff(below, axis=1), first


def render_image(
    centroids_px: Pixels,
    mag: Array,
    camera_size: tuple[int, int],
    optics: Optics,
    seed: int,
    light_e: Array | None = None,
) -> NDArray[np.uint16]:
    """Return the image of stars as a detector would record it.

    Electrons of stars, background and hot pixels are Poisson variates; the full well cuts
    them; the read-out adds Gaussian noise and rounds to whole ADU.

    >>> import numpy as np
    >>> image = render_image(np.array([[10.5, 20.5]]), np.array([3.0]), (64, 48), Optics(), 1)
    >>> image.shape, np.unravel_index(image.argmax(), image.shape) == (20, 10)
    ((48, 64), True)
    """
    generator = np.random.default_rng(seed)
    mean = star_electrons(centroids_px, mag, camera_size, optics) + optics.background_e
    if light_e is not None:
        mean += light_e
    hot = generator.choice(mean.size, min(optics.hot_pixels, mean.size), replace=False)
    mean.flat[hot] += optics.full_well_e * generator.uniform(*_HOT_RANGE, size=len(hot))
    electrons = generator.poisson(np.minimum(mean, _MAX_ELECTRONS)).astype(np.float64)
    np.minimum(electrons, optics.full_well_e, out=electrons)
    electrons += generator.normal(scale=optics.read_noise_e, size=mean.shape)
    adu = np.rint(electrons / optics.gain_e_per_adu + optics.bias_adu)
    return np.clip(adu, 0, 65_535).astype(np.uint16)


def write_simulated(path: Path, frame: SimulatedFrame, camera: Camera, seed: int) -> None:
    """Write a simulated frame as centroids, or as the image that a camera would take."""
    suffix = path.suffix.lower()
    if suffix == CENTROIDS_SUFFIX:
        write_centroids(frame.centroids_px, path, frame.mag)
        return
    if suffix not in WRITTEN_KINDS:
        raise ConfigError(
            "the name has no suffix of a frame that starcat writes",
            where=path,
            hint=f"end it with one of {CENTROIDS_SUFFIX} (centroids), {', '.join(WRITTEN_KINDS)} "
            "(images)",
        )
    size = camera.width_px, camera.height_px
    image = render_image(frame.centroids_px, frame.mag, size, Optics(), seed)
    if WRITTEN_KINDS[suffix] == "JPEG":
        # Eight bits from a black point below the sky of the default optics.
        image = np.clip(np.rint((image.astype(np.float64) - 90.0) / 4.0), 0, 255).astype(np.uint8)
    write_image(path, image)
