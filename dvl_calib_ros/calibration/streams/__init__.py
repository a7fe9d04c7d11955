"""Order, pairing and interpolation of the three streams."""
