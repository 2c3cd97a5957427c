"""Artifacts: products become a directory with a manifest; reading, verifying, comparing it."""
