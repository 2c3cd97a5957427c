"""Artifacts: products become a directory with a manifest; reading, verifying, comparing it."""

from starcat.rooms import lazy_names

__getattr__ = lazy_names(__name__, __file__)
