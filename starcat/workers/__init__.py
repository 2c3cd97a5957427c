"""Child processes that answer requests: one protocol, and the limits that a system sets to them."""

from starcat.rooms import lazy_names

__getattr__ = lazy_names(__name__, __file__)
