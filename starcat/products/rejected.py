"""The product ``rejected``: records that are no guide stars, which reading and selection make."""

from __future__ import annotations

from starcat.products.kind import ProductKind

POSITION = 20

KIND = ProductKind(name="rejected", in_database=False, count=None, cost=None)
