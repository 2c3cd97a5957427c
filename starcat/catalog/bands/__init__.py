"""Magnitudes in the band of a sensor: responses, spectra, and relations between bands."""

from starcat.rooms import lazy_names

__getattr__ = lazy_names(__name__, __file__)
