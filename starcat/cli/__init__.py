"""The command line: parse, call one function, print, exit code."""

from starcat.rooms import lazy_names

__getattr__ = lazy_names(__name__, __file__)
