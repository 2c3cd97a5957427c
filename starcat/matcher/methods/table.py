"""The table of methods: the function that proposes candidates, and the products it needs.

A new method is a module with a function that yields candidates, and one line in `METHODS`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

from starcat.errors import ConfigError, ProductError
from starcat.matcher import levels
from starcat.matcher.database import Database
from starcat.matcher.methods import (
    dynamic_angle,
    grid,
    hausdorff_angular,
    hausdorff_l1,
    hausdorff_l2,
    pairs,
    pyramid,
    radial,
    triangle,
)
from starcat.matcher.methods.candidates import Candidates
from starcat.matcher.methods.triangle_order import TriangleOrder
from starcat.matcher.observation import Observation

Propose = Callable[[Observation, Database, TriangleOrder], Iterator[Candidates]]


@dataclass(frozen=True)
class Method:
    """A way to identify stars.

    Attributes
    ----------
    propose : callable
        Yields batches of candidates for an observation, the most promising first.
    products : tuple of str
        Names of the products that it needs beside the stars.
    description : str
        Description in a few words.
    optional : tuple of str
        Names of products that it can use where they are there.
    """

    propose: Propose
    products: tuple[str, ...]
    description: str = ""
    optional: tuple[str, ...] = ()


METHODS: dict[str, Method] = {
    "triangle": Method(
        triangle.candidates,
        triangle.PRODUCTS,
        "area and circumradius of triangles (S4)",
        (levels.PRODUCT,),
    ),
    "pairs": Method(pairs.candidates, pairs.PRODUCTS, "triangles joined from star pairs"),
    "pyramid": Method(pyramid.candidates, pyramid.PRODUCTS, "such triangles with a fourth star"),
    "hausdorff_angular": Method(
        hausdorff_angular.candidates, hausdorff_angular.PRODUCTS, "sets of separations (S5)"
    ),
    "hausdorff_l2": Method(
        hausdorff_l2.candidates, hausdorff_l2.PRODUCTS, "sets of ratios of distances (S1)"
    ),
    "hausdorff_l1": Method(
        hausdorff_l1.candidates, hausdorff_l1.PRODUCTS, "planar sets of an upright camera (S1)"
    ),
    "dynamic_angle": Method(
        dynamic_angle.candidates, dynamic_angle.PRODUCTS, "neighbours by angle and distance (S2)"
    ),
    "grid": Method(grid.candidates, grid.PRODUCTS, "cells around a star in common"),
    "radial": Method(radial.candidates, radial.PRODUCTS, "rings and sectors in common"),
}
"""Every method by name, the best one first."""


def method_named(name: str) -> Method:
    """Return a method.

    Parameters
    ----------
    name : str
        Name of the method, a key of `METHODS`.

    Returns
    -------
    Method
        The one of that name.

    Raises
    ------
    ConfigError
        If there is none, listing those there are.
    """
    try:
        return METHODS[name]
    except KeyError:
        raise ConfigError(
            f"method {name!r} is unknown; choose one of {', '.join(METHODS)}", value=name
        ) from None


def best_method(products: Iterable[str]) -> str:
    """Return the best method that some products allow.

    Parameters
    ----------
    products : iterable of str
        Names of the products that a database holds.

    Returns
    -------
    str
        The first of `METHODS` whose products are there.

    Raises
    ------
    ProductError
        If no method can work with them.
    """
    there = set(products)
    for name, method in METHODS.items():
        if there.issuperset(method.products):
            return name
    raise ProductError(
        f"no method works with the products {', '.join(sorted(there)) or 'none'} alone; set "
        "'products.triangles.enabled = true' in the spec and build again"
    )
