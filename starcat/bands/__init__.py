"""Magnitudes in the band of a sensor: responses, spectra, and relations between bands."""
