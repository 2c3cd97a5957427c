"""What a camera sends: pictures, calibration, the sky in time, planning."""
