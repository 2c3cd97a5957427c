"""Layouts: the indices, numbers and ranges of the products that the matcher opens.

The matcher checks every dataset that it maps against them, and against the columns of the product's
schema, which stand nowhere else. It must run without pydantic and pyarrow, so this module does not
import them, and the modules of the products take their layouts from it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from math import inf, pi

from starcat.storage.schema import SchemaColumn, product_schema

Numbers = Mapping[str, float]

LARGEST = 1e6
"""No angle, distance, magnitude or direction of a database is larger, in its own unit."""

SMALLEST = 1e-9
"""No radius, bin or number of bins is smaller, so that a division by it stays finite."""

RANGES = {
    "ratio": (1.0, 1e20),
    "separation_rad": (0.0, pi),
    "smallest_distance": (0.0, LARGEST),
    # Infinite if three stars are in a line.
    "circumradius_rad": (0.0, inf),
    "fov_x_deg": (0.001, 179.0),
    "fov_y_deg": (0.001, 179.0),
}
"""Narrower and wider ranges of some real numbers, ends included."""


@dataclass(frozen=True)
class ProductLayout:
    """The datasets and numbers of a product in addition to the columns of its schema."""

    # List columns that do not refer to stars, each with the number that its values stay below, from
    # the product's numbers.
    lists: dict[str, Callable[[Numbers], float]] = field(default_factory=dict)
    # Whether there is ``star_offsets``, the first row of each star.
    by_star: bool = False
    # Whether there is a K-vector: ``kvector_counts`` and its line.
    kvector: bool = False
    # Look-up tables of rows, ``<name>_offsets`` and ``<name>_rows``, with the number of bins.
    bins: dict[str, Callable[[Numbers], float]] = field(default_factory=dict)
    # Real numbers, one per star; NaN for a star without a value.
    per_star: tuple[str, ...] = ()
    # Attributes of at least `SMALLEST`.
    numbers: tuple[str, ...] = ()

    @property
    def indices(self) -> tuple[str, ...]:
        """The datasets."""
        return (
            *(("star_offsets",) if self.by_star else ()),
            *(("kvector_counts",) if self.kvector else ()),
            *(name + part for name in self.bins for part in ("_offsets", "_rows")),
            *self.per_star,
        )


LAYOUTS: dict[str, ProductLayout] = {
    "stars": ProductLayout(),
    "boresights": ProductLayout(),
    "pairs": ProductLayout(kvector=True),
    "triangles": ProductLayout(kvector=True),
    "neighbours": ProductLayout(
        by_star=True,
        bins={"lookup": lambda n: n["n_angle_bins"] * n["n_separation_bins"]},
        numbers=("angle_bin_rad", "separation_bin_rad", "n_angle_bins", "n_separation_bins"),
    ),
    "hausdorff_angular": ProductLayout(by_star=True, numbers=("radius_rad",)),
    "hausdorff_l2": ProductLayout(
        by_star=True, per_star=("smallest_distance",), numbers=("radius_rad",)
    ),
    "grid": ProductLayout(
        lists={"cells": lambda n: n["cells_per_side"] ** 2},
        bins={"cell": lambda n: n["cells_per_side"] ** 2},
        numbers=("radius_rad", "buffer_rad", "cells_per_side"),
    ),
    "radial": ProductLayout(
        lists={"rings": lambda n: n["rings"]},
        bins={"ring": lambda n: n["rings"]},
        numbers=("radius_rad", "rings", "sectors"),
    ),
    "levels": ProductLayout(),
}
"""The products that a method of the matcher reads, by name."""


@cache
def columns_in_database(product: str) -> tuple[SchemaColumn, ...]:
    """Return the columns of a product that the matcher's file has, from its newest schema.

    Examples
    --------
    >>> [column.name for column in columns_in_database("pairs")]
    ['i', 'j', 'separation_rad']
    """
    return tuple(column for column in product_schema(product).columns if column.in_database)


def datasets_of(product: str) -> tuple[str, ...]:
    """Return the names of all datasets of a product that the matcher opens.

    Examples
    --------
    >>> datasets_of("pairs")
    ('i', 'j', 'separation_rad', 'kvector_counts')
    """
    columns = columns_in_database(product)
    names = (name for column in columns for name in column.datasets)
    return (*names, *LAYOUTS[product].indices)
