"""The description of a product by its module: one `ProductKind`, which all other packages read.

A module of this package that defines ``KIND`` is a product, and stands in the list of
`starcat.database.products.table`. Its schema describes the columns. Only fields that differ from
their defaults are given: a product that is made from the guide stars alone has a name, a section of
the spec, a function that makes it and a function that counts its rows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from pydantic import Field

from starcat.arrays import Array, Directions
from starcat.database.products.counting import Neighbourhoods
from starcat.database.products.layouts import LAYOUTS, ProductLayout
from starcat.database.products.tiling import FieldSize, FieldStars
from starcat.geometry.camera import Camera
from starcat.sections import Section
from starcat.storage.schema import ProductSchema, product_schema

if TYPE_CHECKING:
    import pyarrow as pa

HALF_FIELD = "default: half of the camera's narrower field"
"""Default of a radius, in words, for its description."""


@dataclass(frozen=True)
class SpecFacts:
    """Facts of the rest of a spec with which the section of a product has to agree."""

    catalog: str  # name of the catalog of the stars
    camera: Camera
    half_field_deg: float  # half of the narrower full angle
    enabled: tuple[str, ...]  # names of the products that the database has


class ProductSection(Section):
    """The section of a spec for a product that can be left out."""

    has_own_fields: ClassVar[bool] = False
    """Whether the product tiles the sphere itself, which `check_fields` may refuse."""

    enabled: bool = Field(True, description="whether the database has this product")

    @property
    def sources(self) -> tuple[str, ...]:
        """Names of the catalogs that the product is made from, without the stars' own catalog."""
        return ()

    def widest_field_deg(self, own_deg: float) -> float:
        """Return the widest horizontal field that the product serves; usually the camera's own."""
        return own_deg

    def check_agrees(self, facts: SpecFacts) -> None:
        """Check the section against the rest of the spec.

        Raises
        ------
        ValueError
            If the two contradict each other. The message begins with ``products.`` and the name.
        """

    def check_fields(self, stars: int, boresights: int, size: FieldSize, max_stars: int) -> None:
        """Check that the product's own tiling, if it has one, is not too large to be counted.

        ``boresights`` and ``size`` are the number and the size of the database's own fields, and
        ``max_stars`` is the largest number of fields, and of stars in them, that are counted.

        Raises
        ------
        ValueError
            If it is too large.
        """


@dataclass(frozen=True)
class ProductInputs:
    """The inputs of every product."""

    directions: Directions  # shape (N, 3): guide stars, ICRS
    mag: Array  # shape (N,)
    fields: FieldStars  # the tiling of the sphere and the stars in each field
    field_size: FieldSize  # size of the tiling's fields
    boresights: int  # number of the tiling's fields
    brightest: int  # stars of a field that make its triangles
    half_field_deg: float  # half of the camera's narrower full angle
    diagonal_rad: float  # diagonal of the camera's field
    requested: Mapping[str, ProductSection]  # sections of the products that are requested

    def radius_rad(self, radius_deg: float | None, factor: float = 1.0) -> float:
        """Return a radius of a spec; None is half of the field, times a factor."""
        if radius_deg is not None:
            return float(np.radians(radius_deg))
        return factor * float(np.radians(self.half_field_deg))

    @cached_property
    def neighbourhoods(self) -> Neighbourhoods:
        """Numbers of neighbours around some of the stars, for the estimate."""
        return Neighbourhoods(self.directions)


@dataclass(frozen=True)
class Extent:
    """How large a product will be."""

    rows: float  # rows of its table
    lists: Mapping[str, float] = field(default_factory=dict)  # entries of each list, all rows
    bins: float = 0.0  # bins of its look-up table
    # pairs or triangles that are gone through to make it, repeats included; 0 if they are the rows
    steps: float = 0.0

    @property
    def worked(self) -> float:
        """Rows that are gone through to make it."""
        return max(self.rows, self.steps)


def row_per_star(inputs: ProductInputs, _: Any) -> Extent:
    """Return the extent of a product that has a row for every star."""
    return Extent(float(len(inputs.directions)))


def neighbour_extent(inputs: ProductInputs, radius_rad: float, bins: float = 0.0) -> Extent:
    """Return the extent of a product whose rows are the neighbours of each star."""
    return Extent(inputs.neighbourhoods.total(radius_rad), bins=bins)


@dataclass(frozen=True)
class ProductKind:
    """The description of a product.

    The functions take the product's own section of the spec as their last argument.
    """

    name: str  # the name in its schema, the spec and the database
    # Makes the product: attributes are named as the columns of the schema, and ``index`` is an
    # `Index`. None if the pipeline makes it from more than guide stars.
    make: Callable[[ProductInputs, Any], Any] | None = None
    section: type[ProductSection] | None = None  # None if every database has the product
    in_database: bool = True  # whether the matcher's HDF5 file has it
    # Its indices. If the matcher opens the product, its layout is in `LAYOUTS`.
    own_layout: ProductLayout = field(default_factory=ProductLayout)
    # Counts it without making it. None if the rows cannot be counted from guide stars.
    count: Callable[[ProductInputs, Any], Extent] | None = row_per_star
    # Bytes of its Parquet file per byte of its columns without texts, measured. Most files have 0.4
    # to 0.7; lists of ascending numbers have less.
    parquet_factor: float = 0.55
    # Yields contradictions in the tables of the product and of the stars.
    problems: Callable[[pa.Table, pa.Table], Iterator[str]] | None = None
    # Counts the stars for which the product uses a catalog; and what these stars have, in words.
    joined: tuple[Callable[[pa.Table, str], int], str] | None = None

    @property
    def schema(self) -> ProductSchema:
        """The newest schema."""
        return product_schema(self.name)

    @property
    def layout(self) -> ProductLayout:
        """Its indices and numbers."""
        return LAYOUTS.get(self.name, self.own_layout)

    @property
    def is_usual(self) -> bool:
        """Whether a database has the product by default, and a spec can leave it out."""
        return self.section is not None and self.section().enabled

    def is_requested(self, inputs: ProductInputs) -> bool:
        """Return whether a database has the product."""
        return self.section is None or self.name in inputs.requested
