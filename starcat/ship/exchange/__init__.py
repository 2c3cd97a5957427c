"""Export of tables to the formats that astronomers use, and of databases to other tools."""

from starcat.rooms import lazy_names

__getattr__ = lazy_names(__name__, __file__)
