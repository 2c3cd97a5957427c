"""Simulation: skies, the frames that a camera makes of them, and the self-test of a build."""

from starcat.rooms import lazy_names

__getattr__ = lazy_names(__name__, __file__)
