"""What the matcher relies on in a database, and the checks that it is so.

`LAYOUT` says for each product which datasets it has and what they are. An index that leads out
of its table would read something else or end in an error far from its cause, so every one is
checked when the database is opened.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import inf, isfinite, pi
from typing import Any

import numpy as np
from numpy.typing import NDArray

from starcat.errors import ProductError

Arrays = Mapping[str, NDArray[Any]]
Numbers = Mapping[str, float]

LARGEST = 1e6
"""No angle, distance, magnitude or direction of a database is larger, in its own unit."""

RANGES = {
    "ratio": (1.0, 1e20),
    "separation_rad": (0.0, pi),
    "smallest_distance": (0.0, LARGEST),
    # Infinite where three stars are in a line.
    "circumradius_rad": (0.0, inf),
    "fov_x_deg": (0.001, 179.0),
    "fov_y_deg": (0.001, 179.0),
}
"""Narrower and wider ranges of some real numbers, ends included."""

MAY_BE_UNKNOWN = ("mag", "smallest_distance")
"""Real numbers that are NaN where a star has none."""


@dataclass(frozen=True)
class Layout:
    """The datasets and numbers of a product.

    Attributes
    ----------
    texts, wholes, reals : tuple of str
        Columns: texts, integers of any value, and real numbers.
    stars : tuple of str
        Columns that are rows of the stars.
    lists : dict of str to callable
        List columns of integers, each with the number that they stay below, made from the
        product's numbers and the number of stars.
    by_star : bool
        Whether ``star_offsets`` says where the rows of each star begin.
    line : bool
        Whether there is a K-vector: ``kvector_counts`` and its line.
    bins : dict of str to callable
        Look-up tables of rows, ``<name>_offsets`` and ``<name>_rows``, each with the number of
        its bins.
    per_star : tuple of str
        Real numbers, one a star.
    numbers : tuple of str
        Attributes above 0.
    """

    texts: tuple[str, ...] = ()
    wholes: tuple[str, ...] = ()
    reals: tuple[str, ...] = ()
    stars: tuple[str, ...] = ()
    lists: dict[str, Callable[[Numbers, int], float]] = field(default_factory=dict)
    by_star: bool = False
    line: bool = False
    bins: dict[str, Callable[[Numbers], float]] = field(default_factory=dict)
    per_star: tuple[str, ...] = ()
    numbers: tuple[str, ...] = ()

    @property
    def columns(self) -> tuple[str, ...]:
        """Datasets with one value a row."""
        return (*self.texts, *self.wholes, *self.reals, *self.stars)

    @property
    def datasets(self) -> tuple[str, ...]:
        """Names of all datasets."""
        return (
            *self.columns,
            *(name + part for name in self.lists for part in ("_offsets", "_values")),
            *(("star_offsets",) if self.by_star else ()),
            *(("kvector_counts",) if self.line else ()),
            *(name + part for name in self.bins for part in ("_offsets", "_rows")),
            *self.per_star,
        )


LAYOUT: dict[str, Layout] = {
    "stars": Layout(texts=("designation",), wholes=("star_id",), reals=("x", "y", "z", "mag")),
    "boresights": Layout(
        wholes=("boresight", "star_count"),
        reals=("ra_deg", "dec_deg", "x", "y", "z"),
        lists={"brightest": lambda _, count: count},
    ),
    "pairs": Layout(reals=("separation_rad",), stars=("i", "j"), line=True),
    "triangles": Layout(reals=("area_rad2", "circumradius_rad"), stars=("i", "j", "k"), line=True),
    "neighbours": Layout(
        reals=("position_angle_rad", "successive_angle_rad", "separation_rad"),
        stars=("star", "neighbour"),
        by_star=True,
        bins={"lookup": lambda n: n["n_angle_bins"] * n["n_separation_bins"]},
        numbers=("angle_bin_rad", "separation_bin_rad", "n_angle_bins", "n_separation_bins"),
    ),
    "hausdorff_angular": Layout(
        reals=("separation_rad",),
        stars=("star", "neighbour"),
        by_star=True,
        numbers=("radius_rad",),
    ),
    "hausdorff_l2": Layout(
        reals=("ratio",),
        stars=("star", "neighbour"),
        by_star=True,
        per_star=("smallest_distance",),
        numbers=("radius_rad",),
    ),
    "grid": Layout(
        stars=("star", "alignment_star"),
        lists={"cells": lambda n, _: n["cells_per_side"] ** 2},
        bins={"cell": lambda n: n["cells_per_side"] ** 2},
        numbers=("radius_rad", "buffer_rad", "cells_per_side"),
    ),
    "radial": Layout(
        wholes=("sector_pattern",),
        stars=("star",),
        lists={"rings": lambda n, _: n["rings"]},
        bins={"ring": lambda n: n["rings"]},
        numbers=("radius_rad", "rings", "sectors"),
    ),
    "levels": Layout(
        wholes=("level",),
        reals=("fov_x_deg", "fov_y_deg"),
        lists=dict.fromkeys(("stars", "i", "j", "k"), lambda _, count: count),
    ),
}
"""The products of a database, by name."""


def check_product(name: str, arrays: Arrays, numbers: Numbers, star_count: int) -> None:
    """Check that a product is what `LAYOUT` says."""
    layout = LAYOUT[name]
    checks = _Checks(name, arrays, star_count)
    rows = len(arrays[layout.columns[0]])
    for attribute in (*layout.numbers, *(("kvector_intercept", "kvector_slope") * layout.line)):
        if not isfinite(numbers[attribute]) or abs(numbers[attribute]) > LARGEST:
            raise _not_so(name, f"attribute {attribute}", f"is {numbers[attribute]}")
    for attribute in layout.numbers:
        if numbers[attribute] <= 0.0:
            raise _not_so(name, f"attribute {attribute}", f"is {numbers[attribute]}")
    for column in layout.texts:
        checks.shape(column, "S", rows)
    for column in layout.wholes:
        checks.shape(column, "iu", rows)
    for column in layout.reals:
        checks.reals(column, rows)
    for column in layout.per_star:
        checks.reals(column, star_count)
    for column in layout.stars:
        checks.shape(column, "iu", rows)
        checks.below(column, star_count)
    for column, limit in layout.lists.items():
        checks.offsets(f"{column}_offsets", rows, len(arrays[f"{column}_values"]))
        checks.below(f"{column}_values", limit(numbers, star_count))
    if layout.by_star:
        checks.offsets("star_offsets", star_count, rows)
    for table, bins in layout.bins.items():
        checks.offsets(f"{table}_offsets", bins(numbers), len(arrays[f"{table}_rows"]))
        checks.below(f"{table}_rows", rows)
    if layout.line:
        checks.counts("kvector_counts", rows)
        if numbers["kvector_slope"] < 0.0:
            raise _not_so(name, "attribute kvector_slope", "is negative")
    if name == "stars":
        checks.directions()


@dataclass(frozen=True)
class _Checks:
    """The checks of one product's datasets; each raises if the dataset is not so."""

    product: str
    arrays: Arrays
    star_count: int

    def shape(self, name: str, kinds: str, length: float) -> None:
        array = self.arrays[name]
        if array.dtype.kind not in kinds:
            raise _not_so(self.product, name, f"holds {array.dtype}")
        if len(array) != length:
            raise _not_so(self.product, name, f"has {len(array)} entries; expected {length:g}")

    def reals(self, name: str, length: int) -> None:
        self.shape(name, "f", length)
        array = self.arrays[name]
        low, high = RANGES.get(name, (-LARGEST, LARGEST))
        if name in MAY_BE_UNKNOWN:
            array = array[~np.isnan(array)]
        # NaN is neither above nor below anything.
        if len(array) and not (array.min() >= low and array.max() <= high):
            raise _not_so(self.product, name, f"holds numbers outside {low:g} to {high:g}, or NaN")

    def below(self, name: str, limit: float) -> None:
        """Check that all entries lie in [0, limit)."""
        array = self.arrays[name]
        self.shape(name, "iu", len(array))
        if len(array) and not (array.min() >= 0 and array.max() < limit):
            raise _not_so(
                self.product,
                name,
                f"refers to {array.min()} to {array.max()}; there are {limit:g}",
            )

    def offsets(self, name: str, entries: float, end: int) -> None:
        """Check that entries + 1 offsets ascend from 0 to the end of their table."""
        self.shape(name, "iu", entries + 1)
        array = self.arrays[name]
        if array[0] != 0 or array[-1] != end or np.any(array[1:] < array[:-1]):
            raise _not_so(self.product, name, f"does not ascend from 0 to {end}")

    def counts(self, name: str, rows: int) -> None:
        """Check that counts of rows ascend, and that none is above the number of rows."""
        self.shape(name, "iu", rows)
        array = self.arrays[name]
        ends = rows == 0 or (array[0] >= 0 and array[-1] <= rows)
        if not ends or np.any(array[1:] < array[:-1]):
            raise _not_so(self.product, name, f"does not ascend within 0 to {rows}")

    def directions(self) -> None:
        squares = sum(self.arrays[axis] ** 2 for axis in ("x", "y", "z"))
        off = np.abs(squares - 1.0)
        if len(off) and not off.max() < 1e-9:
            row = int(np.argmax(~(off < 1e-9)))
            raise _not_so(self.product, "x, y, z", f"is no unit vector in row {row}")


def _not_so(product: str, what: str, found: str) -> ProductError:
    return ProductError(
        f"{product}/{what} {found}; the database is damaged. Build the artifact again, or fetch "
        "it again",
        product=product,
    )
