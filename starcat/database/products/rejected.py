"""The product ``rejected``: records that reading and selection reject as guide stars."""

from __future__ import annotations

from starcat.database.products.kind import ProductKind

KIND = ProductKind(name="rejected", in_database=False, count=None)
