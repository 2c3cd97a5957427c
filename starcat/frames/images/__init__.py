"""The image path: star images rendered, read from files, measured and drawn."""

from starcat.rooms import lazy_names

__getattr__ = lazy_names(__name__, __file__)
