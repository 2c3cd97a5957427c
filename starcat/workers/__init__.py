"""Child processes that answer requests: one protocol, and the limits that a system sets to them."""
