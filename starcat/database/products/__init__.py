"""Products: the tables, made from guide stars, in which a tracker looks things up."""

from starcat.rooms import lazy_names

__getattr__ = lazy_names(__name__, __file__)
