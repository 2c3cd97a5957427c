"""The image path: star images rendered, read from files, measured and drawn."""
