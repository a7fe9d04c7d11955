"""D1: displacements that dead reckoning gives against positions with metres of noise."""
