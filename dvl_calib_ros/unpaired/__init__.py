"""Comparison of a simulator's DVL with a vehicle's, from recordings of different motions."""
