"""Geometry: directions, attitudes, cameras and the indices over them; arrays in, arrays out."""

from starcat.rooms import lazy_names

__getattr__ = lazy_names(__name__, __file__)
