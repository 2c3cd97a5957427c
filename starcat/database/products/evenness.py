"""Evenness: the error of the attitude that each field's stars allow, and how evenly stars lie.

All centroids have the same noise, so an error is stated per pixel of it. Nothing here draws or
writes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array, Directions
from starcat.database.products.tiling import FieldSize, FieldStars, reach_rad
from starcat.geometry.attitude import attitude_deviations, information_of_groups

ARCSEC = float(np.degrees(1.0)) * 3600.0


@dataclass(frozen=True)
class ErrorSpread:
    """How one error is spread over the fields; infinite for a field without an attitude."""

    # errors that occur; 50 % and 99 % of the fields have at most these errors
    median: float
    one_percent: float
    worst: float


@dataclass(frozen=True, eq=False)
class Evenness:
    """Errors that the stars of the fields allow, arcseconds per pixel of centroid noise."""

    # standard deviations, shape (F,): infinite if the stars of a field determine no attitude
    across: Array  # across the boresight, root mean square of the two axes
    about: Array  # about the boresight
    entropy: float  # entropy of the stars over cells; 1 if all cells hold as many
    cells: int

    @property
    def spreads(self) -> dict[str, ErrorSpread]:
        """How both errors are spread over the fields."""
        return {"across": spread_of_errors(self.across), "about": spread_of_errors(self.about)}


def evenness_of(
    fields: FieldStars,
    directions: Directions,
    size: FieldSize,
    field: Literal["rectangular", "circular"],
    focal_length_px: float,
    *,
    is_part: bool = False,
) -> Evenness:
    """Return the attitude errors of fields and the evenness of their stars.

    The cells of the entropy are as large as a field. If the fields tile a part of the sphere, these
    are the cells with a boresight.
    """
    deviations = field_deviations(fields, directions) * ARCSEC / focal_length_px
    entropy, cells = distribution_entropy(
        directions, 4.0 * np.pi / field_area(size, field), fields.boresights if is_part else None
    )
    across = np.sqrt(0.5 * (deviations[:, 0] ** 2 + deviations[:, 1] ** 2))
    return Evenness(across, deviations[:, 2], entropy, cells)


def field_deviations(fields: FieldStars, directions: Directions) -> Array:
    """Return the deviations of the attitude of each field if its stars have a noise of 1.

    Shape (F, 3), about x, y and z of the frame at roll 0; infinite without an attitude.
    """
    seen = fields.seen(directions)
    return attitude_deviations(information_of_groups(seen, fields.field, len(fields.boresights)))


def spread_of_errors(errors: Array) -> ErrorSpread:
    """Return how errors are spread over the fields."""
    median, percent = np.quantile(errors, [0.5, 0.99], method="inverted_cdf")
    return ErrorSpread(float(median), float(percent), float(errors.max()))


def field_area(size: FieldSize, field: Literal["rectangular", "circular"]) -> float:
    """Return the solid angle of a field."""
    if field == "circular":
        return 2.0 * np.pi * (1.0 - float(np.cos(reach_rad(size, field))))
    x, y = (np.tan(np.radians(0.5 * angle)) for angle in (size.fov_x_deg, size.fov_y_deg))
    return float(4.0 * np.arctan2(x * y, np.sqrt(1.0 + x * x + y * y)))


def distribution_entropy(
    directions: Directions, cells: float, within: Directions | None = None
) -> tuple[float, int]:
    """Return Shannon's entropy of directions over equal cells, in units of the largest possible.

    ``-sum(p ln p) / ln K`` for the shares p of the K cells, and K, which is about ``cells``. With
    ``within``, only the cells of these directions count.

    >>> from starcat.geometry.sphere import saff_kuijlaars
    >>> entropy, count = distribution_entropy(saff_kuijlaars(3000), 286)
    >>> round(entropy, 3), count
    (0.998, 284)
    """
    cell, count = equal_area_cells(directions, cells)
    if within is not None:
        some = np.unique(equal_area_cells(within, cells)[0])
        cell, count = cell[np.isin(cell, some)], len(some)
    if count == 1 or not len(cell):
        return 1.0, count
    share = np.unique(cell, return_counts=True)[1] / len(cell)
    return float(-(share * np.log(share)).sum() / np.log(count)), count


def equal_area_cells(directions: Directions, cells: float) -> tuple[NDArray[np.int64], int]:
    """Return the cell of each direction, and how many cells there are.

    The cells are parts of rings along the declination, nearly square and all of the same area.
    """
    side = np.sqrt(4.0 * np.pi / cells)
    rings = max(1, round(np.pi / side))
    middle = np.sin((np.arange(rings) + 0.5) * np.pi / rings)
    parts = np.maximum(1, np.rint(2.0 * np.pi * middle / side)).astype(np.int64)
    before = np.concatenate([[0], np.cumsum(parts)])
    count = int(before[-1])
    height = 2.0 * before[1:-1] / count - 1.0
    ring = np.searchsorted(height, directions[:, 2], side="right")
    turn = np.arctan2(directions[:, 1], directions[:, 0]) / (2.0 * np.pi) % 1.0
    part = np.minimum((turn * parts[ring]).astype(np.int64), parts[ring] - 1)
    return before[ring] + part, count
