"""The table of methods: the function that proposes candidates, and the products it needs.

A new method is a function that yields candidates, and one line in `METHODS`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

from starcat.errors import ConfigError, ProductError
from starcat.matcher.database import MatcherDatabase
from starcat.matcher.methods import dynamic_angle, hausdorff, pairs, patterns, triangle
from starcat.matcher.observation import Candidates, Observation


@dataclass(frozen=True)
class Method:
    """A way to identify stars."""

    # Yields batches of candidates for an observation, the most promising first. A method gets the
    # frame and, in the settings of the observation, everything else.
    propose: Callable[[Observation, MatcherDatabase], Iterator[Candidates]]
    products: tuple[str, ...]  # products that it needs beside the stars
    description: str = ""
    optional: tuple[str, ...] = ()  # products that it uses if the database has them


METHODS: dict[str, Method] = {
    "triangle": Method(
        triangle.candidates, ("triangles",), "area and circumradius of triangles (S4)", ("levels",)
    ),
    "pairs": Method(pairs.pair_candidates, ("pairs",), "triangles joined from star pairs"),
    "pyramid": Method(pairs.pyramid_candidates, ("pairs",), "such triangles with a fourth star"),
    "hausdorff_angular": Method(
        hausdorff.angular_candidates, ("hausdorff_angular",), "sets of separations (S5)"
    ),
    "hausdorff_l2": Method(
        hausdorff.ratio_candidates, ("hausdorff_l2",), "sets of ratios of distances (S1)"
    ),
    "hausdorff_l1": Method(
        hausdorff.point_candidates, ("hausdorff_l2",), "planar sets of an upright camera (S1)"
    ),
    "dynamic_angle": Method(
        dynamic_angle.candidates, ("neighbours",), "neighbours by angle and distance (S2)"
    ),
    "grid": Method(patterns.grid_candidates, ("grid",), "cells around a star in common"),
    "radial": Method(patterns.radial_candidates, ("radial",), "rings and sectors in common"),
}
"""Every method by name, the best one first."""


def method_named(name: str) -> Method:
    """Return a method; `ConfigError` lists those there are."""
    try:
        return METHODS[name]
    except (KeyError, TypeError):  # a list has no hash
        raise ConfigError(
            f"method {name!r} is unknown", value=name, hint=f"choose one of {', '.join(METHODS)}"
        ) from None


def best_method(products: Iterable[str]) -> str:
    """Return the first of `METHODS` that some products allow; `ProductError` if none does."""
    there = set(products)
    for name, method in METHODS.items():
        if there.issuperset(method.products):
            return name
    raise ProductError(
        f"no method works with the products {', '.join(sorted(there)) or 'none'} alone",
        hint="set 'products.triangles.enabled = true' in the spec and build again",
    )
