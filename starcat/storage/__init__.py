"""Storage: files that are either complete or absent, their digests, and downloads."""

from starcat.rooms import lazy_names

__getattr__ = lazy_names(__name__, __file__)
