"""The table of products: every module of this package with a ``POSITION``, in that order.

The order decides the bytes of a manifest. The section ``[products]`` of a spec, the recipes, the
estimate, the checks of a database and the forms of the service are views of this table: a new
product is a new module with its schema.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from pydantic import create_model

from starcat.plugins import plugin_modules
from starcat.products.kind import ProductKind, ProductSection
from starcat.sections import Section

PRODUCTS: Mapping[str, ProductKind] = MappingProxyType(
    {module.KIND.name: module.KIND for module in plugin_modules("starcat.products")}
)
"""All products by name, in the order of the database."""

USUAL_PRODUCTS = tuple(name for name, kind in PRODUCTS.items() if kind.is_usual)
"""Products that a database has unless its spec leaves them out."""


class ProductSections(Section):
    """Which products the database holds, and their parameters."""

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any: ...

    @property
    def sections(self) -> dict[str, ProductSection]:
        """The sections by product, in the order of the database."""
        return {name: getattr(self, name) for name in type(self).model_fields}

    @property
    def wanted(self) -> dict[str, ProductSection]:
        """The sections of the products that are requested."""
        return {name: section for name, section in self.sections.items() if section.enabled}


if TYPE_CHECKING:
    Products = ProductSections
else:
    Products = create_model(
        "Products",
        __base__=ProductSections,
        __doc__=ProductSections.__doc__,
        **{
            name: (kind.section, kind.section())
            for name, kind in PRODUCTS.items()
            if kind.section is not None
        },
    )
