"""The matcher: centroids and a database become identified stars and an attitude.

This package needs only numpy and h5py, so that it can run on a small machine.
"""

from starcat.rooms import lazy_names

__getattr__ = lazy_names(__name__, __file__)
