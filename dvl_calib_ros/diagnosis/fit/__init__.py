"""Fits of hypotheses: Gauss-Newton, criteria, cross-validation, parametric bootstrap."""
