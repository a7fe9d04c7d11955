"""Forward model: recorded streams, hypotheses and the residual."""
