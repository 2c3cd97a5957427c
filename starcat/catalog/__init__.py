"""Catalogs: archive files become one star table, then guide stars and rejected stars."""

from starcat.rooms import lazy_names

__getattr__ = lazy_names(__name__, __file__)
