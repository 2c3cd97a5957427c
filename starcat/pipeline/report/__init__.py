"""The report of a build: tables, plots and one page, the same bytes for the same build."""

from starcat.rooms import lazy_names

__getattr__ = lazy_names(__name__, __file__)
