"""The rules by which stars of a star table become guide stars, one file per rule."""

from starcat.rooms import lazy_names

__getattr__ = lazy_names(__name__, __file__)
