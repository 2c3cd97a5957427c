"""The product ``stars``: the guide stars, which the selection makes."""

from __future__ import annotations

from starcat.database.products.kind import ProductKind

KIND = ProductKind(name="stars")
