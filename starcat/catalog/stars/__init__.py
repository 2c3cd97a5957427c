"""Star tables: their columns, the motions of stars, and the verdicts on records."""

from starcat.rooms import lazy_names

__getattr__ = lazy_names(__name__, __file__)
