"""Geometry: directions, attitudes, cameras and the indices over them; arrays in, arrays out."""
