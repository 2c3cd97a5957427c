"""Catalogs of any size on disk, as HATS: written by Dask, read a partition at a time."""

from starcat.rooms import lazy_names

__getattr__ = lazy_names(__name__, __file__)
