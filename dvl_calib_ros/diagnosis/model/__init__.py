"""The forward model: recorded streams, hypotheses, and the residual that a hypothesis leaves."""
