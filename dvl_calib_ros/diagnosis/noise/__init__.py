"""The noise of the residual: level, colour, and least squares whitened by it."""
