"""A camera as the vector of numbers that a calibration fits, with its derivatives.

The camera is that of `starcat.geometry`, and two numbers more that it has not: how much longer the
focal length is downwards than to the right, and the skew of the axes. They are fitted only to say
whether the pixels are square.
"""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array, Directions
from starcat.geometry.camera import Camera
from starcat.geometry.distortion import Distortion

Points = NDArray[np.complex128]

FOCAL = ("focal_length_px",)
CENTRE = ("principal_point_x_px", "principal_point_y_px")
RADIAL = ("k1", "k2", "k3")
TANGENTIAL = ("p1", "p2")
AXES = ("aspect", "skew")
PARAMETERS = (*FOCAL, *CENTRE, *RADIAL, *TANGENTIAL, *AXES)
"""Names of the numbers, in the order of the vector.

``aspect`` is the focal length along y over that along x, less 1; ``skew`` is how far x moves with
y, the tangent of the angle by which the axes are not perpendicular.
"""


def values_of(camera: Camera) -> Array:
    """Return the numbers of a camera."""
    lens = asdict(camera.distortion)
    values = {**lens, "focal_length_px": camera.focal_length_px}
    values |= dict(zip(CENTRE, camera.principal_point_px, strict=True))
    return np.array([values.get(name, 0.0) for name in PARAMETERS])


def camera_of(values: Array, size_px: tuple[int, int]) -> Camera:
    """Return the camera of numbers; aspect and skew are left out."""
    given = dict(zip(PARAMETERS, values.tolist(), strict=True))
    lens = Distortion(**{name: given[name] for name in (*RADIAL, *TANGENTIAL)})
    centre = [given[name] for name in CENTRE]
    focal_px = given["focal_length_px"]
    return Camera(*size_px, focal_px, principal_point_px=centre, distortion=lens)


def cropped(camera: Camera, share: float) -> tuple[Camera, Array]:
    """Return the middle of a camera as a camera of its own."""
    size = camera.width_px, camera.height_px
    left, top = (round(0.5 * side * (1.0 - share)) for side in size)
    x_px, y_px = camera.principal_point_px
    middle = Camera(
        size[0] - 2 * left,
        size[1] - 2 * top,
        camera.focal_length_px,
        principal_point_px=(x_px - left, y_px - top),
        distortion=camera.distortion,
    )
    return middle, np.array([left, top], dtype=np.float64)


def project(values: Array, body: Directions) -> Array:
    """Project directions with any numbers, those of a lens that folds the image included."""
    w, focal_px = _image(values, _plane(body)), values[0]
    aspect, skew = values[-2:]
    x = values[1] + focal_px * (w.real + skew * w.imag)
    return np.column_stack([x, values[2] + focal_px * (1.0 + aspect) * w.imag])


def value_derivatives(values: Array, body: Directions) -> Array:
    """Return how pixels change with the numbers of the camera."""
    focal_px, (aspect, skew) = values[0], values[-2:]
    z = _plane(body)
    x, y, s = z.real, z.imag, z.real**2 + z.imag**2
    w = _image(values, z)
    of_lens = (z * s, z * s**2, z * s**3, 2.0 * y * z + 1j * s, 2.0 * x * z + s)
    by_value = np.zeros((len(z), 2, len(PARAMETERS)))
    by_value[:, :, 0] = _pair(w, aspect, skew)
    by_value[:, 0, 1] = by_value[:, 1, 2] = 1.0
    for column, change in enumerate(of_lens, start=3):
        by_value[:, :, column] = focal_px * _pair(change, aspect, skew)
    by_value[:, 1, 8] = by_value[:, 0, 9] = focal_px * w.imag
    return by_value


def turn_derivatives(values: Array, body: Directions) -> Array:
    """Return how pixels change with the attitude of the camera."""
    focal_px, (aspect, skew) = values[0], values[-2:]
    k1, k2, k3, p1, p2 = values[3:8]
    z = _plane(body)
    x, y, s = z.real, z.imag, z.real**2 + z.imag**2
    slope = k1 + s * (2.0 * k2 + 3.0 * k3 * s)
    across = 2.0 * p2 * x + 2.0 * p1 * y
    # The image moves with z and with the conjugate of z, and z with the rotation.
    by_z = 1.0 + s * (k1 + s * (k2 + s * k3)) + s * slope + 2.0 * across
    by_conjugate = z * (slope * z + 2.0 * complex(p2, p1))
    turned = (-x * y - 1j * (1.0 + y * y), 1.0 + x * x + 1j * x * y, -y + 1j * x)
    by_turn = np.empty((len(z), 2, 3))
    for column, change in enumerate(turned):
        moved = by_z * change + by_conjugate * np.conj(change)
        by_turn[:, :, column] = focal_px * _pair(moved, aspect, skew)
    return by_turn


def _plane(body: Directions) -> Points:
    return np.asarray((body[:, 0] + 1j * body[:, 1]) / body[:, 2])


def _image(values: Array, z: Points) -> Points:
    """Return the images of directions, as `Distortion.distorted` does inside its fold."""
    k1, k2, k3, p1, p2 = values[3:8]
    s = z.real**2 + z.imag**2
    factor = 1.0 + s * (k1 + s * (k2 + s * k3)) + 2.0 * (p2 * z.real + p1 * z.imag)
    return np.asarray(z * factor + s * complex(p2, p1))


def _pair(w: Points, aspect: float, skew: float) -> Array:
    return np.column_stack([w.real + skew * w.imag, (1.0 + aspect) * w.imag])
