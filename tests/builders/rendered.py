"""Rendered frames as FITS pictures and as photographs."""

from __future__ import annotations

import io

import numpy as np
from astropy.io import fits
from PIL import Image

from starcat.frames.images.render import Optics, star_electrons
from starcat.geometry.camera import Camera
from starcat.pipeline.simulation.simulate import SimulatedFrame

SIGMA_PX, SKY, NOISE = 1.2, 100.0, 5.0


def picture_of(frame: SimulatedFrame, camera: Camera) -> bytes:
    """Return a FITS picture of a frame, its rows from the bottom."""
    image = np.random.default_rng(1).normal(SKY, NOISE, (camera.height_px, camera.width_px))
    y, x = np.mgrid[: camera.height_px, : camera.width_px] + 0.5
    for (cx, cy), mag in zip(frame.centroids_px, frame.mag, strict=True):
        spot = np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * SIGMA_PX**2))
        image += 2e4 * 10.0 ** (-0.4 * (mag - 3.0)) * spot
    buffer = io.BytesIO()
    fits.PrimaryHDU(np.clip(image, 0, 60000).astype(np.uint16)[::-1]).writeto(buffer)
    return buffer.getvalue()


def photograph_of(frame: SimulatedFrame, camera: Camera, *, is_colour: bool) -> bytes:
    """Return a JPEG of a frame, as a camera for photographs writes it, its rows from the top."""
    optics = Optics(psf_sigma_px=2.2, zero_point_e=2e5)
    size = (camera.width_px, camera.height_px)
    image = star_electrons(frame.centroids_px, frame.mag, size, optics).astype(np.float32)
    image += np.random.default_rng(1).normal(20.0, 4.0, image.shape).astype(np.float32)
    grey = np.clip(image, 0, 255).astype(np.uint8)
    picture = Image.fromarray(np.stack([grey, grey, grey // 2], axis=2) if is_colour else grey)
    buffer = io.BytesIO()
    picture.save(buffer, "JPEG", quality=95)
    return buffer.getvalue()
