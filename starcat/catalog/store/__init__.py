"""Catalogs of any size on disk, as HATS: written with Dask, read partition by partition."""

from starcat.rooms import lazy_names

__getattr__ = lazy_names(__name__, __file__)
