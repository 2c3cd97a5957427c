"""Pipeline: build a verified database from a spec and archive files."""

from starcat.rooms import lazy_names

__getattr__ = lazy_names(__name__, __file__)
