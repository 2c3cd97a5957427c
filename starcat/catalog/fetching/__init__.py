"""Fetching: where archive files come from, and where they are looked for."""
