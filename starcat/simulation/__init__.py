"""Simulation: skies, the frames that a camera makes of them, and the self-test of a build."""
