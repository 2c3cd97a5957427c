"""Databases: write products into a folder with a manifest, and read, verify and compare it."""

from starcat.rooms import lazy_names

__getattr__ = lazy_names(__name__, __file__)
