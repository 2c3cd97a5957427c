"""Planning: what a star sensor will see at attitudes of the future, and where it is blind."""
