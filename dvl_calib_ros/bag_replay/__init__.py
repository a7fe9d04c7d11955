"""Calibration over recorded bags."""
