"""Readers: convert bytes of archive files to typed columns, and locate every bad record."""
