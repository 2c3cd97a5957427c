"""Room 1: archive files become one star table, then guide stars and rejected stars."""
