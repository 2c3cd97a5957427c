"""Layers between the network and the service: tokens, limits, headers, logs, measurements."""
