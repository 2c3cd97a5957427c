"""The real sky: positions of its bodies, aberration of starlight, and names of its stars."""

from starcat.rooms import lazy_names

__getattr__ = lazy_names(__name__, __file__)
