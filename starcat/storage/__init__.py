"""Storage: files that are whole or absent, their digests, and downloads."""
