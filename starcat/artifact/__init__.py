"""Room 3: products become a directory with a manifest, written whole or not at all."""
