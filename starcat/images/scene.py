"""What stands between a clean star image and a photograph: light of the sky, and a file's digits.

Input are the size of a frame and a `Scene`, output are electrons of light that is no star's, and
the image of a detector as a camera writes it: black point, eight bits. Drawn are a gradient of
town light, the Moon with its glow, and clouds of nebulous light.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from starcat.arrays import Array


@dataclass(frozen=True)
class Scene:
    """The sky behind the stars, and what is left of it in a file.

    Attributes
    ----------
    town_light_e : float
        Electrons of the gradient in the brightest corner or at the brightest edge; it is a tenth
        of that on the opposite side.
    town_light_deg : float
        Direction in which it becomes brighter: 0 to the right, 90 down.
    moon_px : pair of float, optional
        Middle of the Moon; it may be outside of the frame.
    moon_radius_px : float
        Radius of its disk, which fills the well.
    glow_e : float
        Electrons of its glow at the edge of the disk.
    glow_px : float
        Distance from the Moon's middle at which the glow is half as bright.
    nebula_e : float
        Standard deviation of nebulous light, electrons.
    nebula_px : float
        Size of its structure.
    black_adu : float
        Step of the detector that is 0 in the file: what is darker is lost.
    adu_per_step : float
        Steps of the detector in a step of the file.
    bits : int
        8 or 16: what is brighter than the largest number is lost.
    """

    town_light_e: float = 0.0
    town_light_deg: float = 90.0
    moon_px: tuple[float, float] | None = None
    moon_radius_px: float = 22.0
    glow_e: float = 0.0
    glow_px: float = 60.0
    nebula_e: float = 0.0
    nebula_px: float = 20.0
    black_adu: float = 0.0
    adu_per_step: float = 1.0
    bits: int = 16

    def __post_init__(self) -> None:
        if self.bits not in (8, 16):
            raise ValueError(f"bits is {self.bits}; expected 8 or 16")
        for name in ("moon_radius_px", "glow_px", "nebula_px", "adu_per_step"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} is {getattr(self, name)}; expected a positive number")
        for name in ("town_light_e", "glow_e", "nebula_e", "black_adu"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise ValueError(f"{name} is {getattr(self, name)}; expected 0 or more")


def scene_light(scene: Scene, camera_size: tuple[int, int], full_well_e: float, seed: int) -> Array:
    """Return the mean number of electrons that a scene adds to the background."""
    width, height = camera_size
    y, x = np.mgrid[:height, :width] + 0.5
    light = np.zeros((height, width))
    if scene.town_light_e:
        direction = np.radians(scene.town_light_deg)
        along = np.cos(direction) * (x - 0.5 * width) + np.sin(direction) * (y - 0.5 * height)
        part = (along - along.min()) / (along.max() - along.min())
        light += scene.town_light_e * 10.0 ** (part - 1.0)
    if scene.moon_px is not None:
        distance = np.hypot(x - scene.moon_px[0], y - scene.moon_px[1])
        light += scene.glow_e / (1.0 + (distance / scene.glow_px) ** 2)
        light[distance < scene.moon_radius_px] += 2.0 * full_well_e
    if scene.nebula_e:
        noise = np.random.default_rng(seed).normal(size=(height, width))
        cloud = gaussian_filter(noise, scene.nebula_px, mode="wrap")
        light += np.maximum(scene.nebula_e * (cloud / cloud.std() + 1.0), 0.0)
    return light


def in_file_steps(adu: NDArray[Any], scene: Scene) -> NDArray[Any]:
    """Return an image of a detector as the file of a camera has it.

    Examples
    --------
    >>> in_file_steps(np.array([[90.0, 130.0, 9e4]]), Scene(black_adu=100.0, bits=8))
    array([[  0,  30, 255]], dtype=uint8)
    """
    steps = np.rint((adu.astype(np.float64) - scene.black_adu) / scene.adu_per_step)
    return np.clip(steps, 0, 2**scene.bits - 1).astype(np.uint8 if scene.bits == 8 else np.uint16)
