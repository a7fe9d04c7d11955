"""The simulator: nonlinear, with individual beams, and independent of the linear models that it tests."""
