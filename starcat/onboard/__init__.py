"""Onboard images: guide stars and their features as one flat file for flight software."""
