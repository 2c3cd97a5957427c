"""The matcher: centroids and an artifact become identified stars and an attitude.

The room needs numpy and h5py only, so that it can run on a small machine.
"""
