"""The addresses of the Virtual Observatory's protocols."""
