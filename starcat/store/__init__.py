"""Catalogs of any size on disk, as HATS: written by Dask, read a partition at a time."""
