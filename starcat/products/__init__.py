"""Room 2: guide stars become the tables that a tracker looks things up in. Pure functions."""
