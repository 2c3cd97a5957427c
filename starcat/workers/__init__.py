"""Child processes that answer requests: their protocol, and limits by the operating system."""

from starcat.rooms import lazy_names

__getattr__ = lazy_names(__name__, __file__)
