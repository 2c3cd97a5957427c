"""The matcher: centroids and an artifact become identified stars and an attitude.

Needs numpy and h5py only: it is the part that someone will put on a small machine.
"""
