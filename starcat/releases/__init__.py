"""Published versions of databases: registries, pulling, pinning."""

from starcat.rooms import lazy_names

__getattr__ = lazy_names(__name__, __file__)
