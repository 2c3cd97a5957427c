"""Catalogs of any size on disk, as HATS collections: written by Dask, read a partition at a time."""
