"""Databases in the files of other star identifiers and plate solvers."""
