"""Artifacts: write products into a folder with a manifest; read, verify and compare databases."""

from starcat.rooms import lazy_names

__getattr__ = lazy_names(__name__, __file__)
