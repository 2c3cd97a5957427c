"""SQL over databases and catalogs."""

from starcat.rooms import lazy_names

__getattr__ = lazy_names(__name__, __file__)
