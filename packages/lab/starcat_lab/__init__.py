"""Simulated skies, and how often and how well they are identified."""
