"""The shape of an identified frame in a user's terms, with the standard errors of its terms."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from starcat.arrays import Array, Pixels
from starcat.geometry.camera import Camera
from starcat.matcher.shape import N_TERMS, Shape, shape_covariance

SIGNIFICANT = 3.0
"""Standard errors from which a term is told in sentences and tables."""


@dataclass(frozen=True)
class FrameShape:
    """How an identified frame differs from the camera that was stated.

    All but the focal length are fractions: 0.01 moves a place by 1 % of its distance from the
    principal point. A term that was not fitted is 0, and its error None.

    Attributes
    ----------
    focal_length_px, focal_length_error_px : float
        Focal length that the frame has on average over the detector, and its standard error.
    corner_distortion, corner_distortion_error : float, float or None
        How much larger the frame is at the distance of a corner than in the middle: a lens.
    stretch, stretch_error : float, float or None
        How much longer the frame is along y: a turn of the camera while the rows were read
        (rolling shutter), or pixels that are not square.
    shear, shear_error : float, float or None
        How far the rows are shifted along x, as a fraction of their distance from the principal
        point: also a turn, or axes that are not perpendicular.
    tilt_x, tilt_x_error, tilt_y, tilt_y_error : float, float or None
        How much larger the frame is at the distance of a corner along x and along y than in the
        middle: a tilted detector, or a lens off its centre.
    turn_deg_s, turn_error_deg_s : float or None
        Speed of the boresight on the sky that explains stretch and shear, if the camera states
        ``readout_s``, and its standard error.
    """

    focal_length_px: float
    focal_length_error_px: float
    corner_distortion: float = 0.0
    corner_distortion_error: float | None = None
    stretch: float = 0.0
    stretch_error: float | None = None
    shear: float = 0.0
    shear_error: float | None = None
    tilt_x: float = 0.0
    tilt_x_error: float | None = None
    tilt_y: float = 0.0
    tilt_y_error: float | None = None
    turn_deg_s: float | None = None
    turn_error_deg_s: float | None = None

    def __repr__(self) -> str:
        """Return the focal length and the significant terms, with their errors, in one line."""
        parts = [f"focal length {self.focal_length_px:.1f} +- {self.focal_length_error_px:.2g} px"]
        for name, (value, error) in self.significant.items():
            parts.append(f"{name} {value:+.4f} +- {error:.2g}")
        if self.turn_deg_s is not None and self.turn_error_deg_s is not None:
            parts.append(f"turn {self.turn_deg_s:.2g} +- {self.turn_error_deg_s:.1g} deg/s")
        return f"<FrameShape: {', '.join(parts)}>"

    @property
    def significant(self) -> dict[str, tuple[float, float]]:
        """Value and standard error of each fraction that is beyond `SIGNIFICANT` errors, by name.

        >>> FrameShape(1000.0, 1.0, 0.02, 0.001, 0.003, 0.002).significant
        {'corner_distortion': (0.02, 0.001)}
        """
        every = {name: (getattr(self, name), getattr(self, f"{name}_error")) for name in FRACTIONS}
        return {
            name: (value, error)
            for name, (value, error) in every.items()
            if error is not None and abs(value) > SIGNIFICANT * error
        }


FRACTIONS = ("corner_distortion", "stretch", "shear", "tilt_x", "tilt_y")
"""Names of the terms of a shape after the scale, in their order."""


STRETCH, SHEAR = 2, 3
"""Terms that a turn of the camera makes while the rows are read."""


def frame_shape(px: Pixels, sigma_px: Array, camera: Camera, shape: Shape) -> FrameShape:
    """Return the terms of a shape with the errors that the noise of its centroids gives them.

    ``camera`` has the fitted focal length, so that the term of the scale is 0 (`shape.of_scale`).
    """
    covariance = np.full((N_TERMS, N_TERMS), np.nan)
    covariance[: shape.free, : shape.free] = shape_covariance(px, sigma_px, camera, shape)[3:, 3:]
    errors = np.sqrt(np.diag(covariance)).tolist()
    values: dict[str, float | None] = {}
    for term, name in enumerate(FRACTIONS[: shape.free - 1], start=1):
        values |= {name: float(shape.terms[term]), f"{name}_error": errors[term]}
    focal_px = camera.focal_length_px
    if shape.free > SHEAR and camera.readout_s is not None:
        moved, both = shape.terms[STRETCH : SHEAR + 1], slice(STRETCH, SHEAR + 1)
        size = float(np.hypot(*moved))
        # The error of a vector's length is that along the vector; of no length, the larger one.
        along = moved / size if size > 0.0 else np.array([1.0, 0.0])
        error = math.sqrt(float(along @ covariance[both, both] @ along))
        deg_s = turn_of_motion_deg_s(camera)
        values |= {"turn_deg_s": size * deg_s, "turn_error_deg_s": error * deg_s}
    return FrameShape(focal_px, focal_px * errors[0], **values)  # type: ignore[arg-type]


def turn_of_motion_deg_s(camera: Camera) -> float:
    """Return the speed on the sky that a stretch or a shear of 1 means; NaN without a readout."""
    readout_s = math.nan if camera.readout_s is None else camera.readout_s
    return math.degrees(camera.height_px / camera.focal_length_px) / readout_s


def turn_in_words(shape: FrameShape, camera: Camera) -> list[str]:
    """Return a sentence about the turn of a camera while its rows were read, if it is certain."""
    rate, error, readout_s = shape.turn_deg_s, shape.turn_error_deg_s, camera.readout_s
    if rate is None or error is None or not rate > SIGNIFICANT * error:
        return []
    longer = "stretched" if shape.stretch > 0.0 else "compressed"
    moves = {
        "stretch": f"{longer} by {abs(shape.stretch):.1%}",
        "shear": f"sheared by {abs(shape.shear):.1%}",
    }
    motions = [moves[name] for name in moves if name in shape.significant] or [*moves.values()]
    return [
        f"the rows are {' and '.join(motions).replace('%', ' %')}: the camera turned by {rate:.2g} "
        f"+- {error:.1g} deg/s across its axis if the readout takes {readout_s:g} s (readout_s)"
    ]
