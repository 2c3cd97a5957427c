"""Specs: the request for a build, checked key by key."""

from starcat.rooms import lazy_names

__getattr__ = lazy_names(__name__, __file__)
