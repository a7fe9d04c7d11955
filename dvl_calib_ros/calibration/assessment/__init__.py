"""Predicted drift, next manoeuvre, reasons against a calibration, and the selection of a model."""
