"""Comparison of calibrations of one DVL."""
