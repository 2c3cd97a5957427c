"""Calibration: identified frames to a camera with its errors."""
