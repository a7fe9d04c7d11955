"""The bank of published models: filter set-up, covariance, observability, cross-validation."""
