"""Onboard images: guide stars and their features as one flat file for flight software."""

from starcat.rooms import lazy_names

__getattr__ = lazy_names(__name__, __file__)
