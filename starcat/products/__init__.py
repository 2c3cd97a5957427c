"""Room 2: guide stars become the tables that a tracker looks things up in. Pure functions."""

from starcat.rooms import lazy_names

__getattr__ = lazy_names(__name__, __file__)
