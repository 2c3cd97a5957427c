"""Distortion: the difference between the images of a lens and of a pinhole, and its inverse.

Points are x + i y in focal lengths from the optical axis; without distortion they are x/z and y/z
of a direction. Pixels are the camera's.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cached_property
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import NDArray

from starcat.arguments import numbers_of, without_unit
from starcat.arrays import Array
from starcat.errors import ConfigError, suggest

Points = NDArray[np.complex128]

HORIZON = 1e8  # largest x/z of a direction that has an image: 2 milliarcsec short of 90 degrees

# Largest coefficient that is accepted. A k3 of this size moves the edge of a field of 0.25 deg by
# a hundredth of its distance.
LARGEST = 1e14

# Most steps of Newton's method. Points need one to three, unless they are next to the fold or have
# no inverse.
NEWTON_STEPS = 50


def checked_number(name: str, value: object, low: float = -np.inf, high: float = np.inf) -> float:
    """Return a value that has to be a finite number, not a bool, in an open interval."""
    value = value if isinstance(value, Real) else without_unit(name, value)
    if isinstance(value, Real) and not isinstance(value, bool):
        with suppress(OverflowError):  # a whole number can be too large for a float
            number = float(value)
            if low < number < high:
                return number
    above = f" above {low:g}" if low > -np.inf else ""
    below = f" and below {high:g}" if high < np.inf else ""
    raise ConfigError(f"expected a finite number{above}{below}", parameter=name, value=value)


def checked_pair(name: str, value: object) -> tuple[float, float]:
    """Return a value that has to be two numbers."""
    given = list(value) if isinstance(value, Iterable) and not isinstance(value, str) else []
    numbers = [without_unit(name, one) for one in given]
    if len(numbers) != 2 or not all(isinstance(one, Real) for one in numbers):
        raise ConfigError(
            "expected a pair of numbers, such as (5, 20)", parameter=name, value=value
        )
    return float(numbers[0]), float(numbers[1])


@dataclass(frozen=True)
class Distortion:
    """Radial and tangential distortion of a lens (Brown-Conrady), as in OpenCV.

    Parameters
    ----------
    k1, k2, k3 : float
        Radial coefficients: ``k1 < 0`` is barrel distortion, ``k1 > 0`` pincushion.
    p1, p2 : float
        Tangential coefficients, of a lens whose elements are not centred.

    Raises
    ------
    ValueError
        If a coefficient is not a number between -1e14 and 1e14.

    Notes
    -----
    With x, y the direction's x/z and y/z and ``s = x^2 + y^2``, the image in focal lengths
    from the principal point is at::

        x (1 + k1 s + k2 s^2 + k3 s^3) + 2 p1 x y + p2 (s + 2 x^2)
        y (1 + k1 s + k2 s^2 + k3 s^3) + p1 (s + 2 y^2) + 2 p2 x y

    References
    ----------
    Conrady 1919, "Decentred lens-systems"; Brown 1966, "Decentering distortion of lenses".
    """

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    def __post_init__(self) -> None:
        coefficients = vars(self).items()
        vars(self).update(
            {name: checked_number(name, k, -LARGEST, LARGEST) for name, k in coefficients}
        )

    def __getstate__(self) -> dict[str, float]:
        return asdict(self)

    @cached_property
    def is_none(self) -> bool:
        """Whether the lens does not distort at all."""
        return not (self.k1 or self.k2 or self.k3 or self.p1 or self.p2)

    @cached_property
    def fold_radius(self) -> float:
        """Distance from the axis, as x/z, below which no two directions share an image.

        The model is the gradient of a function. As far as its Hessian is positive, on a disc,
        the function is strictly convex and no two points share a gradient. The Hessian's
        eigenvalues are the radial polynomial P and d(r P)/dr, less 6 r hypot(p1, p2) at the
        worst. Without p1 and p2, the image turns back exactly where d(r P)/dr is 0.
        """
        t = 6.0 * float(np.hypot(self.p1, self.p2))
        # Roots of 1/r, so that the leading coefficient is not 0.
        slope = np.roots([1.0, -t, 3.0 * self.k1, 0.0, 5.0 * self.k2, 0.0, 7.0 * self.k3])
        radial = np.roots([1.0, -t, self.k1, 0.0, self.k2, 0.0, self.k3])
        root = np.concatenate([slope, radial])
        # Rounding makes a double root, where the slope only touches 0, a complex pair.
        largest = root.real[np.abs(root.imag) <= 1e-7 * np.abs(root)].max(initial=0.0)
        return float(1.0 / max(largest, 1.0 / HORIZON))

    @cached_property
    def image_radius(self) -> float:
        """Distance from the principal point, focal lengths, within which images have inverses."""
        r = np.array(self.fold_radius)
        return float(r * self._polynomial(r * r) - 3.0 * np.hypot(self.p1, self.p2) * r * r)

    @cached_property
    def _scales(self) -> tuple[Array, Array]:
        """Distances of images, ascending, and factors that make them distances of directions."""
        even = np.tan(np.linspace(0.0, min(np.arctan(self.fold_radius), 1.57), 4097))
        # A strong lens bends the image within the first of the even steps: add narrow ones.
        r = np.union1d(even, np.geomspace(1e-12, 1.0, 1025) * even[-1])
        polynomial = self._polynomial(r * r)
        return r * polynomial, 1.0 / polynomial

    def _polynomial(self, s: Array) -> Array:
        return 1.0 + s * (self.k1 + s * (self.k2 + s * self.k3))

    def distorted(self, z: Points) -> Points:
        """Return where the lens puts directions x/z + i y/z; NaN from the fold outwards."""
        size = np.abs(z)
        size = np.where(size < self.fold_radius, size, np.nan)
        s = size * size
        factor = self._polynomial(s)
        if not (self.p1 or self.p2):
            return np.asarray(z * factor)
        factor += 2.0 * (self.p2 * z.real + self.p1 * z.imag)
        return np.asarray(z * factor + s * complex(self.p2, self.p1))

    def undistorted(self, image: Points) -> Points:
        """Return the directions that the lens puts at images; NaN if there is none.

        Newton's method in the plane, started from a table of the radial part. At a distance
        d short of the fold, images that differ by a rounding are 1e-16/d apart in direction.
        """
        tangential = complex(self.p2, self.p1)
        with np.errstate(all="ignore"):  # points without an inverse may overflow
            z = image * np.interp(np.abs(image), *self._scales)
            for _ in range(NEWTON_STEPS):
                s = z.real * z.real + z.imag * z.imag
                factor = self._polynomial(s)
                slope = self.k1 + s * (2.0 * self.k2 + 3.0 * self.k3 * s)
                across = 2.0 * self.p2 * z.real + 2.0 * self.p1 * z.imag
                miss = z * (factor + across) + s * tangential - image
                # The derivative by z is a real number; the other one is that by the conjugate of z.
                by_z = factor + s * slope + 2.0 * across
                by_conjugate = z * (slope * z + 2.0 * tangential)
                step = by_z * miss - by_conjugate * miss.conj()
                step /= by_z * by_z - (by_conjugate * by_conjugate.conj()).real
                z = z - step
                size = np.abs(z)
                outside = size >= self.fold_radius
                # The error that is left is about the square of the step.
                unsolved = outside | (np.abs(step) > 1e-8 * size)
                if not unsolved.any():
                    break
                # The solution lies within the fold radius: a step that leaves that disc is taken
                # back to its edge, which is nearer to the solution.
                z = np.where(outside, z * (self.fold_radius / size), z)
        return np.where(unsolved, np.nan, z)


OPENCV = ("k1", "k2", "p1", "p2", "k3")
"""Order of the coefficients in a list, as OpenCV has it."""


def distortion_of(value: Any) -> Distortion:
    """Return the distortion of an argument: itself, a mapping, five numbers, or None for none."""
    if value is None:
        return NO_DISTORTION
    if isinstance(value, Distortion):
        return value
    if isinstance(value, Mapping):
        unknown = [str(name) for name in value if name not in OPENCV]
        if unknown:
            hint = suggest(unknown[0], OPENCV)
            raise ConfigError(
                f"the key {unknown[0]!r} is unknown",
                parameter="distortion",
                hint=f"{hint}known keys are k1, k2, k3, p1, p2",
            )
        return Distortion(**value)
    words = f"five numbers ({', '.join(OPENCV)}, as in OpenCV)"
    numbers = numbers_of("distortion", value, f"(5,), {words}").ravel()
    if len(numbers) != len(OPENCV):
        raise ConfigError(
            f"expected a Distortion, a mapping, or {words}", parameter="distortion", value=value
        )
    return Distortion(**dict(zip(OPENCV, numbers.tolist(), strict=True)))


NO_DISTORTION = Distortion()  # the distortion of a lens that projects like a pinhole
