"""Planning: the stars that a sensor will see at future attitudes, and the gaps without enough."""
