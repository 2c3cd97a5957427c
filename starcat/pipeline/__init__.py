"""Pipeline: a spec and archive files become a verified database."""

from starcat.rooms import lazy_names

__getattr__ = lazy_names(__name__, __file__)
