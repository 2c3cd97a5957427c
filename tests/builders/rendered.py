"""Rendered frames as FITS pictures."""

from __future__ import annotations

import io

import numpy as np
from astropy.io import fits

from starcat.geometry.camera import Camera
from starcat.simulation.simulate import Frame

SIGMA_PX, SKY, NOISE = 1.2, 100.0, 5.0


def picture_of(frame: Frame, camera: Camera) -> bytes:
    """Return a FITS picture of a frame, its rows from the bottom."""
    image = np.random.default_rng(1).normal(SKY, NOISE, (camera.height_px, camera.width_px))
    y, x = np.mgrid[: camera.height_px, : camera.width_px] + 0.5
    for (cx, cy), mag in zip(frame.centroids_px, frame.mag, strict=True):
        spot = np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * SIGMA_PX**2))
        image += 2e4 * 10.0 ** (-0.4 * (mag - 3.0)) * spot
    buffer = io.BytesIO()
    fits.PrimaryHDU(np.clip(image, 0, 60000).astype(np.uint16)[::-1]).writeto(buffer)
    return buffer.getvalue()
