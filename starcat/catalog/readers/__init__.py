"""Readers: bytes of archive files to typed columns, with the place of every bad record."""
