"""Tables in the formats that astronomers use, and star tables of other tools."""

from starcat.rooms import lazy_names

__getattr__ = lazy_names(__name__, __file__)
