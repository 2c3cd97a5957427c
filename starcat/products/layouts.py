"""Layouts: the columns, indices, numbers and ranges of the products that the matcher opens.

The matcher checks every dataset that it maps against them. It must run without pydantic and
pyarrow, so this module imports nothing, and the modules of the products take their layouts from
it. Units and meanings are in the schemas.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import inf, pi

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

MAY_BE_UNKNOWN = ("mag", "smallest_distance")
"""Real numbers that are NaN for a star without a value."""


@dataclass(frozen=True)
class ProductLayout:
    """The datasets and numbers of a product."""

    texts: tuple[str, ...] = ()
    # Integers of any value.
    wholes: tuple[str, ...] = ()
    reals: tuple[str, ...] = ()
    # Rows of the stars.
    stars: tuple[str, ...] = ()
    # List columns of integers, each with the number that its values stay below, from the product's
    # numbers and the number of stars.
    lists: dict[str, Callable[[Numbers, int], float]] = field(default_factory=dict)
    # Whether there is ``star_offsets``, the first row of each star.
    by_star: bool = False
    # Whether there is a K-vector: ``kvector_counts`` and its line.
    kvector: bool = False
    # Look-up tables of rows, ``<name>_offsets`` and ``<name>_rows``, with the number of bins.
    bins: dict[str, Callable[[Numbers], float]] = field(default_factory=dict)
    # Real numbers, one per star.
    per_star: tuple[str, ...] = ()
    # Attributes of at least `SMALLEST`.
    numbers: tuple[str, ...] = ()

    @property
    def columns(self) -> tuple[str, ...]:
        """Datasets with one value per row."""
        return (*self.texts, *self.wholes, *self.reals, *self.stars)

    @property
    def indices(self) -> tuple[str, ...]:
        """Datasets in addition to the columns of the schema."""
        return (
            *(("star_offsets",) if self.by_star else ()),
            *(("kvector_counts",) if self.kvector else ()),
            *(name + part for name in self.bins for part in ("_offsets", "_rows")),
            *self.per_star,
        )

    @property
    def datasets(self) -> tuple[str, ...]:
        """All datasets."""
        lists = (name + part for name in self.lists for part in ("_offsets", "_values"))
        return (*self.columns, *lists, *self.indices)


LAYOUTS: dict[str, ProductLayout] = {
    "stars": ProductLayout(
        texts=("designation",), wholes=("star_id",), reals=("x", "y", "z", "mag")
    ),
    "boresights": ProductLayout(
        wholes=("boresight", "star_count"),
        reals=("ra_deg", "dec_deg", "x", "y", "z"),
        lists={"brightest": lambda _, count: count},
    ),
    "pairs": ProductLayout(reals=("separation_rad",), stars=("i", "j"), kvector=True),
    "triangles": ProductLayout(
        reals=("area_rad2", "circumradius_rad"), stars=("i", "j", "k"), kvector=True
    ),
    "neighbours": ProductLayout(
        reals=("position_angle_rad", "successive_angle_rad", "separation_rad"),
        stars=("star", "neighbour"),
        by_star=True,
        bins={"lookup": lambda n: n["n_angle_bins"] * n["n_separation_bins"]},
        numbers=("angle_bin_rad", "separation_bin_rad", "n_angle_bins", "n_separation_bins"),
    ),
    "hausdorff_angular": ProductLayout(
        reals=("separation_rad",),
        stars=("star", "neighbour"),
        by_star=True,
        numbers=("radius_rad",),
    ),
    "hausdorff_l2": ProductLayout(
        reals=("ratio",),
        stars=("star", "neighbour"),
        by_star=True,
        per_star=("smallest_distance",),
        numbers=("radius_rad",),
    ),
    "grid": ProductLayout(
        stars=("star", "alignment_star"),
        lists={"cells": lambda n, _: n["cells_per_side"] ** 2},
        bins={"cell": lambda n: n["cells_per_side"] ** 2},
        numbers=("radius_rad", "buffer_rad", "cells_per_side"),
    ),
    "radial": ProductLayout(
        wholes=("sector_pattern",),
        stars=("star",),
        lists={"rings": lambda n, _: n["rings"]},
        bins={"ring": lambda n: n["rings"]},
        numbers=("radius_rad", "rings", "sectors"),
    ),
    "levels": ProductLayout(
        wholes=("level",),
        reals=("fov_x_deg", "fov_y_deg"),
        lists=dict.fromkeys(("stars", "i", "j", "k"), lambda _, count: count),
    ),
}
"""The products that a method of the matcher reads, by name."""
