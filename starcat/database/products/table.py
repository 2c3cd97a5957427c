"""The list of products: the fields of `Products`, in the order of the database.

The section ``[products]`` of a spec, the recipes, the estimate, the checks of a database and the
forms of the service are views of this list: a new product is a new module, its schema and a field.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from types import MappingProxyType

from starcat.database.products import boresights, motions, rejected, stars
from starcat.database.products.crossmatch import Crossmatch
from starcat.database.products.grid import Grid
from starcat.database.products.hausdorff_angular import HausdorffAngular
from starcat.database.products.hausdorff_l2 import HausdorffL2
from starcat.database.products.kind import ProductKind, ProductSection
from starcat.database.products.levels import Levels
from starcat.database.products.neighbours import Neighbours
from starcat.database.products.pairs import Pairs
from starcat.database.products.radial import Radial
from starcat.database.products.triangles import Triangles
from starcat.sections import Section


class Products(Section):
    """Which products the database holds, and their parameters."""

    pairs: Pairs = Pairs()
    triangles: Triangles = Triangles()
    neighbours: Neighbours = Neighbours()
    hausdorff_angular: HausdorffAngular = HausdorffAngular()
    hausdorff_l2: HausdorffL2 = HausdorffL2()
    grid: Grid = Grid()
    radial: Radial = Radial()
    levels: Levels = Levels()
    crossmatch: Crossmatch = Crossmatch()

    @property
    def sections(self) -> dict[str, ProductSection]:
        """The sections by product, in the order of the database."""
        return {name: getattr(self, name) for name in type(self).model_fields}

    @property
    def requested(self) -> dict[str, ProductSection]:
        """The sections of the products that are requested."""
        return {name: section for name, section in self.sections.items() if section.enabled}


WITHOUT_SECTION = (stars.KIND, rejected.KIND, boresights.KIND, motions.KIND)
"""Products that no section of a spec turns on or off."""

OF_SPECS: tuple[ProductKind, ...] = tuple(
    import_module(type(section).__module__).KIND for section in Products().sections.values()
)
"""Products that a spec can leave out: ``KIND`` of the module that defines the section."""

PRODUCTS: Mapping[str, ProductKind] = MappingProxyType(
    {kind.name: kind for kind in (*WITHOUT_SECTION, *OF_SPECS)}
)
"""All products by name, in the order of the database."""

USUAL_PRODUCTS = tuple(name for name, kind in PRODUCTS.items() if kind.is_usual)
"""Products that a database has unless its spec leaves them out."""
