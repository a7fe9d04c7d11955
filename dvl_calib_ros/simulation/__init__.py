"""The simulator: nonlinear and down to the beams, kept apart from the linear models it is meant to test."""
