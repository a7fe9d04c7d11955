"""The calibration over recorded bags."""
