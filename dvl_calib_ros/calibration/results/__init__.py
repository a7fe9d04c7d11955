"""Results of a calibration, and their verification on held-out data."""
