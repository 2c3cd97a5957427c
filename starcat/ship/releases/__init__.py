"""Published versions of databases: registries, publishing, pulling and pinning."""

from starcat.rooms import lazy_names

__getattr__ = lazy_names(__name__, __file__)
